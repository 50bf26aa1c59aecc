"""A table of causes, one for each rule of the guard: what makes the rule fire, and what it reports then."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.base.records import (
    AttitudeSample,
    ContactRequest,
    EstimatorSample,
    FlightMode,
    ImuSample,
    LockPhase,
    Mode,
    OdometrySample,
    OtherVehicle,
    Override,
    Phase,
    PoseSample,
    Request,
    RoundTrip,
    StatusText,
    SystemStatus,
    Tick,
)
from dart_flight.core.guard.estimator_watch import ESTIMATOR_BAD_S
from dart_flight.core.guard.flight_conditions import LYING_TILT_DEG
from dart_flight.core.guard.heading_step import HEADING_STEP_DEG
from dart_flight.core.guard.pose_watch import _GROUND_LOST_S, LOST_APPROACH_S, LOST_LAND_S
from dart_flight.core.guard.rule import Rule
from dart_flight.core.guard.rules import _STALE_SAMPLES, BATTERY_LOW_S, IMU_CLIPPED_S, IMU_STUCK_S, LYING_S
from dart_flight.core.guard.second_vehicle import POSITION_JUMP_M
from dart_flight.core.guard.stream_watch import (
    ACTUATOR_TIMEOUT_S,
    LINK_LOST_S,
    STAMP_TOLERANCE_S,
    STATUS_TIMEOUT_S,
)
from dart_flight.core.pace import BATCH_S
from dart_flight.planning.contact_fit import ContactFitter
from tests.core.conftest import NO_SETTINGS, RULES_WITHOUT_JUMP, SHORT_TIMEOUTS, HandFedCore

Fly = Callable[[HandFedCore], object]


class Cause(NamedTuple):
    """The cause of a rule.

    Attributes:
        detail: what the operator reads: the measured value and its limit; for an exception, its last line.
        fly: what happens to the vehicle.
        phase: phase in which it happens.
        settings: changed keys of the mission.
    """

    detail: str
    fly: Fly
    phase: Phase
    settings: Mapping[str, Any]

    def fire(self, rules: tuple[Rule, ...] = RULES_WITHOUT_JUMP, other: int | None = None) -> HandFedCore:
        """Return a core on which this has happened, beside the system `other` on the link."""
        c = HandFedCore(rules=rules, settings=self.settings)
        if other is not None:
            c.feed(OtherVehicle(c.t_us, c.t_us, other))
        c.enter(self.phase)
        self.fly(c)
        return c


CAUSES: dict[str, Cause] = {}


def cause(
    detail: str, phase: Phase = Phase.APPROACH, settings: Mapping[str, Any] = NO_SETTINGS, name: str = ""
) -> Callable[[Fly], Fly]:
    """Register a function as the cause of the rule `name`, or of the rule of the function's name."""

    def register(fly: Fly) -> Fly:
        CAUSES[name or fly.__name__] = Cause(detail, fly, phase, settings)
        return fly

    return register


def fly_to_acrylic(c: HandFedCore) -> None:
    """Fly through the first collision, from the approach towards the second wall."""
    c.meet_wood()
    c.pulse((-10.0, -16.0))
    c.run(0.1)
    c.position_ned = (1.2, 0.9, -1.0)


@cause("PX4 is in manual")
def pilot(c: HandFedCore) -> None:
    c.set_status(flight_mode=FlightMode.MANUAL)


@cause("Failsafe activated; PX4 is in land")
def px4_failsafe(c: HandFedCore) -> None:
    c.feed(StatusText(c.t_us, c.t_us, "critical", "Failsafe activated"))
    c.set_status(flight_mode=FlightMode.LAND)


@cause("Critical battery level: switching to Land")
def failsafe_announced(c: HandFedCore) -> None:
    c.feed(StatusText(c.t_us, c.t_us, "critical", "Critical battery level: switching to Land"))


@cause("PX4 has stopped the motors")
def terminated(c: HandFedCore) -> None:
    c.set_status(system_status=SystemStatus.FLIGHT_TERMINATION)


