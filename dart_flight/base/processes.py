"""Processes beside a flight: how they give way to it, how late one runs, and how they are ended."""

from __future__ import annotations

import contextlib
import fcntl
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import IO

_WATCHING_NICE = 19
_PIPE_BYTES = 1 << 19
_NAP_S, _MEASURE_S = 0.005, 0.5
LATE_S = 0.05  # from here on a flight in real time is in doubt


def use_idle_priority() -> None:
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


class ChildProcess(subprocess.Popen[bytes]):
    """A module of ours in a process and session of its own: lines in, lines out. Ctrl-C is not its business.

    Args:
        module: what it runs; it must end when its standard input does.
        first: line that it is told first, however long.
        take: gets every line that it says, on a thread of its own; an empty one when it says no more.
        errors: where its standard error goes; None: where this process's goes.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self, module: str, first: bytes, take: Callable[[bytes], None], errors: IO[bytes] | int | None = None
    ) -> None:
        super().__init__(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
        )
        assert self.stdin is not None
        self._take = take
        self.pipe = self.stdin.fileno()
        self.send(first)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            fcntl.fcntl(self.pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # a long contact takes 50 kB
        os.set_blocking(self.pipe, False)
        self.listener = threading.Thread(target=self._listen, name=module, daemon=True)
        self.listener.start()

    def send(self, line: bytes) -> bool:
        """Tell it a line; any thread, never blocks. False: it does not take it, or is gone."""
        assert self.stdin is not None
        try:
            self.stdin.write(line + b"\n")
            self.stdin.flush()
        except (OSError, ValueError):
            return False
        return True

    def end(self, patience_s: float) -> None:
        """Close its standard input, wait, kill it if it stays; never raises."""
        assert self.stdin is not None
        with contextlib.suppress(OSError):
            self.stdin.close()
        try:
            self.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()
        self.listener.join(patience_s)  # output written before the end still counts

    def _listen(self) -> None:
        assert self.stdout is not None
        for line in self.stdout:
            self._take(line)
        self._take(b"")
