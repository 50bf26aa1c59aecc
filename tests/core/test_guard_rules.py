"""The table of the guard's rules: each rule fires on its cause, and not if it is removed from the table."""

import inspect
import math
import random
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.base.geometry import Vec2, Vec3, quaternion_from_euler
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ContactRequest,
    DetectionFloor,
    EstimatorSample,
    FlightMode,
    GuardEvent,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Input,
    LandedState,
    LockCommand,
    LockPhase,
    LockState,
    MissionEnd,
    Mode,
    OdometrySample,
    OperatorRequest,
    OtherVehicle,
    Output,
    Override,
    Phase,
    PhaseChange,
    PoseSample,
    Request,
    RoundTrip,
    Setpoint,
    Silence,
    StatusText,
    SystemStatus,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.base.streams import BY_NAME
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core import flight_core
from dart_flight.core.guard.flight_conditions import LYING_TILT_DEG, FlightConditions
from dart_flight.core.guard.rule import Rule, Scope, in_scope
from dart_flight.core.guard.rules import LYING_S, RULES, table
from dart_flight.core.guard.second_vehicle import SecondClockDetector, SecondPositionDetector
from dart_flight.core.mission import executive
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState
from dart_flight.planning.contact_fit import ContactFitter
from tests.core.conftest import RULES_WITHOUT_JUMP, SHORT_TIMEOUTS, HandFedCore

CAUSES: dict[str, Callable[[HandFedCore], object]] = {}
SETTINGS: dict[str, Mapping[str, Any]] = {}


def cause(fly: Callable[[HandFedCore], object]) -> Callable[[HandFedCore], object]:
    """Register the flight on which the rule of the same name fires."""
    CAUSES[fly.__name__] = fly
    return fly


def cause_with(settings: Mapping[str, Any]) -> Callable[[Callable[[HandFedCore], object]], object]:
    """Register as `cause` does, for a mission with these settings."""

    def register(fly: Callable[[HandFedCore], object]) -> object:
        SETTINGS[fly.__name__] = settings
        return cause(fly)

    return register


def core_for(name: str, rules: tuple[Rule, ...] = RULES_WITHOUT_JUMP) -> HandFedCore:
    """Return a core on which the cause of a rule can be flown."""
    return HandFedCore(rules=rules, settings=SETTINGS.get(name, {}))


def fly_to_acrylic(c: HandFedCore) -> None:
    """Fly through the first collision, towards the second wall."""
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.run(0.1)
    c.position_ned = (1.2, 0.9, -1.0)


@cause
def pilot(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_status(flight_mode=FlightMode.MANUAL)


@cause
def px4_failsafe(c: HandFedCore) -> None:
    c.enter_approach()
    c.feed(StatusText(c.t_us, c.t_us, "critical", "Failsafe activated"))
    c.set_status(flight_mode=FlightMode.LAND)


@cause
def failsafe_announced(c: HandFedCore) -> None:
    c.enter_approach()
    c.feed(StatusText(c.t_us, c.t_us, "critical", "Critical battery level: switching to Land"))


@cause
def terminated(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_status(system_status=SystemStatus.FLIGHT_TERMINATION)


@cause
def disarmed(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_status(armed=False)


@cause
def link_lost(c: HandFedCore) -> None:
    c.enter_approach()
    c.silent |= {"imu", "attitude", "odometry", "actuator", "status"}
    c.run(6.0)


def silent(stream: str, seconds: float) -> Callable[[HandFedCore], object]:
    def fly(c: HandFedCore) -> None:
        c.enter_approach()
        c.silent.add(stream)
        c.run(seconds)

    return fly


for _stream, _seconds in (
    ("imu", 0.1),
    ("attitude", 0.23),
    ("odometry", 0.23),
    ("actuator", 0.4),
    ("status", 3.5),
):
    CAUSES[f"{_stream}_silent"] = silent(_stream, _seconds)


@cause
def stream_rate(c: HandFedCore) -> None:
    c.enter_approach()
    c.odometry_every = 14  # 18 Hz, needs 30
    c.run(2.2)


def alternate_vehicles(c: HandFedCore, ahead_us: int, apart_m: float, seconds: float) -> None:
    """Feed the telemetry of two vehicles alternately."""
    for _ in range(round(seconds / 0.004)):
        c.run(0.004)
        t, received = c.t_us + ahead_us + 1000, c.t_us
        x, y, z = c.position_ned
        c.feed(ImuSample(t, received, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)))
        c.feed(AttitudeSample(t, received, c.q))
        c.feed(OdometrySample(t, received, (x, y + apart_m, z), c.velocity_ned))


def delay_telemetry(c: HandFedCore) -> None:
    """Feed a round trip of a second, then samples as before."""
    c.feed(RoundTrip(c.t_us, c.t_us - 1_000_000, c.t_us))
    c.run(0.3)


@cause
def telemetry_late_ground(c: HandFedCore) -> None:
    c.run(0.1)
    delay_telemetry(c)


@cause
def telemetry_late(c: HandFedCore) -> None:
    c.enter_approach()
    delay_telemetry(c)


@cause
def second_vehicle_ground(c: HandFedCore) -> None:
    c.run(0.1)
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)


@cause
def second_vehicle(c: HandFedCore) -> None:
    c.enter_approach()
    alternate_vehicles(c, -238_000_000, 0.0, 0.1)


@cause
def stamps_backwards(c: HandFedCore) -> None:
    c.enter_approach()
    for i in range(5):
        c.feed(AttitudeSample(c.t_us - 1_000_000 + 8000 * i, c.t_us, c.q))
    c.feed(Tick(c.t_us + 20_000))


@cause
def imu_stuck(c: HandFedCore) -> None:
    c.enter_approach()
    c.noise_m_s2 = 0.0
    c.run(0.15)


@cause
def imu_clipped(c: HandFedCore) -> None:
    c.enter_approach()
    c.force_ned = (250.0, 0.0, 0.0)
    c.run(0.3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_imu_clipped_on_any_axis_is_reported(axis: int) -> None:
    c = HandFedCore()
    c.enter_approach()
    force = [0.0, 0.0, 0.0]
    force[axis] = 250.0 if axis < 2 else -250.0
    c.force_ned = (force[0], force[1], force[2])
    c.run(0.3)
    assert "imu_clipped" in [event.rule for event in fired(c)]


@cause
def estimator_jump(c: HandFedCore) -> None:
    c.enter_approach()
    c.position_ned = (0.0, -0.4, -1.0)
    c.run(0.1)


@cause
def estimator_reset(c: HandFedCore) -> None:
    c.enter_approach()
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=3))
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=4))
    north, east, down = c.position_ned
    c.position_ned = (north + 0.08, east, down)
    c.run(0.05)


@cause
def heading_reset(c: HandFedCore) -> None:
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=3))
    c.enter_approach()
    c.q = quaternion_from_euler(0.0, 0.0, 0.5)
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=4))
    c.run(0.05)


@cause
def estimator_flags(c: HandFedCore) -> None:
    c.enter_approach()
    c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
    c.run(0.4)


@cause
def position_uncertain(c: HandFedCore) -> None:
    c.enter_approach()
    c.feed(EstimatorSample(c.t_us, c.t_us, healthy=True, position_sd_m=0.23))
    c.run(0.1)


@cause
def position_delayed(c: HandFedCore) -> None:
    """The vehicle goes up and down; its velocity is estimated as with EKF2_EV_DELAY 0.15 s too long."""
    c.enter_approach()
    mass_kg = c.core.mission.vehicle.airframe.mass_kg
    for tick in range(750):
        t_s = 0.004 * tick
        c.force_ned = (0.0, 0.0, mass_kg * math.sin(4.0 * t_s))
        pull = 0.75 * 0.15 * math.sin(4.0 * (t_s - 0.45))
        c.velocity_ned = (0.0, 0.0, -math.cos(4.0 * t_s) / 4.0 + pull)
        c.run(0.004)


@cause_with({"vehicle.guard.kill_after_s": 10.0})
def still_armed(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND, battery_v=15.0)
    c.run(11.0)


@cause
def battery(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)


@cause
def tilt(c: HandFedCore) -> None:
    c.enter_approach()
    c.q = quaternion_from_euler(1.2, 0.0, 0.0)
    c.run(0.02)


@cause
def altitude(c: HandFedCore) -> None:
    c.enter_approach()
    c.position_ned = (0.0, 0.0, -2.2)
    c.run(0.1)


@cause
def bounds(c: HandFedCore) -> None:
    c.enter_approach()
    c.velocity_ned = (-1.0, 0.0, 0.0)
    c.position_ned = (-1.7, 0.0, -1.0)  # inside, but not after a braking distance of half a metre
    c.run(0.1)


@cause
def speed(c: HandFedCore) -> None:
    c.enter_approach()
    for step in range(1, 12):
        c.velocity_ned = (0.0, -0.33 * step, 0.0)
        c.run(0.008)


@cause
def force_over_limit(c: HandFedCore) -> None:
    c.fly_to_wood()
    c.pulse((0.0, -190.0))


@cause
def peak_force(c: HandFedCore) -> None:
    c.fly_to_wood()
    c.pulse((0.0, -160.0))


@cause
def wall_not_met(c: HandFedCore) -> None:
    c.fly_to_wood()
    c.position_ned = (0.917, 1.3, -1.0)
    c.run(0.1)


@cause
def wall_met_early(c: HandFedCore) -> None:
    c.enter_approach()
    c.position_ned = (0.5, 0.6, -1.0)
    c.run(0.1)
    c.pulse((0.0, -20.0))


@cause_with({"collisions": []})
def unplanned_hit(c: HandFedCore) -> None:
    c.finish_climb()
    c.pulse((12.0, 16.0))


@cause
def no_peak(c: HandFedCore) -> None:
    c.fly_to_wood()
    c.hide_peaks()
    c.force_ned = (0.0, -20.0, 0.0)
    c.run(0.4)


@cause
def lock_not_settled(c: HandFedCore) -> None:
    c.enter_approach()
    c.set_lock(None, LockPhase.FAULT)
    c.run(0.02)


@cause
def lock_late(c: HandFedCore) -> None:
    fly_to_acrylic(c)
    c.set_lock(Mode.RIGID, LockPhase.TRAVELLING)
    c.velocity_ned = (1.0, 0.0, 0.0)
    c.run(0.3)


