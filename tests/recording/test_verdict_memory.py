"""The memory of a verdict does not depend on the flight's duration, and its figures cover all of it."""

from __future__ import annotations

import math
import random
import tracemalloc
from pathlib import Path

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import Mode, OdometrySample, Phase, PhaseChange, TruthSample, World
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.recording.verdict import PositionError, VerdictBuilder
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights

MISSION = load_flyable(packaged("missions", "single_wall.yaml"))


def hover(builder: VerdictBuilder, minutes: float, from_us: int) -> int:
    """Add odometry and truth at 125 Hz, as in a simulated flight, and return the next stamp."""
    t_us = from_us
    for _ in range(round(minutes * 60 * 125)):
        builder.add(
            TruthSample(t_us, (0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), Mode.RIGID)
        )
        builder.add(OdometrySample(t_us, t_us, (0.0, 0.01, -1.0), (0.0, 0.0, 0.0)))
        t_us += 8000
    return t_us


def test_the_verdict_builder_does_not_grow_with_the_flight() -> None:
    builder = VerdictBuilder(MISSION)
    builder.add(OdometrySample(1000, 1000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    builder.add(PhaseChange(1000, Phase.READYING, Phase.OFFBOARD, ""))
    builder.add(PhaseChange(1000, Phase.ARMING, Phase.CLIMB, ""))
    t_us = hover(builder, 0.5, 8000)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    hover(builder, 2.0, t_us)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 300_000  # keeping all samples would take 3.6 MB
    error_m = builder.build(World.FAST, 1).ekf_error_m
    assert error_m is not None
    assert math.isclose(error_m, 0.01, abs_tol=1e-9)


def test_the_largest_position_error_covers_all_samples(flown: SharedFlights) -> None:
    """The reference searches all samples after the flight."""
    flight = flown("single_wall", 1)
    records = [e.record for e in read_log(Path(flight.log)).entries]
    true = sorted((r.t_us, r.position_mission) for r in records if isinstance(r, TruthSample))
    chance = random.Random(1)
    estimates = [(t + 3000, tuple(p + chance.gauss(0.0, 0.01) for p in place)) for t, place in true[:-2]]
    worst = 0.0
    for (t_us, place), (t0, a), (t1, b) in zip(estimates, true, true[1:], strict=False):
        share = (t_us - t0) / (t1 - t0)
        worst = max(worst, math.dist(place, [p + share * (q - p) for p, q in zip(a, b, strict=True)]))
    for lag in (0, 5, 200):  # number of samples by which truth follows or precedes the estimate
        late, early = PositionError(), PositionError()
        feed(late, estimates, true, lag)
        feed(early, estimates, true, -lag)
        assert late.worst_m == worst
        assert early.worst_m == worst


def feed(
    error: PositionError,
    estimates: list[tuple[int, Vec3]] | list[tuple[int, tuple[float, ...]]],
    true: list[tuple[int, Vec3]],
    lag: int,
) -> None:
    for i in range(len(true) + abs(lag)):
        if 0 <= i + min(lag, 0) < len(estimates):
            t_us, (x, y, z) = estimates[i + min(lag, 0)]
            error.add_estimate(t_us, (x, y, z))
        if 0 <= i - max(lag, 0) < len(true):
            error.add_truth(*true[i - max(lag, 0)])
    error.add_truth(true[-1][0] + 8000, true[-1][1])
