"""The causes of an uncontrolled flight, as the verdict reports them."""

from __future__ import annotations

import math

import pytest

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import MissionEnd, Mode, Outcome, TruthSample, World
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.verdict import Verdict, VerdictBuilder

MISSION = load_mission(packaged("missions", "single_wall.yaml"))
X, Y, Z = (bounds[1] for bounds in (MISSION.bounds.x, MISSION.bounds.y, MISSION.bounds.z))


def truth(place: Vec3, tilt_deg: float = 0.0, down_m_s: float = 0.0) -> TruthSample:
    half = 0.5 * math.radians(tilt_deg)
    q = (math.cos(half), math.sin(half), 0.0, 0.0)
    return TruthSample(
        t_us=0, position_mission=place, velocity_mission=(0.0, 0.0, -down_m_s), q_frd_to_ned=q,
        contact_force_mission=(0.0, 0.0, 0.0), mode=Mode.RIGID,
    )  # fmt: skip


def verdict(
    *samples: TruthSample, outcome: Outcome = Outcome.COMPLETED, reason: str | None = None
) -> Verdict:
    builder = VerdictBuilder(MISSION)
    for sample in samples:
        builder.add(sample)
    builder.add(MissionEnd(0, outcome, reason, 0.0))
    return builder.build(World.FAST, 1)


HIGH = truth((0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("sample", "word"),
    [
        (truth((X + 0.49, 0.0, 1.0)), None),
        (truth((X + 0.51, 0.0, 1.0)), "0.51 m outside bounds_m"),
        (truth((0.0, Y + 0.6, 1.0)), "0.60 m outside bounds_m"),
        (truth((0.0, 0.0, Z + 0.6)), "0.60 m outside bounds_m"),
        (truth((0.0, 0.0, 1.0), tilt_deg=79.0), None),
        (truth((0.0, 0.0, 1.0), tilt_deg=90.0), "tilted by 90 degrees"),
        (truth((0.0, 0.0, 0.01), down_m_s=1.4), None),
        (truth((0.0, 0.0, 0.01), down_m_s=1.6), "hit the ground at 1.60 m/s"),
    ],
)
def test_each_exceeded_limit_is_reported_as_its_own_cause(sample: TruthSample, word: str | None) -> None:
    found = verdict(HIGH, sample, HIGH).uncontrolled
    assert len(found) == (word is not None)
    assert word is None or word in found[0]


def test_an_aborted_flight_without_a_reason_is_uncontrolled() -> None:
    assert verdict(HIGH, outcome=Outcome.ABORTED).uncontrolled == ["not completed, for no known reason"]
    assert verdict(HIGH, outcome=Outcome.ABORTED, reason="bounds: left them").uncontrolled == []


def test_a_flight_without_truth_is_never_classified_as_uncontrolled() -> None:
    assert verdict(outcome=Outcome.ABORTED).uncontrolled == []