@cause
def lock_not_ready(c: HandFedCore) -> None:
    c.enter_prepare()
    c.run(3.6)


@cause_with(SHORT_TIMEOUTS)
def climb_timeout(c: HandFedCore) -> None:
    c.set_lock(Mode.RIGID)
    c.run(0.5)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    c.run(0.1)
    c.set_status(armed=True, landed=LandedState.IN_AIR)
    c.run(3.5)


@cause_with(SHORT_TIMEOUTS)
def transit_timeout(c: HandFedCore) -> None:
    c.set_lock(Mode.RIGID)
    c.run(0.5)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    c.run(0.1)
    c.set_status(armed=True, landed=LandedState.IN_AIR)
    c.position_ned = (0.0, 0.0, -1.0)
    for _ in range(50):
        if c.core.phase is Phase.TRANSIT:
            break
        c.run(0.02)
    c.position_ned = (0.2, 0.0, -1.0)
    c.run(3.5)


@cause_with({"collisions": [], "limits.collision_timeout_s": 2.0})
def goal_not_reached(c: HandFedCore) -> None:
    c.finish_climb()
    c.run(8.0)


@cause_with({"waypoints": [{"pause": "operator", "timeout_s": 5.0}]})
def pause_timeout(c: HandFedCore) -> None:
    c.finish_climb()
    c.run(6.0)


@cause_with(SHORT_TIMEOUTS)
def not_ready(c: HandFedCore) -> None:
    c.run(3.5)  # the lock does not report


@cause_with(SHORT_TIMEOUTS)
def offboard_refused(c: HandFedCore) -> None:
    c.set_lock(Mode.RIGID)
    c.run(4.0)


@cause_with(SHORT_TIMEOUTS)
def arming_refused(c: HandFedCore) -> None:
    c.set_lock(Mode.RIGID)
    c.run(0.5)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    c.run(3.5)


def request_by_operator(request: Request) -> Callable[[HandFedCore], object]:
    def fly(c: HandFedCore) -> None:
        c.enter_approach()
        c.feed(OperatorRequest(c.t_us, request))

    return fly


@cause
def hit_in_noise(c: HandFedCore) -> None:
    """The climb is so noisy that the planned hit would not be detected."""
    c.set_lock(Mode.RIGID)
    c.run(0.5)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    c.run(0.1)
    c.set_status(armed=True)
    c.run(0.1)
    c.set_status(landed=LandedState.IN_AIR)
    rng = random.Random(1)
    for _ in range(750):
        c.force_ned = (rng.gauss(0.0, 25.0), rng.gauss(0.0, 25.0), 0.0)
        c.run(0.004)
    c.force_ned = (0.0, 0.0, 0.0)
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(1.0)
    c.set_lock(Mode.FLEXIBLE)
    c.run(0.02)


@cause_with({"vehicle.airframe.mass_kg": 0.85})
def hover_thrust(c: HandFedCore) -> None:
    """The vehicle weighs 1.3 kg and is configured with 0.85 kg."""
    c.enter_climb()
    c.run(2.0)
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(0.5)


def rigid_pulse(c: HandFedCore) -> None:
    """Hit with the pulse of rigid arms at 0.6 m/s, without friction, while the lock reports flexible."""
    c.fly_to_wood()
    c.pulse((0.0, -41.0), 0.056)
    c.run(0.08)
    request = next(o for o in c.outputs if isinstance(o, ContactRequest))
    c.feed(ContactFitter(c.core.mission.vehicle).answer(request, c.t_us))


@cause_with({"mode_mismatch": "land"})
def mode_felt(c: HandFedCore) -> None:
    rigid_pulse(c)


@cause_with(
    {
        "walls": {},
        "collisions": [
            {
                "wall": "board",
                "mode": "rigid",
                "probe": {"from_m": [0.0, 0.0], "direction": [1.0, 0.0], "length_m": 2.1},
            },
            {
                "wall": "board",
                "mode": "rigid",
                "approach": {"normal_m_s": -2.0},
                "alpha_wall_m_per_n": [0.01, 0.01],
            },
        ],
    }
)
def no_approach(c: HandFedCore) -> None:
    """The board is 1.7 m nearer than the end of the probe, so the run-up has too little room."""
    c.enter_prepare()
    c.run(0.1)
    c.position_ned, c.velocity_ned = (0.4, 0.0, -1.0), (0.5, 0.0, 0.0)
    c.run(0.05)
    c.pulse((-20.0, 0.0))
    c.position_ned, c.velocity_ned = (0.1, 0.0, -1.0), (0.0, 0.0, 0.0)
    c.run(2.0)


def lose_body(c: HandFedCore, seconds: float) -> None:
    """Feed a pose, and then frames without the body."""
    for tracked in (True, *(False,) * round(seconds / 0.02)):
        c.feed(PoseSample(c.t_us, c.t_us, "dart", tracked, c.position_ned, c.q))
        c.run(0.02)


@cause
def pose_source_ground(c: HandFedCore) -> None:
    c.run(0.1)
    lose_body(c, 2.1)


@cause
def pose_source(c: HandFedCore) -> None:
    c.enter_approach()
    lose_body(c, 0.4)


@cause
def pose_source_blind(c: HandFedCore) -> None:
    c.enter_approach()
    lose_body(c, 1.7)


for _name in ("pose_source_ground", "pose_source", "pose_source_blind"):
    SETTINGS[_name] = {"vehicle.mocap.url": "udp://127.0.0.1:9763/dart"}


CAUSES |= {
    "operator": request_by_operator(Request.LAND),
    "operator_release": request_by_operator(Request.RELEASE),
    "world_died": request_by_operator(Request.WORLD_DIED),
}


def lie_down(c: HandFedCore, tilt_deg: float, height_m: float, seconds: float) -> None:
    """Fall, then lie still with this tilt and height above the place of take-off."""
    (north, east, down), steps = c.position_ned, 50
    c.q = quaternion_from_euler(math.radians(tilt_deg), 0.0, 0.0)
    fallen_m = -height_m - down
    for step in range(1, steps + 1):
        c.position_ned = (north, east, down + fallen_m * step / steps)
        c.velocity_ned = (0.0, 0.0, fallen_m / (steps * 0.008))
        c.run(0.008)
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(seconds)


@cause
def lying(c: HandFedCore) -> None:
    c.enter_approach()
    lie_down(c, 1.02 * LYING_TILT_DEG, 0.1, LYING_S + 0.05)


@cause
def operator_ground(c: HandFedCore) -> None:
    c.run(0.1)
    c.feed(OperatorRequest(c.t_us, Request.LAND))


@cause
def mission_fault(c: HandFedCore) -> None:
    c.enter_approach()
    c.break_mission()
    c.run(0.02)


# The operator reads what was measured and its limit.
DETAILS = {
    "link_lost": "no telemetry for 5.0 s",
    "imu_silent": "no data for 100 ms",
    "actuator_silent": "no data for 320 ms",
    "status_silent": "no heartbeat for 3.0 s",
    "stream_rate": "odometry arrives at 18 Hz, minimum 30 Hz",
    "telemetry_late": "telemetry arrives 500 ms after sampling, limit 75 ms, round trip 1000 ms",
    "second_vehicle": "two clocks alternate, 238.0 s apart",
    "imu_stuck": "the IMU repeats one reading for 116 ms",
    "imu_clipped": "the IMU is at full scale for 256 ms",
    "pose_source_ground": "not tracking body dart for 2.02 s, limit 2 s",
    "pose_source_blind": "not tracking body dart for 1.50 s, limit 1.5 s",
    "pose_source": "not tracking body dart for 0.26 s, limit 0.25 s",
    "estimator_jump": "position jumped by 1.00 m, limit 0.3 m",
    "estimator_reset": "position stepped by 0.08 m, velocity by 0.00 m/s",
    "heading_reset": "heading stepped by 28.6 deg, limit 5 deg",
    "estimator_flags": "no valid estimate for 0.3 s",
    "position_uncertain": "standard deviation of the position 0.23 m, limit 0.10 m",
    "lying": "the vehicle has been lying on the ground at 61 deg for 0.5 s",
    "still_armed": "still armed after 10 s in land mode",
    "hover_thrust": "the thrust curve gives a mass of 1.30 kg, airframe.mass_kg is 0.85: ratio 0.65, "
    "limits 0.75 to 1.25",
    "tilt": "69 deg, limit 60 deg",
    "altitude": "2.20 m, limits 0.3 to 2 m",
    "bounds": "the vehicle would stop 0.20 m outside bounds_m",
    "speed": "3.63 m/s, limit 3 m/s",
    "force_over_limit": "180 N, limit 172.5 N",
    "peak_force": "162 N at wall wood, limit 150 N",
    "wall_not_met": "no contact, but the vehicle is 0.20 m behind the plane of wall wood",
    "wall_met_early": "contact 0.50 m before wall wood",
    "unplanned_hit": "unplanned impact of 12 N in phase goal",
    "lock_late": "the lock is travelling, not rigid; wall acrylic is 0.45 m away, closing speed 1.00 m/s",
    "goal_not_reached": "the vehicle is still 1.12 m from the goal",
}


def fired(c: HandFedCore) -> list[GuardEvent]:
    return [o for o in c.outputs if isinstance(o, GuardEvent)]


def jump_position(c: HandFedCore) -> None:
    north, east, down = c.position_ned
    c.position_ned = (north, east - 0.4, down)


def reset_estimator(c: HandFedCore) -> None:
    for count in (3, 4):
        c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=count))
    north, east, down = c.position_ned
    c.position_ned = (north + 0.08, east, down)


def tilt_over(c: HandFedCore) -> None:
    c.q = quaternion_from_euler(1.2, 0.0, 0.0)


