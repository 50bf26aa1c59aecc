"""The shipped missions with a ringing IMU: hits found, false ones, latency (docs/real_data.md).

python -m tools.campaigns.ringing --runs 10 [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.vehicle import ImuRinging
from dart_flight.samples import ImpactOnset, TruthContact
from dart_flight.worlds.fast import fly_fast
from dart_flight.worlds.prepare import load_flyable

ROOT = Path(__file__).parents[2]
MISSIONS = ("dual_collision", "single_wall")
RINGINGS = {
    "none": None,
    "white 3 m/s2": ImuRinging(white_m_s2=3.0),
    "tone 3 m/s2, 50 to 200 Hz": ImuRinging(tone_m_s2=3.0),
    "both": ImuRinging(white_m_s2=3.0, tone_m_s2=3.0),
}
_NEAR_US = 200_000  # an onset belongs to a true contact that began at most this long before


def fly(name: str, ringing: ImuRinging | None, sigma: float | None, seed: int) -> dict[str, Any]:
    """One flight; `sigma` None is the configured detector."""
    mission = load_flyable(ROOT / "missions" / f"{name}.yaml")
    replace, vehicle = msgspec.structs.replace, mission.vehicle
    detection = vehicle.detection if sigma is None else replace(vehicle.detection, noise_sigma=sigma)
    simulation = replace(vehicle.simulation, imu_ringing=ringing)
    mission = replace(mission, vehicle=replace(vehicle, detection=detection, simulation=simulation))
    onsets: list[int] = []
    contacts: list[TruthContact] = []

    def watch(record: object) -> None:
        if isinstance(record, ImpactOnset):
            onsets.append(record.t_us)
        elif isinstance(record, TruthContact):
            contacts.append(record)

    verdict = fly_fast(mission, seed, None, watch)
    latencies = []
    rest = list(onsets)
    for contact in contacts:
        mine = [t for t in rest if -4_000 <= t - contact.t_us <= contact.end_us - contact.t_us + 20_000]
        if mine:
            latencies.append((mine[0] - contact.t_us) * 1e-3)
            rest.remove(mine[0])
    false = [t for t in rest if not any(0 <= t - c.t_us < _NEAR_US for c in contacts)]
    return {
        "outcome": verdict.outcome.value,
        "reason": verdict.reason,
        "contacts": len(contacts),
        "found": len(latencies),
        "latency_ms": latencies,
        "false": len(false),
        "flight_s": verdict.flight_time_s or 0.0,
        "peak_error": [
            c.measured.peak_force_n / c.truth.peak_force_n - 1.0
            for c in verdict.collisions
            if c.truth is not None and c.truth.peak_force_n and c.measured.peak_force_n is not None
        ],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly all of it; prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--json", type=Path, default=Path("build/ringing.json"))
    parser.add_argument("--only", action="append", choices=tuple(RINGINGS))
    parser.add_argument("--sigma", type=float)
    options = parser.parse_args(arguments)
    rows = []
    for said in options.only or RINGINGS:
        flights = [
            fly(mission, RINGINGS[said], options.sigma, seed)
            for mission in MISSIONS
            for seed in range(1, options.runs + 1)
        ]
        latency = sorted(ms for f in flights for ms in f["latency_ms"])
        errors = sorted(abs(e) for f in flights for e in f["peak_error"])
        row = {
            "ringing": said,
            "flights": len(flights),
            "completed": sum(f["outcome"] == "completed" for f in flights),
            "reasons": sorted({f["reason"] for f in flights if f["reason"]}),
            "contacts": sum(f["contacts"] for f in flights),
            "found": sum(f["found"] for f in flights),
            "false": sum(f["false"] for f in flights),
            "minutes": sum(f["flight_s"] for f in flights) / 60.0,
            "latency_ms_median": latency[len(latency) // 2] if latency else math.nan,
            "latency_ms_worst": latency[-1] if latency else math.nan,
            "peak_error_median": errors[len(errors) // 2] if errors else math.nan,
            "peak_error_worst": errors[-1] if errors else math.nan,
        }
        rows.append(row)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
