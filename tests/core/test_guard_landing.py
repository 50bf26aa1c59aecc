"""Landings of the guard: when they end, when the motors are stopped, and where the vehicle waits."""

from __future__ import annotations

import math

import pytest

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.base.records import (
    FlightMode,
    ImuSample,
    LandedState,
    Override,
    Phase,
    Request,
    Setpoint,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.core.guard.flight_conditions import LYING_TILT_DEG
from dart_flight.core.guard.guard import _DISARM_AFTER_US, _HOLD_US, _LANDING_US, _RETRY_US, _UNSURE_US
from dart_flight.core.guard.rules import BATTERY_LOW_S, LYING_S
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.senses import Sensed
from tests.core.conftest import SHORT_TIMEOUTS, HandFedCore, core_in, known, of_kind
from tests.core.guard_causes import CAUSES, alternate_vehicles, lie_down

TICK_US = 4000  # period of the samples


@pytest.mark.parametrize(
    ("tilt_deg", "height_m", "seconds", "kills"),
    [
        (LYING_TILT_DEG + 1.0, 0.1, LYING_S + 0.1, True),
        (180.0, -0.1, LYING_S + 0.1, True),
        (LYING_TILT_DEG - 1.0, 0.1, 3.0, False),
        (LYING_TILT_DEG + 1.0, 0.8, 3.0, False),
        (LYING_TILT_DEG + 1.0, 0.1, LYING_S - 0.1, False),
    ],
    ids=["on its side", "upside down", "a slope", "in the air", "a moment"],
)
def test_only_a_vehicle_that_lies_on_the_ground_is_disarmed(
    tilt_deg: float, height_m: float, seconds: float, kills: bool
) -> None:
    c = core_in(Phase.APPROACH)
    lie_down(c, tilt_deg, height_m, seconds)
    assert (VehicleAction.KILL in c.actions) is kills


def test_a_tilt_that_is_no_longer_reported_disarms_nothing() -> None:
    c = core_in(Phase.APPROACH)
    c.q = quaternion_from_euler(math.radians(LYING_TILT_DEG + 20.0), 0.0, 0.0)
    c.run(0.02)
    c.silent.add("attitude")
    lie_down(c, LYING_TILT_DEG + 20.0, 0.1, LYING_S + 1.0)
    assert "lying" not in c.fired_rules


def test_motors_that_the_guard_has_stopped_are_no_further_fault() -> None:
    c = core_in(Phase.APPROACH)
    lie_down(c, LYING_TILT_DEG + 20.0, 0.1, LYING_S + 0.1)
    c.motors, c.falling = (0.0,) * 4, True
    c.run(0.3)
    assert "disarmed" not in c.fired_rules
    assert c.core.override is Override.KILL


def test_a_landed_vehicle_is_disarmed_only_if_px4_has_not_done_so_in_time() -> None:
    c = core_in(Phase.APPROACH)
    c.land_with_low_battery()
    (event,) = c.fired
    guard, state = c.guard, c.core.state

    def requested_actions(after_us: int, on_ground: bool) -> list[VehicleAction]:
        state.now_us, state.on_ground = event.t_us + after_us, on_ground
        out = guard.review(Tick(state.host_us), state, Sensed(), Phase.OVERRULED, Proposal())
        return [o.action for o in of_kind(VehicleCommand, out)]

    assert requested_actions(_DISARM_AFTER_US, on_ground=True) == []
    assert requested_actions(2 * _DISARM_AFTER_US, on_ground=False) == []  # never in the air
    assert requested_actions(_DISARM_AFTER_US + 1, on_ground=True) == [VehicleAction.DISARM]
    assert requested_actions(_DISARM_AFTER_US + _RETRY_US, on_ground=True) == []
    assert requested_actions(_DISARM_AFTER_US + _RETRY_US + 1, on_ground=True) == [VehicleAction.DISARM]


def test_motors_are_stopped_only_after_the_kill_timeout_of_a_landing() -> None:
    c = core_in(Phase.APPROACH, settings={"vehicle.guard.kill_after_s": 10.0})
    c.land_with_low_battery()
    c.run(9.9)
    assert VehicleAction.KILL not in c.actions
    c.run(0.2)
    assert VehicleAction.KILL in c.actions
    c.set_status(armed=False)
    c.run(0.25)
    assert known(c.core.end).outcome == "aborted"


def test_a_landing_is_awaited_until_the_kill_timeout() -> None:
    """The default is too short if the configured timeout is longer."""
    c = core_in(Phase.APPROACH, settings={"vehicle.guard.kill_after_s": 1e-6 * _LANDING_US + 1.0})
    c.land_with_low_battery()
    c.silent = {"actuator", "attitude"}
    c.odometry_every = 10
    c.run(1e-6 * _LANDING_US + 0.5)
    assert c.core.end is None
    c.run(1.0)
    assert c.fired_rules[-1] == "still_armed"


def ends_after(c: HandFedCore, after_us: int) -> bool:
    """Return whether the guard's landing has ended this long after it began."""
    event = next(e for e in c.fired if e.action is Override.LAND)
    guard, state = c.guard, c.core.state
    state.now_us = event.t_us + after_us
    guard.review(Tick(state.host_us), state, Sensed(), Phase.OVERRULED, Proposal())
    return guard.end is not None


def test_a_landing_without_a_kill_timeout_is_awaited_for_a_limited_time() -> None:
    c = core_in(Phase.APPROACH, settings={"vehicle.guard.kill_after_s": None})
    c.set_status(battery_v=12.9)
    c.run(BATTERY_LOW_S + 0.2)
    assert [ends_after(c, after_us) for after_us in (1_000_000, _LANDING_US, _LANDING_US + 1)] == [
        False,
        False,
        True,
    ]


def test_a_landing_beside_a_second_vehicle_lasts_a_minimum_time() -> None:
    """The report of landed and disarmed may come from either vehicle."""
    c = core_in(Phase.APPROACH)
    alternate_vehicles(c, 238_000_000, 0.0, 0.1)
    c.set_status(armed=False, landed=LandedState.ON_GROUND)
    assert [ends_after(c, after_us) for after_us in (1_000_000, _UNSURE_US - 1, _UNSURE_US)] == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("armed", [False, True])
def test_an_armed_vehicle_is_disarmed_when_the_flight_is_given_up(armed: bool) -> None:
    c = HandFedCore(settings=SHORT_TIMEOUTS)
    c.set_status(armed=armed)
    CAUSES["not_ready"].fly(c)
    assert c.core.end is not None
    assert c.actions == [VehicleAction.DISARM] * armed


def test_landing_time_counts_only_while_armed_in_land_mode() -> None:
    """Otherwise a long flight or a long wait on the ground would count as an endless landing."""
    c = core_in(Phase.APPROACH)
    watch = c.conditions
    c.run(2.0)
    assert watch.landing_s == 0.0
    c = HandFedCore()
    watch = c.conditions
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(2.0)
    assert watch.landing_s == 0.0
    c.set_status(armed=True)
    c.run(2.0)
    assert watch.landing_s == pytest.approx(2.0, abs=0.02)
    c.set_status(armed=False)
    c.run(0.1)
    assert watch.landing_s == 0.0


@pytest.mark.parametrize(("speed_m_s", "after_us"), [(0.09, _HOLD_US // 2), (0.11, _HOLD_US)])
def test_a_vehicle_that_broke_off_is_landed_after_half_the_time_if_it_rests(
    speed_m_s: float, after_us: int
) -> None:
    c = core_in(Phase.APPROACH)
    c.run(1.0)
    c.velocity_ned = (0.0, speed_m_s, 0.0)
    c.request(Request.LAND)
    out = c.run(1e-6 * _HOLD_US + 1.0)
    assert c.core.override is Override.BREAK_OFF
    land = next(o for o in out if isinstance(o, VehicleCommand) and o.action is VehicleAction.LAND)
    assert land.t_us - c.fired[0].t_us == after_us + TICK_US


def test_landing_time_is_the_shorter_of_both_clocks() -> None:
    c = HandFedCore()
    c.run(0.1)
    c.set_status(flight_mode=FlightMode.LAND, armed=True)
    c.run(2.0)
    c.host_ahead_us += 60_000_000
    c.run(0.02)
    assert c.conditions.landing_s == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize("whose", ["one sample", "autopilot", "host"])
def test_a_jump_of_one_clock_in_a_landing_does_not_stop_the_motors(whose: str) -> None:
    """Both clocks must exceed the timeout."""
    c = core_in(Phase.APPROACH)
    c.land_with_low_battery()
    c.run(1.0)
    if whose == "one sample":
        c.feed(ImuSample(c.t_us + 60_000_000, c.t_us, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)))
    elif whose == "autopilot":
        c.t_us += 60_000_000
        c.host_ahead_us -= 60_000_000
    else:
        c.host_ahead_us += 60_000_000
    c.run(1.0)
    assert "still_armed" not in c.fired_rules


def test_the_retreat_from_an_unknown_wall_follows_the_measured_push() -> None:
    """With plain GPS a wall may be a metre off its place, so the force gives its direction."""

    def retreat_target() -> tuple[float, float]:
        north, east, _ = of_kind(Setpoint, c.outputs)[-1].position_ned
        return north, east

    c = core_in(Phase.TRANSIT)
    assert c.core.phase is Phase.TRANSIT
    c.position_ned = (0.3, 0.2, -1.0)
    c.run(0.02)
    c.pulse((20.0, 0.0))
    assert c.fired_rules == ["unplanned_hit"]
    away_m = c.core.mission.vehicle.guard.retreat_m
    assert retreat_target() == pytest.approx((0.3 + away_m, 0.2), abs=0.01)
    c.run(0.3)
    c.pulse((0.0, -40.0))
    assert retreat_target() == pytest.approx((0.3, 0.2 - away_m), abs=0.01)


def test_the_retreat_from_one_face_of_a_partition_does_not_lead_through_it() -> None:
    """The vehicle is nearer to the front than the retreat, but on the other side."""
    board = {"point_m": [-0.15, 0.8], "normal": [-1.0, 0.0], "length_m": 0.2, "material": "wood"}
    thick = board | {"thickness_m": 0.012, "given_at": "centre"}
    c = core_in(Phase.TRANSIT, settings={"walls.board": thick})
    c.position_ned = (0.3, -0.8, -1.0)
    c.run(0.02)
    c.pulse((20.0, 0.0))
    assert c.fired_rules == ["unplanned_hit"]
    held = of_kind(Setpoint, c.outputs)[-1].position_ned
    assert held[:2] == pytest.approx((-0.15 + 0.412 + c.core.mission.vehicle.guard.retreat_m, -0.8), abs=0.01)


def test_one_report_of_landed_and_disarmed_does_not_end_a_guard_landing() -> None:
    """It may come from a second vehicle on the same link, before the first sample of that vehicle."""
    c = core_in(Phase.APPROACH)
    c.land_with_low_battery()
    c.run(1.0)
    c.set_status(armed=False, landed=LandedState.ON_GROUND)
    c.run(0.1)
    assert c.core.end is None
    alternate_vehicles(c, 0, 3.0, 1.0)
    assert c.core.end is None


def test_a_vehicle_reported_disarmed_in_the_air_has_not_landed() -> None:
    c = core_in(Phase.APPROACH)
    c.land_with_low_battery()
    c.set_status(armed=False)
    c.run(1.0)
    assert c.core.end is None
    c.set_status(landed=LandedState.ON_GROUND)
    c.run(1.0)
    assert c.core.end is not None