@pytest.mark.parametrize(
    ("first", "then", "rule"),
    [
        (jump_position, reset_estimator, "estimator_reset"),
        (jump_position, tilt_over, "tilt"),
    ],
)
def test_a_further_fault_is_recorded_once_while_the_guard_holds(
    first: Callable[[HandFedCore], None], then: Callable[[HandFedCore], None], rule: str
) -> None:
    """The action does not change, but whoever reads the log must know."""
    c = HandFedCore()
    c.enter_approach()
    c.run(1.0)
    c.use_rules(RULES)
    first(c)
    c.run(0.2)
    assert fired(c)[0].action is Override.HOLD
    before = len(fired(c))
    then(c)
    c.run(0.2)
    recorded = [event for event in fired(c)[before:] if event.rule == rule]
    assert [event.action for event in recorded] == [Override.NONE]
    assert c.core.override is Override.HOLD


def climb_out(c: HandFedCore) -> None:
    north, east, _ = c.position_ned
    c.position_ned = (north, east, -2.4)


def empty_battery(c: HandFedCore) -> None:
    c.set_status(battery_v=12.9)
    c.run(1.2)


def switch_to(mode: FlightMode, text: str = "") -> Callable[[HandFedCore], None]:
    def switch(c: HandFedCore) -> None:
        if text:
            c.feed(StatusText(c.t_us, c.t_us, "critical", text))
        c.set_status(flight_mode=mode)

    return switch


def slow_down_odometry(c: HandFedCore) -> None:
    c.odometry_every = 14
    c.run(2.2)


def end_odometry(c: HandFedCore) -> None:
    c.odometry_every = 10_000
    c.run(0.7)


@pytest.mark.parametrize(
    ("first", "then", "reason", "others"),
    [
        (tilt_over, climb_out, "tilt", {"altitude"}),
        (CAUSES["position_delayed"], jump_position, "position_delayed", {"estimator_jump"}),
        (jump_position, empty_battery, "estimator_jump", {"battery"}),
        (CAUSES["heading_reset"], climb_out, "heading_reset", {"altitude"}),
        # A later rule that explains the first one.
        (slow_down_odometry, end_odometry, "odometry_silent", {"stream_rate"}),
        (slow_down_odometry, delay_telemetry, "telemetry_late", {"stream_rate"}),
        # A release.
        (tilt_over, switch_to(FlightMode.MANUAL), "pilot", {"tilt"}),
        (tilt_over, switch_to(FlightMode.LAND, "Failsafe activated"), "px4_failsafe", {"tilt"}),
        (empty_battery, request_by_operator(Request.RELEASE), "operator_release", {"battery"}),
    ],
)
def test_the_reason_is_the_first_rule_or_the_one_that_explains_it(
    first: Callable[[HandFedCore], None],
    then: Callable[[HandFedCore], None],
    reason: str,
    others: set[str],
) -> None:
    c = HandFedCore()
    if first in CAUSES.values():
        first(c)
        c.use_rules(RULES)
    else:
        c.enter_approach()
        c.run(1.0)
        c.use_rules(RULES)
        first(c)
    c.run(0.2)
    (before,) = {event.rule for event in fired(c) if event.action is not Override.NONE}
    then(c)
    c.run(0.3)
    assert c.core._guard.reason is not None
    assert c.core._guard.reason.partition(":")[0] == reason
    assert {before, *(event.rule for event in fired(c))} >= {reason, *others}


def test_every_rule_has_a_cause_here() -> None:
    assert set(CAUSES) == {rule.name for rule in RULES}


@pytest.mark.parametrize("rule", RULES, ids=lambda r: r.name)
def test_a_rule_fires_on_its_cause_and_is_reported(rule: Rule) -> None:
    c = core_for(rule.name, RULES if rule.name == "estimator_jump" else RULES_WITHOUT_JUMP)
    CAUSES[rule.name](c)
    events = fired(c)
    mine = [e for e in events if e.rule == rule.name]
    assert len(mine) == 1, [(e.rule, e.detail) for e in events]
    assert mine[0].action == rule.action
    assert mine[0].detail == DETAILS.get(rule.name, mine[0].detail)
    after = c.outputs[c.outputs.index(mine[0]) :]
    if rule.action is Override.RELEASE:
        assert any(isinstance(o, Silence) for o in after)
        assert not any(isinstance(o, Setpoint | VehicleCommand) for o in after)
        end = next(o for o in after if isinstance(o, MissionEnd))
        assert end.outcome == ("released" if rule.by_person else "aborted")
        assert end.reason is not None
        assert end.reason.startswith(rule.name)
    elif rule.action is not Override.GIVE_UP:
        assert c.core.override is rule.action
        assert c.core.phase in (Phase.OVERRULED, Phase.DONE)


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
    c = core_for("lying")
    c.enter_approach()
    lie_down(c, tilt_deg, height_m, seconds)
    sent = [o.action for o in c.outputs if isinstance(o, VehicleCommand)]
    assert (VehicleAction.KILL in sent) is kills


def test_a_tilt_that_is_no_longer_reported_disarms_nothing() -> None:
    c = core_for("lying")
    c.enter_approach()
    c.q = quaternion_from_euler(math.radians(LYING_TILT_DEG + 20.0), 0.0, 0.0)
    c.run(0.02)
    c.silent.add("attitude")
    lie_down(c, LYING_TILT_DEG + 20.0, 0.1, LYING_S + 1.0)
    assert "lying" not in [event.rule for event in fired(c)]


def test_motors_that_the_guard_has_stopped_are_no_further_fault() -> None:
    c = core_for("lying")
    c.enter_approach()
    lie_down(c, LYING_TILT_DEG + 20.0, 0.1, LYING_S + 0.1)
    c.motors, c.falling = (0.0,) * 4, True
    c.run(0.3)
    assert "disarmed" not in [event.rule for event in fired(c)]
    assert c.core.override is Override.KILL


def test_a_delayed_position_is_reported_with_its_value_and_a_remedy() -> None:
    c = HandFedCore()
    CAUSES["position_delayed"](c)
    (event,) = fired(c)
    found = re.fullmatch(
        r"the position estimate leads the IMU by about (\d+) ms, limit 50 ms: check EKF2_EV_DELAY",
        event.detail,
    )
    assert found is not None
    assert 100 < int(found[1]) < 200


def test_the_position_delay_is_not_checked_without_a_limit() -> None:
    """Vehicles in old logs have no such limit."""
    c = HandFedCore(settings={"vehicle.guard.position_delay_s": None})
    CAUSES["position_delayed"](c)
    assert not fired(c)


def test_a_mode_mismatch_is_only_reported_if_the_mission_continues() -> None:
    c = HandFedCore()
    rigid_pulse(c)
    (event,) = fired(c)
    assert (event.rule, event.action) == ("mode_felt", Override.NONE)
    assert "contact with wall wood indicates rigid arms, but the lock reports flexible" in event.detail
    assert c.core.override is Override.NONE
    assert c.core.phase is Phase.RECOVERY


@pytest.mark.rest
@pytest.mark.parametrize("rule", RULES, ids=lambda r: r.name)
def test_a_removed_rule_is_not_reported(rule: Rule) -> None:
    c = core_for(rule.name, tuple(r for r in RULES_WITHOUT_JUMP if r is not rule))
    CAUSES[rule.name](c)
    assert rule.name not in [e.rule for e in fired(c)]


@pytest.mark.parametrize(
    ("name", "named"),
    [
        *((name, False) for name in ("pilot", "tilt", "bounds")),
        *((f"{stream}_silent", True) for stream in ("imu", "attitude", "odometry", "actuator", "status")),
        *((name, True) for name in ("link_lost", "stream_rate", "stamps_backwards")),
        *((name, True) for name in ("telemetry_late", "telemetry_late_ground", "not_ready")),
    ],
)
def test_another_system_on_the_link_is_named_if_a_stream_fails(name: str, named: bool) -> None:
    c = core_for(name, tuple(rule for rule in RULES_WITHOUT_JUMP if rule.name != "second_vehicle_ground"))
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    CAUSES[name](c)
    event = next(e for e in fired(c) if e.rule == name)
    assert event.detail.endswith("system 7 sends on the same link") is named


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("pilot", "released"),
        ("operator_release", "released"),
        ("px4_failsafe", "aborted"),
        ("disarmed", "aborted"),
    ],
)
def test_only_a_person_releases_a_flight(name: str, outcome: str) -> None:
    c = core_for(name)
    CAUSES[name](c)
    c.run(0.3)
    assert c.core.end is not None
    assert c.core.end.outcome == outcome


def test_no_rule_fires_in_a_quiet_flight() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.run(1.0)
    assert not fired(c)


@pytest.mark.parametrize("mode", [Mode.RIGID, Mode.FLEXIBLE])
def test_a_contact_after_a_recovery_needs_the_planned_mode_of_the_lock(mode: Mode) -> None:
    """A vehicle that does not close on the wall has no late lock, but it may still touch the wall."""
    c = HandFedCore()
    fly_to_acrylic(c)
    c.set_lock(mode)
    c.position_ned, c.velocity_ned = (1.65, 0.9, -1.0), (0.0, 0.0, 0.0)
    c.run(0.3)
    assert not fired(c)
    c.pulse((-20.0, 0.0))
    found = [(e.rule, e.detail) for e in fired(c)]
    phases = [o.after for o in c.outputs if isinstance(o, PhaseChange)][-2:]
    if mode is Mode.RIGID:
        assert (found, phases) == ([], [Phase.CONTACT, Phase.RECOVERY])
    else:
        assert found == [("lock_not_settled", "contact with wall acrylic while the lock is not rigid")]
        assert phases == [Phase.RECOVERY, Phase.OVERRULED]


def test_a_wall_that_the_recovery_does_not_reach_is_given_up_after_a_timeout() -> None:
    c = HandFedCore(settings={"limits.collision_timeout_s": 0.6})
    fly_to_acrylic(c)
    c.set_lock(Mode.RIGID)
    c.velocity_ned = (0.0, 0.0, 0.0)
    c.run(0.4)
    assert "wall_not_met" not in {e.rule for e in fired(c)}
    c.run(0.3)
    assert [e.detail for e in fired(c) if e.rule == "wall_not_met"] == [
        "the recovery did not reach wall acrylic in time"
    ]


