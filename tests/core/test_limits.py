"""Time and distance limits of the core; each test fails if its limit is ignored or moved."""

from __future__ import annotations

import itertools
import math

import msgspec
import pytest

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.base.records import (
    ClockOffset,
    ContactEnd,
    EstimatorSample,
    FlightMode,
    GoalPassed,
    ImpactOnset,
    ImpactPeak,
    LandedState,
    OdometrySample,
    Phase,
    PhaseChange,
    Request,
    Setpoint,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.config.mission import load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.guard.estimator_watch import ESTIMATOR_BAD_S
from dart_flight.core.guard.guard import _HOLD_US, _RETRY_US
from dart_flight.core.mission.course import ARRIVED_S
from dart_flight.core.mission.executive import _REST_AFTER_US, _REST_TIMEOUT_US
from dart_flight.core.mission.executive import _RETRY_US as _MISSION_RETRY_US
from dart_flight.core.mission.mission_progress import _SLOWEST, MissionProgress
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import (
    DUAL,
    ROOT,
    RULES_WITHOUT_JUMP,
    SHORT_TIMEOUTS,
    SINGLE,
    HandFedCore,
    MissionInPhase,
    core_in,
    known,
    of_kind,
)

MISSION = load_mission(ROOT / DUAL)
RETREAT_M = MISSION.vehicle.guard.retreat_m
HOLD_S, RETRY_S = 1e-6 * _HOLD_US, 1e-6 * _RETRY_US


# --- the detector ------------------------------------------------------------------------------------------


def test_arm_vibration_after_a_contact_is_no_second_impact() -> None:
    """No impact is detected during the refractory time after a contact, but impacts are after it."""
    c = HandFedCore()
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    refractory_s = c.core.mission.vehicle.detection.refractory_s
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(0.05)
    assert of_kind(ContactEnd, c.outputs)
    # Well above the threshold, but shorter than the refractory time.
    swing = c.pulse((-14.0, 0.0), refractory_s - 0.08)
    assert not of_kind(ImpactOnset, swing)
    c.run(0.1)
    again = c.pulse((-14.0, 0.0)) + c.run(0.1)
    assert len(of_kind(ImpactOnset, again)) == 1


def test_friction_alone_can_start_the_planned_hit() -> None:
    """Friction comes first; only a force clearly into the wall is unplanned."""
    c = HandFedCore()
    c.fly_to_wood()
    out = c.pulse((-14.0, 0.0))
    assert [o.planned for o in of_kind(ImpactOnset, out)] == [True]
    assert not c.fired


def test_the_peak_of_a_hit_from_behind_is_detected_without_delay() -> None:
    """Its force points into the wall, so the wall's normal does not apply."""
    c = HandFedCore()
    c.fly_to_wood()
    began_us = c.t_us
    out = c.pulse((0.0, 16.0)) + c.run(0.1)
    assert [o.planned for o in of_kind(ImpactOnset, out)] == [False]
    (peak,) = of_kind(ImpactPeak, out)
    assert peak.detected_us - began_us < 60_000
    assert peak.normal == pytest.approx((0.0, -1.0), abs=0.05)


def test_a_push_above_the_threshold_counts_as_wind_only_after_it_outlasts_a_contact() -> None:
    climbing, pushed = core_in(Phase.CLIMB), HandFedCore()  # in the climb no contact is expected yet
    pushed.fly_to_wood()
    pushed.pulse((-10.0, -16.0))
    pushed.position_ned, pushed.velocity_ned = (1.0, 1.0, -1.0), (0.0, 0.0, 0.0)
    for c in (climbing, pushed):
        c.force_ned = (14.0, 0.0, 0.0)
        c.run(1.0)
    assert climbing.senses.detector.slow_force.value == (0.0, 0.0)
    assert pushed.senses.detector.slow_force.value[0] > 1.0


# --- phases ---


TRAVEL_S = 2.0
LATE_US = round(1e6 * (MISSION.vehicle.flying.ready_timeout_s + TRAVEL_S))
SLOW_US = round(_SLOWEST * LATE_US)  # by the host's clock


@pytest.mark.parametrize(
    ("autopilot_us", "host_us", "late"),
    [
        (LATE_US, LATE_US, False),
        (LATE_US + 1, LATE_US + 1, True),
        (LATE_US + 1, 0, True),
        (0, SLOW_US, False),  # a slow simulation
        (0, SLOW_US + 1, True),  # the autopilot's clock jumped back
    ],
)
def test_a_phase_is_late_after_its_timeout_and_its_travel_time(
    autopilot_us: int, host_us: int, late: bool
) -> None:
    state, progress = FlightState(), MissionProgress(MISSION, {})
    progress.entered_us, progress.entered_host_us = 50_000_000, 70_000_000
    state.now_us, state.host_us = progress.entered_us + autopilot_us, progress.entered_host_us + host_us
    assert progress.is_late(state, TRAVEL_S) is late


def test_the_time_before_the_first_sample_does_not_count() -> None:
    """The autopilot may have run for long when the program starts."""
    c = HandFedCore(settings=SHORT_TIMEOUTS)
    c.t_us += 3_600_000_000
    c.run(2.9)
    assert not c.fired
    c.run(0.3)
    assert c.fired_rules == ["not_ready"]


def test_every_waypoint_is_held_after_its_arrival() -> None:
    """The vehicle is at both waypoints from the beginning."""
    here = {"position_m": [0.0, 0.0], "speed_m_s": 0.5}
    c = core_in(Phase.TRANSIT, settings={"waypoints": [{**here, "hold_s": 1.2}, {**here, "hold_s": 0.5}]})
    c.run(3.0)
    began = of_kind(PhaseChange, c.outputs)[-4:-1]
    assert [o.after for o in began] == [Phase.WAYPOINT, Phase.WAYPOINT, Phase.TRANSIT]
    held_s = [(b.t_us - a.t_us) * 1e-6 for a, b in itertools.pairwise(began)]
    assert held_s == pytest.approx([ARRIVED_S + 1.2, ARRIVED_S + 0.5], abs=0.03)


@pytest.mark.parametrize(
    ("after_us", "speed_m_s", "rests"),
    [
        (_REST_AFTER_US, 0.0, False),
        (_REST_AFTER_US + 1, 0.0, True),
        (_REST_TIMEOUT_US, 1.0, False),
        (_REST_TIMEOUT_US + 1, 1.0, True),
    ],
)
def test_a_leg_from_rest_begins_when_the_vehicle_is_slow_or_after_a_timeout(
    after_us: int, speed_m_s: float, rests: bool
) -> None:
    mission = load_mission(ROOT / SINGLE).replace({"waypoints": [{"position_m": [-1.0, 1.0], "after": 1}]})
    flown = MissionInPhase(mission, Phase.RECOVERY, 1)
    flown.state.update_odometry(OdometrySample(after_us, 0, (1.0, 0.0, -1.0), (speed_m_s, 0.0, 0.0)))
    flown.step()
    assert (flown.progress.phase is Phase.WAYPOINT) is rests


HELD_S = 2.0
HELD = MISSION.replace(
    {
        "waypoints": [{"position_m": [0.0, 0.0], "hold_s": HELD_S}],
        "goal": {"position_m": [0.0, 0.0], "capture_radius_m": 0.15, "hold_s": HELD_S},
    }
)


@pytest.mark.parametrize(
    ("phase", "following"), [(Phase.WAYPOINT, Phase.TRANSIT), (Phase.GOAL, Phase.LANDING)]
)
def test_a_waypoint_and_the_goal_are_held_to_the_microsecond(phase: Phase, following: Phase) -> None:
    began_us, hold_us = 1_000_000, round(1e6 * HELD_S)
    for held_us, after in ((hold_us - 1, phase), (hold_us, following)):
        flown = MissionInPhase(HELD, phase, now_us=began_us + held_us)
        flown.progress.reached_us = flown.progress.captured_us = began_us
        flown.step()
        assert flown.progress.phase is after


assert MISSION.vehicle.lock is not None
PEAK_US = round(2e6 * MISSION.vehicle.detection.peak_wait_s)
LOCK_US = round(1e6 * (MISSION.vehicle.lock.timeout_s + 2.0))


@pytest.mark.parametrize(
    ("phase", "after_us", "rules"),
    [
        (Phase.CONTACT, PEAK_US, []),
        (Phase.CONTACT, PEAK_US + 1, ["no_peak"]),
        (Phase.PREPARE, LOCK_US, []),
        (Phase.PREPARE, LOCK_US + 1, ["lock_not_ready"]),
    ],
)
def test_a_peak_and_the_lock_are_awaited_for_a_limited_time(
    phase: Phase, after_us: int, rules: list[str]
) -> None:
    assert MissionInPhase(MISSION, phase, now_us=after_us).step() == rules


def test_the_operator_ends_one_pause_at_a_time() -> None:
    pause = {"pause": "operator", "timeout_s": 5.0}
    c = core_in(Phase.TRANSIT, settings={"waypoints": [pause, pause]})
    for phase in (Phase.PAUSE, Phase.PAUSE, Phase.TRANSIT, Phase.TRANSIT):
        assert c.core.phase is phase
        c.request(Request.CONTINUE)
        c.run(0.02)


@pytest.mark.parametrize(
    ("after_us", "repeated"), [(_MISSION_RETRY_US - 1, False), (_MISSION_RETRY_US, True)]
)
def test_a_command_is_repeated_after_its_retry_time(after_us: int, repeated: bool) -> None:
    flown, counts = MissionInPhase(MISSION, Phase.ARMING), []
    for flown.state.now_us in (5, 5 + after_us):
        flown.step()
        counts.append(len(of_kind(VehicleCommand, flown.proposal.outputs)))
    assert counts == [1, repeated]


# --- commands ----------------------------------------------------------------------------------------------


def landing_requests_s(c: HandFedCore, seconds: float) -> list[float]:
    """Run for `seconds`; return when landing is requested, seconds from now."""
    began_us = c.t_us
    out = c.run(seconds)
    requested = of_kind(VehicleCommand, out)
    assert {o.action for o in requested} <= {VehicleAction.LAND}
    return [(o.t_us - began_us) * 1e-6 for o in requested]


def test_the_guard_requests_landing_every_second_until_telemetry_confirms_it() -> None:
    c = core_in(Phase.APPROACH)
    c.position_ned = (0.0, 0.0, -2.2)  # lands at once
    times = landing_requests_s(c, 3.5 * RETRY_S)
    assert times == pytest.approx([RETRY_S * i for i in range(4)], abs=0.04)
    c.set_status(flight_mode=FlightMode.LAND)
    assert landing_requests_s(c, 2.5) == []


def test_the_mission_requests_landing_every_second_until_telemetry_confirms_it() -> None:
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.4, -1.0, -1.0)  # at the goal
    out = c.run(8.5)  # until the recovery times out
    assert [o.timed_out for o in of_kind(GoalPassed, out)] == [True]
    c.run(2.0)
    assert c.core.phase is Phase.LANDING
    first, *later = landing_requests_s(c, 3.5 * RETRY_S)
    assert [t - first for t in later[:2]] == pytest.approx([RETRY_S, 2.0 * RETRY_S], abs=0.04)
    c.set_status(flight_mode=FlightMode.LAND)
    assert landing_requests_s(c, 2.5) == []
    c.set_status(landed=LandedState.ON_GROUND)
    c.set_status(armed=False)
    c.run(0.1)
    assert c.core.end is None  # one report may come from another vehicle
    c.run(0.2)
    assert known(c.core.end).outcome == "completed"


