"""Arrival: place, speed and heading for a time, with a velocity estimate that shakes as PX4's does."""

from __future__ import annotations

import math
import random

import pytest

from dart_flight.base.geometry import MissionFrame, Vec3, norm, quaternion_from_euler
from dart_flight.base.records import AttitudeSample, OdometrySample, Phase
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.mission.course import (
    _ARRIVED_YAW_RAD,
    _DRIFTING_NEAR,
    _DRIFTING_SLOW,
    _DRIFTING_TURNED,
    ARRIVED_M,
    ARRIVED_M_S,
    ARRIVED_S,
    Arrival,
)
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import DUAL, GPS, ROOT, MissionInPhase

MISSION = load_mission(ROOT / DUAL)
SHAKE_M_S, SHAKE_TIME_S, STEP_S = 0.07, 0.1, 0.008


class Climb:
    """The end of a climb: the vehicle is near the target above its place of take-off."""

    def __init__(self, mission: Mission = MISSION) -> None:
        self.flown, self.altitude_m, self.t_us = MissionInPhase(mission, Phase.CLIMB), mission.altitude_m, 0
        self.flown.progress.course = self.flown.progress.course.hold((0.0, 0.0))

    def arrives(self, seconds: float, north_m: float = 0.0, velocity: Vec3 = (0.0, 0.0, 0.0)) -> bool:
        """Feed samples for `seconds`; return whether the vehicle has arrived by then."""
        for _ in range(round(seconds / STEP_S)):
            self.t_us += round(1e6 * STEP_S)
            state = self.flown.state
            state.update_attitude(AttitudeSample(self.t_us, 0, quaternion_from_euler(0.0, 0.0, 0.0)))
            place = (north_m, 0.0, -self.altitude_m)
            state.update_odometry(OdometrySample(self.t_us, 0, place, velocity))
            self.flown.step()
        return self.flown.progress.phase is not Phase.CLIMB


def shaking(seconds: float) -> list[Vec3]:
    """Return velocity errors, one for each sample."""
    rng, error, errors = random.Random(7), [0.0, 0.0, 0.0], []
    keep = math.exp(-STEP_S / SHAKE_TIME_S)
    for _ in range(round(seconds / STEP_S)):
        error = [keep * e + rng.gauss(0.0, SHAKE_M_S * math.sqrt(1.0 - keep * keep)) for e in error]
        errors.append((error[0], error[1], error[2]))
    return errors


def test_a_hovering_vehicle_arrives_despite_a_shaking_velocity_estimate() -> None:
    errors = shaking(4.0)
    slow = "".join("s" if norm(error) < ARRIVED_M_S else " " for error in errors)
    assert max(map(len, slow.split())) * STEP_S < ARRIVED_S  # single samples are never slow for long enough
    climb = Climb()
    assert any(climb.arrives(STEP_S, velocity=error) for error in errors)


@pytest.mark.parametrize(("drift_m_s", "arrives"), [(0.0, True), (0.15, False), (0.3, False)])
def test_a_vehicle_that_flies_past_does_not_arrive(drift_m_s: float, arrives: bool) -> None:
    """The vehicle is near the target for 1.6 s: it travels 0.24 m at 0.15 m/s."""
    climb, errors = Climb(), shaking(1.6)
    found = [
        climb.arrives(STEP_S, drift_m_s * (i * STEP_S - 0.8), velocity=(drift_m_s + x, y, z))
        for i, (x, y, z) in enumerate(errors)
    ]
    assert any(found) is arrives


def test_the_mean_velocity_covers_the_requested_time_span() -> None:
    state = FlightState()
    assert state.mean_velocity(0.3) == (0.0, 0.0, 0.0)
    state.anchor(MissionFrame())
    for i in range(1, 101):
        state.update_odometry(OdometrySample(i * 10_000, i * 10_000, (0.0, 0.0, 0.0), (float(i), 0.0, 0.0)))
    assert state.mean_velocity(0.0)[0] == pytest.approx(100.0)
    assert state.mean_velocity(0.1)[0] == pytest.approx(95.5)  # the newest ten


def test_an_arrival_lasts_its_time_without_an_interruption() -> None:
    climb = Climb()
    assert not climb.arrives(ARRIVED_S - STEP_S)
    assert not climb.arrives(STEP_S, north_m=9.0)  # the time restarts
    assert not climb.arrives(ARRIVED_S - STEP_S)
    climb.flown.progress.arrived_us = None  # as when a phase begins
    assert not climb.arrives(ARRIVED_S - STEP_S)
    assert climb.arrives(3.0 * STEP_S)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("mission", "limits"),
    [
        (DUAL, (ARRIVED_M, ARRIVED_M_S, _ARRIVED_YAW_RAD)),
        # More tolerant, because the position drifts.
        (
            GPS,
            (_DRIFTING_NEAR * ARRIVED_M, _DRIFTING_SLOW * ARRIVED_M_S, _DRIFTING_TURNED * _ARRIVED_YAW_RAD),
        ),
    ],
)
def test_an_arrival_has_limits_of_distance_speed_and_heading(mission: str, limits: Vec3, sign: float) -> None:
    arrival = Arrival(load_mission(ROOT / mission))

    def is_at(shares: tuple[float, ...]) -> bool:
        """Return whether the vehicle has arrived at shares of the limits; NED headings are clockwise."""
        away_m, speed_m_s, yaw = (sign * share * limit for share, limit in zip(shares, limits, strict=True))
        state = FlightState()
        state.anchor(MissionFrame())
        state.update_attitude(AttitudeSample(1, 1, quaternion_from_euler(0.0, 0.0, yaw - math.pi / 2.0)))
        state.update_odometry(OdometrySample(1, 1, (0.0, away_m, -1.0), (0.0, 0.0, speed_m_s)))
        return arrival.is_at((0.0, 0.0, 1.0), math.pi / 2.0, state)

    assert is_at((0.99, 0.99, 0.99))
    assert not any(is_at(shares) for shares in ((1.01, 0.99, 0.99), (0.99, 1.01, 0.99), (0.99, 0.99, 1.01)))