@pytest.mark.parametrize(
    ("phase", "walls"),
    [
        (Phase.TRANSIT, (None, None)),
        (Phase.APPROACH, ("wood", "acrylic")),
        (Phase.CONTACT, ("wood", "acrylic")),
        (Phase.RECOVERY, (None, "acrylic")),  # the wooden one has an approach of its own
        (Phase.LANDING, (None, None)),
    ],
)
def test_the_expected_contact_is_with_the_next_wall(
    phase: Phase, walls: tuple[str | None, str | None]
) -> None:
    flown, state = executive.Executive(HandFedCore().core.mission), FlightState()
    # 2 s after the beginning of the phase, a bounce is over.
    flown.progress.phase, flown.progress.entered_us, state.now_us = phase, 0, 2_000_000
    for flown.progress.index, name in enumerate(walls):
        expected = flown.progress.expected = flown._impacts.expected(flown.progress, state)
        assert (expected.wall.name if expected.wall else None) == name
        assert expected.watching is (phase is not Phase.LANDING)
        assert flown._impacts.expected(flown.progress, state) is expected


@pytest.mark.parametrize(
    ("phase", "wall", "planned_now"),
    [
        (Phase.TRANSIT, 0, False),
        (Phase.APPROACH, 0, True),
        (Phase.CONTACT, 0, False),  # a second one before the peak
        (Phase.RECOVERY, 0, False),  # it has an approach of its own
        (Phase.RECOVERY, 1, True),
        (Phase.GOAL, 2, False),
    ],
)
def test_an_onset_is_planned_only_if_the_plan_has_a_contact_then(
    phase: Phase, wall: int, planned_now: bool
) -> None:
    flown = executive.Executive(HandFedCore().core.mission)
    flown.progress.phase, flown.progress.index, flown.progress.entered_us = phase, wall, 0
    onset = ImpactOnset(5, 1, 5, (0.0, 9.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), True)
    finding = flown._impacts.on_onset(onset, flown.progress, FlightState()).finding
    assert (finding is None or finding.rule != "unplanned_hit") is planned_now


@pytest.mark.parametrize("hits", [1, 3], ids=["after a probe", "after a hit, the next wall ahead"])
@pytest.mark.parametrize(
    ("before_m", "after_s", "noted"),
    [
        (0.1, 0.5, True),
        (0.1, 1.0, True),
        (0.1, 1.000001, False),  # too late for a bounce
        (2.0, 0.5, False),  # nowhere near the wall
    ],
)
def test_a_bounce_on_the_wall_just_hit_is_only_reported(
    before_m: float, after_s: float, noted: bool, hits: int
) -> None:
    mission = load_mission(packaged("missions", "dual_collision_gps.yaml"))
    flown, state = executive.Executive(mission), FlightState()
    flown.progress.phase, flown.progress.index, flown.progress.entered_us = Phase.RECOVERY, hits, 0
    state.now_us = round(1e6 * after_s)
    state.position = place = (0.4, -1.1 + before_m, 1.0)
    # During a bounce, no contact with the wall ahead is expected.
    assert (flown._impacts.expected(flown.progress, state).wall is None) is (noted or hits == 1)
    onset = ImpactOnset(5, 1, 5, (0.0, 9.0, 0.0), (0.0, 0.0, 0.0), place, True)
    finding = flown._impacts.on_onset(onset, flown.progress, state).finding
    assert finding is not None
    assert finding.rule == ("unplanned_hit" if noted or hits == 1 else "wall_met_early")
    assert finding.note_only is noted


@pytest.mark.parametrize(
    ("hits", "place", "away"), [(4, (1.6, -0.5, 1.0), (-1.0, 0.0)), (3, (0.4, -1.1, 1.0), (0.0, 1.0))]
)
def test_the_vehicle_retreats_and_replans_after_a_bounce(hits: int, place: Vec3, away: Vec2) -> None:
    mission = load_mission(packaged("missions", "dual_collision_gps.yaml"))
    flown, p, state = executive.Executive(mission), Proposal(), FlightState()
    flown.progress.phase, flown.progress.index, flown.progress.entered_us, state.now_us = (
        Phase.RECOVERY,
        hits,
        0,
        300_000,
    )
    state.position = place
    flown.progress.replan = Replan(trajectory=Trajectory.level((0.0,) * 6, (0.0,) * 6, 1.0, (1.0,)))
    onset = ImpactOnset(5, 1, 5, (-9.0, 0.0, 0.0), (0.0, 0.0, 0.0), place, False)
    flown._handle_contacts(Sensed(None, (onset,), True), state, p)
    target, retreat_m = flown.progress.course.target, mission.vehicle.guard.retreat_m
    assert target[:2] == pytest.approx((place[0] + retreat_m * away[0], place[1] + retreat_m * away[1]))
    assert flown.progress.replan.since_us is None
    assert [finding.note_only for finding in p.findings] == [True]


@pytest.mark.parametrize(("phase", "wall"), [(Phase.TRANSIT, 0), (Phase.RECOVERY, 1), (Phase.GOAL, 2)])
def test_a_peak_of_an_unplanned_contact_starts_no_recovery(phase: Phase, wall: int) -> None:
    flown, p = executive.Executive(HandFedCore().core.mission), Proposal()
    flown.progress.phase, flown.progress.index = phase, wall
    peak = ImpactPeak(5, 5, 5, (0.0, 1.0), 20.0, 0.0, (0.0, 0.0, 1.0), False)
    flown._handle_contacts(Sensed(None, (peak,), True), FlightState(), p)
    assert (p.outputs, flown.progress.phase, flown.progress.index) == ([], phase, wall)


def test_the_mission_may_record_but_not_command_in_the_step_of_a_rule() -> None:
    c, proposal = HandFedCore(), Proposal()
    c.enter_approach()
    state, t_us = c.core._senses.state, c.t_us
    record = PhaseChange(t_us, Phase.APPROACH, Phase.CONTACT, "impact", 1)
    commands: list[Output] = [
        Setpoint(t_us, t_us, (1.0, 0.0, -1.0), 0.0),
        VehicleCommand(t_us, VehicleAction.OFFBOARD),
        LockCommand(t_us, Mode.RIGID),
    ]
    proposal.outputs += [*commands, record]
    proposal.add_finding("wall_not_met", "by hand")
    out = c.core._guard.review(Tick(t_us), state, Sensed(None, (), False), c.core.phase, proposal)
    assert [o for o in out if isinstance(o, GuardEvent)]
    assert record in out
    assert not [o for o in out if o in commands]


@pytest.mark.parametrize(
    ("found", "events"),
    [
        (("climb_timeout", "wall_not_met"), ["climb_timeout"]),
        (("wall_not_met", "climb_timeout"), ["wall_not_met", "climb_timeout"]),
        (("wall_not_met", "no_peak"), ["wall_not_met"]),
    ],
)
def test_a_weaker_finding_does_not_follow_a_stronger_one_in_one_step(
    found: tuple[str, str], events: list[str]
) -> None:
    c, proposal = HandFedCore(), Proposal()
    c.enter_approach()
    for name in found:
        proposal.add_finding(name, "by hand")
    guard, state = c.core._guard, c.core._senses.state
    out = guard.review(Tick(c.t_us), state, Sensed(None, (), False), c.core.phase, proposal)
    assert [o.rule for o in out if isinstance(o, GuardEvent)] == events
    assert guard.action is (Override.LAND if "climb_timeout" in found else Override.BREAK_OFF)


@pytest.mark.parametrize(
    ("mode", "threshold_n", "rigid_n", "flexible_n", "fires"),
    [
        (Mode.FLEXIBLE, 20.0, 1.0, 500.0, True),
        (Mode.FLEXIBLE, 20.0, 500.0, 1.0, False),
        (Mode.FLEXIBLE, 20.0, 500.0, None, False),
        (Mode.FLEXIBLE, 0.1, 500.0, 500.0, False),  # configured threshold: no noise has been learned
        (Mode.RIGID, 20.0, 500.0, 1.0, True),
        (Mode.RIGID, 20.0, 1.0, 500.0, False),
    ],
)
def test_a_planned_hit_is_in_the_noise_if_the_floor_of_its_mode_is_higher(
    mode: Mode, threshold_n: float, rigid_n: float, flexible_n: float | None, fires: bool
) -> None:
    mission = HandFedCore().core.mission
    planned = msgspec.structs.replace(mission.collisions[0], mode=mode)
    changed = msgspec.structs.replace(mission, collisions=(planned, *mission.collisions[1:]))
    found = executive.Executive(changed)
    floor = DetectionFloor(0, threshold_n, 1.0, 1.0, rigid_n, flexible_n)
    finding = found._impacts.on_detection_floor(floor, found.progress).finding
    assert (finding is not None and finding.rule == "hit_in_noise") is fires


def test_a_landed_vehicle_is_disarmed_only_if_px4_has_not_done_so_in_15_s() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    (event,) = [o for o in c.outputs if isinstance(o, GuardEvent)]
    guard, state = c.core._guard, c.core._senses.state

    def requested_actions(after_s: float, on_ground: bool) -> list[VehicleAction]:
        state.now_us, state.on_ground = event.t_us + round(after_s * 1e6), on_ground
        out = guard.review(Tick(state.host_us), state, Sensed(None, (), False), Phase.OVERRULED, Proposal())
        return [o.action for o in out if isinstance(o, VehicleCommand)]

    assert requested_actions(14.9, on_ground=True) == []
    assert requested_actions(40.0, on_ground=False) == []  # never in the air
    assert requested_actions(15.1, on_ground=True) == [VehicleAction.DISARM]
    assert requested_actions(16.0, on_ground=True) == []
    assert requested_actions(16.1, on_ground=True) == [VehicleAction.DISARM]


def test_motors_are_stopped_only_after_the_kill_timeout_of_a_landing() -> None:
    def killed(outputs: list[Output]) -> bool:
        return any(isinstance(o, VehicleCommand) and o.action is VehicleAction.KILL for o in outputs)

    c = HandFedCore(settings={"vehicle.guard.kill_after_s": 10.0})
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    assert not killed(c.run(8.0))
    assert killed(c.run(3.0))
    c.set_status(armed=False)
    c.run(0.25)
    assert c.core.end is not None
    assert c.core.end.outcome == "aborted"


def test_a_landing_is_awaited_until_the_kill_timeout() -> None:
    """The default of a minute is too short if the configured timeout is longer."""
    c = HandFedCore(settings={"vehicle.guard.kill_after_s": 61.0})
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    c.silent = {"actuator", "attitude"}
    c.odometry_every = 10
    c.run(60.5)
    assert c.core.end is None
    c.run(1.0)
    assert [e.rule for e in fired(c)][-1] == "still_armed"


