"""Shrink a recorded flight to the core's inputs and decisions, so that it can be kept as a regression.

python -m tests.recording.keep_flight flights/.../flight.mcap tests/data/flights/embedded.mcap

The copy omits truth, force and torque estimates, and everything later than 2 s after the last contact.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec

from dart_flight.base.records import ContactEnd, ForceEstimate, TorqueEstimate
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.schema import INPUTS, OUTPUTS
from dart_flight.recording.writer import LogPart

_AFTER_US = 2_000_000
LEFT_OUT = (ForceEstimate, TorqueEstimate)  # one record per IMU sample


def keep(source: Path, target: Path) -> int:
    """Write the small log and return its size in bytes."""
    log = read_log(source)
    if not log.complete:
        raise SystemExit(f"{source}: the log is cut")
    last = _last_number(log)
    target.unlink(missing_ok=True)
    part = LogPart(target, _without_machine(log.about), 1)
    t_us = 0
    for entry in log.entries:
        t_us = getattr(entry.record, "t_us", 0) or t_us
        kept = isinstance(entry.record, (*INPUTS, *OUTPUTS)) and not isinstance(entry.record, LEFT_OUT)
        if kept and entry.number <= last:
            part.write(entry.record, t_us, entry.number)
    part.finish({"lost": "0"})
    part.close()
    return target.stat().st_size


def _without_machine(about: dict[str, str]) -> dict[str, str]:
    """Return the description without the recording machine's name and folders."""
    flown = msgspec.json.decode(about["flown"])
    flown["source"] = Path(flown["source"]).name
    return {
        **about,
        "flown": msgspec.json.encode(flown).decode(),
        "mission_source": Path(about["mission_source"]).name,
        "host": about["host"].split(", ")[-1],
    }


def _last_number(log: Log) -> int:
    """Return the number of the last input to keep."""
    ends = [e.record.t_us for e in log.entries if isinstance(e.record, ContactEnd)]
    if not ends:
        raise SystemExit(f"{log.source}: no contact")
    until = ends[-1] + _AFTER_US
    return max(e.number for e in log.entries if 0 < getattr(e.record, "t_us", 0) <= until)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(f"{keep(Path(sys.argv[1]), Path(sys.argv[2]))} bytes")
