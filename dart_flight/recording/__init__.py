"""The record of a flight: one MCAP file, written as it goes, readable up to where it was cut."""

from dart_flight.recording.reader import LogEntry, read_log
from dart_flight.recording.writer import FlightLog

__all__ = ["FlightLog", "LogEntry", "read_log"]