def ends_after(c: HandFedCore, seconds: float) -> bool:
    """Return whether the guard's landing has ended `seconds` after it began."""
    event = next(e for e in fired(c) if e.action is Override.LAND)
    guard, state = c.core._guard, c.core._senses.state
    state.now_us = event.t_us + round(seconds * 1e6)
    guard.review(Tick(state.host_us), state, Sensed(None, (), False), Phase.OVERRULED, Proposal())
    return guard.end is not None


def test_a_landing_without_a_kill_timeout_is_awaited_for_a_minute() -> None:
    c = HandFedCore(settings={"vehicle.guard.kill_after_s": None})
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    assert [ends_after(c, seconds) for seconds in (1.0, 59.9, 60.1)] == [False, False, True]


def test_a_landing_beside_a_second_vehicle_lasts_at_least_fifteen_seconds() -> None:
    """The report of landed and disarmed may come from either vehicle."""
    c = HandFedCore()
    c.enter_approach()
    alternate_vehicles(c, 238_000_000, 0.0, 0.1)
    c.set_status(armed=False, landed=LandedState.ON_GROUND)
    assert [ends_after(c, seconds) for seconds in (1.0, 14.9, 15.1)] == [False, False, True]


@pytest.mark.parametrize(("every_us", "after_us"), [(4_000, 96_000), (20_000, 240_000)])
def test_rules_are_checked_at_the_same_interval_without_ticks(every_us: int, after_us: int) -> None:
    """Checks are more than 20 ms apart: with a sample every 4 ms, 80 ms without IMU are found after 96 ms.

    With a sample every 20 ms, a dozen have not arrived by then, so the timeout is the 0.2 s of any stream.
    """
    c = HandFedCore(rules=tuple(rule for rule in RULES if rule.name == "imu_silent"))
    c.enter_approach()
    c.run(0.02)
    c.feed(Tick(c.t_us))
    last_us = c.t_us
    while not fired(c):
        c.t_us += every_us
        c.feed(AttitudeSample(c.t_us, c.t_us, c.q))
    assert c.t_us - last_us == after_us


@pytest.mark.parametrize(("axis", "side"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_vehicle_must_be_able_to_stop_inside_the_bounds(axis: int, side: int) -> None:
    """At 1 m/s it needs half a metre."""
    mission = load_mission(packaged("missions", "hover.yaml"))
    watch, limit_m = FlightConditions(mission), (mission.bounds.x, mission.bounds.y)[axis][side]
    outwards = 1.0 if side else -1.0

    def excess_m(inside_m: float, speed_m_s: float) -> float:
        position, velocity = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
        position[axis], velocity[axis] = limit_m - outwards * inside_m, outwards * speed_m_s
        watch.state.position = (position[0], position[1], position[2])
        watch.state.velocity = (velocity[0], velocity[1], velocity[2])
        return watch.stop_excess_m()

    assert excess_m(0.3, 1.0) == pytest.approx(0.2)
    assert excess_m(0.8, 2.0) == pytest.approx(0.2)
    assert (excess_m(0.55, 1.0), excess_m(0.3, -1.0)) == (0.0, 0.0)


@pytest.mark.parametrize(("outside_m", "rules"), [(-0.01, []), (0.01, ["altitude"])])
@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize(("hits_wall", "tolerance_m"), [(False, 0.05), (True, 0.25)])
def test_an_altitude_slightly_outside_the_flight_space_is_tolerated(
    hits_wall: bool, tolerance_m: float, above: bool, outside_m: float, rules: list[str]
) -> None:
    """The vertical force of a contact moves the vehicle."""
    c = HandFedCore()
    c.fly_to_wood()
    if hits_wall:
        c.pulse((-10.0, -16.0))
    low, high = c.core.mission.bounds.z
    up_m = high + tolerance_m + outside_m if above else low - tolerance_m - outside_m
    c.position_ned = (*c.position_ned[:2], -up_m)
    c.run(0.05)
    assert [e.rule for e in fired(c)] == rules


@pytest.mark.parametrize(("climb_m_s", "rules"), [(3.29, []), (3.31, ["speed"])])
def test_a_tenth_above_the_speed_limit_is_tolerated(climb_m_s: float, rules: list[str]) -> None:
    c = HandFedCore()
    c.enter_approach()
    assert c.core.mission.limits.speed_m_s == 3.0
    c.velocity_ned = (0.0, 0.0, -climb_m_s)
    c.run(0.05)
    assert [e.rule for e in fired(c)] == rules


@pytest.mark.parametrize("armed", [False, True])
def test_an_armed_vehicle_is_disarmed_when_the_flight_is_given_up(armed: bool) -> None:
    c = HandFedCore(settings=SHORT_TIMEOUTS)
    c.set_status(armed=armed)
    CAUSES["not_ready"](c)
    assert c.core.end is not None
    actions = [o.action for o in c.outputs if isinstance(o, VehicleCommand)]
    assert actions == [VehicleAction.DISARM] * armed


def test_landing_time_counts_only_while_armed_in_land_mode() -> None:
    """Otherwise a long flight or a long wait on the ground would count as an endless landing."""
    c = HandFedCore()
    c.enter_approach()
    watch = c.core._guard._watch
    c.run(2.0)
    assert watch.landing_s == 0.0
    c = HandFedCore()
    watch = c.core._guard._watch
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(2.0)
    assert watch.landing_s == 0.0
    c.set_status(armed=True)
    c.run(2.0)
    assert watch.landing_s == pytest.approx(2.0, abs=0.02)
    c.set_status(armed=False)
    c.run(0.1)
    assert watch.landing_s == 0.0


@pytest.mark.parametrize(("later_us", "just_after"), [(1_999_999, True), (2_000_000, False)])
def test_an_impact_excuses_the_estimator_for_two_seconds(later_us: int, just_after: bool) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.pulse((0.0, -30.0))
    watch = c.core._guard._watch
    assert watch.impact is not None
    watch.state.now_us = watch.impact.t_us + later_us
    assert watch.just_after_impact is just_after


@pytest.mark.parametrize(("speed_m_s", "after_us"), [(0.09, 1_504_000), (0.11, 3_004_000)])
def test_a_vehicle_that_broke_off_is_landed_after_a_second_and_a_half_at_rest_or_after_three(
    speed_m_s: float, after_us: int
) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.run(1.0)
    c.velocity_ned = (0.0, speed_m_s, 0.0)
    c.feed(OperatorRequest(c.t_us, Request.LAND))
    out = c.run(4.0)
    assert c.core.override is Override.BREAK_OFF
    land = next(o for o in out if isinstance(o, VehicleCommand) and o.action is VehicleAction.LAND)
    assert land.t_us - fired(c)[0].t_us == after_us


def test_landing_time_is_the_shorter_of_both_clocks() -> None:
    c = HandFedCore()
    c.run(0.1)
    c.set_status(flight_mode=FlightMode.LAND, armed=True)
    c.run(2.0)
    c.host_ahead_us += 60_000_000
    c.run(0.02)
    assert c.core._guard._watch.landing_s == pytest.approx(2.0, abs=0.03)


def test_a_jump_of_one_stamp_in_a_landing_does_not_stop_the_motors() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(1.0)
    c.feed(ImuSample(c.t_us + 60_000_000, c.t_us, (0.0, 0.0, -9.8), (0.0, 0.0, 0.0)))
    c.run(0.5)
    assert "still_armed" not in [e.rule for e in fired(c)]


@pytest.mark.parametrize("whose", ["autopilot", "host"])
def test_a_jump_of_one_clock_in_a_landing_does_not_stop_the_motors(whose: str) -> None:
    """Both clocks must exceed the timeout."""
    c = HandFedCore()
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(1.0)
    if whose == "autopilot":
        c.t_us += 60_000_000
        c.host_ahead_us -= 60_000_000
    else:
        c.host_ahead_us += 60_000_000
    c.run(1.0)
    assert "still_armed" not in [e.rule for e in fired(c)]


def test_a_reset_count_without_a_step_is_no_reset() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=3))
    c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=4))
    c.run(0.12)
    # A later step that is too small for `estimator_jump` is unrelated.
    north, east, down = c.position_ned
    c.position_ned = (north + 0.08, east, down)
    c.run(0.1)
    assert fired(c) == []


@pytest.mark.parametrize(
    ("faster_m_s", "says"), [(1.6, ["velocity jumped by 1.60 m/s, limit 1.5 m/s"]), (1.4, [])]
)
def test_a_velocity_jump_is_an_estimator_jump(faster_m_s: float, says: list[str]) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.use_rules(RULES)
    c.velocity_ned = (faster_m_s, 0.0, 0.0)
    c.run(0.016)
    assert [e.detail for e in fired(c) if e.rule == "estimator_jump"] == says


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("along", "jumps"), [(1.0, False), (-1.0, True)])
def test_a_position_is_compared_with_its_extrapolation_by_velocity(
    axis: int, along: float, jumps: bool
) -> None:
    """0.26 m between two sparse samples at 2.9 m/s are no jump forwards, but are one backwards."""
    c = HandFedCore()
    c.finish_climb()
    fast, there = [0.0, 0.0, 0.0], list(c.position_ned)
    fast[axis] = 2.9
    for away_m, after_us in ((0.0, 8000), (along * 2.9 * 0.09, 90_000)):
        there[axis], c.t_us = there[axis] + away_m, c.t_us + after_us
        position, velocity = (there[0], there[1], there[2]), (fast[0], fast[1], fast[2])
        c.feed(OdometrySample(c.t_us, c.t_us, position, velocity))
    message = f"position jumped by {2 * 2.9 * 0.09:.2f} m, limit 0.3 m"
    assert (c.core._guard._watch.estimator.jump == message) is jumps
    assert bool(c.core._guard._watch.estimator.jump) is jumps