@cause("PX4 disarmed in the air")
def disarmed(c: HandFedCore) -> None:
    c.set_status(armed=False)


@cause(f"no telemetry for {LINK_LOST_S:.1f} s")
def link_lost(c: HandFedCore) -> None:
    c.silence()
    c.run(LINK_LOST_S + 1.0)


def silence(stream: str, seconds: float) -> Fly:
    def fly(c: HandFedCore) -> None:
        c.silent.add(stream)
        c.run(seconds)

    return fly


for _stream, _seconds, _detail in (
    ("imu", 0.1, "no data for 100 ms"),
    ("attitude", 0.23, "no data for 220 ms"),
    ("odometry", 0.23, "no data for 220 ms"),
    ("actuator", ACTUATOR_TIMEOUT_S + 0.1, f"no data for {1e3 * (ACTUATOR_TIMEOUT_S + BATCH_S):.0f} ms"),
    ("status", STATUS_TIMEOUT_S + 0.5, f"no heartbeat for {STATUS_TIMEOUT_S:.1f} s"),
):
    cause(_detail, name=f"{_stream}_silent")(silence(_stream, _seconds))


@cause("odometry arrives at 18 Hz, minimum 30 Hz")
def stream_rate(c: HandFedCore) -> None:
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


@cause("telemetry arrives 500 ms after sampling, limit 75 ms, round trip 1000 ms", Phase.READYING)
def telemetry_late_ground(c: HandFedCore) -> None:
    c.run(0.1)
    delay_telemetry(c)


@cause("telemetry arrives 500 ms after sampling, limit 75 ms, round trip 1000 ms")
def telemetry_late(c: HandFedCore) -> None:
    delay_telemetry(c)


@cause("two clocks alternate, 238.0 s apart", Phase.READYING)
def second_vehicle_ground(c: HandFedCore) -> None:
    c.run(0.1)
    alternate_vehicles(c, 238_000_000, 3.0, 0.1)


@cause("two clocks alternate, 238.0 s apart")
def second_vehicle(c: HandFedCore) -> None:
    alternate_vehicles(c, -238_000_000, 0.0, 0.1)


@cause(f"attitude: {_STALE_SAMPLES} samples in a row have stamps over {STAMP_TOLERANCE_S:g} s in the past")
def stamps_backwards(c: HandFedCore) -> None:
    for i in range(_STALE_SAMPLES):
        c.feed(AttitudeSample(c.t_us - round(2e6 * STAMP_TOLERANCE_S) + 8000 * i, c.t_us, c.q))
    c.feed(Tick(c.t_us + 20_000))


@cause(f"the IMU has repeated one reading for {1e3 * (IMU_STUCK_S + 0.016):.0f} ms")
def imu_stuck(c: HandFedCore) -> None:
    c.noise_m_s2 = 0.0
    c.run(IMU_STUCK_S + 0.05)


@cause(f"the IMU has been at full scale for {1e3 * (IMU_CLIPPED_S + 0.006):.0f} ms")
def imu_clipped(c: HandFedCore) -> None:
    c.force_ned = (250.0, 0.0, 0.0)
    c.run(IMU_CLIPPED_S + 0.05)


@cause(f"position jumped by 1.00 m, limit {POSITION_JUMP_M:g} m")
def estimator_jump(c: HandFedCore) -> None:
    c.position_ned = (0.0, -0.4, -1.0)
    c.run(0.1)


@cause("position stepped by 0.08 m, velocity by 0.00 m/s")
def estimator_reset(c: HandFedCore) -> None:
    c.reset_estimator()
    c.shift(north_m=0.08)
    c.run(0.05)


@cause(f"heading stepped by 28.6 deg, limit {HEADING_STEP_DEG:g} deg")
def heading_reset(c: HandFedCore) -> None:
    c.q = quaternion_from_euler(0.0, 0.0, 0.5)
    c.reset_estimator()
    c.run(0.05)


@cause(f"no valid estimate for {ESTIMATOR_BAD_S:.1f} s")
def estimator_flags(c: HandFedCore) -> None:
    c.feed(EstimatorSample(c.t_us, c.t_us, healthy=False))
    c.run(ESTIMATOR_BAD_S + 0.1)


