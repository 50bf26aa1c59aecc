"""Processes that fly: one that dies, one that raises, Ctrl-C, many items."""

from __future__ import annotations

import errno
import os
import signal
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


def moody(folder: Path, number: int) -> int:
    """Dies of 3 the first time, of 5 always; raises at 7."""
    if number == 5 or (number == 3 and not (folder / "died").exists()):
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 7:
        raise InputError("seven", source="here")
    return number * number


class AwkwardError(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and\n{two}")


def awkward(number: int) -> int:
    raise AwkwardError(number, 2)


class Dead:
    """Cannot be made in another process."""

    def __reduce__(self) -> tuple[object, tuple[int]]:
        return os._exit, (3,)

    def __call__(self, number: int) -> int:
        return number


def flown(results: Iterator[FinishedItem[int, int]]) -> dict[int, int | Failure]:
    found: dict[int, int | Failure] = {}
    for item, result in results:
        assert item not in found
        found[item] = result
    return found


def test_every_item_is_flown_once() -> None:
    assert flown(work(square, range(50), 3, Interrupt())) == {n: n * n for n in range(50)}


def test_items_are_taken_as_they_are_flown() -> None:
    taken: list[int] = []

    def endless() -> Iterator[int]:
        while True:
            taken.append(len(taken))
            yield taken[-1]

    results = work(square, endless(), 2, Interrupt())
    first = [next(results).result for _ in range(10)]
    results.close()
    assert len(first) == 10
    assert len(taken) <= 12


def test_a_process_that_dies_costs_its_own_flight_a_retry(tmp_path: Path) -> None:
    found = flown(work(partial(moody, tmp_path), range(10), 2, Interrupt()))
    assert found[5] == Failure("its process died 2 times")
    seven = found[7]
    assert isinstance(seven, Failure)
    assert isinstance(seven.error, InputError)
    assert seven.what.startswith("InputError: here: seven (test_workers.py:")
    assert {n: r for n, r in found.items() if n not in (5, 7)} == {
        n: n * n for n in range(10) if n not in (5, 7)
    }


def test_a_pool_that_breaks_while_it_starts_a_process_is_renewed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may have closed the pipes that the new process is to get: EBADF instead of a broken pool."""
    submit, calls = ProcessPoolExecutor.submit, count()

    def torn(pool: ProcessPoolExecutor, *what: Any) -> Any:
        if next(calls) == 3:
            raise OSError(errno.EBADF, "Bad file descriptor")
        return submit(pool, *what)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", torn)
    assert flown(work(square, range(10), 2, Interrupt())) == {n: n * n for n in range(10)}


def test_an_exception_that_cannot_travel_is_told_in_words() -> None:
    (result,) = flown(work(awkward, [1], 1, Interrupt())).values()
    assert isinstance(result, Failure)
    assert result.error is None
    assert result.what.startswith("AwkwardError: 1 and 2 (test_workers.py:")


def test_processes_that_cannot_begin_end_it() -> None:
    with pytest.raises(FlightError, match=r"exited before its first flight"):
        list(work(Dead(), range(5), 2, Interrupt()))


def test_an_interrupt_lets_those_under_way_land() -> None:
    with Interrupt() as interrupt:
        results = work(square, range(1000), 2, interrupt)
        found = [next(results)]
        os.kill(os.getpid(), signal.SIGINT)
        found += results
        assert interrupt.count == 1
    assert 1 <= len(found) <= 3
    assert all(done.result == done.item**2 for done in found)


def test_a_second_interrupt_gives_them_up() -> None:
    with Interrupt() as interrupt:
        results = work(square, range(1000), 2, interrupt)
        next(results)
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGHUP)
        assert not list(results)
    with pytest.raises(KeyboardInterrupt):  # afterwards it is as before
        os.kill(os.getpid(), signal.SIGINT)