@pytest.mark.parametrize("sd", [None, 0.05])
def test_the_lateness_limit_of_a_wall_includes_its_position_uncertainty(sd: float | None) -> None:
    """The limit grows by three standard deviations at the planned closing speed."""
    loaded = HandFedCore("missions/paper_single_wall.yaml").core.mission
    (planned,) = loaded.collisions
    wall = msgspec.structs.replace(planned.wall, position_sd_m=sd)
    mission = msgspec.structs.replace(
        loaded, walls=(wall,), collisions=(msgspec.structs.replace(planned, wall=wall),)
    )
    late_s = mission.vehicle.guard.wall_late_s + (0.0 if sd is None else 3.0 * sd / 1.0)

    def found(since_s: float) -> list[str]:
        flown, state, p = executive.Executive(mission), FlightState(), Proposal()
        flown.progress.phase, flown.progress.entered_us = Phase.APPROACH, 0
        approach = Trajectory.level((0.0,) * 6, (0.0,) * 6, 1.0, (2.0,))
        flown.progress.course = flown.progress.course.approach(approach)
        state.now_us = round((2.0 + since_s) * 1e6)
        state.lock = LockState(0, LockPhase.SETTLED, planned.mode)
        flown._approach(state, Sensed(None, (), False), p)
        return [finding.rule for finding in p.findings]

    assert (found(late_s - 0.01), found(late_s + 0.01)) == ([], ["wall_not_met"])


@pytest.mark.parametrize("name", ["estimator_jump", "estimator_reset", "estimator_flags"])
def test_the_estimator_is_not_checked_shortly_after_an_impact(name: str) -> None:
    c = HandFedCore()
    c.fly_to_wood()
    c.pulse((-10.0, -16.0))
    c.set_lock(Mode.RIGID)
    c.run(0.15)
    c.use_rules(RULES)  # only now, because a teleport is a jump as well
    # One disturbance at a time: of two rules with the same action, only the first is reported.
    if name == "estimator_flags":
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
    else:
        north, east, down = c.position_ned
        c.position_ned = (north + (0.4 if name == "estimator_jump" else 0.1), east, down)
    if name == "estimator_reset":
        c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=1))
        c.feed(EstimatorSample(c.t_us, c.t_us, reset_counter=2))
    c.run(0.5)
    assert name not in [e.rule for e in fired(c)]


def test_hold_mode_after_a_gap_is_a_failsafe_and_manual_mode_is_a_pilot() -> None:
    for mode, rule in ((FlightMode.HOLD, "px4_failsafe"), (FlightMode.MANUAL, "pilot")):
        c = HandFedCore()
        c.enter_approach()
        c.silent |= {"imu", "attitude", "odometry", "actuator", "status"}
        c.run(1.5)
        c.silent.clear()
        c.run(0.02)
        c.set_status(flight_mode=mode)
        assert fired(c)[-1].rule == rule


@pytest.mark.parametrize(("silent_s", "rule"), [(0.3, "pilot"), (0.7, "px4_failsafe")])
def test_a_gap_explains_a_mode_change_only_if_it_is_long_enough(silent_s: float, rule: str) -> None:
    c = HandFedCore(rules=tuple(r for r in RULES_WITHOUT_JUMP if not r.name.endswith("_silent")))
    c.enter_approach()
    c.silent |= {"imu", "attitude", "odometry", "actuator", "status"}
    c.run(silent_s)
    c.silent.clear()
    c.run(0.02)
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(0.11)
    assert fired(c)[-1].rule == rule


@pytest.mark.parametrize(("before_s", "rule"), [(2.9, "px4_failsafe"), (3.1, "pilot")])
@pytest.mark.parametrize("cause", ["word", "gap"])
def test_a_text_or_a_gap_explains_a_mode_change_for_three_seconds(
    cause: str, before_s: float, rule: str
) -> None:
    c = HandFedCore(rules=tuple(r for r in RULES_WITHOUT_JUMP if not r.name.endswith("_silent")))
    c.enter_approach()
    if cause == "word":
        c.feed(StatusText(c.t_us, c.t_us, "critical", "Failsafe activated"))
    else:
        c.silent |= {"imu", "attitude", "odometry", "actuator"}
        c.run(0.7)
        c.silent.clear()
    c.run(before_s)
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(0.11)
    assert fired(c)[-1].rule == rule


@pytest.mark.parametrize(
    ("paused_s", "later_s", "named"), [(0.06, 2.0, True), (0.03, 0.1, False), (0.06, 3.1, False)]
)
def test_a_pause_of_this_program_is_named_for_three_seconds(
    paused_s: float, later_s: float, named: bool
) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.t_us += round(paused_s * 1e6)  # no sample, and no tick either
    c.run(later_s)
    c.silent.add("imu")
    c.run(0.1)
    (event,) = fired(c)
    assert event.rule == "imu_silent"
    assert ("did not run for 6" in event.detail) is named


def test_the_longest_of_several_recent_pauses_is_named() -> None:
    c = HandFedCore()
    c.enter_approach()
    for paused_us in (60_000, 80_000, 50_000):
        c.t_us += paused_us
        c.run(0.5)
    c.silent.add("imu")
    c.run(0.1)
    assert "did not run for 8" in fired(c)[0].detail


def test_a_position_after_a_pause_of_its_stream_is_no_jump() -> None:
    c = HandFedCore(rules=RULES)
    c.finish_climb()
    before = [e.rule for e in fired(c)]
    c.silent.add("odometry")
    c.run(0.15)
    north, east, down = c.position_ned
    c.position_ned = (north + 0.4, east, down)
    c.silent.clear()
    c.run(0.1)
    assert [e.rule for e in fired(c)] == before


def test_a_pause_of_all_streams_is_tolerated_longer_than_one_of_the_imu() -> None:
    """A busy host delays all streams by a tenth of a second; the guard lands if the pause lasts longer."""
    c = HandFedCore()
    c.enter_approach()
    c.silent |= {"imu", "attitude", "odometry", "actuator"}
    c.run(0.15)
    assert not fired(c)
    c.run(0.1)
    assert fired(c)


def test_single_late_datagrams_are_no_backwards_clock() -> None:
    c = HandFedCore()
    c.enter_approach()
    for _ in range(20):
        c.feed(AttitudeSample(c.t_us - 1_000_000, c.t_us, c.q))
        c.run(0.02)
    assert not fired(c)


@pytest.mark.parametrize("stream", ["imu", "attitude", "odometry"])
def test_backwards_stamps_are_detected_in_every_stream(stream: str) -> None:
    c = HandFedCore()
    c.enter_approach()
    for i in range(5):
        t_us = c.t_us - 1_000_000 + 8000 * i
        samples: dict[str, Input] = {
            "imu": ImuSample(t_us, c.t_us, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)),
            "attitude": AttitudeSample(t_us, c.t_us, c.q),
            "odometry": OdometrySample(t_us, c.t_us, c.position_ned, c.velocity_ned),
        }
        c.feed(samples[stream])
    c.feed(Tick(c.t_us + 20_000))
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("stamps_backwards", f"{stream}: 5 samples in a row more than 0.5 s in the past")
    ]


def test_a_low_rate_of_motor_commands_is_named() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.silent.add("actuator")
    for _ in range(25):
        c.run(0.1)
        c.feed(ActuatorSample(c.t_us, c.t_us, c.motors))
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("stream_rate", f"actuator arrives at 10 Hz, minimum {BY_NAME['actuator'].expected_hz:.0f} Hz")
    ]


def test_findings_of_other_modules_are_in_the_rule_table() -> None:
    names = {rule.name: rule for rule in RULES}
    found = set[str]()
    for source in Path(executive.__file__).parent.glob("*.py"):
        found |= set(re.findall(r'[fF]inding\(\s*"(\w+)"', source.read_text()))
    found |= set(re.findall(r'Finding\(\s*"(\w+)"', inspect.getsource(flight_core)))
    assert found == {name for name, rule in names.items() if rule.condition.cause is None}


def test_a_finding_without_a_rule_is_a_fault_of_the_mission() -> None:
    """A finding of a rule that exists, but not in this guard's table, is ignored."""
    c = HandFedCore(rules=tuple(rule for rule in RULES_WITHOUT_JUMP if rule.name != "no_peak"))
    c.enter_approach()
    propose, names = c.core._executive.propose, ["no_peak"]

    def propose_with_finding(item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        propose(item, state, sensed, p)
        if names:
            p.add_finding(names.pop(), "")

    c.core._executive.propose = propose_with_finding  # type: ignore[method-assign]
    c.run(0.02)
    assert (names, fired(c)) == ([], [])
    names.append("no_such_rule")
    c.run(0.02)
    (event,) = fired(c)
    assert (event.rule, event.action) == ("mission_fault", Override.LAND)
    assert "KeyError: 'no_such_rule'" in event.detail


@pytest.mark.parametrize(
    ("phase", "scopes"),
    [
        (Phase.READYING, {Scope.ALWAYS, Scope.GROUND}),
        (Phase.ARMING, {Scope.ALWAYS, Scope.GROUND}),
        (Phase.CLIMB, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED, Scope.FLYING}),
        (Phase.RECOVERY, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED, Scope.FLYING}),
        (Phase.LANDING, {Scope.ALWAYS, Scope.AIR}),
        (Phase.OVERRULED, {Scope.ALWAYS, Scope.AIR, Scope.GUIDED}),
        (Phase.DONE, set[Scope]()),
    ],
)
def test_a_scope_selects_the_phases_in_which_a_rule_is_evaluated(phase: Phase, scopes: set[Scope]) -> None:
    assert {scope for scope in Scope if in_scope(RULES[0]._replace(scope=scope), phase)} == scopes


def test_the_table_of_the_manual_names_scope_and_inputs_of_every_rule() -> None:
    header, _, *rows = table().splitlines()
    assert header == "| rule | fires when | threshold | action | judged by |"
    assert [row.split("`")[1] for row in rows] == [rule.name for rule in RULES]
    by_name = {row.split("`")[1]: row for row in rows}
    assert by_name["imu_stuck"].endswith(" | 0.1 s | land | guard, in the air |")
    assert by_name["peak_force"].endswith(" | `limits.peak_force_n` | break off | mission |")
    for name, kinds in (("altitude", "`OdometrySample`"), ("disarmed", "`StatusSample`, `ActuatorSample`")):
        assert by_name[name].endswith(f", at once after {kinds} |")


