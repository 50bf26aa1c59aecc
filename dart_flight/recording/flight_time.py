"""Flight time: seconds since the first IMU sample, as shown by terminal, CSV, replay and report.

Autopilots count time from their own start. This sample arrives early and does not depend on which records are
shown or were written.
"""

from __future__ import annotations

from collections.abc import Iterable

from dart_flight.base.records import ImuSample, Record


class FlightTime:
    """Converts autopilot times to seconds since the flight's zero; receives the records in order."""

    def __init__(self) -> None:
        self.zero_us: int | None = None

    def add(self, record: Record) -> None:
        if self.zero_us is None and isinstance(record, ImuSample):
            self.zero_us = record.t_us

    def seconds(self, t_us: int) -> float | None:
        return None if self.zero_us is None else (t_us - self.zero_us) * 1e-6


def find_zero(records: Iterable[Record]) -> int:
    """Return the autopilot time of a recorded flight's zero, or the first stamp if there is no IMU sample."""
    time = FlightTime()
    first_us = 0
    for record in records:
        time.add(record)
        if time.zero_us is not None:
            return time.zero_us
        first_us = first_us or getattr(record, "t_us", 0)
    return first_us
