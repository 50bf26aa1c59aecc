"""A serial cable between two programs: two pseudo-terminals, and what a wire does that these do not.

A pseudo-terminal has no baud rate: the cable carries so many bytes a second each way, and what comes while
its buffer is full is lost, byte by byte, as in a port without flow control. It can be cut and mended.
"""

from __future__ import annotations

import os
import pty
import select
import time
import tty

from dart_flight.base.thread_context import ThreadContext

BUFFER_BYTES = 4096  # of the kernel's side of a serial port
_CHUNK = 4096
_PERIOD_S = 0.001


class SerialWay:
    """Bytes on their way from one end to the other."""

    def __init__(self, rate_bytes_s: float | None) -> None:
        self._rate, self._credit, self._since_s = rate_bytes_s, 0.0, time.monotonic()
        self.waiting = bytearray()
        self.carried = self.dropped = 0
        self._unread = False  # whoever has the other end open does not read

    def take(self, data: bytes, limit: int | None) -> None:
        room = len(data) if limit is None else max(0, limit - len(self.waiting))
        self.waiting += data[:room]
        if not self._unread:
            self.dropped += len(data) - min(room, len(data))

    def pass_on(self, to: int) -> None:
        now_s = time.monotonic()
        if self._rate is None:
            count = len(self.waiting)
        else:
            # Never more at once than the wire carries in a few of its periods: credit is not saved up.
            self._credit = min(self._credit + self._rate * (now_s - self._since_s), self._rate * 0.005)
            count = min(len(self.waiting), int(self._credit))
        self._since_s = now_s
        if not count:
            return
        try:
            written = os.write(to, self.waiting[:count])
        except OSError:
            written = 0
        self._unread = written < count
        del self.waiting[:written]
        self.carried += written
        self._credit -= written


class SerialCable(ThreadContext):
    """`with SerialCable(92_160) as cable: open(cable.ends[0]) ...`.

    Args:
        rate_bytes_s: each way; None: as fast as it goes.

    Attributes:
        ends: the two devices.
        cut: True: whatever is sent is lost.
    """

    def __init__(self, rate_bytes_s: float | None = None) -> None:
        self._limit = None if rate_bytes_s is None else BUFFER_BYTES
        self._ways = (SerialWay(rate_bytes_s), SerialWay(rate_bytes_s))
        masters, slaves = zip(*(pty.openpty() for _ in range(2)), strict=True)
        self.ends = (os.ttyname(slaves[0]), os.ttyname(slaves[1]))
        for end in slaves:
            tty.setraw(end)
            os.close(end)  # a program that shares no port refuses one that somebody has open
        for end in masters:
            os.set_blocking(end, False)
        self._masters = masters
        self.cut = False
        super().__init__()

    @property
    def carried(self) -> tuple[int, int]:
        """Bytes from the first end to the second, and back."""
        return self._ways[0].carried, self._ways[1].carried

    @property
    def dropped(self) -> tuple[int, int]:
        """Bytes lost on the wire likewise; what nobody reads is not counted."""
        return self._ways[0].dropped, self._ways[1].dropped

    def _close(self) -> None:
        for end in self._masters:
            os.close(end)

    def _run(self) -> None:
        a, b = self._masters
        while not self._stop.is_set():
            waits = any(way.waiting for way in self._ways)
            select.select([a, b], [], [], _PERIOD_S if waits else 0.01)
            came = [_read(end) for end in self._masters]
            there, back = self._ways
            for way, data, heard, to in ((there, came[0], came[1], b), (back, came[1], came[0], a)):
                if heard is None:
                    way.waiting.clear()  # nobody has the other end open
                elif self.cut:
                    way.dropped += len(data or b"")
                else:
                    way.take(data or b"", self._limit)
                    way.pass_on(to)
            if waits or None in came:
                time.sleep(_PERIOD_S / 4)


def _read(end: int) -> bytes | None:
    """What has come from one end; None: nobody has it open."""
    try:
        return os.read(end, _CHUNK)
    except BlockingIOError:
        return b""
    except OSError:
        return None