def test_thresholds_named_in_the_table_exist() -> None:
    c = HandFedCore()
    mission, vehicle = c.core.mission, c.core.mission.vehicle
    assert vehicle.lock is not None
    places = {
        "guard": vehicle.guard,
        "flying": vehicle.flying,
        "lock": vehicle.lock,
        "detection": vehicle.detection,
        "estimation": vehicle.estimation,
        "limits": mission.limits,
        "bounds_m": mission.bounds,
        "goal": mission.goal,
        "mode_mismatch": mission,
        "mocap": vehicle.mocap,
    }
    for rule in RULES:
        for key in filter(None, rule.condition.threshold.split(", ")):
            if key.startswith("streams:") or key[0].isdigit():
                continue
            section, *names = key.split(".")
            node = places[section]
            for name in names:
                assert name in {f.name for f in msgspec.structs.fields(node)}, key
                node = getattr(node, name)


@pytest.mark.parametrize("odometry_every", [1, 2])
@pytest.mark.parametrize("ahead_s", [238.0, -238.0, 2.0, -0.7])
def test_alternating_clocks_are_two_vehicles_and_time_does_not_jump(
    ahead_s: float, odometry_every: int
) -> None:
    """This holds even if the samples of the two vehicles alternate in all streams."""
    c = HandFedCore()
    c.enter_approach()
    c.odometry_every = odometry_every
    before_us = c.t_us
    alternate_vehicles(c, round(ahead_s * 1e6), 0.0, 0.1)
    assert [e.rule for e in fired(c)] == ["second_vehicle"]
    assert f"{abs(ahead_s):.1f} s apart" in fired(c)[0].detail
    assert 0 <= c.core.state.now_us - before_us < 1_000_000


def test_alternating_positions_with_one_clock_are_two_vehicles() -> None:
    c = HandFedCore(rules=RULES)
    c.enter_approach()
    alternate_vehicles(c, 0, 3.0, 0.1)
    assert fired(c)[-1].rule == "second_vehicle"  # after the jump, which is detected first
    assert "3.0 m apart" in fired(c)[-1].detail
    assert c.core.override is Override.LAND


def test_a_position_after_a_gap_is_not_compared_with_earlier_ones() -> None:
    """The vehicle may have flown back during the gap, which indicates no second vehicle."""
    places, t_us = SecondPositionDetector(0.3), 0

    def difference_m(north_m: float, after_s: float = 0.02) -> float | None:
        nonlocal t_us
        t_us += round(after_s * 1e6)
        places.update(OdometrySample(t_us, t_us, (north_m, 0.0, -1.0), (0.0, 0.0, 0.0)))
        return places.position_difference_m(t_us)

    for _ in range(5):
        for north_m in (0.0, 3.0):
            assert difference_m(north_m, 1.1) is None
            assert difference_m(3.0 - north_m) is None  # one jump, not two
    assert [difference_m(north_m) for north_m in (0.0, 3.0, 0.0, 3.0, 0.0)][-1] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("north_m", "speed_m_s", "after_us", "odd"),
    [
        (0.2, 0.0, 1_000_000, False),
        (3.0, 0.0, 1_000_000, True),
        (3.0, 0.0, 1_000_001, False),
        (0.6, 2.0, 200_000, False),  # the vehicle flies 0.4 m in this time
        (0.8, 2.0, 200_000, True),
    ],
)
def test_positions_at_most_a_second_apart_differ_by_flight_and_tolerance(
    north_m: float, speed_m_s: float, after_us: int, odd: bool
) -> None:
    places = SecondPositionDetector(0.3)
    for t_us, x in ((5, 0.0), (5 + after_us, north_m)):
        places.update(OdometrySample(t_us, t_us, (x, 0.0, -1.0), (speed_m_s, 0.0, 0.0)))
    assert (places.odd_us is not None) is odd


@pytest.mark.parametrize(("back_us", "seconds_apart"), [(0, None), (50_000, None), (600_000, 0.6)])
def test_alternating_stamps_are_two_clocks_if_farther_apart_than_late_datagrams(
    back_us: int, seconds_apart: float | None
) -> None:
    clocks = SecondClockDetector(100_000.0)
    for i in range(8):
        t_us = 10_000_000 + 10_000 * i
        clocks.update(t_us, t_us)
        clocks.update(t_us - back_us, t_us)
    assert clocks.clock_difference_s(10_070_000) == pytest.approx(seconds_apart)
    assert (clocks.odd_us is not None) is (seconds_apart is not None)


@pytest.mark.parametrize(
    ("turns", "after_us", "detected"), [(2, 0, False), (3, 0, True), (3, 1_800_000, False)]
)
def test_two_clocks_are_detected_by_three_alternations_within_two_seconds(
    turns: int, after_us: int, detected: bool
) -> None:
    """The alternations are 0.1 s apart."""
    clocks = SecondClockDetector(100_000.0)
    for i in range(turns + 1):
        t_us = 10_000_000 + 100_000 * i
        clocks.update(t_us, t_us)
        clocks.update(t_us - 5_000_000, t_us)
    last_us = 10_000_000 + 100_000 * turns
    assert (clocks.clock_difference_s(last_us + after_us + 1) is not None) is detected
    assert (clocks.clock_difference_s(last_us + max(0, after_us - 1)) is not None) is (turns == 3)


@pytest.mark.parametrize(("ahead_us", "odd"), [(5_900_000, False), (6_100_000, True)])
def test_a_stamp_further_ahead_than_the_elapsed_time_belongs_to_another_clock(
    ahead_us: int, odd: bool
) -> None:
    """The limit is a second plus twenty times the elapsed time of the host."""
    clocks = SecondClockDetector(100_000.0)
    clocks.update(10_000_000, 0)
    clocks.update(10_000_000 + ahead_us, 250_000)
    assert (clocks.odd_us is not None) is odd


def test_a_clock_that_is_set_back_repeatedly_is_one_clock() -> None:
    """A replayed stream does this: no second clock continues from the earlier time."""
    clocks = SecondClockDetector(100_000.0)
    for i in range(8):
        t_us = 10_000_000 + 10_000 * i
        clocks.update(t_us, t_us)
        clocks.update(5_000_000, t_us)
    assert clocks.clock_difference_s(10_070_000) is None


def test_a_second_vehicle_becomes_the_reason_after_an_earlier_rule() -> None:
    """Both rules land, so the second one changes only the reason."""
    c = HandFedCore()
    c.enter_approach()
    c.silent = {"odometry"}
    c.run(0.3)
    assert [e.rule for e in fired(c)] == ["odometry_silent"]
    c.silent = set()
    alternate_vehicles(c, 238_000_000, 0.0, 0.1)
    assert [e.rule for e in fired(c)] == ["odometry_silent", "second_vehicle"]


def test_telemetry_that_waited_for_this_program_is_not_attributed_to_the_link() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.feed(RoundTrip(c.t_us, c.t_us, c.t_us))
    c.run(0.1)
    c.host_ahead_us += 100_000  # a pause, after which the program does not catch up
    c.run(0.3)
    (event,) = fired(c)
    assert (event.rule, event.detail) == (
        "telemetry_late",
        "this program reads telemetry 100 ms after sampling, limit 75 ms; the computer is too busy: this "
        "program did not run for 104 ms",
    )


def test_late_telemetry_becomes_the_reason_after_a_silent_stream() -> None:
    """Both rules land; each names the other system on the link, which may be the cause."""
    c = HandFedCore()
    c.enter_approach()
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    c.silent = {"odometry"}
    c.run(0.3)
    c.silent = set()
    delay_telemetry(c)
    late = "telemetry arrives 500 ms after sampling, limit 75 ms, round trip 1000 ms"
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("odometry_silent", "no data for 220 ms; system 7 sends on the same link"),
        ("telemetry_late", f"{late}; system 7 sends on the same link"),
    ]
    c.set_status(flight_mode=FlightMode.LAND, landed=LandedState.ON_GROUND, armed=False)
    c.run(0.3)
    assert c.core.end is not None
    assert c.core.end.reason == f"telemetry_late: {late}; system 7 sends on the same link"


def test_the_status_of_the_other_vehicle_does_not_end_the_flight() -> None:
    """The other vehicle is disarmed in another mode: no pilot, no landing and no end of the flight."""
    c = HandFedCore()
    c.enter_approach()
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)
    assert any(isinstance(o, VehicleCommand) and o.action is VehicleAction.LAND for o in c.outputs)
    c.set_status(armed=False, flight_mode=FlightMode.HOLD, landed=LandedState.ON_GROUND)
    alternate_vehicles(c, 238_000_000, 3.0, 2.0)
    assert [e.rule for e in fired(c)] == ["second_vehicle"]
    assert c.core.end is None


@pytest.mark.parametrize("ahead_us", [238_000_000, 0])
def test_a_mode_received_before_the_other_vehicles_samples_is_not_a_pilot(ahead_us: int) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.outputs.clear()
    c.set_status(armed=False, flight_mode=FlightMode.HOLD, landed=LandedState.ON_GROUND)
    c.run(0.02)
    assert not [o for o in c.outputs if isinstance(o, GuardEvent | Setpoint | VehicleCommand)]
    alternate_vehicles(c, ahead_us, 3.0, 0.1)
    assert fired(c)[-1].rule == "second_vehicle"
    assert not {"pilot", "px4_failsafe", "disarmed"} & {e.rule for e in fired(c)}
    alternate_vehicles(c, ahead_us, 3.0, 2.0)
    assert any(isinstance(o, VehicleCommand) and o.action is VehicleAction.LAND for o in c.outputs)
    assert c.core.end is None


def test_a_switch_to_hold_silences_the_mission_at_once_and_ends_it_after_0_1_s() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.outputs.clear()
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(0.09)
    assert not fired(c)
    c.run(0.02)
    assert [e.rule for e in fired(c)] == ["pilot"]
    assert c.core.end is not None
    assert not [o for o in c.outputs if isinstance(o, Setpoint | VehicleCommand)]


def test_a_brief_change_of_mode_only_interrupts_the_setpoints() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.set_status(flight_mode=FlightMode.HOLD)
    c.run(0.05)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    assert any(isinstance(o, Setpoint) for o in c.run(0.2))
    assert not fired(c)


