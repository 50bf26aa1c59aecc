"""Download of PX4's own log into the flight's folder, for `fly` and `px4-log`.

Both functions raise VehicleError if no vehicle answers at the URL, and DownloadError if the vehicle does not
answer the request.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path

from dart_flight.recording.found import PX4_LOG
from dart_flight.vehicle.downloads import DownloadError, DownloadTime, Px4LogEntry, logs_of_flight
from dart_flight.vehicle.ground_link import GroundLink

_WRITTEN_S = 2.0  # after disarming, PX4 needs up to this time to finish writing the log


def list_px4_logs(url: str, timeout_s: float) -> list[Px4LogEntry]:
    with GroundLink(url, timeout_s) as link, contextlib.closing(link.px4_logs()) as logs:
        return logs.entries()


def fetch_px4_log(
    url: str,
    timeout_s: float,
    folder: Path,
    armed: tuple[datetime, datetime] | None,
    *,
    before: Collection[Px4LogEntry] | None = None,
    choose: Callable[[list[Px4LogEntry]], Px4LogEntry],
    print_line: Callable[[str], None],
    progress: Callable[[float], None] = lambda share: None,
    opened: Callable[[], None] = lambda: None,
) -> Path:
    """Download PX4's log of a flight into the flight's folder and return the path of the file.

    Args:
        url: MAVLink URL of the vehicle, which must be disarmed.
        armed: arming time and end time of the flight, or None if not known.
        before: logs that existed before the flight, or None if not known.
        choose: callback that selects a log if several logs may belong to the flight.
        progress: callback for the received fraction, 0 to 1.
        opened: called when the link is open (`LinkLease.lock_device`).
    """
    path = folder / PX4_LOG
    with GroundLink(url, timeout_s) as link, contextlib.closing(link.px4_logs()) as logs:
        opened()
        link.require_disarmed()
        time.sleep(_WRITTEN_S)
        found = logs_of_flight(logs.entries(), armed, before)
        if not found:
            raise DownloadError("PX4 has no log of this flight: check SDLOG_MODE and the SD card")
        entry = found[0] if len(found) == 1 else choose(found)
        print_line(f"downloading PX4's log {entry.line()}; Ctrl-C skips it")
        expected = DownloadTime(entry.size_bytes, time.monotonic())

        def report(share: float) -> None:
            line = expected.line(share, time.monotonic())
            if line is not None:
                print_line(line)
            progress(share)

        logs.download(entry, path, report)
    return path
