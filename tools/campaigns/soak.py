"""An hour of hovering: does memory, do descriptors, threads or the log grow other than they should?

    python -m tools.campaigns.soak                    # an hour in real time, through MAVSDK
    python -m tools.campaigns.soak --minutes 10
    python -m tools.campaigns.soak --speed 3          # the same hour in twenty minutes, where the machine can

`dry-run` flies a mission that holds a waypoint, in a process of its own; this one looks at it once in a
minute of flight, through /proc. It fails where memory grows by more than 8 MB from the third minute to the
last (the index of one part of the log, and what Python keeps in reserve), or where descriptors or threads
become more. The simulated battery lasts 13 minutes and ends nothing here. `--set KEY=VALUE` is for `dry-run`:
on a busy machine longer silences.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

_HOLD_MAX_S = 600.0  # of one waypoint
_SETTLED_MINUTES = 3
_GROWTH_MB = 8.0
_LANDING_S = 90.0


class Minute(NamedTuple):
    """What the process has, at the end of a minute of flight."""

    minute: int
    memory_mb: float  # resident
    descriptors: int
    threads: int
    log_mb: float  # of all parts


def mission_of(minutes: float) -> dict[str, object]:
    """A mission that hovers for so long, and hits nothing."""
    holds = [_HOLD_MAX_S] * int(60.0 * minutes // _HOLD_MAX_S)
    holds += [60.0 * minutes % _HOLD_MAX_S] if 60.0 * minutes % _HOLD_MAX_S else []
    return {
        "version": 1,
        "name": "soak",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": [0.0, 0.0], "capture_radius_m": 0.2, "hold_s": 1.0},
        "bounds_m": {"x": [-2.0, 2.0], "y": [-2.0, 2.0], "z": [0.3, 2.0]},
        "waypoints": [{"position_m": [0.3 * (i % 2), 0.0], "hold_s": hold} for i, hold in enumerate(holds)],
        "walls": {},
        "collisions": [],
    }


def look(pid: int, minute: int, folder: Path) -> Minute:
    """One line of the table.

    Raises:
        OSError: the process has ended.
    """
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line
    )
    log_bytes = sum(path.stat().st_size for path in folder.rglob("*.mcap"))
    return Minute(
        minute,
        int(status["VmRSS"].split()[0]) / 1024.0,
        len(os.listdir(f"/proc/{pid}/fd")),
        int(status["Threads"]),
        log_bytes / 1e6,
    )


def soak(
    minutes: float, speed: float, folder: Path, settings: Sequence[str] = ()
) -> tuple[list[Minute], int]:
    """Fly; returns the minutes, and the flight's exit status."""
    path = folder / "soak.yaml"
    path.write_text(yaml.safe_dump(mission_of(minutes), sort_keys=False))
    words = ["dry-run", str(path), "--speed", f"{speed:g}", "--log-dir", str(folder), "--json"]
    always = ("guard.battery_remaining=0", "guard.battery_v=0")
    words += [word for setting in (*always, *settings) for word in ("--set", setting)]
    found: list[Minute] = []
    command = [sys.executable, "-m", "dart_flight", *words]
    with (folder / "verdict.json").open("wb") as out, subprocess.Popen(command, stdout=out) as flight:
        began_s = time.monotonic()
        for minute in range(1, int(minutes) + 1):
            while time.monotonic() - began_s < 60.0 * minute / speed and flight.poll() is None:
                time.sleep(0.5)
            if flight.poll() is not None:
                break
            found.append(look(flight.pid, minute, folder))
            print("{:4d} min {:7.1f} MB {:4d} descriptors {:3d} threads, log {:6.1f} MB".format(*found[-1]))
            sys.stdout.flush()
        status = flight.wait(_LANDING_S + 60.0 * minutes)
    return found, status


def problems(found: list[Minute]) -> list[str]:
    """What has grown that should not."""
    settled = found[_SETTLED_MINUTES - 1 :]
    if len(settled) < 2:
        return ["the flight was too short to tell"]
    first, last = settled[0], settled[-1]
    wrong = []
    if last.memory_mb - first.memory_mb > _GROWTH_MB:
        minutes = last.minute - first.minute
        wrong.append(f"memory grew by {last.memory_mb - first.memory_mb:.1f} MB in {minutes} minutes")
    for name in ("descriptors", "threads"):
        more = getattr(last, name) - getattr(first, name)
        if more > 0:
            wrong.append(f"{more} {name} more")
    return wrong


def main() -> int:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of flight (default 60)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (default 1)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for `dry-run`")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found, status = soak(arguments.minutes, arguments.speed, Path(folder), arguments.set)
        wrong = problems(found) + ([f"the flight ended with status {status}"] if status else [])
        if status:
            sys.stdout.write((Path(folder) / "verdict.json").read_text()[:1000])
    print("\n".join(wrong) or "nothing grew")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
