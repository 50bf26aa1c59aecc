"""A serial cable between two programs: two pseudo-terminals with the data rate and losses of a wire.

A pseudo-terminal has no baud rate, so the cable limits the bytes per second in each direction. Bytes that
arrive while its buffer is full are lost, as in a port without flow control. A test can cut and mend it.
"""

from __future__ import annotations

import os
import pty
import select
import time
import tty

from dart_flight.base.thread_context import ThreadContext

BUFFER_BYTES = 4096  # the kernel's buffer of a serial port
_CHUNK = 4096
_PERIOD_S = 0.001


class SerialWay:
    """One direction of the cable, with the bytes in transit."""

    def __init__(self, rate_bytes_s: float | None) -> None:
        self._rate, self._credit, self._since_s = rate_bytes_s, 0.0, time.monotonic()
        self.waiting = bytearray()
        self.carried = self.dropped = 0
        self._unread = False  # the program at the other end does not read

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
            # An idle wire must not save up credit for a burst.
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
        rate_bytes_s: data rate in each direction; None: unlimited.

    Attributes:
        ends: the two devices.
        cut: whether all sent bytes are lost.
    """

    def __init__(self, rate_bytes_s: float | None = None) -> None:
        self._limit = None if rate_bytes_s is None else BUFFER_BYTES
        self._ways = (SerialWay(rate_bytes_s), SerialWay(rate_bytes_s))
        masters, slaves = zip(*(pty.openpty() for _ in range(2)), strict=True)
        self.ends = (os.ttyname(slaves[0]), os.ttyname(slaves[1]))
        for end in slaves:
            tty.setraw(end)
            os.close(end)  # a program that locks its port rejects one that is open
        for end in masters:
            os.set_blocking(end, False)
        self._masters = masters
        self.cut = False
        super().__init__()

    @property
    def carried(self) -> tuple[int, int]:
        """Numbers of bytes carried from the first end to the second, and back."""
        return self._ways[0].carried, self._ways[1].carried

    @property
    def dropped(self) -> tuple[int, int]:
        """Numbers of bytes lost in both directions, without those that no program reads."""
        return self._ways[0].dropped, self._ways[1].dropped

    def _close(self) -> None:
        for end in self._masters:
            os.close(end)

    def _run(self) -> None:
        a, b = self._masters
        while not self._stop.is_set():
            waits = any(way.waiting for way in self._ways)
            select.select([a, b], [], [], _PERIOD_S if waits else 0.01)
            received = [_read(end) for end in self._masters]
            forward, back = self._ways
            ends = ((forward, received[0], received[1], b), (back, received[1], received[0], a))
            for way, data, opposite, to in ends:
                if opposite is None:
                    way.waiting.clear()  # no program has the other end open
                elif self.cut:
                    way.dropped += len(data or b"")
                else:
                    way.take(data or b"", self._limit)
                    way.pass_on(to)
            if waits or None in received:
                time.sleep(_PERIOD_S / 4)


def _read(end: int) -> bytes | None:
    """Return the bytes received from one end, or None if no program has it open."""
    try:
        return os.read(end, _CHUNK)
    except BlockingIOError:
        return b""
    except OSError:
        return None
