"""A simulated flight that continues to the ground: loss of control and the rule that ended the mission."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import Outcome, Record, TruthContact
from dart_flight.config.mission import Mission, load_mission
from dart_flight.run.fast import fly_fast
from dart_flight.sim.draws import DrawnWorld
from dart_flight.sim.faults.fault_table import Fault, parse_fault
from tests.watched_flight import WatchedFlight, excursion_allowed_m, place_walls, rule_of

DATA = Path(__file__).parent / "data"
NEAR = load_mission(DATA / "near_wall.yaml")


def with_guards_at(mission: Mission, height_m: float) -> DrawnWorld:
    simulation = mission.vehicle.simulation
    contact = msgspec.structs.replace(simulation.contact, guard_height_m=height_m)
    simulation = msgspec.structs.replace(simulation, contact=contact)
    vehicle = msgspec.structs.replace(mission.vehicle, simulation=simulation)
    return DrawnWorld(msgspec.structs.replace(mission, vehicle=vehicle), None, {})


@pytest.mark.rest
def test_a_watched_flight_equals_the_fast_flight_and_passes_on_every_record() -> None:
    watched = WatchedFlight(NEAR, 1)
    contacts: list[Record] = []

    def collect_contacts(record: Record, number: int) -> None:
        if isinstance(record, TruthContact):
            contacts.append(record)

    watched.onlookers.append(collect_contacts)
    verdict = watched.run()
    assert verdict.outcome is Outcome.COMPLETED
    assert verdict.collisions == fly_fast(NEAR, 1, None).collisions
    assert (watched.problems, rule_of(verdict)) == ([], "")
    assert len(contacts) == len(verdict.collisions) > 0
    assert math.degrees(watched.truth.tilt_rad) < 45.0


@pytest.mark.rest
def test_a_rollover_is_reported_as_uncontrolled() -> None:
    """An impact at 3 m/s with guards 12 cm below the centre of mass cannot be balanced."""
    mission = load_mission(DATA / "faster_hit.yaml")
    watched = WatchedFlight(mission, 1, with_guards_at(mission, -0.12))
    verdict = watched.run()
    assert verdict.outcome is not Outcome.COMPLETED
    assert any(problem.startswith("tilted by") for problem in watched.problems)


def test_the_first_rule_that_acts_is_the_cause() -> None:
    watched = WatchedFlight(NEAR, 1, fault=parse_fault("imu-dropout@approach"))
    verdict = watched.run()
    assert (rule_of(verdict), watched.problems) == ("imu_silent", [])
    assert watched.decided_us is not None


def test_walls_are_shifted_along_their_normal_and_rotated() -> None:
    (wall,) = NEAR.walls
    (moved,) = place_walls(DrawnWorld(NEAR, None, {}), {wall.name: 0.1}, {wall.name: 90.0}).mission.walls
    assert math.dist(moved.point, wall.point) == pytest.approx(0.1)
    assert wall.signed_distance(moved.point) == pytest.approx(0.1)  # along its normal
    assert moved.normal[0] * wall.normal[0] + moved.normal[1] * wall.normal[1] == pytest.approx(
        0.0, abs=1e-12
    )


def test_a_position_fault_widens_the_permitted_excursion_by_its_size() -> None:
    assert excursion_allowed_m(None) == 0.5
    assert excursion_allowed_m(Fault("ekf-jump", -0.7)) == pytest.approx(1.2)
    assert excursion_allowed_m(Fault("ekf-jump", math.inf)) == math.inf
