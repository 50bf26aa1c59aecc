"""`make test` and `make test-rest`; each test runs in one of these two commands.

    python -m tools.run_tests          lint, types, and the tests without a mark of the next line
    python -m tools.run_tests --rest   the tests that are marked realtime, browser, px4 or rest
    python -m tools.run_tests --list   print the pytest commands of `make test` and `make test-rest`

Real-time tests run first and alone. If such a test exceeds a time limit while the computer is busy, it counts
as skipped. If a real-time test or a test in the browser fails, it runs once more without the others, because
the computer may have suspended one process only. All other tests run in simulated time and pass at any load.
Types are checked in parallel. Ctrl-C ends everything.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

IN_BACKGROUND, THE_REST, LIST = "--behind", "--rest", "--list"
_PATIENCE_S = 20.0
LINT = ("ruff format --check .", "ruff check .")
REST = "realtime or browser or px4 or rest"


def _files_with(mark: str) -> str:
    """Return the test files that name a mark, because each worker needs 5 s to collect all test files."""
    paths = sorted(Path("tests").rglob("test_*.py"))
    return " ".join(str(path) for path in paths if re.search(rf"\b{mark}\b", path.read_text("utf-8")))


TESTS = (f"pytest -m 'not ({REST})' -n auto --dist worksteal -rs",)
# Use three workers, because these tests mostly wait.
REAL_TIME = f"pytest -m 'realtime and not px4' -n 3 --dist worksteal -rs {_files_with('realtime')}"
BROWSER = f"pytest -m browser -n 2 --dist worksteal -rs {_files_with('browser')}"
REPEATED = (REAL_TIME, BROWSER)
REST_TESTS = (
    *REPEATED,
    f"pytest -m 'rest and not realtime and not px4' -n auto --dist worksteal -rs {_files_with('rest')}",
    "pytest -m px4 -rs tests/px4",
)
TYPES = ("mypy",)


def again(command: str) -> str:
    """Return the command that runs what failed once more, one test after the other."""
    return re.sub(r"-n \d --dist worksteal", "-n 0 --last-failed --last-failed-no-failures none", command)


def run(commands: Sequence[str]) -> bool:
    """Run modules one after the other, also after a failure; return whether all succeeded."""
    good = True
    for command in commands:
        print(f"+ {command}", flush=True)
        good &= finish(subprocess.Popen([sys.executable, "-m", *shlex.split(command)])) == 0
    return good


def finish(process: subprocess.Popen[bytes]) -> int:
    """Wait for a process and return its exit status; end it if this process is interrupted."""
    try:
        return process.wait()
    except KeyboardInterrupt:  # the child received the interrupt, too
        process.wait()
        raise
    finally:
        end(process, process.send_signal)


def end(process: subprocess.Popen[bytes], send: Callable[[int], None]) -> None:
    """End a process by SIGINT, so that it ends its children, and by SIGTERM if it ignores SIGINT."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if process.poll() is None:
            send(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE_S)


def start_in_background(commands: Sequence[str], output: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start commands in a separate process group, with their output in a file."""
    words = [sys.executable, "-m", "tools.run_tests", IN_BACKGROUND, *commands]
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, process_group=0
    )


def show(output: IO[bytes], process: subprocess.Popen[bytes]) -> None:
    """Print the output of a process until it ends."""
    ended = False
    while not ended:
        ended = process.poll() is not None  # checked before the last read, so that no output is lost
        sys.stdout.buffer.write(output.read())
        sys.stdout.flush()
        time.sleep(0.2)


def run_both(first: Sequence[str], others: Sequence[str]) -> bool:
    """Run `first` and `others` in parallel, print the output of `others`, and return the overall success."""
    with tempfile.NamedTemporaryFile() as written, open(written.name, "rb") as output:
        process = start_in_background(others, written)
        try:
            good = run(first)
            show(output, process)
            return process.wait() == 0 and good
        finally:
            end(process, functools.partial(os.killpg, process.pid))


def main(arguments: Sequence[str]) -> int:
    """Run everything and return 0 if all succeeded."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        if arguments[:1] == [IN_BACKGROUND]:
            good = run(arguments[1:])
        elif arguments == [LIST]:
            print(*TESTS, *REST_TESTS, sep="\n")
            good = True
        elif arguments == [THE_REST]:
            good = True
            for tests in REPEATED:
                good &= run([tests]) or run([again(tests)])
            good &= run(REST_TESTS[len(REPEATED) :])
        else:
            good = run(LINT) and run_both(TESTS, TYPES)
    except KeyboardInterrupt:
        good = False
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
