"""The lock in worlds with drawn parameters: the arms follow it, and arms that do not are reported."""

from pathlib import Path

import pytest

from dart_flight.base.records import World
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.fast import fly_fast
from dart_flight.run.many_flights import summarise, unexplained_modes
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.draws import LOCK_TRUE_MODE, parse_vary
from dart_flight.sim.pipe import FULL_SPEED
from tests.shared_flights import SharedFlights

ROOT = Path(__file__).parents[2]


@pytest.mark.rest
@pytest.mark.mavlink
def test_a_drawn_servo_locks_the_arms_before_the_second_collision(tmp_path: Path) -> None:
    """Faults set before the autopilot's clock is known would freeze the time of the servo's model."""
    mission = load_flyable(ROOT / "missions/paper_dual_collision.yaml")
    spreads = parse_vary(["servo"], mission.vehicle)
    embedded = fly_embedded(mission, 4, tmp_path, spreads=spreads, speed=FULL_SPEED)
    assert embedded.world is World.EMBEDDED
    assert [c.mode_felt for c in embedded.collisions] == ["flexible", "rigid"]
    truth = embedded.collisions[1].truth
    assert truth is not None
    assert truth.peak_force_n == pytest.approx(69.0, rel=0.1)


def test_arms_that_do_not_follow_the_lock_are_reported_unless_a_fault_was_drawn(flown: SharedFlights) -> None:
    mission = load_flyable(ROOT / "missions/paper_dual_collision.yaml")
    verdict = fly_fast(mission, 4, None, lock_faults=MockFaults(servo=ServoFaults(stuck=True)))
    assert unexplained_modes(verdict) == [
        "the arms did not follow the lock",
        "collision 2: the arms were flexible, but the lock reported rigid",
        "collision 2: the contact indicates flexible, but the lock reports rigid, true mode flexible",
    ]
    assert summarise([verdict]).unexplained_modes == {"4": unexplained_modes(verdict)}
    verdict.drawn = {LOCK_TRUE_MODE: "stuck"}
    assert unexplained_modes(verdict) == []
    assert unexplained_modes(flown("paper_dual_collision", 1).verdict) == []


@pytest.mark.rest
def test_the_mode_of_an_unplanned_contact_is_not_assigned_to_a_planned_collision() -> None:
    """The vehicle hits the acrylic wall behind its planned place, after aborting the approach."""
    mission = load_flyable(ROOT / "missions/paper_dual_collision.yaml")
    verdict = fly_fast(mission, 7238, None, spreads=parse_vary(["all"], mission.vehicle))
    assert [(c.wall, c.mode_felt) for c in verdict.collisions] == [("wood", "flexible")]
    assert unexplained_modes(verdict) == []
