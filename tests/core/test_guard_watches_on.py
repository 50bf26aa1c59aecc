"""Rules that still apply after the guard has overruled the mission; a landing is not interrupted."""

from __future__ import annotations

import pytest

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.base.records import (
    EstimatorSample,
    FlightMode,
    Override,
    Phase,
    Request,
    Setpoint,
    VehicleAction,
)
from dart_flight.config.mission import load_mission
from dart_flight.core.guard.rules import _ALTITUDE_SLACK_M, _GUARD_STRAYS_M, RULES
from tests.core.conftest import DUAL, ROOT, HandFedCore, core_in, of_kind

MISSION = load_mission(ROOT / DUAL)
(SOUTH_M, NORTH_M), (LOW_M, HIGH_M) = MISSION.bounds.x, MISSION.bounds.z


def broken_off_core() -> HandFedCore:
    return request_landing(core_in(Phase.APPROACH))


def request_landing(c: HandFedCore) -> HandFedCore:
    c.request(Request.LAND)
    c.run(0.1)
    assert c.fired_actions == [("operator", "break_off")]
    c.velocity_ned = (0.3, 0.0, 0.0)  # moving: it lands only after 3 s
    return c


@pytest.mark.parametrize(
    ("north_m", "rules"),
    [
        (NORTH_M + _GUARD_STRAYS_M - 0.01, []),
        (NORTH_M + _GUARD_STRAYS_M + 0.01, [("bounds", "hold")]),
        (SOUTH_M - _GUARD_STRAYS_M - 0.01, [("bounds", "hold")]),
    ],
)
def test_a_break_off_that_leaves_the_bounds_holds(north_m: float, rules: list[tuple[str, str]]) -> None:
    """The excess must exceed the tolerance for a wall at their edge."""
    c = broken_off_core()
    c.position_ned = (north_m, 0.0, -1.0)
    out = c.run(0.1)
    assert c.fired_actions[1:] == rules
    if rules:
        assert c.core.override is Override.HOLD
        assert of_kind(Setpoint, out)[-1].position_ned[0] == pytest.approx(north_m)


@pytest.mark.parametrize(
    ("height_m", "lands"),
    [
        (HIGH_M + _ALTITUDE_SLACK_M + 0.01, True),
        (HIGH_M + _ALTITUDE_SLACK_M - 0.01, False),
        (LOW_M - _ALTITUDE_SLACK_M - 0.01, True),
        (LOW_M - _ALTITUDE_SLACK_M + 0.01, False),
    ],
)
def test_a_break_off_that_leaves_the_altitude_limits_lands(height_m: float, lands: bool) -> None:
    c = broken_off_core()
    c.position_ned = (0.0, 0.0, -height_m)
    c.run(0.1)
    assert c.fired_actions[1:] == ([("altitude", "land")] if lands else [])


def test_a_landing_may_descend_below_the_lowest_altitude() -> None:
    c = broken_off_core()
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(2.0)
    assert VehicleAction.LAND in c.actions
    c.set_status(flight_mode=FlightMode.LAND)
    for height_m in (0.25, 0.1, 0.0):
        c.position_ned = (2.6, 0.0, -height_m)
        c.run(0.1)
    assert c.fired_actions == [("operator", "break_off")]


def test_a_broken_off_climb_may_be_below_the_lowest_altitude() -> None:
    c = core_in(Phase.CLIMB)
    assert c.core.phase is Phase.CLIMB
    c.position_ned = (0.0, 0.0, -0.1)
    request_landing(c)
    c.run(0.3)
    assert c.fired_actions == [("operator", "break_off")]


def test_a_tilt_without_effect_is_reported_once() -> None:
    c = broken_off_core()
    for _ in range(2):
        c.q = quaternion_from_euler(1.3, 0.0, 0.0)
        c.run(0.1)
        c.q = quaternion_from_euler(0.0, 0.0, 0.0)
        c.run(0.1)
    assert c.fired_actions[1:] == [("tilt", "none")]
    assert c.core.override is Override.BREAK_OFF
    assert c.guard.reason == "operator: landing requested"


def test_an_estimator_jump_moves_the_hold_position() -> None:
    c = broken_off_core()
    c.use_rules(RULES)
    for east_m in (0.5, 1.0):  # the second jump finds the guard holding already
        c.position_ned = (0.0, east_m, -1.0)
        last = of_kind(Setpoint, c.run(0.1))[-1]
        assert last.position_ned[1] == pytest.approx(east_m)
    assert c.fired_actions[1:] == [("estimator_jump", "hold")]


def test_an_impact_does_not_excuse_an_uncertain_position() -> None:
    """A hit does not raise PX4's standard deviation; a drifting position exceeds the limit in that time."""
    c = HandFedCore()
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.feed(EstimatorSample(c.t_us, c.t_us, position_sd_m=0.11))
    c.run(0.05)
    assert ("position_uncertain", "land") in c.fired_actions
