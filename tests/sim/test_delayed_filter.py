"""A filter with a wrong pose delay: like EKF2, it leads the vehicle and oscillates."""

from __future__ import annotations

import math
import random
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.base.records import GuardEvent, ImpactOnset, Outcome, Phase, PhaseChange, Record
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.run.fast import FastFlight
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.delayed_filter import DelayedFilter
from dart_flight.sim.estimator import Estimator
from dart_flight.sim.faults.fault_table import parse_fault

LEVEL = (1.0, 0.0, 0.0, 0.0)
TICK_S, TRUE_S = 0.004, 0.012


class LevelFlight:
    """A level vehicle with given accelerations to the north, and its filter."""

    def __init__(self, delay_s: float) -> None:
        self.estimator = Estimator()
        self.filter = DelayedFilter(self.estimator, 0.0, delay_s)
        self.north = self.speed = self.time_s = 0.0
        self._rng = random.Random(1)
        self._poses: deque[tuple[float, Vec3]] = deque()
        self._ticks = 0

    def fly(self, seconds: float, acceleration: float = 0.0) -> float:
        """Fly, and return the position error of the largest magnitude, positive to the north."""
        worst = 0.0
        for _ in range(round(seconds / TICK_S)):
            self.time_s += TICK_S
            self._ticks += 1
            self.north += self.speed * TICK_S + 0.5 * acceleration * TICK_S**2
            self.speed += acceleration * TICK_S
            specific_force = (acceleration + self._rng.gauss(0.0, 0.05), 0.0, -GRAVITY_M_S2)
            self.filter.predict(self.time_s, specific_force, (0.0, 0.0, 0.0), TICK_S)
            if self._ticks % 3 == 0:
                self._poses.append((self.time_s, (self.north + self._rng.gauss(0.0, 0.001), 0.0, 0.0)))
            while self._poses and self._poses[0][0] + TRUE_S <= self.time_s:
                self.filter.correct(*self._poses.popleft(), LEVEL)
            error = self.error_m
            worst = error if abs(error) > abs(worst) else worst
        return worst

    @property
    def error_m(self) -> float:
        return self.estimator.position[0] - self.north


@settings(max_examples=8, deadline=None)
@given(delay_ms=st.floats(0.0, 150.0), speed=st.floats(-1.5, 1.5))
def test_the_estimate_leads_by_the_speed_times_the_error_of_the_delay(delay_ms: float, speed: float) -> None:
    level = LevelFlight(delay_ms * 1e-3)
    level.fly(1.0)
    level.fly(1.0, speed)
    level.fly(4.0)
    assert level.error_m == pytest.approx(speed * (delay_ms * 1e-3 - TRUE_S), abs=0.015)
    assert level.estimator.velocity[0] == pytest.approx(speed, abs=0.05)


def test_the_estimate_follows_a_manoeuvre_with_the_right_delay() -> None:
    level = LevelFlight(TRUE_S)
    level.fly(1.0)
    for acceleration in (2.0, -2.0, -2.0, 2.0):
        assert abs(level.fly(0.5, acceleration)) < 0.03


def test_the_estimate_oscillates_after_a_stop_with_a_wrong_delay() -> None:
    """The estimate overshoots, because the learnt tilt and velocity are wrong."""
    level = LevelFlight(0.15 + TRUE_S)
    level.fly(1.0)
    level.fly(0.5, 2.0)
    level.fly(2.0)
    level.fly(0.5, -2.0)
    swing = [level.fly(0.25) for _ in range(12)]
    assert max(swing) > 0.05
    assert min(swing) < -0.01
    assert abs(swing[-1]) < 0.03


def test_poses_beyond_the_gate_reset_the_estimate() -> None:
    level = LevelFlight(TRUE_S)
    level.fly(2.0)
    before = level.estimator.resets
    level.north += 1.0  # displaced without an acceleration at the IMU
    assert abs(level.fly(0.8)) > 0.9
    level.fly(1.5)
    assert level.estimator.resets == before + 1
    assert abs(level.error_m) < 0.02


# --- effects on a flight and on the guard -------------------------------------------------------------------


class DelayedFlight:
    """A fast flight to the single wall: start of the approach, events of the guard, onset and end."""

    def __init__(self, fault: str, settings: dict[str, object] | None = None, mission: str = "") -> None:
        self.events: list[GuardEvent] = []
        self.onset_us = self.approach_us = math.inf
        loaded = load_flyable(packaged("missions", mission or "paper_single_wall.yaml"))
        loaded = loaded.replace(settings) if settings else loaded
        fast_flight = FastFlight(loaded, 3, observe=self.add_record, fault=parse_fault(fault))
        fast_flight.run()
        self.end = fast_flight.core.end

    def add_record(self, record: Record, number: int) -> None:
        if isinstance(record, GuardEvent):
            self.events.append(record)
        elif isinstance(record, ImpactOnset):
            self.onset_us = min(self.onset_us, record.t_us)
        elif isinstance(record, PhaseChange) and record.after is Phase.APPROACH:
            self.approach_us = min(self.approach_us, record.t_us)


@pytest.mark.parametrize("delay_ms", [160, *(pytest.param(ms, marks=pytest.mark.rest) for ms in (90, 300))])
def test_a_wrong_delay_aborts_the_flight_before_the_wall(delay_ms: int) -> None:
    flight = DelayedFlight(f"ev-delay={delay_ms}")
    (event,) = flight.events
    assert event.rule == "position_delayed"
    assert "leads the IMU" in event.detail
    assert flight.onset_us == math.inf
    assert event.t_us < flight.approach_us + 2_000_000
    assert flight.end is not None
    assert flight.end.outcome is Outcome.ABORTED


def test_poses_that_are_older_than_configured_make_the_estimate_lag() -> None:
    flight = DelayedFlight("ev-delay=10", {"vehicle.simulation.pose_delay_s": 0.12})
    assert [event.rule for event in flight.events] == ["position_delayed"]
    assert "lags the IMU" in flight.events[0].detail
    assert flight.onset_us == math.inf


@pytest.mark.rest
def test_a_wrong_delay_is_detected_with_a_slow_motion_capture() -> None:
    flight = DelayedFlight("ev-delay=160", {"vehicle.simulation.pose_rate_hz": 30.0})
    assert [event.rule for event in flight.events] == ["position_delayed"]
    assert flight.onset_us == math.inf


@pytest.mark.parametrize("delay_ms", [30, pytest.param(10, marks=pytest.mark.rest)])
def test_a_flight_with_a_nearly_right_delay_completes(delay_ms: int) -> None:
    flight = DelayedFlight(f"ev-delay={delay_ms}")
    assert not flight.events
    assert flight.end is not None
    assert flight.end.outcome is Outcome.COMPLETED


def test_a_wrong_delay_is_refused_as_a_fault_without_motion_capture() -> None:
    with pytest.raises(
        InputError, match="ev-delay: needs motion capture, but this vehicle's position comes from GPS"
    ):
        parse_fault("ev-delay=90", has_mocap=False)