@cause("standard deviation of the position 0.23 m, limit 0.10 m")
def position_uncertain(c: HandFedCore) -> None:
    c.feed(EstimatorSample(c.t_us, c.t_us, healthy=True, position_sd_m=0.23))
    c.run(0.1)


@cause("the position estimate leads the IMU by about 172 ms, limit 50 ms: check EKF2_EV_DELAY")
def position_delayed(c: HandFedCore) -> None:
    """The vehicle goes up and down; its velocity is estimated as with EKF2_EV_DELAY 0.15 s too long."""
    mass_kg = c.core.mission.vehicle.airframe.mass_kg
    for tick in range(750):
        t_s = 0.004 * tick
        c.force_ned = (0.0, 0.0, mass_kg * math.sin(4.0 * t_s))
        pull = 0.75 * 0.15 * math.sin(4.0 * (t_s - 0.45))
        c.velocity_ned = (0.0, 0.0, -math.cos(4.0 * t_s) / 4.0 + pull)
        c.run(0.004)


@cause("still armed after 10 s in land mode", settings={"vehicle.guard.kill_after_s": 10.0})
def still_armed(c: HandFedCore) -> None:
    c.land_with_low_battery()
    c.set_status(battery_v=15.0)
    c.run(11.0)


@cause("12.9 V")
def battery(c: HandFedCore) -> None:
    c.set_status(battery_v=12.9)
    c.run(BATTERY_LOW_S + 0.2)


@cause("69 deg, limit 60 deg")
def tilt(c: HandFedCore) -> None:
    c.q = quaternion_from_euler(1.2, 0.0, 0.0)
    c.run(0.02)


@cause("2.20 m, limits 0.3 to 2 m")
def altitude(c: HandFedCore) -> None:
    c.position_ned = (0.0, 0.0, -2.2)
    c.run(0.1)


@cause("the vehicle would stop 0.20 m outside bounds_m")
def bounds(c: HandFedCore) -> None:
    c.velocity_ned = (-1.0, 0.0, 0.0)
    c.position_ned = (-1.7, 0.0, -1.0)  # inside, but not after a braking distance of half a metre
    c.run(0.1)


@cause("3.63 m/s, limit 3 m/s")
def speed(c: HandFedCore) -> None:
    for step in range(1, 12):
        c.velocity_ned = (0.0, -0.33 * step, 0.0)
        c.run(0.008)


@cause("180 N, limit 172.5 N")
def force_over_limit(c: HandFedCore) -> None:
    c.meet_wood()
    c.pulse((0.0, -190.0))


@cause("162 N at wall wood, limit 150 N")
def peak_force(c: HandFedCore) -> None:
    c.meet_wood()
    c.pulse((0.0, -160.0))


@cause("30 N at wall wood, limit 20 N", settings={"collisions[0].peak_limit_n": 20.0})
def harder_hit(c: HandFedCore) -> None:
    c.meet_wood()
    c.pulse((0.0, -30.0))


@cause("no contact, but the vehicle is 0.20 m behind the plane of wall wood")
def wall_not_met(c: HandFedCore) -> None:
    c.meet_wood()
    c.position_ned = (0.917, 1.3, -1.0)
    c.run(0.1)


@cause("contact 0.50 m before wall wood")
def wall_met_early(c: HandFedCore) -> None:
    c.position_ned = (0.5, 0.6, -1.0)
    c.run(0.1)
    c.pulse((0.0, -20.0))


@cause("unplanned impact of 12 N in phase goal", Phase.TRANSIT, {"collisions": []})
def unplanned_hit(c: HandFedCore) -> None:
    c.pulse((12.0, 16.0))


@cause("the contact force has no peak")
def no_peak(c: HandFedCore) -> None:
    c.meet_wood()
    c.hide_peaks()
    c.force_ned = (0.0, -20.0, 0.0)
    c.run(0.4)


