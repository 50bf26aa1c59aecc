"""How a process that only watches gives way to a flight on the same machine."""

from __future__ import annotations

import contextlib
import os
import sys

_WATCHING_NICE = 19


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
