"""Arrival with a velocity estimate that shakes as PX4's does."""

from __future__ import annotations

import math
import random

import pytest

from dart_flight.base.geometry import MissionFrame, quaternion_from_euler
from dart_flight.base.records import AttitudeSample, OdometrySample, Phase
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission import course
from dart_flight.core.mission.executive import Executive
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import ROOT

SHAKE_M_S, SHAKE_TIME_S, STEP_US = 0.07, 0.1, 8000


def arrival_time_s(mission: Mission, seconds: float, drift_m_s: float = 0.0) -> float | None:
    """Return when the vehicle has arrived, seconds; its velocity estimate shakes by 0.07 m/s per axis."""
    flown, state, rng = Executive(mission), FlightState(), random.Random(7)
    state.anchor(MissionFrame())
    flown.progress.phase, flown.progress.course = Phase.GOAL, flown.progress.course.hold((0.0, 0.0))
    x, shake = -0.5 * drift_m_s * seconds, [0.0, 0.0, 0.0]
    keep = math.exp(-STEP_US * 1e-6 / SHAKE_TIME_S)
    for i in range(1, round(seconds * 1e6 / STEP_US)):
        t = i * STEP_US
        shake = [keep * s + rng.gauss(0.0, SHAKE_M_S * math.sqrt(1.0 - keep * keep)) for s in shake]
        x += drift_m_s * STEP_US * 1e-6
        position = (x, 0.0, -mission.altitude_m)
        velocity = (drift_m_s + shake[0], shake[1], shake[2])
        state.update_attitude(AttitudeSample(t, t, (1.0, 0.0, 0.0, 0.0)))
        state.update_odometry(OdometrySample(t, t, position, velocity))
        if flown._has_arrived(state):
            return t * 1e-6
    return None


def dual_collision_mission() -> Mission:
    return load_mission(ROOT / "missions/paper_dual_collision.yaml")


def test_a_hovering_vehicle_arrives_despite_a_shaking_velocity_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert arrival_time_s(dual_collision_mission(), 4.0) is not None
    monkeypatch.setattr(course, "MEAN_SPEED_S", 0.01)
    assert arrival_time_s(dual_collision_mission(), 4.0) is None


@pytest.mark.parametrize("drift_m_s", [0.15, 0.3])
def test_a_vehicle_that_flies_past_does_not_arrive(drift_m_s: float) -> None:
    # The vehicle is near the target for 1.6 s: it travels 0.24 m at 0.15 m/s.
    assert arrival_time_s(dual_collision_mission(), 1.6) is not None
    assert arrival_time_s(dual_collision_mission(), 1.6, drift_m_s) is None


def test_the_mean_velocity_covers_the_requested_time_span() -> None:
    state = FlightState()
    assert state.mean_velocity(0.3) == (0.0, 0.0, 0.0)
    state.anchor(MissionFrame())
    for i in range(1, 101):
        state.update_odometry(OdometrySample(i * 10_000, i * 10_000, (0.0, 0.0, 0.0), (float(i), 0.0, 0.0)))
    assert state.mean_velocity(0.0)[0] == pytest.approx(100.0)
    assert state.mean_velocity(0.1)[0] == pytest.approx(95.5)  # the newest ten


@pytest.mark.parametrize(
    ("name", "near_m", "slow_m_s", "turned_rad"),
    [("paper_dual_collision", 0.12, 0.1, 0.05), ("dual_collision_gps", 0.3, 0.4, 0.1)],
)
def test_an_arrival_is_more_tolerant_if_the_position_drifts(
    name: str, near_m: float, slow_m_s: float, turned_rad: float
) -> None:
    arrival = course.Arrival(load_mission(packaged("missions", f"{name}.yaml")))

    def is_at(away_m: float, speed_m_s: float, yaw: float) -> bool:
        """Return whether the vehicle has arrived; NED headings are clockwise."""
        state = FlightState()
        state.anchor(MissionFrame())
        state.update_attitude(AttitudeSample(1, 1, quaternion_from_euler(0.0, 0.0, yaw - math.radians(90.0))))
        state.update_odometry(OdometrySample(1, 1, (0.0, away_m, -1.0), (0.0, 0.0, speed_m_s)))
        return arrival.is_at((0.0, 0.0, 1.0), math.radians(90.0), state)

    limits = (near_m, slow_m_s, turned_rad)
    for sign in (1.0, -1.0):
        assert is_at(*(0.99 * sign * limit for limit in limits))
        for i in range(3):
            assert not is_at(*(sign * limit * (1.01 if k == i else 0.99) for k, limit in enumerate(limits)))
