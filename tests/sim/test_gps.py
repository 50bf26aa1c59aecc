"""GPS position in the fast world: its drift with the filter's weights, and late fixes."""

from __future__ import annotations

import math
import random
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3, subtract
from dart_flight.config.mission import load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import packaged
from dart_flight.planning.positioning import effective_source
from dart_flight.sim.embedded_autopilot import TICK_S, default_parameters, make_autopilot
from dart_flight.sim.estimator import Estimator
from dart_flight.sim.gps_filter import GpsFilter, GpsWeights
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant
from dart_flight.sim.sensors import GPS_QUALITIES, GpsQuality, GpsReceiver

LEVEL = (1.0, 0.0, 0.0, 0.0)
DEFAULT, UNWEIGHTED = GpsWeights(0.5, 0.3, (0.0, 0.0, 0.0)), GpsWeights(10.0, 0.3, (0.0, 0.0, 0.0))
PERFECT = GpsQuality(3, 0.0, 60.0, 0.0, 0.0, 0.0, 0.0)


class GpsVehicle:
    """A vehicle with a given motion, its estimator, a perfect IMU, late fixes and newer attitudes."""

    def __init__(self, quality: GpsQuality, weights: GpsWeights, seed: int) -> None:
        self.receiver = GpsReceiver(quality, GaussianNoise(random.Random(seed)))
        self.estimator, self.weights = Estimator(), weights
        self.true = SimpleNamespace(time_s=0.0, position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0))

    def step(self, acceleration: float = 0.0) -> None:
        """Advance one tick with an acceleration to the north."""
        true, h = self.true, TICK_S
        true.position = (true.position[0] + h * true.velocity[0] + 0.5 * h * h * acceleration, 0.0, 0.0)
        true.velocity = (true.velocity[0] + h * acceleration, 0.0, 0.0)
        true.time_s += h
        self.estimator.predict(true.time_s, (acceleration, 0.0, -GRAVITY_M_S2), (0.0, 0.0, 0.0), h)
        if round(true.time_s / h) % 2:
            self.estimator.correct_attitude(true.time_s - 0.01, LEVEL)
        fix = self.receiver.measure(cast(Plant, true))
        if fix is not None:
            self.estimator.correct_gps(fix.t_s, fix.position_ned, fix.velocity_ned, self.weights)

    @property
    def error_ned(self) -> Vec3:
        """Estimated minus true position."""
        return subtract(self.estimator.position, self.true.position)


def drift_m(quality: GpsQuality, weights: GpsWeights, after_s: tuple[float, ...]) -> list[float]:
    """Return the rms changes of the position error along an axis after these times, over flights."""
    steps = [round(s / TICK_S) for s in after_s]
    settle = round(30.0 / TICK_S)
    changes: list[list[float]] = [[] for _ in after_s]
    for seed in range(12):
        gps_vehicle = GpsVehicle(quality, weights, seed)
        errors = []
        for _ in range(settle + 2 * steps[-1]):
            gps_vehicle.step()
            errors.append(gps_vehicle.error_ned[:2])
        for begin in (settle, settle + steps[-1]):
            for found, n in zip(changes, steps, strict=True):
                then, now = errors[begin - 1], errors[begin + n - 1]
                found += [b - a for a, b in zip(then, now, strict=True)]
    return [math.sqrt(float(np.mean(np.square(found)))) for found in changes]


@pytest.mark.parametrize(
    ("weights", "bias_m_s", "expected_m"),
    [
        (DEFAULT, 0.0, (0.34, 0.53)),
        pytest.param(UNWEIGHTED, 0.0, (0.08, 0.14), marks=pytest.mark.rest),
        pytest.param(UNWEIGHTED, 0.03, (0.15, 0.28), marks=pytest.mark.rest),
    ],
    ids=["default", "unweighted", "unweighted with a bias of the velocity"],
)
def test_the_position_drift_after_5_and_10_s_matches_the_calculation(
    weights: GpsWeights, bias_m_s: float, expected_m: tuple[float, float]
) -> None:
    quality = GPS_QUALITIES["plain"]._replace(velocity_wander_m_s=bias_m_s)
    assert drift_m(quality, weights, (5.0, 10.0)) == pytest.approx(expected_m, rel=0.5)


def test_an_anchored_mission_sets_the_weights_for_the_shipped_receiver() -> None:
    plain = GPS_QUALITIES["plain"]
    assert (plain.velocity_wander_m_s, plain.velocity_wander_s) == (0.03, 20.0)
    assert (plain.wander_m, plain.wander_s) == (1.0, 60.0)
    assert GPS_QUALITIES[PositionSource.ANCHORED] == plain
    mission = load_mission(packaged("missions", "dual_collision_gps.yaml"))
    changed = mission.replace({"vehicle.simulation.position_from": "plain"})
    assert effective_source(mission, PositionSource.PLAIN) is PositionSource.ANCHORED
    assert effective_source(mission, PositionSource.RTK) is PositionSource.RTK
    autopilot = make_autopilot(changed, 1)
    assert autopilot.gps is not None
    assert autopilot.parameters["EKF2_GPS_P_NOISE"] == 10.0
    without = changed.replace({"frame.anchored_by": "none"})
    assert effective_source(without, PositionSource.PLAIN) is PositionSource.PLAIN
    assert make_autopilot(without, 1).parameters["EKF2_GPS_P_NOISE"] == 0.5
    assert make_autopilot(mission, 1).gps is None, "motion capture, by default"
    assert "EKF2_GPS_P_NOISE" in default_parameters(mission.vehicle)


# --- late fixes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [DEFAULT, UNWEIGHTED], ids=["default", "unweighted"])
def test_a_collision_between_a_fix_and_its_arrival_adds_no_error(weights: GpsWeights) -> None:
    """The vehicle rebounds at 1 m/s within 64 ms; a fix is compared with the estimate at its own time."""
    gps_vehicle = GpsVehicle(PERFECT, weights, 1)
    speeds = [1.0] * 125 + [-27.0] * 16 + [0.0] * 100
    for _ in range(1000):
        gps_vehicle.step()
    for k, commanded in enumerate(speeds):
        gps_vehicle.step(2.0 if commanded == 1.0 else commanded)
        assert max(map(abs, gps_vehicle.error_ned)) < 1e-6, k


def test_a_perfect_receiver_does_not_move_the_estimate_of_a_resting_vehicle() -> None:
    gps_vehicle = GpsVehicle(PERFECT, UNWEIGHTED, 1)
    for _ in range(500):
        gps_vehicle.step()
    assert gps_vehicle.error_ned == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert gps_vehicle.estimator.ok


@given(position_m=st.floats(0.03, 10.0), velocity_m_s=st.floats(0.05, 1.0), every_s=st.floats(0.05, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_filter_is_never_much_less_certain_than_a_single_fix(
    position_m: float, velocity_m_s: float, every_s: float
) -> None:
    gps_filter = GpsFilter(GpsWeights(position_m, velocity_m_s, (0.0, 0.0, 0.0)))
    for _ in range(8):
        gps_filter.predict(every_s)
        gains = gps_filter.correct()
        assert 0.0 <= gains[0][0] < 1.0
        assert 0.0 <= gains[1][1] < 1.0
        assert gps_filter.position_sd_m <= math.sqrt(2.0) * position_m * (1.0 + 1e-9)
