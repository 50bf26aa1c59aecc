"""`make test`: lint, types and all tests.

    python -m tools.run_tests

Tests in real time run first and alone; one that fails is skipped, and counted, if the computer was too busy.
All others run in simulated time and pass at any load; types are checked beside them. Ctrl-C ends everything.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import IO

BEHIND = "--behind"
_PATIENCE_S = 20.0
LINT = ("ruff format --check .", "ruff check .")
REAL_TIME = ("pytest -m 'realtime and not px4' -n 4 --dist worksteal -rs",)  # they mostly wait
TESTS = ("pytest -m 'not realtime and not px4' -n auto --dist worksteal -rs", "pytest -m px4 -rs tests/px4")
TYPES = ("mypy",)


def run(commands: Sequence[str]) -> bool:
    """Run modules one after the other, also after one that fails; whether all were good."""
    good = True
    for command in commands:
        print(f"+ {command}", flush=True)
        good &= finish(subprocess.Popen([sys.executable, "-m", *shlex.split(command)])) == 0
    return good


def finish(process: subprocess.Popen[bytes]) -> int:
    """The exit status of a process; it is ended and waited for when this one is."""
    try:
        return process.wait()
    except KeyboardInterrupt:  # which it has got as well
        process.wait()
        raise
    finally:
        end(process, process.send_signal)


def end(process: subprocess.Popen[bytes], send: Callable[[int], None]) -> None:
    """By Ctrl-C, so that it ends what it has started; where that is ignored, as behind a script, SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if process.poll() is None:
            send(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE_S)


def behind(commands: Sequence[str], output: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start to run commands in a process group of their own."""
    words = [sys.executable, "-m", "tools.run_tests", BEHIND, *commands]
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, process_group=0
    )


def show(said: IO[bytes], process: subprocess.Popen[bytes]) -> None:
    """What a process has said so far and says from now on, to its end."""
    ended = False
    while not ended:
        ended = process.poll() is not None  # before the last look
        sys.stdout.buffer.write(said.read())
        sys.stdout.flush()
        time.sleep(0.2)


def run_both(first: Sequence[str], others: Sequence[str]) -> bool:
    """Run `first` and `others` side by side, then show the output of `others`; whether all were good."""
    with tempfile.NamedTemporaryFile() as output, open(output.name, "rb") as said:
        process = behind(others, output)
        try:
            good = run(first)
            show(said, process)
            return process.wait() == 0 and good
        finally:
            end(process, functools.partial(os.killpg, process.pid))


def main(arguments: Sequence[str]) -> int:
    """Run everything; 0 where all of it was good."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        if arguments[:1] == [BEHIND]:
            good = run(arguments[1:])
        else:
            good = run(LINT) and run(REAL_TIME)
            good &= run_both(TESTS, TYPES)
    except KeyboardInterrupt:
        good = False
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
