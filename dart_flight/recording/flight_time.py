"""The zero of a flight's time, the same in terminal, CSV, replay and report: its first IMU sample.

Autopilots count from their own start. The first sample that reaches the program is known from the beginning
on, whatever comes later and however little of the rest is shown or was written.
"""

from __future__ import annotations

from collections.abc import Iterable

from dart_flight.base.records import ImuSample, Record


class FlightTime:
    """Takes the records of a flight in order, and gives seconds since its zero.

    Attributes:
        zero_us: the autopilot's time that is 0 s; None until it is known.
    """

    def __init__(self) -> None:
        self.zero_us: int | None = None

    def take(self, record: Record) -> None:
        """Take the next record; only the first IMU sample matters."""
        if self.zero_us is None and isinstance(record, ImuSample):
            self.zero_us = record.t_us

    def seconds(self, t_us: int) -> float | None:
        """Seconds since the zero; None before it is known."""
        return None if self.zero_us is None else (t_us - self.zero_us) * 1e-6


def zero_of(records: Iterable[Record]) -> int:
    """The autopilot's time that is 0 s of a recorded flight, microseconds.

    A log without any IMU sample counts from its first record that has a time.
    """
    time = FlightTime()
    first_us = 0
    for record in records:
        time.take(record)
        if time.zero_us is not None:
            return time.zero_us
        first_us = first_us or getattr(record, "t_us", 0)
    return first_us
