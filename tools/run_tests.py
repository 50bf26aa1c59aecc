"""`make test`: lint, types and all tests; those in real time beside the others.

    python -m tools.run_tests

Tests in real time mostly wait. Meanwhile types and all other tests run in the idle class, which gives way at
once; what they say is shown when those in real time have ended. Ctrl-C ends both.
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

from dart_flight.base.processes import use_idle_priority

BEHIND = "--behind"
_PATIENCE_S = 20.0
LINT = ("ruff format --check .", "ruff check .")
OTHERS = (
    "mypy",
    # The stand-in for PX4 has five seconds to answer, in which the idle class may not have run at all.
    "pytest -m 'not mavlink and not px4' -n auto --dist worksteal -rR --reruns 1 --only-rerun Px4LostError",
)
REAL_TIME = (
    "pytest -m px4 -rs --reruns 1 tests/px4",
    # Two side by side. The guard lands after 100 ms of silence; a shared machine may stall for longer: up to
    # twice more.
    "pytest -m mavlink -n 2 --dist worksteal -rsR --reruns 2 --reruns-delay 1",
)


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
    """Start to run commands in the idle class, in a process group of their own.

    In the same session: where the kernel shares the processor by sessions, a class counts only within one.
    """
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
    """Run `first`, beside it `others` in the idle class, then show what these said; whether all were good."""
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
            use_idle_priority()
            good = run(arguments[1:])
        else:
            good = run(LINT) and run_both(REAL_TIME, OTHERS)
    except KeyboardInterrupt:
        good = False
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
