"""The record of a flight: MCAP files, written as it goes, readable up to where they were cut."""

from dart_flight.recording.reader import Log, LogEntry, read_log
from dart_flight.recording.writer import FlightLog

__all__ = ["FlightLog", "Log", "LogEntry", "read_log"]