@cause("the lock left the mode flexible during the approach")
def lock_not_settled(c: HandFedCore) -> None:
    c.set_lock(None, LockPhase.FAULT)
    c.run(0.02)


@cause("the lock is travelling, not rigid; wall acrylic is 0.45 m away, closing speed 1.00 m/s")
def lock_late(c: HandFedCore) -> None:
    fly_to_acrylic(c)
    c.set_lock(Mode.RIGID, LockPhase.TRAVELLING)
    c.velocity_ned = (1.0, 0.0, 0.0)
    c.run(0.3)


@cause("the lock is not flexible before collision 1", Phase.PREPARE)
def lock_not_ready(c: HandFedCore) -> None:
    c.run(3.6)


@cause("the altitude was not reached in time", Phase.CLIMB, SHORT_TIMEOUTS)
def climb_timeout(c: HandFedCore) -> None:
    c.run(3.5)


@cause("the run-up point was not reached in time", Phase.TRANSIT, SHORT_TIMEOUTS)
def transit_timeout(c: HandFedCore) -> None:
    c.position_ned = (0.2, 0.0, -1.0)
    c.run(4.0)


@cause(
    "the vehicle is still 1.12 m from the goal",
    Phase.TRANSIT,
    {"collisions": [], "limits.collision_timeout_s": 2.0},
)
def goal_not_reached(c: HandFedCore) -> None:
    c.run(8.0)


@cause(
    "the operator did not resume within 5 s",
    Phase.TRANSIT,
    {"waypoints": [{"pause": "operator", "timeout_s": 5.0}]},
)
def pause_timeout(c: HandFedCore) -> None:
    c.run(6.0)


@cause("the lock is not rigid", Phase.READYING, SHORT_TIMEOUTS)
def not_ready(c: HandFedCore) -> None:
    c.run(3.5)  # the lock does not report


@cause("PX4 refused offboard mode", Phase.READYING, SHORT_TIMEOUTS)
def offboard_refused(c: HandFedCore) -> None:
    c.set_lock(Mode.RIGID)
    c.run(4.0)


@cause("PX4 refused to arm", Phase.ARMING, SHORT_TIMEOUTS)
def arming_refused(c: HandFedCore) -> None:
    c.run(3.5)


def request(kind: Request) -> Fly:
    return lambda c: c.request(kind)


cause("landing requested", name="operator")(request(Request.LAND))
cause("released by the operator", name="operator_release")(request(Request.RELEASE))
cause("the simulated vehicle ended", name="world_died")(request(Request.WORLD_DIED))


@cause("flexible, 15 N at wall wood, below the detection limit of 30 N at this vibration level", Phase.CLIMB)
def hit_in_noise(c: HandFedCore) -> None:
    """The climb is so noisy that the planned hit would not be detected."""
    rng = random.Random(1)
    for _ in range(750):
        c.force_ned = (rng.gauss(0.0, 25.0), rng.gauss(0.0, 25.0), 0.0)
        c.run(0.004)
    c.force_ned = (0.0, 0.0, 0.0)
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(1.0)
    c.set_lock(Mode.FLEXIBLE)
    c.run(0.02)


@cause(
    "the thrust curve gives a mass of 1.30 kg, airframe.mass_kg is 0.85: ratio 0.65, limits 0.75 to 1.25",
    Phase.CLIMB,
    {"vehicle.airframe.mass_kg": 0.85},
)
def hover_thrust(c: HandFedCore) -> None:
    """The vehicle weighs 1.3 kg and is configured with 0.85 kg."""
    c.run(2.0)
    c.position_ned = (0.0, 0.0, -1.0)
    c.run(0.5)


def rigid_pulse(c: HandFedCore) -> None:
    """Hit with the pulse of rigid arms at 0.6 m/s, without friction, while the lock reports flexible."""
    c.meet_wood()
    c.pulse((0.0, -41.0), 0.056)
    c.run(0.08)
    fit = next(o for o in c.outputs if isinstance(o, ContactRequest))
    c.feed(ContactFitter(c.core.mission.vehicle).answer(fit))


