"""Worker processes: deaths, exceptions, interrupts, many items."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from dart_flight.base.errors import FlightError
from dart_flight.config.document import InputError
from dart_flight.run.workers import Failure, FinishedItem, Interrupt, work


def square(number: int) -> int:
    return number * number


def square_or_fail(folder: Path, number: int) -> int:
    """Return the square; die at 3 the first time, at 5 always, and raise at 7."""
    if number == 5 or (number == 3 and not (folder / "died").exists()):
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7:
        raise InputError("seven", source="here")
    return number * number


class AwkwardError(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and\n{two}")


def raise_awkward_error(number: int) -> int:
    raise AwkwardError(number, 2)


class DiesOnUnpickling:
    """A callable that ends the worker process in which it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[int]]:
        return os._exit, (3,)

    def __call__(self, number: int) -> int:
        return number


def results_by_item(results: Iterator[FinishedItem[int, int]]) -> dict[int, int | Failure]:
    found: dict[int, int | Failure] = {}
    for item, result in results:
        assert item not in found
        found[item] = result
    return found


def test_every_item_is_flown_once() -> None:
    assert results_by_item(work(square, range(50), 3, Interrupt())) == {n: n * n for n in range(50)}


def test_items_are_consumed_only_as_workers_become_free() -> None:
    drawn: list[int] = []

    def endless() -> Iterator[int]:
        while True:
            drawn.append(len(drawn))
            yield drawn[-1]

    results = work(square, endless(), 2, Interrupt())
    first = [next(results).result for _ in range(10)]
    results.close()
    assert len(first) == 10
    assert len(drawn) <= 12


def test_an_item_whose_process_dies_is_retried_once(tmp_path: Path) -> None:
    found = results_by_item(work(partial(square_or_fail, tmp_path), range(10), 2, Interrupt()))
    assert found[5] == Failure("its process died 2 times")
    seven = found[7]
    assert isinstance(seven, Failure)
    assert isinstance(seven.error, InputError)
    assert seven.what.startswith("InputError: here: seven (test_workers.py:")
    assert {n: r for n, r in found.items() if n not in (5, 7)} == {
        n: n * n for n in range(10) if n not in (5, 7)
    }


def test_a_pool_that_breaks_while_it_starts_a_process_is_renewed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pool may have closed the new process's pipes, which raises EBADF instead of BrokenProcessPool."""
    submit, calls = ProcessPoolExecutor.submit, count()

    def submit_once_broken(pool: ProcessPoolExecutor, *arguments: Any) -> Any:
        if next(calls) == 3:
            raise OSError(errno.EBADF, "Bad file descriptor")
        return submit(pool, *arguments)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", submit_once_broken)
    assert results_by_item(work(square, range(10), 2, Interrupt())) == {n: n * n for n in range(10)}


def test_an_exception_that_cannot_be_pickled_is_reported_as_text() -> None:
    (result,) = results_by_item(work(raise_awkward_error, [1], 1, Interrupt())).values()
    assert isinstance(result, Failure)
    assert result.error is None
    assert result.what.startswith("AwkwardError: 1 and 2 (test_workers.py:")


def test_processes_that_cannot_start_raise_a_flight_error() -> None:
    with pytest.raises(FlightError, match=r"exited before its first flight"):
        list(work(DiesOnUnpickling(), range(5), 2, Interrupt()))


def first_at_once(n: int) -> int:
    """Return the square, and only the first without delay: the others still run when the first is there."""
    time.sleep(2.0 if n else 0.0)
    return n * n


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Handle SIGINT as Python does, although a background shell has started the tests and ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_is_announced_and_lets_running_items_finish() -> None:
    announced: list[int] = []
    with Interrupt(announced.append) as interrupt:
        results = work(first_at_once, range(1000), 2, interrupt)
        found = [next(results)]
        os.kill(os.getpid(), signal.SIGINT)
        found += results
        assert interrupt.count == 1
    assert 1 <= len(found) <= 3
    assert announced == [len(found) - 1], "the items in progress are announced once"
    assert all(done.result == done.item**2 for done in found)


@pytest.mark.usefixtures("interruptible")
def test_a_second_interrupt_abandons_running_items() -> None:
    with Interrupt() as interrupt:
        results = work(first_at_once, range(1000), 2, interrupt)
        next(results)
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert not list(results)
    with pytest.raises(KeyboardInterrupt):  # the previous handler is restored
        os.kill(os.getpid(), signal.SIGINT)


GROUP = """
import signal, sys, time
from pathlib import Path
from dart_flight.run.workers import Interrupt, work
from tests.run.test_workers import slow_square
if __name__ == "__main__":
    signal.signal(signal.SIGHUP, signal.SIG_IGN if "nohup" in sys.argv else signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with Interrupt() as interrupt:
        for n, done in enumerate(work(slow_square, range(6), 2, interrupt)):
            print(done.result, flush=True)
    print("interrupts:", interrupt.count, flush=True)
"""


def slow_square(n: int) -> int:
    time.sleep(0.4)
    return n * n


@pytest.mark.parametrize(
    ("signals", "arguments", "flown", "counted"),
    [
        ([signal.SIGHUP], ["nohup"], 6, 0),
        ([signal.SIGHUP, signal.SIGHUP], [], None, 1),
        ([signal.SIGTERM, signal.SIGTERM], [], None, 1),  # as GNU timeout
    ],
)
def test_a_signal_to_the_whole_group_leaves_the_items_in_progress(
    tmp_path: Path, signals: list[signal.Signals], arguments: list[str], flown: int | None, counted: int
) -> None:
    (tmp_path / "program.py").write_text(GROUP)
    command = [sys.executable, str(tmp_path / "program.py"), *arguments]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=environment
    )
    assert process.stdout is not None
    assert process.stdout.readline() in ("0\n", "1\n")
    for number in signals:
        os.killpg(process.pid, number)
    *results, count = process.stdout.read().splitlines()
    assert count == f"interrupts: {counted}"
    assert process.wait() == 0
    assert len(results) + 1 == flown or (flown is None and 2 <= len(results) + 1 <= 4)


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("unshare"), reason="needs a mount namespace")
def test_a_missing_dev_shm_is_named(tmp_path: Path) -> None:
    program = (
        "from dart_flight.run.workers import Interrupt, work; from tests.run.test_workers import square;"
        "list(work(square, range(2), 2, Interrupt()))"
    )
    script = f"mount -t tmpfs -o ro none /dev/shm || exit 9; exec {sys.executable} -c '{program}'"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-c", script],
        capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    if done.returncode == 9:
        pytest.skip("mounting is not permitted here")
    assert "FlightError: cannot start processes for the flights: Read-only file system; " in done.stderr
    assert "/dev/shm" in done.stderr
