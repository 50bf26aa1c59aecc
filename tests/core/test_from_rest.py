"""From one thing to the next, fed by hand: where a way begins, when it is over, what the lock is told."""

from __future__ import annotations

import math
from typing import Any

import pytest

from dart_flight.base.records import (
    FlightMode,
    LandedState,
    LockCommand,
    Mode,
    Output,
    Phase,
    PhaseChange,
    Setpoint,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.core.mission.course import ARRIVED_S
from tests.core.conftest import HandFedCore
from tests.core.test_limits import SINGLE, after_the_contact

HERE = (1.0, -0.5, -1.0)  # where `after_the_contact` leaves the vehicle, NED


def set_points(outputs: list[Output]) -> list[Setpoint]:
    return [o for o in outputs if isinstance(o, Setpoint)]


def after_phase(outputs: list[Output], phase: Phase) -> list[Output]:
    """What came after the change to a phase."""
    first = next(i for i, o in enumerate(outputs) if isinstance(o, PhaseChange) and o.after is phase)
    return outputs[first:]


def begun(outputs: list[Output]) -> dict[Phase, int]:
    """When each phase began, microseconds."""
    return {o.after: o.t_us for o in outputs if isinstance(o, PhaseChange)}


def test_to_a_waypoint_it_sets_out_from_where_it_has_come_to_rest() -> None:
    """Whatever the recovery's set point was."""
    c = HandFedCore(SINGLE, settings={"waypoints": [{"position_m": [0.2, 1.5], "after": 1}]})
    after_the_contact(c)
    out = after_phase(c.run(2.0), Phase.WAYPOINT)
    assert math.dist(set_points(out)[0].position_ned, HERE) < 0.01


def test_to_a_goal_far_away_it_sets_out_from_where_it_is() -> None:
    c = HandFedCore(SINGLE)
    after_the_contact(c)
    c.position_ned = (0.9, -1.0, -1.0)
    c.run(0.3)
    c.position_ned = (2.0, -1.0, -1.0)
    out = after_phase(c.run(0.3), Phase.GOAL)
    assert math.dist(set_points(out)[0].position_ned, c.position_ned) < 0.01


def test_having_arrived_for_one_phase_is_not_having_arrived_for_the_next() -> None:
    """The same place twice: each time it is to be there, slow and turned as wanted, for the whole time."""
    there = {"position_m": [0.0, 0.0], "hold_s": 0.0}
    c = HandFedCore(settings={"waypoints": [there, there | {"altitude_m": 1.0}]})
    c.finish_climb()
    c.run(2.0)
    arrive_us = ARRIVED_S * 1e6
    times = [o.t_us for o in c.outputs if isinstance(o, PhaseChange) and o.before is not Phase.READYING]
    assert Phase.TRANSIT in begun(c.outputs)
    first, second, transit = times[-4:-1] if c.core.phase is Phase.PREPARE else times[-3:]
    assert second - first >= arrive_us
    assert transit - second >= arrive_us


WAITS: dict[str, Any] = {"pause": "operator", "timeout_s": 60.0}
FLIES: dict[str, Any] = {"position_m": [1.0, 0.0], "hold_s": 1.0}


@pytest.mark.parametrize(("stop", "phase"), [(WAITS, Phase.PAUSE), (FLIES, Phase.WAYPOINT)])
def test_wherever_it_stops_the_lock_is_brought_back_to_the_transit_mode(
    stop: dict[str, Any], phase: Phase
) -> None:
    c = HandFedCore(settings={"waypoints": [stop]})
    c.finish_climb()
    assert c.core.phase is phase
    c.outputs.clear()
    c.set_lock(Mode.FLEXIBLE)  # somebody has moved it
    c.run(0.1)
    assert [o.mode for o in c.outputs if isinstance(o, LockCommand)] == [Mode.RIGID]


def test_at_the_goal_the_lock_is_brought_back_to_the_transit_mode() -> None:
    c = HandFedCore(SINGLE)
    after_the_contact(c)
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(8.5)
    assert c.core.phase is Phase.GOAL
    c.outputs.clear()
    c.set_lock(Mode.FLEXIBLE)
    c.run(0.1)
    assert [o.mode for o in c.outputs if isinstance(o, LockCommand)] == [Mode.RIGID]


def test_a_new_phase_does_not_wait_to_give_the_lock_its_order_again() -> None:
    """An order that has had no effect is repeated every second, and at once where a phase begins."""
    c = HandFedCore(SINGLE, settings={"waypoints": [{"position_m": [0.2, 1.5], "after": 1}]})
    c.enter_approach()
    c.position_ned, c.velocity_ned = (1.6, -0.5, -1.0), (1.0, -0.5, 0.0)
    c.run(0.05)
    c.pulse((-20.0, 10.0))
    c.position_ned, c.velocity_ned = HERE, (0.0, 0.0, 0.0)
    out = c.run(0.9)  # the lock stays flexible
    orders = [o.t_us for o in out if isinstance(o, LockCommand)]
    assert c.core.phase is Phase.WAYPOINT
    assert len(orders) == 2
    assert 0 <= orders[1] - begun(out)[Phase.WAYPOINT] < 20_000


def test_a_vehicle_that_has_landed_and_stays_armed_is_told_to_disarm() -> None:
    c = HandFedCore(SINGLE)
    after_the_contact(c)
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(10.5)
    assert c.core.phase is Phase.LANDING
    c.set_status(flight_mode=FlightMode.LAND)
    asked = [o.action for o in c.run(9.0) if isinstance(o, VehicleCommand)]
    assert asked == []  # never in the air
    c.outputs.clear()
    c.set_status(landed=LandedState.ON_GROUND)
    c.run(2.5)
    asked = [o.action for o in c.outputs if isinstance(o, VehicleCommand)]
    assert asked == [VehicleAction.DISARM] * 3


def test_one_report_of_landed_and_disarmed_is_not_added_to_a_later_one() -> None:
    """The first may have been another vehicle's."""
    c = HandFedCore(SINGLE)
    after_the_contact(c)
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(10.5)
    c.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    c.run(0.1)
    c.set_status(landed=LandedState.IN_AIR, armed=True)
    c.run(1.0)
    c.set_status(landed=LandedState.ON_GROUND, armed=False)
    c.run(0.1)
    assert c.core.end is None
    c.run(0.2)
    assert c.core.end is not None
