"""The lock between two collisions: in time, too late, silent, stuck."""

from pathlib import Path

import msgspec

from dart_flight.base.records import Override, World
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LimitSwitch
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]


def dual(**lock_changes: object) -> Mission:
    mission = load_flyable(ROOT / "missions/paper_dual_collision.yaml")
    assert mission.vehicle.lock is not None
    lock = msgspec.structs.replace(mission.vehicle.lock, **lock_changes)
    return msgspec.structs.replace(mission, vehicle=msgspec.structs.replace(mission.vehicle, lock=lock))


def with_travel(seconds: float) -> Mission:
    lock = dual().vehicle.lock
    assert lock is not None
    return dual(servo=msgspec.structs.replace(lock.servo, travel_s=seconds))


def test_a_servo_known_to_be_slow_is_committed_to_where_it_will_be_in_time() -> None:
    """Holding still would no longer stop short of the wall when it settles, and it settles before the hit."""
    verdict = fly_fast(with_travel(0.6), 1, None)
    assert verdict.outcome == "completed"
    assert [(c.wall, c.mode_felt) for c in verdict.collisions] == [("wood", "flexible"), ("acrylic", "rigid")]


def test_a_servo_known_to_be_too_slow_breaks_the_second_approach_off() -> None:
    verdict = fly_fast(with_travel(1.0), 1, None)
    assert verdict.outcome == "aborted"
    assert verdict.reason is not None
    assert verdict.reason.startswith("lock_late: the lock is travelling, not rigid")
    assert [c.wall for c in verdict.collisions] == ["wood"]  # the acrylic wall was never touched
    assert verdict.flight_time_s is not None  # and it has landed


def test_a_limit_switch_that_stays_silent_breaks_it_off_too() -> None:
    mission = dual(limit_switch=LimitSwitch(chip="gpiochip0", rigid_line=17))
    assert fly_fast(mission, 1, None).outcome == "completed"
    # Silent from the first: it never gets off the ground.
    verdict = fly_fast(mission, 1, None, lock_faults=MockFaults(switch_silent=True))
    assert verdict.outcome == "aborted"
    assert verdict.reason is not None
    assert "the lock is not rigid" in verdict.reason
    assert verdict.flight_time_s is None


def test_a_switch_that_falls_silent_in_flight_breaks_it_off() -> None:
    from dart_flight.recording.verdict import VerdictBuilder
    from dart_flight.run.fast import FastFlight

    mission = dual(limit_switch=LimitSwitch(chip="gpiochip0", rigid_line=17))
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


def test_a_stuck_servo_without_a_switch_is_revealed_by_the_contact(flown: SharedFlights) -> None:
    """The controller reports what it commands: `settled (no feedback)`. The wall tells the truth."""
    verdict = fly_fast(dual(), 1, None, lock_faults=MockFaults(servo=ServoFaults(stuck=True)))
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
