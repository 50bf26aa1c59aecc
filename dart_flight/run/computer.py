"""State of the computer for the flight's log: temperature, undervoltage and throttling.

A Raspberry Pi reports undervoltage and throttling as flags in one word, for the current state and for the
time since power-on. Other computers report at most a temperature.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from dart_flight.base.records import ComputerSample, Record
from dart_flight.base.thread_context import ThreadContext
from dart_flight.vehicle.clock import host_us

_PERIOD_S = 1.0
_FLAGS = "sys/devices/platform/soc/soc:firmware/get_throttled"  # the word of `vcgencmd get_throttled`
_ZONES = "sys/class/thermal"
_UNDERVOLTAGE, _FREQUENCY_CAPPED, _THROTTLED, _SOFT_LIMIT = 1, 2, 4, 8
_SINCE_START = 16  # bit offset of the flags that were set at any time since power-on


def read_computer(root: Path = Path("/")) -> ComputerSample:
    """Return the current state from the kernel; a field that the kernel does not report is None."""
    flags = None
    with contextlib.suppress(OSError, ValueError):
        flags = int((root / _FLAGS).read_text(), 16)
    held_back = _FREQUENCY_CAPPED | _THROTTLED | _SOFT_LIMIT
    return ComputerSample(
        host_us(),
        _hottest_c(root),
        None if flags is None else bool(flags & _UNDERVOLTAGE),
        None if flags is None else bool(flags & held_back),
        None if flags is None else bool(flags >> _SINCE_START & _UNDERVOLTAGE),
        None if flags is None else bool(flags >> _SINCE_START & held_back),
    )


def _hottest_c(root: Path) -> float | None:
    found = []
    for zone in sorted((root / _ZONES).glob("thermal_zone*/temp")):
        with contextlib.suppress(OSError, ValueError):
            found.append(int(zone.read_text()) * 1e-3)
    return max(found, default=None)


class ComputerWatch(ThreadContext):
    """Context in which a thread delivers a sample of the computer's state once per second."""

    def __init__(self, deliver: Callable[[Record], None]) -> None:
        super().__init__()
        self._deliver = deliver

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s += _PERIOD_S
            self._deliver(read_computer())
