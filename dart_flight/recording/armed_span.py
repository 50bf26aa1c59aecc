"""The time span in which a recorded flight was armed, by the host's calendar, to find PX4's log of it."""

from __future__ import annotations

from datetime import datetime, timedelta

from dart_flight.base.records import StatusSample, World
from dart_flight.recording.reader import Log


def armed_span(log: Log) -> tuple[datetime, datetime] | None:
    """Return when a recorded flight was armed, and when last, by the host's calendar; None if not known."""
    started, monotonic = log.about.get("started_utc"), log.about.get("started_monotonic_us", "")
    armed = [
        e.record.received_us for e in log.entries if isinstance(e.record, StatusSample) and e.record.armed
    ]
    if started is None or not armed or not monotonic.isdigit() or log.world is World.FAST:
        return None
    try:
        begin = datetime.fromisoformat(started) - timedelta(microseconds=int(monotonic))
        return begin + timedelta(microseconds=armed[0]), begin + timedelta(microseconds=armed[-1])
    except (ValueError, OverflowError):
        return None
