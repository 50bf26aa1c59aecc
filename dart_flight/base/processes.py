"""Processes that run during a flight: their priority, scheduling latency and termination."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import IO, NoReturn

_WATCHING_NICE = 19
_PIPE_BYTES = 1 << 19
_NAP_S, _MEASURE_S = 0.005, 0.5
_ALARM_FACTOR = 3.0  # SIGALRM waits this many times longer than the thread that forces an exit
LATE_S = 0.05  # largest scheduling latency without a risk for a real-time flight


def use_idle_priority() -> None:
    """Run this process, and the threads that it starts later, only while a processor is idle.

    A process with a high nice value would still receive time slices of milliseconds. A process in the idle
    class (sched(7)) yields immediately.
    """
    with contextlib.suppress(OSError):
        os.nice(_WATCHING_NICE)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def measure_lateness_s() -> float:
    """Sleep repeatedly for 0.5 s in total; return the largest delay of a wake-up."""
    worst_s, end_s = 0.0, time.monotonic() + _MEASURE_S
    while (now_s := time.monotonic()) < end_s:
        time.sleep(_NAP_S)
        worst_s = max(worst_s, time.monotonic() - now_s - _NAP_S)
    return worst_s


def exit_within(status: int, patience_s: float) -> NoReturn:
    """Exit with a status; kill the process if it has not exited after `patience_s`.

    Exit functions, and the threads and destructors of libraries such as MAVSDK, may block. A thread ends the
    process if the interpreter still runs. SIGALRM ends a process whose interpreter is blocked, but the status
    is lost; SIGALRM therefore comes later, so that a busy computer can end the interpreter.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()

    def end() -> None:
        time.sleep(patience_s)
        names = [one.name for one in threading.enumerate() if not one.daemon and one.is_alive()]
        with contextlib.suppress(OSError):
            os.write(2, f"forced exit; threads still running: {', '.join(names) or 'none'}\n".encode())
        os._exit(status)

    threading.Thread(target=end, name="exit", daemon=True).start()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, _ALARM_FACTOR * patience_s)
    sys.exit(status)


class ChildProcess(subprocess.Popen[bytes]):
    """A Python module that runs in its own process and session, and exchanges lines with this program.

    Because of the new session, Ctrl-C at the terminal does not reach the module.

    Args:
        module: name of the module, which must exit when its standard input is closed.
        first: first line that is sent to the module; it may have any length.
        on_line: callback, on a separate thread, for every printed line; an empty line means that the module
            ended.
        errors: destination of the module's standard error; None uses this process's standard error.
    """

    def __init__(
        self,
        module: str,
        first: bytes,
        on_line: Callable[[bytes], None],
        errors: IO[bytes] | int | None = None,
    ) -> None:
        super().__init__(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            start_new_session=True,
        )
        assert self.stdin is not None
        self._on_line = on_line
        self.pipe = self.stdin.fileno()
        self.send(first)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            fcntl.fcntl(self.pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # the request of a long contact has 50 kB
        os.set_blocking(self.pipe, False)
        self.listener = threading.Thread(target=self._listen, name=module, daemon=True)
        self.listener.start()

    def send(self, line: bytes) -> bool:
        """Send a line without blocking, from any thread; return False if the pipe is full or closed."""
        assert self.stdin is not None
        try:
            self.stdin.write(line + b"\n")
            self.stdin.flush()
        except (OSError, ValueError):
            return False
        return True

    def end(self, patience_s: float) -> None:
        """Close the standard input, wait up to `patience_s`, then kill the process if needed; never raise."""
        assert self.stdin is not None
        with contextlib.suppress(OSError):
            self.stdin.close()
        try:
            self.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()
        self.listener.join(patience_s)  # read the output that the process wrote before its exit

    def _listen(self) -> None:
        assert self.stdout is not None
        for line in self.stdout:
            self._on_line(line)
        self._on_line(b"")