@cause(
    "contact with wall wood indicates rigid arms, but the lock reports flexible (log odds 126.4)",
    settings={"mode_mismatch": "land"},
)
def mode_felt(c: HandFedCore) -> None:
    rigid_pulse(c)


@cause(
    "the run-up to wall board at 2.00 m/s starts at (-3.19, 0.00), 1.19 m outside bounds_m; "
    "lower the approach speed, move the impact along the wall, or move start "
    "back along the line of the approach",
    Phase.PREPARE,
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
    },
)
def no_approach(c: HandFedCore) -> None:
    """The board is 1.7 m nearer than the end of the probe, so the run-up has too little room."""
    c.run(0.1)
    c.position_ned, c.velocity_ned = (0.4, 0.0, -1.0), (0.5, 0.0, 0.0)
    c.run(0.05)
    c.pulse((-20.0, 0.0))
    c.position_ned, c.velocity_ned = (0.1, 0.0, -1.0), (0.0, 0.0, 0.0)
    c.run(2.0)


TRACKED: Mapping[str, Any] = {"vehicle.mocap.url": "udp://127.0.0.1:9763/dart"}


def lose_body(c: HandFedCore, seconds: float) -> None:
    """Feed a pose, and then frames without the body."""
    for tracked in (True, *(False,) * round(seconds / 0.02)):
        c.feed(PoseSample(c.t_us, c.t_us, "dart", tracked, c.position_ned, c.q))
        c.run(0.02)


def not_tracking(later_s: float, limit_s: float) -> str:
    return f"not tracking body dart for {limit_s + later_s:.2f} s, limit {limit_s:g} s"


@cause(not_tracking(BATCH_S, _GROUND_LOST_S), Phase.READYING, TRACKED)
def pose_source_ground(c: HandFedCore) -> None:
    c.run(0.1)
    lose_body(c, _GROUND_LOST_S + 0.1)


@cause(not_tracking(0.01, LOST_APPROACH_S), settings=TRACKED)
def pose_source(c: HandFedCore) -> None:
    lose_body(c, LOST_APPROACH_S + 0.15)


@cause(not_tracking(0.0, LOST_LAND_S), settings=TRACKED)
def pose_source_blind(c: HandFedCore) -> None:
    lose_body(c, LOST_LAND_S + 0.2)


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


@cause(f"the vehicle has been lying on the ground at {1.02 * LYING_TILT_DEG:.0f} deg for {LYING_S:.1f} s")
def lying(c: HandFedCore) -> None:
    lie_down(c, 1.02 * LYING_TILT_DEG, 0.1, LYING_S + 0.05)


@cause("stopped by the operator before take-off", Phase.READYING)
def operator_ground(c: HandFedCore) -> None:
    c.run(0.1)
    c.request(Request.LAND)


@cause("ZeroDivisionError: mission")
def mission_fault(c: HandFedCore) -> None:
    c.break_mission()
    c.run(0.02)


# What the vehicle does on each cause: a decision for its safety, written down apart from the rules.
ACTIONS = {
    Override.RELEASE: "px4_failsafe terminated pilot disarmed link_lost operator_release world_died",
    Override.BREAK_OFF: "failsafe_announced pose_source heading_reset position_delayed hover_thrust tilt "
    "force_over_limit operator peak_force wall_not_met wall_met_early hit_in_noise unplanned_hit no_peak "
    "lock_not_settled mode_felt lock_late harder_hit",
    Override.LAND: "imu_silent attitude_silent odometry_silent status_silent telemetry_late second_vehicle "
    "stamps_backwards imu_stuck imu_clipped pose_source_blind estimator_flags position_uncertain battery "
    "altitude operator_ground lock_not_ready climb_timeout pause_timeout goal_not_reached mission_fault",
    Override.HOLD: "actuator_silent stream_rate estimator_jump estimator_reset bounds speed no_approach "
    "transit_timeout",
    Override.GIVE_UP: "telemetry_late_ground second_vehicle_ground pose_source_ground not_ready "
    "offboard_refused arming_refused",
    Override.KILL: "still_armed lying",
}
