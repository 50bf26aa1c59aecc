"""Whole missions in the fast world."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import GoalPassed, Record, Setpoint, TruthSample
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import FastFlight, fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.faults.fault_table import Fault
from tests.shared_flights import PLAIN_GPS, Flown, SharedFlights

MISSIONS = Path(__file__).parents[2] / "missions"
SHIPPED = [
    path.relative_to(MISSIONS).with_suffix("").as_posix()
    for path in sorted(MISSIONS.rglob("*.yaml"))
    if path.parent.name != "scenarios" and path.stem != "transit"  # test_waypoints.py flies the transit
]
# Flights that other tests look at.
SHARED: dict[str, Callable[[SharedFlights], Flown]] = {
    "dual_collision": lambda flown: flown("dual_collision", 2, vary=("contact=0.2",)),
    "dual_collision_gps": lambda flown: flown("dual_collision_gps", 1, settings=PLAIN_GPS),
    "dual_collision_replan": lambda flown: flown("dual_collision_replan", 1),
    "find_a_wall": lambda flown: flown("find_a_wall", 1),
    "paper_dual_collision": lambda flown: flown("paper_dual_collision", 1),
    "paper_single_wall": lambda flown: flown("paper_single_wall", 1),
    "rigid_cage/single_wall": lambda flown: flown("rigid_cage/single_wall", 1),
    "single_wall": lambda flown: flown("single_wall", 1),
}


def test_the_dual_collision_completes_as_in_the_paper(flown: SharedFlights) -> None:
    verdict = flown("paper_dual_collision", 1).verdict
    assert verdict.outcome == "completed"
    assert [(c.wall, c.mode) for c in verdict.collisions] == [("wood", "flexible"), ("acrylic", "rigid")]
    first = verdict.collisions[0]
    assert first.truth is not None
    assert first.truth.normal_m_s == pytest.approx(-0.6, abs=0.1)
    assert first.truth.tangential_m_s == pytest.approx(0.5, abs=0.1)
    for collision in verdict.collisions:
        assert collision.truth is not None
        assert collision.measured.peak_force_n == pytest.approx(collision.truth.peak_force_n, rel=0.15)
    switch = verdict.collisions[0].lock
    assert switch is not None
    assert switch.contact_end_us is not None
    assert switch.relaxed_us is not None
    assert switch.commanded_us is not None
    assert switch.settled_us is not None
    # The lock moves after the contact and the relaxation, and settles before the next wall.
    assert switch.contact_end_us < switch.relaxed_us <= switch.commanded_us + 20_000
    assert switch.commanded_us < switch.settled_us < verdict.collisions[1].t_us
    assert verdict.final_error_m is not None
    assert verdict.final_error_m <= 0.2
    assert verdict.max_tilt_deg is not None
    assert verdict.max_tilt_deg < 45.0
    assert not verdict.guard


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_mission_completes_as_predicted(name: str, flown: SharedFlights) -> None:
    if name in SHARED:
        verdict = SHARED[name](flown).verdict
    else:
        shipped = load_flyable(MISSIONS / f"{name}.yaml")
        verdict = fly_fast(shipped.replace({"goal.hold_s": min(1.0, shipped.goal.hold_s)}), 1, None)
    assert (verdict.outcome, verdict.reason, verdict.guard) == ("completed", None, [])
    assert verdict.plan_followed is not False
    assert verdict.uncontrolled == []


def test_setpoints_depend_only_on_the_seed(flown: SharedFlights) -> None:
    def setpoints(records: Iterable[Record]) -> bytes:
        return msgspec.json.encode([r for r in records if isinstance(r, Setpoint)])

    def recorded(seed: int) -> bytes:
        return setpoints(entry.record for entry in read_log(flown("paper_single_wall", seed).log).entries)

    again: list[Record] = []
    fly_fast(load_flyable(packaged("missions", "paper_single_wall.yaml")), 1, None, again.append)
    assert recorded(1) == setpoints(again)
    assert recorded(1) != recorded(2)


@pytest.mark.rest
def test_a_distant_goal_is_approached_at_transit_speed() -> None:
    mission = load_mission(packaged("missions", "paper_single_wall.yaml")).replace(
        {"goal.position_m": [-5.0, 1.0], "bounds_m.x": [-6.0, 2.2]}
    )
    records: list[Record] = []
    verdict = fly_fast(mission, 1, None, records.append)
    assert (verdict.outcome, verdict.reason) == ("completed", None)
    assert verdict.final_error_m is not None
    assert verdict.final_error_m < 0.1
    began = next(r.t_us for r in records if isinstance(r, GoalPassed))
    after = [r for r in records if isinstance(r, TruthSample) and r.t_us > began]
    speeds = [math.hypot(r.velocity_mission[0], r.velocity_mission[1]) for r in after]
    assert max(speeds) < 1.3 * mission.vehicle.flying.transit_speed_m_s


@pytest.mark.rest
def test_a_backward_clock_jump_before_takeoff_ends_the_flight_as_not_ready() -> None:
    """After the jump the autopilot's time stops for the core, while the host's time continues."""
    mission = load_mission(packaged("missions", "paper_single_wall.yaml"))
    flight = FastFlight(mission, 16, fault=Fault("clock-back", 972.6, None, 0.02))
    flight.run()
    assert flight.core.end is not None
    assert (flight.core.end.reason or "").startswith("not_ready")
    assert not flight.autopilot.armed
