"""Deadman: a small process that kills the app if the app hangs.

MAVSDK repeats the last setpoint from its own thread, so PX4 would not notice a hang of the app. A hang that
holds the interpreter lock also stops every thread of the app that could detect the hang. Therefore the core
thread and the event loop feed a separate process through a pipe. If the core thread or the event loop stops
feeding it, the process kills the app (SIGKILL). The setpoints then stop and PX4's failsafe acts.

`SystemdNotice` is the second protection: systemd's watchdog (`Type=notify`, `WatchdogSec`). The event loop
feeds this watchdog only while the core thread is also alive.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

CORE, LOOP = b"c", b"l"
_ARM, _LET_GO = b"a", b"q"
_OWN_PAUSES = 2.0  # after a pause of this many of its periods, the watcher restarts its timeouts
FEED_PERIOD_S = 0.1  # longest period between two feeds; a shorter period causes more wake-ups
_FEEDS = 5  # number of feeds due within `starve_s`; at least one must arrive
_MIN_S = 0.001
_WORD = struct.Struct("=cd")  # a message and its time, short enough for an atomic write
_MAX_WORDS = 400  # maximum number of messages in one read
_MIN_PAUSE_S = 0.1


class Deadman:
    """The app's side of the deadman.

    Args:
        starve_s: longest permitted time without a feed from the core thread or the event loop.
        note: text file to which a line is written when the app is killed.

    Attributes:
        feed_period_s: period at which core thread and event loop should feed the deadman.
    """

    def __init__(self, starve_s: float, note: Path | None = None) -> None:
        # A handle stays with this process; a process id may later belong to another process.
        self._self = os.pidfd_open(os.getpid())
        self._arguments = [
            *(str(self._self), str(os.getpid()), str(starve_s)),
            str(note.resolve()) if note else "",
        ]
        self.feed_period_s = _period_s(starve_s)
        self._fed_s = {CORE: -math.inf, LOOP: -math.inf}
        self._armed = False
        self._start()

    def _start(self) -> None:
        # -I -S: the watcher needs only the standard library and starts in tens of milliseconds.
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, *self._arguments],
            stdin=subprocess.PIPE,
            pass_fds=(self._self,),
            start_new_session=True,  # Ctrl-C and a closed terminal must not end the watcher
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    @property
    def pid(self) -> int:
        return self._process.pid

    def arm(self) -> None:
        """Arm the deadman, which then kills the app if a feed is missing."""
        self._armed = True
        self._write(_ARM)

    def feed(self, part: bytes) -> None:
        """Report that `CORE` or `LOOP` is alive. Any thread may call this in every step; it never blocks."""
        now = time.monotonic()
        if now - self._fed_s[part] >= self.feed_period_s:
            self._fed_s[part] = now
            self._write(part)

    def restart_if_dead(self) -> None:
        if self._process.poll() is not None:
            self._start()
            if self._armed:
                self._write(_ARM)

    def disarm(self) -> None:
        """After the flight, end the watcher without killing the app."""
        # Keep the pipe open, because the core thread may still write to the pipe.
        self._write(_LET_GO)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)
        with contextlib.suppress(OSError):
            os.close(self._self)

    def _write(self, what: bytes) -> None:
        # Ignore errors: a full pipe holds enough feeds, and the event loop restarts a dead watcher.
        with contextlib.suppress(OSError, ValueError):
            os.write(self._pipe, _WORD.pack(what, time.monotonic()))


class SystemdNotice:
    """Sender of messages to systemd (sd_notify) over $NOTIFY_SOCKET; does nothing without this variable."""

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        values = os.environ if environment is None else environment
        address = values.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")):
            self._address = "\0" + address[1:] if address.startswith("@") else address
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        usec = values.get("WATCHDOG_USEC", "")
        mine = values.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._period_s = 0.5e-6 * int(usec) if usec.isdigit() and mine else None
        self._sent_s = -math.inf

    def ready(self, status: str) -> None:
        self._send(f"READY=1\nSTATUS={status}")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feed systemd's watchdog if half its timeout has passed since the last feed; call often."""
        now = time.monotonic()
        if self._period_s is not None and now - self._sent_s >= self._period_s:
            self._sent_s = now
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), self._address)


def _period_s(starve_s: float) -> float:
    return min(FEED_PERIOD_S, starve_s / _FEEDS)


# --- the process -------------------------------------------------------------------------------------------


def _watch(handle: int, pid: int, starve_s: float, note: str) -> int:
    """Read the pipe until the flight or the app ends; kill the app if feeds stop. Return the exit status."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.set_blocking(0, False)
    period_s = _period_s(starve_s)
    own_pause_s = max(_MIN_PAUSE_S, _OWN_PAUSES * period_s)
    armed = False
    looked_s = time.monotonic()
    fed_s = {CORE: looked_s, LOOP: looked_s}
    while True:
        # Poll, because waking up for every message is expensive; each message contains its time.
        left_s = min(fed_s.values()) + starve_s - time.monotonic() if armed else period_s
        time.sleep(max(_MIN_S, min(period_s, left_s)))
        now = time.monotonic()
        try:
            words = _read_messages()
        except EOFError:
            return 0
        for word, sent_s in words:
            if word == _LET_GO:
                return 0
            if word in fed_s:
                fed_s[word] = max(fed_s[word], sent_s)
        arming = any(word == _ARM for word, _ in words)
        if arming or now - looked_s > own_pause_s:
            # Restart the timeouts: the app has just armed the deadman, or this process itself was suspended.
            armed = armed or arming
            fed_s = dict.fromkeys(fed_s, now)
        looked_s = now
        starved = [part for part, at_s in fed_s.items() if now - at_s > starve_s]
        if armed and starved:
            names = " and ".join("core thread" if part == CORE else "event loop" for part in starved)
            _kill(handle, pid, f"{names} silent for {now - min(fed_s.values()):.3f} s", note)
            return 1


def _read_messages() -> list[tuple[bytes, float]]:
    """Return the new messages with their times; raise EOFError if the app has ended."""
    words: list[tuple[bytes, float]] = []
    while True:
        try:
            food = os.read(0, _MAX_WORDS * _WORD.size)
        except BlockingIOError:
            return words
        if not food:
            if words:
                return words  # EOFError follows in the next call
            raise EOFError
        words += _WORD.iter_unpack(food)


def _kill(handle: int, pid: int, why: str, note: str) -> None:
    with contextlib.suppress(OSError):
        signal.pidfd_send_signal(handle, signal.SIGKILL)
    # The load helps to distinguish a hang from a busy computer.
    with contextlib.suppress(OSError):
        why += f" (load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors)"
    line = f"deadman: {why}, killed process {pid} at monotonic {time.monotonic():.3f} s\n"
    with contextlib.suppress(OSError):
        os.write(2, line.encode())
    if note:
        with contextlib.suppress(OSError), open(note, "a", encoding="utf-8") as file:
            file.write(line)


if __name__ == "__main__":
    sys.exit(_watch(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]))