def test_a_stronger_action_does_not_wait_for_the_retry_of_a_weaker_one() -> None:
    c = core_in(Phase.APPROACH)
    c.request(Request.LAND)
    assert landing_requests_s(c, 0.5 * HOLD_S + 0.1) == [pytest.approx(0.5 * HOLD_S, abs=0.02)]
    c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
    assert landing_requests_s(c, 0.9) == [pytest.approx(ESTIMATOR_BAD_S, abs=0.03)]


def test_a_tilted_vehicle_is_stopped_by_setpoints_before_it_lands() -> None:
    """PX4's land mode levels only at MPC_JERK_AUTO: after 64 degrees it flew 17 m at up to 7 m/s."""
    c = core_in(Phase.APPROACH)
    c.q, c.velocity_ned = quaternion_from_euler(1.2, 0.0, 0.0), (1.5, 0.0, 0.0)
    out = c.run(0.5)
    assert c.fired_rules == ["tilt"]
    assert not of_kind(VehicleCommand, out)
    setpoints = of_kind(Setpoint, out)
    assert len(setpoints) >= 14
    assert len({o.position_ned for o in setpoints[1:]}) == 1
    c.q, c.velocity_ned = quaternion_from_euler(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    rested_s = 0.5 * HOLD_S - 0.5
    assert landing_requests_s(c, rested_s + 0.6) == [pytest.approx(rested_s, abs=0.05)]


# --- where the guard holds ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("up_m", "held_m"),
    [
        (0.6, 1.0),  # too low: climb to the mission's altitude
        (1.0, 1.0),
        (1.6, 1.6),  # higher: do not descend onto a possible obstacle
    ],
)
def test_the_guard_holds_at_the_mission_altitude_or_higher(up_m: float, held_m: float) -> None:
    c = core_in(Phase.APPROACH)
    c.position_ned = (0.0, 0.0, -up_m)
    c.run(0.02)
    assert not c.fired
    c.request(Request.LAND)
    held = of_kind(Setpoint, c.run(0.5))
    assert held
    assert {round(o.position_ned[2], 6) for o in held} == {-held_m}


