"""The description of a flight in its log, and the mission reconstructed from it.

The log contains everything that a replay needs: the mission as written, the mission as flown (with the
vehicle's configuration and all command-line options), the software and the machine. Functions raise
InputError if the data that they need is missing or contradictory.
"""

from __future__ import annotations

import contextlib
import platform
import subprocess
import time
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import msgspec

from dart_flight import __version__
from dart_flight.base.records import StatusSample, World
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.recording.reader import Log, MissingDataError


def describe_flight(mission: Mission, world: World, seed: int | None) -> dict[str, str]:
    """Return the description of a flight that is about to begin.

    `mission_text` is the mission as written, `flown` the resolved mission with its vehicle. `started_utc` and
    `started_monotonic_us` are the same moment on the host's calendar clock and on its monotonic clock.
    """
    about = {
        "mission": mission.name,
        "mission_source": mission.source,
        "flown": msgspec.json.encode(mission).decode(),
        "vehicle": msgspec.json.encode(mission.vehicle).decode(),
        "world": world.value,
        "seed": "" if seed is None else str(seed),
        "software": software_version(),
        "host": f"{platform.node()}, Python {platform.python_version()}",
        "machine": machine(),
        "started_utc": datetime.now(UTC).isoformat(timespec="microseconds"),
        "started_monotonic_us": str(time.monotonic_ns() // 1000),
    }
    try:
        about["mission_text"] = Path(mission.source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):  # the mission was built in Python, or its file is gone
        with contextlib.suppress(InputError):  # no file describes a mission that code has changed
            tree = msgspec.json.encode(mission.to_dict())
            about["mission_text"] = msgspec.json.format(tree, indent=2).decode()
    return about


@lru_cache(maxsize=1)
def machine() -> str:
    """Return the names of the processor and the mathematics library.

    Two machines with the same names produce floating-point results that are equal bit for bit.
    """
    return " ".join((platform.machine(), *platform.libc_ver()))


@lru_cache(maxsize=1)
def software_version() -> str:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return __version__
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty"],
            capture_output=True,
            text=True,
            timeout=2.0,
            check=True,
        )
        return f"{__version__} ({done.stdout.strip()})"
    return __version__


def flown_mission(about: dict[str, str], source: str) -> Mission:
    """Return the mission as flown.

    A key that is not in the log gets its default value.
    """
    text = about.get("flown")
    if text is None:
        raise MissingDataError("the log does not contain its mission", source=source)
    try:
        return msgspec.json.decode(text, type=Mission)
    except msgspec.MsgspecError as error:
        raise InputError(f"this version cannot read the mission in the log: {error}", source=source) from None


def written_mission(about: dict[str, str], source: str) -> tuple[Document, Document]:
    """Return the mission's text and the vehicle's configuration as documents that can be edited."""
    if "mission_text" not in about or "vehicle" not in about:
        raise InputError("the log does not contain its mission's text", source=source)
    text = msgspec.json.format(about["vehicle"], indent=2)
    return Document(about["mission_text"], f"{source}: mission"), Document(text, f"{source}: vehicle")


def parse_written(mission: Document, vehicle: Document) -> Mission:
    """Return the mission that the two documents of `written_mission` define."""
    return parse_mission(mission, vehicle.convert(VehicleConfig))


def armed_span(log: Log) -> tuple[datetime, datetime] | None:
    """Return when the vehicle of a log was first and last armed, on the host's calendar clock.

    Return None if the log does not contain these times, or the flight was in the fast world.
    """
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
