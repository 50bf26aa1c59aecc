"""Files of the flight controller, by MAVLink FTP and by PX4's log protocol."""

from __future__ import annotations

import queue
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavsdk.plugins.ftp import Ftp

from dart_flight.base.errors import FlightError

_SILENT_S = 3.0  # without progress


class DownloadError(FlightError):
    """A file of the flight controller cannot be downloaded."""


def wait_for_end(
    arrived: queue.SimpleQueue[tuple[Any, Any]], what: str, progress: Callable[[Any], None]
) -> None:
    """Wait for the end of a download, whose callback puts results and progress.

    Raises:
        DownloadError: it failed, or made no progress for 3 s.
    """
    moved_s, before = time.monotonic(), None
    while True:
        try:
            result, data = arrived.get(timeout=0.2)  # short, so that Ctrl-C is handled
        except queue.Empty:
            if time.monotonic() - moved_s > _SILENT_S:
                raise DownloadError(f"{what}: no data for {_SILENT_S:g} s") from None
            continue
        if result.name == "SUCCESS":
            return
        if result.name != "NEXT":
            raise DownloadError(f"{what}: {result.name.lower().replace('_', ' ')}")
        if str(data) != before:
            moved_s, before = time.monotonic(), str(data)
        progress(data)


def download_file(system: Any, path: str) -> bytes:
    """Return the content of a small file of the flight controller, by MAVLink FTP.

    Raises:
        DownloadError: there is no such file, or the flight controller has no FTP.
    """
    arrived: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
    ftp = Ftp(system)
    with tempfile.TemporaryDirectory() as folder:
        try:
            ftp.download_async(path, folder, True, lambda result, data, _: arrived.put((result, data)))
            wait_for_end(arrived, path, lambda data: None)
            return (Path(folder) / Path(path).name).read_bytes()
        finally:
            ftp.destroy()