@pytest.mark.parametrize(
    ("mission", "distance_m", "along_m", "closing_m_s", "held_m"),
    [
        (SINGLE, 0.3, 0.0, 0.0, RETREAT_M),  # the retreat distance
        (SINGLE, 0.8, 0.0, 0.0, 0.8),  # farther away: no retreat
        (SINGLE, 0.8, 0.0, 0.8, 1.2),  # brake harder than by holding still
        (SINGLE, 0.8, 0.0, -0.8, 0.8),
        (SINGLE, 1.1, 0.0, 0.8, 1.1),  # no hard braking for a distant wall
        (SINGLE, 0.3, 1.7, 0.0, 0.3),  # beside the wall's end there is no wall ahead
        (SINGLE, 0.3, -1.7, 0.0, 0.3),
        (SINGLE, -0.3, 0.0, 0.0, RETREAT_M),  # the wall may be farther away than planned
        (SINGLE, -0.52, 0.0, 0.0, -0.52),  # on its other side
        (DUAL, 0.3, 0.2, 0.0, RETREAT_M),  # a wall along the other axis
        (DUAL, RETREAT_M + 0.1, 0.2, 0.4, RETREAT_M + 0.3),
        (DUAL, RETREAT_M + 0.1, 0.2, -0.4, RETREAT_M + 0.1),
    ],
)
def test_a_break_off_keeps_its_distance_from_a_wall_ahead(
    mission: str, distance_m: float, along_m: float, closing_m_s: float, held_m: float
) -> None:
    c = core_in(Phase.PREPARE, mission)
    wall = c.core.mission.walls[0]
    (nx, ny), (tx, ty) = wall.normal, wall.tangent
    away_m = distance_m - wall.signed_distance(wall.point)
    x, y = wall.point[0] + away_m * nx + along_m * tx, wall.point[1] + away_m * ny + along_m * ty
    c.position_ned, c.velocity_ned = (x, -y, -1.0), (-closing_m_s * nx, closing_m_s * ny, 0.0)
    c.run(0.02)
    assert wall.signed_distance(c.core.state.position) == pytest.approx(distance_m, abs=0.01)
    c.request(Request.LAND)
    north, east, _ = of_kind(Setpoint, c.run(0.1))[0].position_ned
    assert wall.signed_distance((north, -east)) == pytest.approx(held_m, abs=0.02)
    assert (north - x) * tx + (-east - y) * ty == pytest.approx(0.0, abs=0.01)