@pytest.mark.parametrize(
    ("left", "says"),
    [
        ({"battery_remaining": 0.1, "battery_v": 15.0}, ["10 %, 15.0 V"]),
        ({"battery_remaining": 0.1}, ["10 %"]),
        ({"battery_remaining": 0.5, "battery_v": 12.9}, ["50 %, 12.9 V"]),
        ({"battery_v": 12.9}, ["12.9 V"]),
        ({"battery_remaining": 0.5, "battery_v": 15.0}, []),
        ({}, []),
    ],
)
def test_a_battery_is_low_by_its_charge_or_its_voltage(left: dict[str, float], says: list[str]) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.set_status(**left)
    c.run(1.2)
    assert [(e.rule, e.detail) for e in fired(c)] == [("battery", words) for words in says]


def test_a_battery_that_recovers_restarts_its_timer() -> None:
    """Repeated short current peaks are no low battery."""
    c = HandFedCore()
    c.enter_approach()
    for _ in range(4):
        c.set_status(battery_v=12.9)
        c.run(0.6)
        c.set_status(battery_v=15.0)
        c.run(0.1)
    assert not fired(c)


def test_short_faults_do_not_add_up() -> None:
    c = HandFedCore()
    c.enter_approach()
    for _ in range(6):
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
        c.run(0.2)
        c.feed(EstimatorSample(c.t_us, c.t_us, healthy=True))
        c.run(0.05)
        c.noise_m_s2 = 0.0
        c.run(0.06)
        c.noise_m_s2 = 1e-4
        c.run(0.01)
    assert not fired(c)


def test_a_kill_switch_is_detected_by_the_fall_before_px4_disarms() -> None:
    """The fall breaks another rule only after 0.3 s, and PX4 stays armed for 5 s more."""
    c = HandFedCore()
    c.enter_approach()
    c.motors, c.falling = (0.0,) * 4, True
    c.run(0.1)
    assert not fired(c)
    c.run(0.04)
    assert [e.rule for e in fired(c)] == ["disarmed"]
    assert c.core.end is not None
    assert c.core.end.reason is not None
    assert c.core.end.reason.endswith("the vehicle has been falling for 104 ms")


@pytest.mark.parametrize("falling", [True, False])
def test_zero_throttle_or_free_fall_alone_is_no_kill_switch(falling: bool) -> None:
    c = HandFedCore()
    c.enter_approach()
    c.motors, c.falling = c.motors if falling else (0.0,) * 4, falling
    c.run(0.3)
    assert "disarmed" not in {e.rule for e in fired(c)}


def test_the_retreat_from_an_unknown_wall_follows_the_measured_push() -> None:
    """With plain GPS a wall may be a metre off its place, so the force gives its direction."""

    def retreat_target() -> tuple[float, float]:
        north, east, _ = next(o for o in reversed(c.outputs) if isinstance(o, Setpoint)).position_ned
        return north, east

    c = HandFedCore()
    c.finish_climb()
    assert c.core.phase is Phase.TRANSIT
    c.position_ned = (0.3, 0.2, -1.0)
    c.run(0.02)
    c.pulse((20.0, 0.0))
    assert [e.rule for e in fired(c)] == ["unplanned_hit"]
    assert retreat_target() == pytest.approx((0.8, 0.2), abs=0.01)
    c.run(0.3)
    c.pulse((0.0, -40.0))
    assert retreat_target() == pytest.approx((0.3, -0.3), abs=0.01)


def test_the_retreat_from_one_face_of_a_partition_does_not_lead_through_it() -> None:
    """The vehicle is 0.45 m behind the front, less than the retreat, but on the other side."""
    board = {"point_m": [-0.15, 0.8], "normal": [-1.0, 0.0], "length_m": 0.2, "material": "wood"}
    c = HandFedCore(settings={"walls.board": board | {"thickness_m": 0.012}})
    c.finish_climb()
    c.position_ned = (0.3, -0.8, -1.0)
    c.run(0.02)
    c.pulse((20.0, 0.0))
    assert [e.rule for e in fired(c)] == ["unplanned_hit"]
    held = next(o for o in reversed(c.outputs) if isinstance(o, Setpoint)).position_ned
    assert held[:2] == pytest.approx((-0.15 + 0.412 + 0.5, -0.8), abs=0.01)


def test_one_report_of_landed_and_disarmed_does_not_end_a_guard_landing() -> None:
    """It may come from a second vehicle on the same link, before the first sample of that vehicle."""
    c = HandFedCore()
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND)
    c.run(1.0)
    c.set_status(armed=False, landed=LandedState.ON_GROUND)
    c.run(0.1)
    assert c.core.end is None
    alternate_vehicles(c, 0, 3.0, 1.0)
    assert c.core.end is None


def test_a_vehicle_reported_disarmed_in_the_air_has_not_landed() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.set_status(battery_v=12.9)
    c.run(1.2)
    c.set_status(flight_mode=FlightMode.LAND, armed=False)
    c.run(1.0)
    assert c.core.end is None
    c.set_status(landed=LandedState.ON_GROUND)
    c.run(1.0)
    assert c.core.end is not None


def test_a_pilot_can_take_over_beside_a_second_vehicle() -> None:
    c = HandFedCore()
    c.enter_approach()
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)
    c.set_status(flight_mode=FlightMode.MANUAL)
    assert fired(c)[-1].rule == "pilot"


@pytest.mark.parametrize("back_s", [5.0, 400.0])
def test_a_single_backwards_jump_of_a_clock_is_reported_as_backwards_stamps(back_s: float) -> None:
    c = HandFedCore()
    c.enter_approach()
    us = round(back_s * 1e6)
    for i in range(1, 60):
        t, received = c.t_us - us + 4000 * i, c.t_us + 4000 * i
        c.feed(AttitudeSample(t, received, c.q))
        c.feed(ImuSample(t, received, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)))
        c.feed(OdometrySample(t, received, c.position_ned, c.velocity_ned))
        c.feed(Tick(received))
    assert [e.rule for e in fired(c)] == ["stamps_backwards"]


def test_a_clock_that_jumps_ahead_is_accepted_eventually() -> None:
    c = HandFedCore()
    c.enter_approach()
    for i in range(1, 60):
        t, received = c.t_us + 50_000_000 + 4000 * i, c.t_us + 4000 * i
        c.feed(AttitudeSample(t, received, c.q))
        c.feed(ImuSample(t, received, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)))
    assert c.core.state.imu is not None
    assert c.core.state.imu.t_us > c.t_us + 50_000_000
    assert "second_vehicle" not in [e.rule for e in fired(c)]


def test_a_failed_stream_is_reported_with_the_other_system_on_the_link() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    c.silent.add("imu")
    c.run(0.1)
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("imu_silent", "no data for 100 ms; system 7 sends on the same link")
    ]
    c = HandFedCore()
    c.enter_approach()
    c.odometry_every = 14
    c.run(1.0)
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    c.run(1.2)
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("stream_rate", "odometry arrives at 18 Hz, minimum 30 Hz; system 7 sends on the same link")
    ]


def test_a_pause_of_this_program_is_named_as_the_cause_of_silence() -> None:
    c = HandFedCore()
    c.enter_approach()
    c.run(0.1)
    c.t_us += 400_000  # no sample, and no tick either
    c.run(0.004)
    assert fired(c)[0].rule.endswith("_silent")
    expected = r"no data for 40\d ms; the computer is too busy: this program did not run for 40\d ms"
    assert re.fullmatch(expected, fired(c)[0].detail)
    c = HandFedCore()  # a silent vehicle is not attributed to the computer
    c.enter_approach()
    c.silent.add("attitude")
    c.run(0.3)
    assert [(e.rule, e.detail) for e in fired(c)] == [("attitude_silent", "no data for 220 ms")]


@pytest.mark.parametrize(
    ("position", "velocity", "words"),
    [
        ((1e33, 0.0, 0.0), (0.0, 0.0, 0.0), "implausible position: 1e+33 m from the origin at 0 m/s"),
        ((0.0, 0.0, -1.0), (0.0, -1e9, 0.0), "implausible position: 1 m from the origin at 1e+09 m/s"),
    ],
)
def test_an_implausible_position_is_reported_and_not_used(position: Vec3, velocity: Vec3, words: str) -> None:
    c = HandFedCore(rules=RULES)
    c.run(0.5)
    c.feed(OdometrySample(c.t_us + 1000, c.t_us + 1000, position, velocity))  # on the ground: rejected
    assert c.core.state.odometry is not None
    assert c.core.state.odometry.position_ned == c.position_ned
    c = HandFedCore(rules=RULES)
    c.set_lock(Mode.RIGID)
    c.run(0.5)
    c.set_status(flight_mode=FlightMode.OFFBOARD)
    c.run(0.1)
    c.set_status(armed=True)
    c.run(0.1)
    assert c.core.phase is Phase.CLIMB
    before = c.core.state.position
    c.feed(OdometrySample(c.t_us + 1000, c.t_us + 1000, position, velocity))
    assert [(e.rule, e.detail) for e in fired(c)] == [("estimator_jump", words)]
    assert c.core.state.position == before


def test_another_system_on_the_link_is_refused_only_before_take_off() -> None:
    c = HandFedCore()
    c.run(0.1)
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))
    assert [(e.rule, e.detail) for e in fired(c)] == [
        ("second_vehicle_ground", "system 7 sends on the same link")
    ]
    assert c.core.end is not None
    c = HandFedCore()
    c.enter_approach()
    c.feed(OtherVehicle(c.t_us, c.t_us, 7))  # its samples are distinguished
    c.run(0.2)
    assert not fired(c)


def test_a_stream_without_usable_messages_is_silent_and_its_cause_is_named() -> None:
    c = HandFedCore(rules=tuple(r for r in RULES if r.name == "actuator_silent"))
    c.enter_approach()
    c.feed(
        StatusText(c.t_us, c.t_us, "error", "ODOMETRY arrives, but no message is usable: the velocity is NaN")
    )
    unusable = "ACTUATOR_OUTPUT_STATUS arrives, but no message is usable: the motors' outputs are invalid"
    c.feed(StatusText(c.t_us, c.t_us, "error", unusable))
    c.silent.add("actuator")
    c.run(0.6)
    event = next(item for item in c.outputs if isinstance(item, GuardEvent))
    assert event.detail.endswith(f"ms; {unusable}")
