"""The shipped missions with a ringing IMU: hits found, false ones, latency (docs/results/ringing.md).

    python -m tools.campaigns.ringing --runs 50 [--first-seed 1001] [--only KIND]... [--json FILE]

Every contact of the simulated vehicle with a wall is one of three kinds:

- planned: the first one with the wall that the mission hits next;
- again: with a wall that was left less than a second before, as a vehicle that is held near a wall touches
  it again and again;
- other: any other.

A reported onset belongs to the contact during which it came, or that ended at most 20 ms before it. An onset
that belongs to no contact is false. Only planned contacts have to be found; of the others it is said in which
phase of the mission they happened.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.records import ContactEnd, ImpactOnset, Phase, PhaseChange, TruthContact
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import ImuRinging
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable

ROOT = Path(__file__).parents[2]
MISSIONS = ("paper_dual_collision", "paper_single_wall")
RINGINGS = {
    "none": None,
    "white 3 m/s2": ImuRinging(white_m_s2=3.0),
    "tone 3 m/s2, 50 to 200 Hz": ImuRinging(tone_m_s2=3.0),
    "both": ImuRinging(white_m_s2=3.0, tone_m_s2=3.0),
}
_AGAIN_US = 1_000_000  # a contact with a wall that was left less than this before is the same visit
_EARLY_US = 4_000  # an onset may be stamped with the tick in which its contact begins
_LATE_US = 20_000  # an onset this long after its contact still is its own


class Met(msgspec.Struct):
    """One contact of the plant with a wall.

    Attributes:
        kind: planned, again or other, as above.
        collision: index of the planned collision, from 1; None for the other kinds.
        phase: of the mission when the contact began.
        latency_ms: from first force to onset; None: not found.
        end_lag_ms: from last force to the reported end.
    """

    wall: str
    mode: str
    kind: str
    collision: int | None
    phase: str
    normal_m_s: float
    peak_n: float
    lasted_ms: float
    t_us: int
    latency_ms: float | None = None
    end_lag_ms: float | None = None


class Watcher:
    """Collects what the comparison needs from a flight's records."""

    def __init__(self) -> None:
        self.onsets: list[int] = []
        self.ends: list[int] = []
        self.contacts: list[TruthContact] = []
        self.phases: list[tuple[int, Phase]] = []

    def __call__(self, record: object) -> None:
        """Take a record of the flight."""
        if isinstance(record, ImpactOnset):
            self.onsets.append(record.t_us)
        elif isinstance(record, ContactEnd):
            self.ends.append(record.t_us)
        elif isinstance(record, TruthContact):
            self.contacts.append(record)
        elif isinstance(record, PhaseChange):
            self.phases.append((record.t_us, record.after))

    def phase_at(self, t_us: int) -> str:
        """Where the mission stood."""
        at = [phase.value for t, phase in self.phases if t <= t_us]
        return at[-1] if at else Phase.READYING.value


def kinds_of(mission: Mission, watched: Watcher) -> list[Met]:
    """The contacts in order, each with its kind; see the module's docstring."""
    met: list[Met] = []
    left: dict[str, int] = {}  # wall -> end of the last contact with it
    following = 0
    for c in sorted(watched.contacts, key=lambda c: c.t_us):
        again = c.wall in left and c.t_us - left[c.wall] < _AGAIN_US
        planned = (
            not again
            and following < len(mission.collisions)
            and mission.collisions[following].wall.name == c.wall
        )
        following += planned
        left[c.wall] = c.end_us
        met.append(
            Met(
                wall=c.wall,
                mode=c.mode.value,
                kind="planned" if planned else "again" if again else "other",
                collision=following if planned else None,
                phase=watched.phase_at(c.t_us),
                normal_m_s=c.normal_in_m_s,
                peak_n=c.peak_normal_force_n,
                lasted_ms=(c.end_us - c.t_us) * 1e-3,
                t_us=c.t_us,
            )
        )
    return met


def match(met: list[Met], watched: Watcher) -> list[int]:
    """Give every contact its onset and its reported end; returns the onsets that belong to none."""
    rest = sorted(watched.onsets)
    for m in met:
        end_us = m.t_us + round(m.lasted_ms * 1e3)
        mine = [t for t in rest if m.t_us - _EARLY_US <= t <= end_us + _LATE_US]
        if not mine:
            continue
        m.latency_ms = (mine[0] - m.t_us) * 1e-3
        rest.remove(mine[0])
        ends = [t for t in watched.ends if t >= mine[0]]
        m.end_lag_ms = (ends[0] - end_us) * 1e-3 if ends else None
    return rest