def test_a_vehicle_that_stops_beyond_its_retreat_stays_there() -> None:
    """A return could touch the wall: after a tilt of 64 degrees PX4 overshot the retreat and did so."""
    c = core_in(Phase.APPROACH)

    def held(position: tuple[float, float], speed: float, seconds: float = 0.1) -> set[tuple[float, float]]:
        c.position_ned, c.velocity_ned = (*position, -1.0), (-speed, 0.0, 0.0)
        c.run(0.04)
        return {o.position_ned[:2] for o in c.run(seconds) if isinstance(o, Setpoint)}

    held((0.2, 0.0), 1.2)
    c.request(Request.LAND)
    (away,) = held((0.1, 0.0), 1.2)
    assert held((-0.6, 0.0), 1.0) == {away}  # still moving
    assert held((-0.8, 0.0), 0.1) == {(-0.8, 0.0)}
    assert held((-0.7, 0.0), 0.1) == {(-0.8, 0.0)}  # the hold position does not move again


def test_the_retreat_from_a_mission_wall_follows_its_normal() -> None:
    c = HandFedCore()
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(0.02)
    c.request(Request.LAND)
    north, east, _ = of_kind(Setpoint, c.run(0.1))[0].position_ned
    assert north == pytest.approx(c.position_ned[0], abs=0.01)
    assert east < c.position_ned[1] - 0.4


