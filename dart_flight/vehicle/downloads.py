"""Downloads from the flight controller: files by MAVLink FTP, logs by MAVLink's log protocol."""

from __future__ import annotations

import contextlib
import os
import queue
import tempfile
import time
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.ftp import Ftp
from mavsdk.plugins.log_files import Entry, LogFiles

from dart_flight.base.errors import FlightError

_SILENT_S = 3.0  # timeout without progress
_LOG_SILENT_S = 15.0  # timeout for a log, which a lossy link delays by repeating chunks
_CANCELLED_S = 2.0  # timeout for the last callback after a cancellation
_RATED_S = 2.0  # time from a download's start until its duration is estimated
_CLOCK_SET = datetime(2020, 1, 1, tzinfo=UTC)  # an earlier date shows that the flight controller had no clock
_ULOG_MAGIC = b"ULog\x01\x12\x35"


class DownloadError(FlightError):
    """A file on the flight controller cannot be downloaded."""


def wait_for_end(
    arrived: queue.SimpleQueue[tuple[Any, Any]],
    what: str,
    progress: Callable[[Any], None] = lambda data: None,
    silent_s: float = _SILENT_S,
) -> None:
    """Wait for the end of a download.

    Args:
        arrived: queue of (result, progress), filled by the download's callback.
        what: name of the download, for error messages.

    Raises:
        DownloadError: the download failed, or made no progress for `silent_s`.
    """
    moved_s, before = time.monotonic(), None
    while True:
        try:
            result, data = arrived.get(timeout=0.2)  # short, so that Ctrl-C is handled
        except queue.Empty:
            if time.monotonic() - moved_s > silent_s:
                raise DownloadError(f"{what}: no data for {silent_s:g} s") from None
            continue
        if result.name == "SUCCESS":
            return
        if result.name != "NEXT":
            raise DownloadError(f"{what}: {result.name.lower().replace('_', ' ')}")
        if str(data) != before:
            moved_s, before = time.monotonic(), str(data)
        progress(data)


def _wait_for_last(arrived: queue.SimpleQueue[tuple[Any, Any]]) -> None:
    """Wait for the last callback of a cancelled download.

    MAVSDK runs the callback on MAVSDK's own thread. If the plugin were destroyed first, the callback would
    end the process with a segmentation fault.
    """
    with contextlib.suppress(queue.Empty):
        while arrived.get(timeout=_CANCELLED_S)[0].name == "NEXT":
            pass


def download_file(system: Any, path: str) -> bytes:
    """Return a small file on the flight controller, by FTP; raise DownloadError if file or FTP is missing."""
    arrived: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
    ftp = Ftp(system)
    with tempfile.TemporaryDirectory() as folder:
        try:
            ftp.download_async(path, folder, True, lambda result, data, _: arrived.put((result, data)))
            wait_for_end(arrived, path)
            return (Path(folder) / Path(path).name).read_bytes()
        finally:
            ftp.destroy()


class Px4LogEntry(msgspec.Struct, frozen=True):
    """A log on the flight controller.

    Attributes:
        id: number in the flight controller's list; the number changes if the list changes.
        ended: time of the last change, or None if the flight controller had no clock.
    """

    id: int
    ended: datetime | None
    size_bytes: int

    def line(self) -> str:
        date = "no date" if self.ended is None else f"ended {self.ended:%Y-%m-%d %H:%M:%S} UTC"
        return f"{self.id}: {date}, {self.size_bytes / 1e6:.1f} MB"


def parse_entry(entry: Entry) -> Px4LogEntry:
    ended = None
    with contextlib.suppress(ValueError):
        date = datetime.fromisoformat(str(entry.date).replace("Z", "+00:00"))
        ended = date if date >= _CLOCK_SET else None
    return Px4LogEntry(int(entry.id), ended, int(entry.size_bytes))


def logs_of_flight(
    entries: Collection[Px4LogEntry],
    armed: tuple[datetime, datetime] | None,
    before: Collection[Px4LogEntry] | None,
) -> list[Px4LogEntry]:
    """Return the logs that may belong to a flight; if the flight's log is identified, return only this log.

    Args:
        armed: arming time and end time of the flight, or None if unknown.
        before: logs on the flight controller before the flight, or None if unknown.
    """
    found = [entry for entry in entries if entry.size_bytes]
    if before is not None:
        known = {(entry.ended, entry.size_bytes) for entry in before}
        found = [entry for entry in found if (entry.ended, entry.size_bytes) not in known]
    if armed is not None and len(found) > 1:
        # PX4 ends a log seconds after disarming, or continues it until power-off.
        dated = [entry for entry in found if entry.ended is not None and entry.ended >= armed[1]]
        if dated:
            first = min(entry.ended for entry in dated if entry.ended is not None)
            return [entry for entry in dated if entry.ended == first]
    return found


class Px4Logs:
    """Access to PX4's logs by MAVLink's log protocol, over an open connection."""

    def __init__(self, system: Any) -> None:
        self._plugin = LogFiles(system)

    def entries(self) -> list[Px4LogEntry]:
        """Return the logs on the flight controller; raise DownloadError if there is no answer."""
        try:
            return [parse_entry(entry) for entry in self._plugin.get_entries()]
        except MavsdkError as error:
            result = getattr(getattr(error, "result", None), "name", str(error))
            if result == "NO_LOGFILES":
                return []
            answer = result.lower().replace("_", " ")
            raise DownloadError(f"cannot read PX4's list of logs: {answer}") from None

    def download(self, entry: Px4LogEntry, path: Path, progress: Callable[[float], None]) -> None:
        """Download a log to a file; if the download is incomplete or interrupted, no file remains.

        Args:
            entry: element of `entries` of this connection.
            progress: receives the fraction received so far, 0 to 1.

        Raises:
            DownloadError: the download failed, or the data is not a ULog.
        """
        part = path.with_name(path.name + ".part")
        part.unlink(missing_ok=True)
        arrived: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
        asked = Entry(entry.id, "", entry.size_bytes)
        try:
            self._plugin.download_log_file_async(
                asked, str(part), lambda result, data, _: arrived.put((result, data))
            )
            try:
                wait_for_end(arrived, path.name, lambda data: progress(data.progress), _LOG_SILENT_S)
            except BaseException:
                with contextlib.suppress(MavsdkError):
                    self._plugin.cancel_download_log_file()
                    _wait_for_last(arrived)
                raise
            with part.open("rb") as file:
                if file.read(len(_ULOG_MAGIC)) != _ULOG_MAGIC:
                    raise DownloadError(f"{path.name}: the received data is not a ULog")
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)

    def close(self) -> None:
        self._plugin.destroy()


class DownloadTime:
    """An estimator of a download's remaining time; it gives a single estimate, after the first seconds.

    `began_s` may be on any clock.
    """

    def __init__(self, size_bytes: int, began_s: float) -> None:
        self._size_bytes, self._began_s, self._is_reported = size_bytes, began_s, False

    def line(self, share: float, now_s: float) -> str | None:
        """Return the remaining time as text, once it is known; `share` is the fraction received so far."""
        elapsed_s = now_s - self._began_s
        if self._is_reported or elapsed_s < _RATED_S or share <= 0.0:
            return None
        self._is_reported = True
        rate = share * self._size_bytes / elapsed_s
        return f"{(1.0 - share) * self._size_bytes / rate / 60.0:.1f} min left at {rate / 1e3:.0f} kB/s"
