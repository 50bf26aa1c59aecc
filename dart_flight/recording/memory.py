"""A flight log in memory: the records that a file would have, and the same reader's object around them."""

from __future__ import annotations

from dart_flight.base.records import Record
from dart_flight.recording.reader import IN_MEMORY, Log, LogEntry


class MemoryLog:
    """Takes the records of one flight, as `FlightLog` does.

    Args:
        about: what describes the flight (`recording.about.describe_flight`).

    Attributes:
        log: what has been taken so far.
    """

    def __init__(self, about: dict[str, str]) -> None:
        self.log = Log(IN_MEMORY, about, {}, [], complete=True)

    shortfall: str | None = None  # memory takes everything

    def put(self, record: Record, number: int) -> None:
        """Take a record; `number` is that of the input it is or follows from."""
        self.log.entries.append(LogEntry(number, record))

    def close(self) -> None:
        """Nothing is left to be done."""