def test_the_guard_holds_at_the_altitude_of_the_current_waypoint() -> None:
    higher = {"position_m": [0.0, 0.0], "altitude_m": 1.4, "speed_m_s": 0.5, "hold_s": 1.0}
    c = core_in(Phase.PREPARE, settings={"waypoints": [higher]})
    assert c.core.phase is Phase.WAYPOINT
    c.request(Request.LAND)
    held = of_kind(Setpoint, c.run(0.5))
    assert {round(o.position_ned[2], 6) for o in held} == {-1.4}


def test_the_guard_does_not_climb_out_of_the_flight_space() -> None:
    """The loader refuses a mission higher than its flight space; the guard does not rely on that."""
    c = HandFedCore()
    mission = c.core.mission
    low = msgspec.structs.replace(mission.bounds, z=(0.3, 0.96))
    c.core = FlightCore(msgspec.structs.replace(mission, bounds=low), RULES_WITHOUT_JUMP)
    c.feed(ClockOffset(c.t_us, 0))
    c.enter_approach()
    c.position_ned = (0.0, 0.0, -0.9)
    c.run(0.02)
    c.request(Request.LAND)
    held = of_kind(Setpoint, c.run(0.5))
    assert {round(o.position_ned[2], 6) for o in held} == {-0.96}


@pytest.mark.parametrize("detail", ["", "PX4 has ended by SIGKILL"])
def test_the_ended_process_is_named_if_it_is_known(detail: str) -> None:
    c = core_in(Phase.APPROACH)
    c.request(Request.WORLD_DIED, detail)
    assert [event.detail for event in c.fired] == [detail or "the simulated vehicle ended"]


def test_the_guard_keeps_the_last_commanded_heading() -> None:
    """The mission is still turning the vehicle from 0.6 rad towards zero."""
    c = HandFedCore()
    c.q = quaternion_from_euler(0.0, 0.0, 0.6)
    c.finish_climb()
    last = [o.yaw_ned_rad for o in of_kind(Setpoint, c.outputs)][-1]
    assert 0.2 < last < 0.55
    c.request(Request.LAND)
    held = [o.yaw_ned_rad for o in of_kind(Setpoint, c.run(0.5))]
    assert held
    assert set(held) == {last}


