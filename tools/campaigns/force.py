"""Campaign: force estimate and detection in single hits, hard flying and missions of a body whose IMU rings
(docs/results/force.md).
"""

from __future__ import annotations

import random
from collections.abc import Sequence

import msgspec
import numpy as np

from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.run.fast import fly_fast
from tests.core.force_hits import figures_of, grid
from tests.core.force_quiet import fly_quiet
from tools.campaigns.results import grouped, markdown, median_and_most

HITS = list(grid((0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0), (0.0, 45.0, 120.0, 200.0, 270.0), (0.0, 15.0, 30.0)))
_HITS_PER_RUN, _QUIET_S = 20, 60.0


class Estimated(msgspec.Struct, frozen=True):
    """Hits that reach the threshold, of these detected, other detections, relative peak errors, latencies."""

    expected: int
    found: int
    false: int
    errors: list[float]
    latencies_ms: list[float] = []


def fly(point: Point, seed: int) -> Estimated:
    """Fly twenty hits, a minute without contact, or a mission."""
    noise, part = float(point.case["noise_m_s2"]), point.case["part"]
    if part == "no contact":
        return Estimated(0, 0, len(fly_quiet(point.mission, _QUIET_S, noise, seed).false_hits), [])
    if part == "hits":
        drawn = random.Random(seed).sample(HITS, _HITS_PER_RUN)
        flown = [figures_of(point.mission, hit, noise, 100 * seed + i) for i, hit in enumerate(drawn)]
        hits = [f for f in flown if f.reached]
        found = [f for f in hits if f.onsets]
        false = sum(max(0, f.onsets - f.contacts) for f in flown)
        return Estimated(len(hits), len(found), false, [abs(f.peak_error) for f in found])
    ringing = {"white_m_s2": noise, "tone_m_s2": float(point.case["tone_m_s2"])}
    v = fly_fast(point.mission.replace({"vehicle.simulation.imu_ringing": ringing}), seed, None)
    real = [c for c in v.collisions if c.truth is not None]
    false = len(v.collisions) - len(real) + sum(c.truth is None for c in v.other_contacts)
    errors = [abs(c.force_error) for c in real if c.force_error is not None]
    latencies_ms = [c.detection_latency_ms for c in real if c.detection_latency_ms is not None]
    return Estimated(len(point.mission.collisions), len(real), false, errors, latencies_ms)


_HEADS = ("part", "noise m/s²", "tone m/s²", "hits", "detected", "false", "peak off %: median, 95th, most",
          "ms to the detection: median, most")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every part and level of noise."""
    table = []
    for key, runs in grouped(rows, "part", "noise_m_s2", "tone_m_s2").items():
        errors = [100.0 * error for run in runs for error in run.errors]
        counts = (sum(getattr(run, name) for run in runs) for name in ("expected", "found", "false"))
        peaks = (np.median(errors), np.quantile(errors, 0.95), max(errors)) if errors else ()
        off = ", ".join(f"{figure:.2f}" for figure in peaks) or "-"
        latencies = median_and_most((ms for run in runs for ms in run.latencies_ms), 1)
        table.append([*key, *map(str, counts), off, latencies])
    return markdown(_HEADS, table)
