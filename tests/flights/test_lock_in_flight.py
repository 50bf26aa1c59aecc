"""The lock between two collisions: in time, late, silent or stuck."""

from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import Override, World
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LimitSwitch
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.recording.verdict import VerdictBuilder
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]


def dual_collision(**lock_changes: object) -> Mission:
    mission = load_flyable(ROOT / "missions/paper_dual_collision.yaml")
    assert mission.vehicle.lock is not None
    lock = msgspec.structs.replace(mission.vehicle.lock, **lock_changes)
    return msgspec.structs.replace(mission, vehicle=msgspec.structs.replace(mission.vehicle, lock=lock))


def with_servo_travel(seconds: float) -> Mission:
    lock = dual_collision().vehicle.lock
    assert lock is not None
    return dual_collision(servo=msgspec.structs.replace(lock.servo, travel_s=seconds))


@pytest.mark.rest
def test_a_slow_servo_completes_the_mission_if_it_settles_before_the_collision() -> None:
    """The lock settles before the collision, but after the last moment to stop before the wall."""
    verdict = fly_fast(with_servo_travel(0.6), 1, None)
    assert verdict.outcome == "completed"
    assert [(c.wall, c.mode_felt) for c in verdict.collisions] == [("wood", "flexible"), ("acrylic", "rigid")]


def test_a_servo_that_is_too_slow_aborts_the_second_approach() -> None:
    verdict = fly_fast(with_servo_travel(1.0), 1, None)
    assert verdict.outcome == "aborted"
    assert verdict.reason is not None
    assert verdict.reason.startswith("lock_late: the lock is travelling, not rigid")
    assert [c.wall for c in verdict.collisions] == ["wood"]  # the acrylic wall is never touched
    assert verdict.flight_time_s is not None  # the vehicle has landed


def test_a_limit_switch_that_is_silent_from_the_start_prevents_the_takeoff() -> None:
    mission = dual_collision(limit_switch=LimitSwitch(chip="gpiochip0", rigid_line=17))
    verdict = fly_fast(mission, 1, None, lock_faults=MockFaults(switch_silent=True))
    assert verdict.outcome == "aborted"
    assert verdict.reason is not None
    assert "the lock is not rigid" in verdict.reason
    assert verdict.flight_time_s is None


@pytest.mark.rest
def test_a_limit_switch_that_fails_in_flight_aborts_the_second_approach() -> None:
    mission = dual_collision(limit_switch=LimitSwitch(chip="gpiochip0", rigid_line=17))
    builder = VerdictBuilder(mission)
    flight = FastFlight(mission, 1, observe=lambda record, _: builder.add(record))
    assert flight.lock is not None
    flight.lock.start()
    while flight.core.phase != "approach":
        flight.tick()
    assert flight.mock is not None
    flight.mock.inject(MockFaults(switch_silent=True))
    flight.run()
    verdict = builder.build(World.FAST, 1)
    assert verdict.reason is not None
    assert verdict.reason.startswith("lock_late")
    assert [c.wall for c in verdict.collisions] == ["wood"]


@pytest.mark.rest
def test_a_stuck_servo_without_a_switch_is_revealed_by_the_contact(flown: SharedFlights) -> None:
    """The controller reports its command, `settled (no feedback)`; the contact shows the real mode."""
    verdict = fly_fast(dual_collision(), 1, None, lock_faults=MockFaults(servo=ServoFaults(stuck=True)))
    assert [(c.mode, c.mode_felt) for c in verdict.collisions] == [
        ("flexible", "flexible"),
        ("rigid", "flexible"),
    ]
    assert [(e.rule, e.action) for e in verdict.guard] == [("mode_felt", Override.NONE)]
    healthy = flown("paper_dual_collision", 1).verdict
    assert [(c.mode, c.mode_felt) for c in healthy.collisions] == [
        ("flexible", "flexible"),
        ("rigid", "rigid"),
    ]