def fly(name: str, ringing: ImuRinging | None, sigma: float | None, seed: int) -> dict[str, Any]:
    """One flight; `sigma` None is the configured detector."""
    mission = load_flyable(ROOT / "missions" / f"{name}.yaml")
    replace, vehicle = msgspec.structs.replace, mission.vehicle
    detection = vehicle.detection if sigma is None else replace(vehicle.detection, noise_sigma=sigma)
    simulation = replace(vehicle.simulation, imu_ringing=ringing)
    mission = replace(mission, vehicle=replace(vehicle, detection=detection, simulation=simulation))
    watched = Watcher()
    verdict = fly_fast(mission, seed, None, watched)
    met = kinds_of(mission, watched)
    false = match(met, watched)
    return {
        "mission": name,
        "seed": seed,
        "outcome": verdict.outcome.value,
        "reason": verdict.reason,
        "contacts": [msgspec.to_builtins(m) for m in met],
        "false": [{"t_us": t, "phase": watched.phase_at(t)} for t in false],
        "flight_s": verdict.flight_time_s or 0.0,
        "peak_error": [
            c.measured.peak_force_n / c.truth.peak_force_n - 1.0
            for c in verdict.collisions
            if c.truth is not None and c.truth.peak_force_n and c.measured.peak_force_n is not None
        ],
    }


def summary(said: str, flights: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of one kind of ringing."""
    met = [c for f in flights for c in f["contacts"]]
    planned = [c for c in met if c["kind"] == "planned"]
    errors = sorted(abs(e) for f in flights for e in f["peak_error"])
    row: dict[str, Any] = {
        "ringing": said,
        "flights": len(flights),
        "completed": sum(f["outcome"] == "completed" for f in flights),
        "reasons": Counter(f["reason"].split(":")[0] for f in flights if f["reason"]),
        "minutes": sum(f["flight_s"] for f in flights) / 60.0,
        "false": sum(len(f["false"]) for f in flights),
        "peak_error_median": _middle(errors),
        "peak_error_worst": max(errors, default=math.nan),
    }
    for mode in ("flexible", "rigid"):
        of = [c for c in planned if c["mode"] == mode]
        found = [c for c in of if c["latency_ms"] is not None]
        row[f"planned {mode}"] = {
            "met": len(of),
            "found": len(found),
            "latency_ms_median": _middle([c["latency_ms"] for c in found]),
            "latency_ms_worst": max((c["latency_ms"] for c in found), default=math.nan),
            "end_lag_ms_median": _middle([c["end_lag_ms"] for c in found if c["end_lag_ms"] is not None]),
        }
    row["missed"] = [c for c in planned if c["latency_ms"] is None]
    for kind in ("again", "other"):
        of = [c for c in met if c["kind"] == kind]
        row[kind] = {
            "met": len(of),
            "found": sum(c["latency_ms"] is not None for c in of),
            "phases": Counter(c["phase"] for c in of),
            "strongest_n": max((c["peak_n"] for c in of), default=0.0),
        }
    return row


def _middle(values: list[float]) -> float:
    return sorted(values)[len(values) // 2] if values else math.nan


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly all of it; one line of JSON for each kind of ringing, the file after every flight."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--json", type=Path, default=Path("build/ringing.json"))
    parser.add_argument("--only", action="append", choices=tuple(RINGINGS))
    parser.add_argument("--mission", action="append", choices=MISSIONS)
    parser.add_argument("--sigma", type=float)
    options = parser.parse_args(arguments)
    kept: dict[str, list[dict[str, Any]]] = {said: [] for said in options.only or RINGINGS}
    options.json.parent.mkdir(parents=True, exist_ok=True)
    for said, flights in kept.items():
        for mission in options.mission or MISSIONS:
            for seed in range(options.first_seed, options.first_seed + options.runs):
                flights.append(fly(mission, RINGINGS[said], options.sigma, seed))
                # What is known so far: a long run may be cut short.
                rows = [summary(name, flown) for name, flown in kept.items() if flown]
                options.json.write_text(json.dumps({"summary": rows, "flights": kept}, indent=1))
        sys.stdout.write(json.dumps(summary(said, flights)) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