# --- heading -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.6, -0.6])
def test_the_heading_turns_at_its_rate_limit_and_reaches_the_target(yaw: float) -> None:
    """The vehicle starts obliquely; the walls need a multiple of a quarter turn."""
    c = HandFedCore()
    c.q = quaternion_from_euler(0.0, 0.0, yaw)
    c.enter_arming()
    c.set_status(armed=True)
    c.run(0.1)
    c.set_status(landed=LandedState.IN_AIR)
    c.position_ned = (0.0, 0.0, -1.0)
    out = of_kind(Setpoint, c.run(2.0))
    assert c.core.phase is Phase.TRANSIT  # the vehicle's heading has not followed, so it has not arrived
    assert out[0].yaw_ned_rad == pytest.approx(yaw)
    rate = math.radians(c.core.mission.vehicle.flying.yaw_rate_deg_s)
    rates = [(b.yaw_ned_rad - a.yaw_ned_rad) / (1e-6 * (b.t_us - a.t_us)) for a, b in itertools.pairwise(out)]
    turning = [r for r in rates if abs(r) > 1e-6]
    assert max(abs(r) for r in turning) <= rate * 1.001
    # At the full rate until the last step, in the shorter direction.
    assert sum(abs(abs(r) - rate) < 1e-3 * rate for r in turning) >= len(turning) - 1
    assert {math.copysign(1.0, r) for r in turning} == {math.copysign(1.0, -yaw)}
    assert len(turning) * 0.008 == pytest.approx(abs(yaw) / rate, abs=0.02)
    assert out[-1].yaw_ned_rad == pytest.approx(0.0, abs=1e-9)


# --- the goal ----------------------------------------------------------------------------------------------


def test_the_goal_is_passed_once_its_distance_grows_by_more_than_noise() -> None:
    """The goal is at (0.4, 1.0); the vehicle comes within 0.30 m and moves away again."""
    c = HandFedCore(SINGLE)
    c.leave_single_wall()

    def at(miss_m: float, seconds: float) -> list[GoalPassed]:
        c.position_ned = (0.4 + miss_m, -1.0, -1.0)
        return of_kind(GoalPassed, c.run(seconds))

    assert at(0.5, 0.2) == []
    assert at(0.3, 0.3) == []
    assert at(0.32, 0.3) == []  # noise
    passed = at(0.36, 0.1)
    assert [(round(p.miss_m, 3), p.timed_out) for p in passed] == [(0.3, False)]
    assert c.core.phase is Phase.GOAL


def test_the_goal_is_not_passed_during_a_contact() -> None:
    """The vehicle slides along the wall, away from the goal."""
    c = core_in(Phase.APPROACH, SINGLE)
    c.position_ned, c.velocity_ned = (1.6, -0.5, -1.0), (1.0, -0.5, 0.0)
    c.run(0.05)
    c.pulse((-40.0, 0.0), 0.04)
    c.force_ned = (-12.0, 0.0, 0.0)
    for i in range(40):
        c.position_ned = (1.6, -0.5 + 0.01 * i, -1.0)
        c.run(0.01)
    assert c.core.phase is Phase.RECOVERY
    assert not [o for o in c.outputs if isinstance(o, ContactEnd | GoalPassed)]
    c.force_ned = (0.0, 0.0, 0.0)
    c.run(0.2)
    c.position_ned = (1.6, 0.3, -1.0)
    c.run(0.1)
    assert [type(o) for o in c.outputs if isinstance(o, ContactEnd | GoalPassed)] == [ContactEnd, GoalPassed]


def test_the_goal_is_not_passed_right_after_a_contact() -> None:
    c = HandFedCore(SINGLE)
    c.leave_single_wall()
    c.position_ned = (0.9, -1.0, -1.0)
    c.run(0.04)
    c.position_ned = (1.1, -1.0, -1.0)
    assert not of_kind(GoalPassed, c.run(0.04))
    assert of_kind(GoalPassed, c.run(0.3))
