"""Processes beside a flight: how they give way to it, how late one runs, and how they are ended."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time

_WATCHING_NICE = 19
_NAP_S, _MEASURE_S = 0.005, 0.5
LATE_S = 0.05  # from here on a flight in real time is in doubt


def stand_back() -> None:
    """Run only where a processor is idle, from now on, with every thread that is started from here.

    A higher nice value alone still has a share, and once it runs a time slice of milliseconds; a process of
    the idle class (sched(7)) gives way at once.
    """
    with contextlib.suppress(OSError):
        os.nice(_WATCHING_NICE)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def measure_lateness_s() -> float:
    """How late this program runs at worst, by half a second of short sleeps; seconds."""
    worst_s, end_s = 0.0, time.monotonic() + _MEASURE_S
    while (now_s := time.monotonic()) < end_s:
        time.sleep(_NAP_S)
        worst_s = max(worst_s, time.monotonic() - now_s - _NAP_S)
    return worst_s


def end_of_input(process: subprocess.Popen[bytes], patience_s: float) -> None:
    """End a process that lives by its standard input: close that, wait, kill it if it stays; never raises."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
