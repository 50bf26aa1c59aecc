"""Phase transitions: where a path starts, when a phase ends, and the lock commands in between."""

from __future__ import annotations

import math
from typing import Any

import pytest

from dart_flight.base.records import (
    FlightMode,
    GuardEvent,
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
from dart_flight.core.mission.ground_phases import _DISARM_AFTER_US
from dart_flight.core.mission.phases import DOWN_US
from tests.core.conftest import SHORT_TIMEOUTS, SINGLE, HandFedCore, core_in, known, of_kind

HERE = (1.0, -0.5, -1.0)  # where `leave_single_wall` leaves the vehicle, NED


def after_phase(outputs: list[Output], phase: Phase) -> list[Output]:
    """Return the outputs from the change to a phase on."""
    first = next(i for i, o in enumerate(outputs) if isinstance(o, PhaseChange) and o.after is phase)
    return outputs[first:]


def phase_starts_us(outputs: list[Output]) -> dict[Phase, int]:
    """Return when each phase began, microseconds."""
    return {o.after: o.t_us for o in outputs if isinstance(o, PhaseChange)}


def test_a_path_to_a_waypoint_starts_where_the_vehicle_came_to_rest() -> None:
    """It does not start at the recovery setpoint."""
    c = HandFedCore(SINGLE, settings={"waypoints": [{"position_m": [0.2, 1.5], "after": 1}]})
    c.leave_single_wall()
    out = after_phase(c.run(2.0), Phase.WAYPOINT)
    assert math.dist(of_kind(Setpoint, out)[0].position_ned, HERE) < 0.01


def test_a_path_to_a_distant_goal_starts_at_the_vehicle() -> None:
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.9, -1.0, -1.0)
    c.run(0.3)
    c.position_ned = (2.0, -1.0, -1.0)
    out = after_phase(c.run(0.3), Phase.GOAL)
    assert math.dist(of_kind(Setpoint, out)[0].position_ned, c.position_ned) < 0.01


def test_arrival_is_timed_again_in_every_phase() -> None:
    """Two waypoints at the same place each need the full time, slow and with the right heading."""
    there = {"position_m": [0.0, 0.0], "hold_s": 0.0}
    c = core_in(Phase.TRANSIT, settings={"waypoints": [there, there | {"altitude_m": 1.0}]})
    c.run(2.0)
    arrive_us = ARRIVED_S * 1e6
    times = [o.t_us for o in c.outputs if isinstance(o, PhaseChange) and o.before is not Phase.READYING]
    assert Phase.TRANSIT in phase_starts_us(c.outputs)
    first, second, transit = times[-4:-1] if c.core.phase is Phase.PREPARE else times[-3:]
    assert second - first >= arrive_us
    assert transit - second >= arrive_us


def test_a_waypoint_is_given_up_after_its_flight_and_the_timeout() -> None:
    settings = {"waypoints": [{"position_m": [1.0, 0.0], "speed_m_s": 0.5}], **SHORT_TIMEOUTS}
    c = core_in(Phase.TRANSIT, settings=settings)
    out = c.run(8.0)  # the vehicle does not follow the setpoints
    (event,) = of_kind(GuardEvent, out)
    assert (event.rule, event.detail) == ("transit_timeout", "waypoint 1 was not reached in time")
    waited_s = (event.t_us - phase_starts_us(c.outputs)[Phase.WAYPOINT]) * 1e-6
    assert waited_s == pytest.approx(1.875 * 1.0 / 0.5 + 3.0, abs=0.02)


def test_a_reached_waypoint_is_not_given_up_while_it_is_held() -> None:
    """The hold may last longer than the timeout, and the vehicle may drift meanwhile."""
    settings = {"waypoints": [{"position_m": [0.0, 0.0], "hold_s": 6.0}], **SHORT_TIMEOUTS}
    c = core_in(Phase.TRANSIT, settings=settings)
    c.run(0.5)
    c.position_ned = (0.3, 0.0, -1.0)
    out = c.run(5.0)
    assert c.core.phase is Phase.WAYPOINT
    assert not of_kind(GuardEvent, out)


WAITS: dict[str, Any] = {"pause": "operator", "timeout_s": 60.0}
FLIES: dict[str, Any] = {"position_m": [1.0, 0.0], "hold_s": 1.0}


@pytest.mark.parametrize(("stop", "phase"), [(WAITS, Phase.PAUSE), (FLIES, Phase.WAYPOINT)])
def test_the_lock_returns_to_the_transit_mode_at_every_stop(stop: dict[str, Any], phase: Phase) -> None:
    c = core_in(Phase.TRANSIT, settings={"waypoints": [stop]})
    assert c.core.phase is phase
    c.outputs.clear()
    c.set_lock(Mode.FLEXIBLE)  # moved by hand
    c.run(0.1)
    assert [o.mode for o in of_kind(LockCommand, c.outputs)] == [Mode.RIGID]


def test_the_lock_returns_to_the_transit_mode_at_the_goal() -> None:
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(8.5)
    assert c.core.phase is Phase.GOAL
    c.outputs.clear()
    c.set_lock(Mode.FLEXIBLE)
    c.run(0.1)
    assert [o.mode for o in of_kind(LockCommand, c.outputs)] == [Mode.RIGID]


def test_a_new_phase_repeats_the_lock_command_at_once() -> None:
    """A command without effect is repeated every second, and at once when a phase begins."""
    c = core_in(Phase.APPROACH, SINGLE, settings={"waypoints": [{"position_m": [0.2, 1.5], "after": 1}]})
    c.position_ned, c.velocity_ned = (1.6, -0.5, -1.0), (1.0, -0.5, 0.0)
    c.run(0.05)
    c.pulse((-20.0, 10.0))
    c.position_ned, c.velocity_ned = HERE, (0.0, 0.0, 0.0)
    out = c.run(0.9)  # the lock stays flexible
    commands = [o.t_us for o in of_kind(LockCommand, out)]
    assert c.core.phase is Phase.WAYPOINT
    assert len(commands) == 2
    assert 0 <= commands[1] - phase_starts_us(out)[Phase.WAYPOINT] < 20_000


def test_a_landed_vehicle_that_stays_armed_is_disarmed() -> None:
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(10.5)
    assert c.core.phase is Phase.LANDING
    c.set_status(flight_mode=FlightMode.LAND)
    assert not of_kind(VehicleCommand, c.run(1e-6 * _DISARM_AFTER_US + 1.0))  # never in the air
    c.outputs.clear()
    c.set_status(landed=LandedState.ON_GROUND)
    c.run(2.5)
    assert c.actions == [VehicleAction.DISARM] * 3


def test_an_interrupted_landed_report_does_not_count_towards_the_next() -> None:
    """The first report may come from another vehicle."""
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.4, -1.0, -1.0)
    c.run(10.5)
    c.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    c.run(0.1)
    c.set_status(landed=LandedState.IN_AIR, armed=True)
    c.run(1.0)
    c.set_status(landed=LandedState.ON_GROUND, armed=False)
    reported_us = c.t_us
    c.run(0.5e-6 * DOWN_US)
    assert c.core.end is None
    c.run(1e-6 * DOWN_US)
    assert known(c.core.end).t_us - reported_us == DOWN_US
