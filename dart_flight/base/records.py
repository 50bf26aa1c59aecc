"""The immutable records that flow through the flight core.

Units are SI. `t_us` is the autopilot's time in integer microseconds; `received_us` is the host's monotonic
time at receipt. The core receives an `Input` and returns an `Output`. An output is either a command, which
the shell (the program around the core) executes, or an estimate or decision, which the shell only logs.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar, Final

import msgspec

from dart_flight.base.geometry import Quaternion, Vec2, Vec3
from dart_flight.base.walls import Wall

MIN_LEAD_M: Final = 0.002  # two guards touch at the same time if one leads the other by less

# PX4's default PWM_<bank>_MIN and _MAX: pulse widths at throttle 0 and 1.
MOTOR_STOP_US, MOTOR_FULL_US = 1000.0, 2000.0


class Mode(StrEnum):
    """State of the arms: Γ = 1 rigid (locked), Γ = 2 flexible (unlocked)."""

    RIGID = "rigid"
    FLEXIBLE = "flexible"

    @property
    def other(self) -> Mode:
        return Mode.FLEXIBLE if self is Mode.RIGID else Mode.RIGID


class FlightMode(StrEnum):
    """PX4's flight modes, as far as the core distinguishes them."""

    UNKNOWN = "unknown"
    READY = "ready"
    TAKEOFF = "takeoff"
    HOLD = "hold"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"
    OFFBOARD = "offboard"
    MANUAL = "manual"  # any mode flown with sticks: manual, stabilized, altitude, position, acro


class LandedState(StrEnum):
    """State of PX4's land detector."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"
    TAKING_OFF = "taking_off"
    LANDING = "landing"


class SystemStatus(StrEnum):
    """MAV_STATE in the autopilot's heartbeat; during a failsafe PX4 reports the value critical."""

    UNKNOWN = "unknown"
    UNINIT = "uninit"
    BOOT = "boot"
    CALIBRATING = "calibrating"
    STANDBY = "standby"
    ACTIVE = "active"
    CRITICAL = "critical"
    EMERGENCY = "emergency"
    POWEROFF = "poweroff"
    FLIGHT_TERMINATION = "flight_termination"


class World(StrEnum):
    """Kind of world in which a flight takes place (docs/architecture.md)."""

    DRONE = "drone"
    PX4 = "px4"  # a real PX4 on our plant
    HITL = "hitl"  # a flight controller in hardware-in-the-loop mode, on our plant
    EMBEDDED = "embedded"  # our small autopilot, through MAVSDK
    FAST = "fast"  # in this process, in simulated time


class Outcome(StrEnum):
    """Outcome of a flight."""

    COMPLETED = "completed"
    ABORTED = "aborted"
    RELEASED = "released"  # a pilot took over


class AfterImpact(StrEnum):
    """Response to an impact."""

    SETPOINT = "setpoint"  # the paper's recovery setpoint
    REPLAN = "replan"  # the paper's setpoint, until a trajectory planned from the measured impact begins


class Request(StrEnum):
    """Request of an operator, or of the shell itself, during a flight."""

    LAND = "land"  # fly away from the wall, then land
    CONTINUE = "continue"  # end the pause
    RELEASE = "release"
    WORLD_DIED = "world_died"  # from the shell: the simulated vehicle has terminated


class ModeMismatch(StrEnum):
    """Response if a contact indicates one mode of the arms, but the lock reports the other mode."""

    NOTE_ONLY = "go_on"  # continue; only record the mismatch in the log and the verdict
    LAND = "land"


class Phase(StrEnum):
    """Phase of the mission; `core/mission/phases.py` lists the transitions."""

    READYING = "readying"  # waiting for telemetry, and for the lock in the transit mode
    OFFBOARD = "offboard"  # requesting offboard mode from PX4
    ARMING = "arming"
    CLIMB = "climb"
    WAYPOINT = "waypoint"  # flying to a waypoint and holding there
    PAUSE = "pause"  # holding until the operator continues
    TRANSIT = "transit"  # flying to the run-up point, yawing parallel to the wall
    PREPARE = "prepare"  # switching the lock to the collision's mode
    APPROACH = "approach"
    CONTACT = "contact"  # from onset to the peak of the normal force
    RECOVERY = "recovery"
    GOAL = "goal"  # holding the goal
    LANDING = "landing"
    DONE = "done"
    OVERRULED = "overruled"  # the guard flies: break-off, hold, landing, or silence


class Override(StrEnum):
    """Action of the guard, in order of rank; an action of higher rank replaces one of lower rank."""

    NONE = "none"
    GIVE_UP = "give_up"  # on the ground: end the mission before take-off
    BREAK_OFF = "break_off"  # fly away from the wall, hold, land
    HOLD = "hold"  # stop at the current position, then land
    LAND = "land"
    KILL = "kill"  # motors off, whatever state PX4 assumes
    RELEASE = "release"  # send nothing more: the pilot or PX4 flies

    @property
    def rank(self) -> int:
        return _RANKS[self]


_RANKS = {override: rank for rank, override in enumerate(Override)}


class Record(msgspec.Struct, frozen=True, gc=False):
    """Base of all records that are exchanged and logged.

    Attributes:
        topic: name of the record's channel in the log.
        frequent: whether such records arrive many times per second. If the log is short of space, these
            records are dropped first.
    """

    topic: ClassVar[str] = ""
    frequent: ClassVar[bool] = False


# --- inputs: telemetry -----------------------------------------------------------------------------


class ImuSample(Record, frozen=True, gc=False):
    """HIGHRES_IMU: specific force (bias-corrected, without gravity) and body rate, FRD."""

    topic: ClassVar[str] = "/in/imu"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    specific_force_frd: Vec3  # m/s2
    rate_frd: Vec3  # rad/s


class AttitudeSample(Record, frozen=True, gc=False):
    """ATTITUDE_QUATERNION: body FRD to world NED."""

    topic: ClassVar[str] = "/in/attitude"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    q_frd_to_ned: Quaternion


class OdometrySample(Record, frozen=True, gc=False):
    """ODOMETRY: PX4's estimate of position (m) and velocity (m/s) in local NED."""

    topic: ClassVar[str] = "/in/odometry"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    position_ned: Vec3
    velocity_ned: Vec3


class ActuatorSample(Record, frozen=True, gc=False):
    """ACTUATOR_OUTPUT_STATUS: PX4's motor outputs, 0 (stopped) to 1."""

    topic: ClassVar[str] = "/in/actuator"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    motors: tuple[float, ...]  # in PX4's order
    stamp_is_estimated: bool = True  # whether the stamp is converted host time; the message has no stamp


class EscSample(Record, frozen=True, gc=False):
    """ESC_STATUS: measured speed of the motors, revolutions per minute."""

    topic: ClassVar[str] = "/in/esc"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    rpm: tuple[float, ...]  # revolutions per minute, in PX4's order


class StatusSample(Record, frozen=True, gc=False):
    """State of the autopilot that rarely changes; one record per change."""

    topic: ClassVar[str] = "/in/status"
    t_us: int
    received_us: int
    armed: bool = False
    flight_mode: FlightMode = FlightMode.UNKNOWN
    landed: LandedState = LandedState.UNKNOWN
    local_position_ok: bool = False  # odometry arrives, and no ESTIMATOR_STATUS reports a problem
    battery_v: float | None = None
    battery_remaining: float | None = None  # 0 to 1
    system_status: SystemStatus = SystemStatus.UNKNOWN  # MAV_STATE in the heartbeat
    battery_id: int | None = None  # id of the evaluated battery in BATTERY_STATUS


class EstimatorSample(Record, frozen=True, gc=False):
    """State of PX4's estimator (ODOMETRY's reset counter, ESTIMATOR_STATUS); unreported fields are None."""

    topic: ClassVar[str] = "/in/estimator"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    reset_counter: int | None = None  # counter of estimator resets; wraps from 255 to 0
    healthy: bool | None = None  # whether attitude, horizontal velocity and a horizontal position are valid
    position_sd_m: float | None = None  # standard deviation of the horizontal position, as reported by PX4


class StatusText(Record, frozen=True, gc=False):
    """STATUSTEXT of the autopilot, a PX4 event as text, or a finding of this program about the link."""

    topic: ClassVar[str] = "/in/statustext"
    t_us: int
    received_us: int
    severity: str  # emergency, alert, critical, error, warning, notice, info or debug
    text: str
    event: str = ""  # PX4's name of the event; empty for a STATUSTEXT
    found_here: bool = False  # whether the text comes from this program, not from PX4


class HealthReport(Record, frozen=True, gc=False):
    """PX4's health and arming checks: problems that prevent arming or flight; one record per change."""

    topic: ClassVar[str] = "/in/health"
    t_us: int
    received_us: int
    can_arm: bool  # whether PX4 can arm in the current flight mode
    blocking: tuple[str, ...]  # problems in the current mode, of severity warning or worse
    others: tuple[str, ...]  # problems in other modes


class OtherVehicle(Record, frozen=True, gc=False):
    """Another autopilot on the same link, identified by its system id. Its telemetry is discarded."""

    topic: ClassVar[str] = "/in/other_vehicle"
    t_us: int
    received_us: int
    system: int  # MAVLink's system id


class PoseSample(Record, frozen=True, gc=False):
    """A pose of the vehicle's marker body, as the motion-capture system sent it (docs/motion_capture.md).

    `base.geometry.RoomFrame` converts it to PX4's local NED.
    """

    topic: ClassVar[str] = "/in/pose"
    frequent: ClassVar[bool] = True
    t_us: int  # autopilot's time of receipt
    received_us: int
    body: str  # name or number of the body at the source
    tracked: bool  # whether the source tracks the body; if not, the pose is invalid
    position_room: Vec3  # m, in the axes of the room
    q_body_to_room: Quaternion
    frame_number: int | None = None  # source's frame counter, or None if the source has none
    source_us: int | None = None  # stamp on the source's own clock
    sender: str = ""  # address of the source, to detect a second source


# --- inputs: lock, results, operator, time -----------------------------------------------------------


class LockPhase(StrEnum):
    """Phase of the lock's state machine; without a sensor, `settled` means that the travel time is over."""

    UNKNOWN = "unknown"
    TRAVELLING = "travelling"
    SETTLED = "settled"
    FAULT = "fault"


class LockState(Record, frozen=True, gc=False):
    """State of the locking mechanism; the times are autopilot time."""

    topic: ClassVar[str] = "/in/lock"
    t_us: int
    phase: LockPhase
    mode: Mode | None  # the commanded mode while travelling, the reached mode once settled
    commanded_us: int | None = None
    settled_us: int | None = None
    feedback: bool = False  # whether a switch has confirmed the position
    reason: str | None = None


class CommandResult(Record, frozen=True, gc=False):
    """Answer to a vehicle command; telemetry, not this answer, shows whether the command took effect."""

    topic: ClassVar[str] = "/in/result"
    t_us: int
    command: str
    ok: bool
    detail: str = ""


class OperatorRequest(Record, frozen=True, gc=False):
    """Request of the operator or the shell; for `world_died`, `detail` is the cause."""

    topic: ClassVar[str] = "/in/operator"
    t_us: int
    request: Request
    detail: str = ""


class ClockOffset(Record, frozen=True, gc=False):
    """Estimate of autopilot time minus host time, microseconds."""

    topic: ClassVar[str] = "/in/clock"
    received_us: int
    offset_us: int


class RoundTrip(Record, frozen=True, gc=False):
    """Timing of an answered request; the delay of telemetry is at most the round trip."""

    topic: ClassVar[str] = "/in/round_trip"
    received_us: int  # host's monotonic time at which the answer was received
    sent_us: int  # host's monotonic time at which the request was sent
    autopilot_us: int | None  # autopilot time of the answer; None if unknown or in simulated time


class PlanAnswer(Record, frozen=True, gc=False):
    """The planner's answer to a `PlanRequest`: a trajectory from a future time, and the predicted contact.

    x and y are piecewise quintic polynomials, constant term first. Their variable is the time since the
    beginning of the piece, seconds. The first piece begins at `begin_us`. After the last piece, the vehicle
    continues at the final velocity.
    """

    topic: ClassVar[str] = "/in/plan"
    received_us: int
    number: int  # request number
    begin_us: int  # autopilot's time at which the trajectory begins
    duration_s: float = 0.0  # total duration
    x_mission: tuple[float, ...] = ()  # coefficients, m, m/s, ...; six for each polynomial
    y_mission: tuple[float, ...] = ()  # coefficients, m, m/s, ...; six for each polynomial
    collision: int | None = None  # 1-based index of the next collision, or None if the goal is next
    impact_s: float | None = None  # time from `begin_us` until the vehicle reaches the wall's plane
    normal_m_s: float | None = None  # velocity at impact, collision frame
    tangential_m_s: float | None = None  # velocity at impact, collision frame
    peak_force_n: float | None = None  # predicted peak normal force, from the coefficients estimated so far
    pieces_s: tuple[float, ...] = ()  # duration of each piece, s; empty for a single piece
    problem: str = ""  # reason why no trajectory was found


class ContactAnswer(Record, frozen=True, gc=False):
    """Results of the fit for a `ContactRequest`; the core outputs `body` and `wall` as records."""

    topic: ClassVar[str] = "/in/contact"
    received_us: int
    number: int  # request number
    body: ImpactBody | None = None  # geometry and torque, or None if the fit gives none
    wall: WallEstimate | None = None  # estimate of the wall, or None if the contact was not planned
    problem: str = ""  # reason why the fit gives no result


class Tick(Record, frozen=True, gc=False):
    """Host time. One record arrives at least every 20 ms, so that the core can detect silent streams."""

    topic: ClassVar[str] = "/in/tick"
    frequent: ClassVar[bool] = True
    host_us: int


Input = (
    ImuSample
    | AttitudeSample
    | OdometrySample
    | ActuatorSample
    | EscSample
    | StatusSample
    | EstimatorSample
    | StatusText
    | HealthReport
    | OtherVehicle
    | PoseSample
    | LockState
    | CommandResult
    | OperatorRequest
    | ClockOffset
    | RoundTrip
    | PlanAnswer
    | ContactAnswer
    | Tick
)


# --- outputs: commands -----------------------------------------------------------------------------


class Setpoint(Record, frozen=True, gc=False):
    """Offboard setpoint in local NED; velocity and acceleration, if present, are feed-forward."""

    topic: ClassVar[str] = "/out/setpoint"
    frequent: ClassVar[bool] = True
    t_us: int
    trigger_received_us: int  # receipt of the sample that triggered the setpoint
    position_ned: Vec3
    yaw_ned_rad: float
    velocity_ned: Vec3 | None = None
    acceleration_ned: Vec3 | None = None
    recovery: bool = False  # whether this is the recovery setpoint of an impact, whose latency is measured


class VehicleAction(StrEnum):
    """Actions of the autopilot, other than setpoints, that the core commands."""

    OFFBOARD = "offboard"
    ARM = "arm"
    LAND = "land"
    DISARM = "disarm"
    KILL = "kill"  # disarms whether or not PX4 detects the ground


class VehicleCommand(Record, frozen=True, gc=False):
    """An action for the autopilot; the result of the action comes back as a `CommandResult`."""

    topic: ClassVar[str] = "/out/command"
    t_us: int
    action: VehicleAction


class LockCommand(Record, frozen=True, gc=False):
    """Command to move the lock; sent only while locking is permitted."""

    topic: ClassVar[str] = "/out/lock"
    t_us: int
    mode: Mode


class LockPermission(Record, frozen=True, gc=False):
    """Permission to move the lock. It is withheld from a contact's onset until the arms have relaxed."""

    topic: ClassVar[str] = "/out/lock_permission"
    t_us: int
    permitted: bool


class PlanRequest(Record, frozen=True, gc=False):
    """Request to replan the rest of the mission after a contact; the `PlanAnswer` has the same number."""

    topic: ClassVar[str] = "/out/plan_request"
    t_us: int  # time of the vehicle's state in this record
    number: int  # request number, counting up
    begin_us: int  # start of the trajectory; an answer received later is rejected
    collision: int | None  # 1-based index of the next collision, or None if the goal is next
    position_mission: Vec3
    velocity_mission: Vec3
    acceleration_mission: Vec3  # acceleration caused by thrust and drag
    setpoint_mission: Vec3  # position setpoint that is active until `begin_us`, m
    lock_ready_us: int | None  # time at which lock and heading are ready for the wall; None: never
    under_way: bool = False  # whether the vehicle follows a trajectory instead of a setpoint
    contact_height_m: float | None = None  # height above the centre of mass at which walls push
    coasts: bool = False  # whether no position is commanded until `begin_us`, only thrust


class ContactRequest(Record, frozen=True, gc=False):
    """Request to fit a contact that has ended; the `ContactAnswer` has the same number (docs/contact_fit.md).

    The contact's IMU samples are stored as columns. They begin a few samples before the first touch.
    """

    topic: ClassVar[str] = "/out/contact_request"
    t_us: int  # stamp of the newest sample
    number: int  # request number, counting up
    onset: ImpactOnset
    wall: Wall | None  # the expected wall, or None if the contact was not planned
    normal: Vec2  # outward normal of the expected wall, else the direction of the force
    mode_reported: Mode | None  # mode reported by the lock at the onset, or None if not settled
    frame_heading_rad: float  # direction of the mission's x axis, clockwise from north
    slow_force: Vec2  # slow horizontal force before the contact, mission frame, N
    noise_n: float  # standard deviation of one force component's white noise
    noise_frd_nm: Vec3  # standard deviation of each torque component's white noise
    sample_us: tuple[int, ...] = ()
    force_mission: tuple[Vec3, ...] = ()
    push_mission: tuple[Vec2, ...] = ()  # horizontal force of thrust and drag, N
    clipped: tuple[bool, ...] = ()  # whether the reading was at full scale
    torque_frd: tuple[Vec3, ...] = ()
    q_frd_to_ned: tuple[Quaternion, ...] = ()
    rate_frd: tuple[Vec3, ...] = ()  # mean rate over the sample's tick


class Silence(Record, frozen=True, gc=False):
    """Command to send nothing more, because the pilot flies."""

    topic: ClassVar[str] = "/out/silence"
    t_us: int
    reason: str


# --- outputs: estimates and decisions --------------------------------------------------------------


class ForceEstimate(Record, frozen=True, gc=False):
    """External force on the vehicle at an IMU sample, mission frame, newton (docs/force.md).

    A sample is the mean over one IMU tick, the interval that ends at `t_us`. If the accelerometer was at full
    scale (`clipped`), the sample is a lower bound of the true force.
    """

    topic: ClassVar[str] = "/estimate/force"
    frequent: ClassVar[bool] = True
    t_us: int
    force_mission: Vec3
    clipped: bool
    filtered_mission: Vec3 = (0.0, 0.0, 0.0)  # first-order low-pass of the force
    variance_n2: Vec3 = (0.0, 0.0, 0.0)  # error variance of each component, mission frame, N2
    noise_n: float = 0.0  # standard deviation of one component's white noise
    push_mission: Vec2 = (0.0, 0.0)  # horizontal force of thrust and drag, N; it acts during a contact, too


class TorqueEstimate(Record, frozen=True, gc=False):
    """External torque about the centre of mass at an IMU sample, body FRD (docs/torque.md).

    The torque is the inertia times the angular acceleration, plus the gyroscopic term, minus the torque of
    the motors. A sample is the mean over one IMU tick, the interval that ends at `t_us`.
    """

    topic: ClassVar[str] = "/estimate/torque"
    frequent: ClassVar[bool] = True
    t_us: int
    torque_frd: Vec3
    noise_frd_nm: Vec3 = (0.0, 0.0, 0.0)  # standard deviation of each component's white noise


class ImpactOnset(Record, frozen=True, gc=False):
    """Onset of an impact: the horizontal force has crossed the threshold."""

    topic: ClassVar[str] = "/event/onset"
    t_us: int  # stamp of the sample that crossed the threshold
    first_us: int  # stamp of the first sample whose force is above the noise
    received_us: int
    force_mission: Vec3
    velocity_mission: Vec3  # last velocity before the contact
    position_mission: Vec3
    planned: bool = False  # whether a wall was expected and the force points away from this wall


class ImpactPeak(Record, frozen=True, gc=False):
    """Peak of the normal and of the tangential force in an impact; the recovery uses both."""

    topic: ClassVar[str] = "/event/peak"
    t_us: int  # time of the normal force's peak
    detected_us: int  # stamp of the sample at which the peak was detected
    received_us: int
    normal: Vec2  # wall normal that defines the normal and tangential force, mission frame
    normal_force_n: float
    tangential_force_n: float  # signed, along the wall's tangent
    position_mission: Vec3  # position at the normal peak
    clipped: bool
    normal_sigma_n: float = 0.0  # standard error of the normal force
    fitted: bool = False  # whether the peak comes from a fit of the contact model; if not, from a parabola


class ContactEnd(Record, frozen=True, gc=False):
    """End of a contact: the force has returned below the release level."""

    topic: ClassVar[str] = "/event/contact_end"
    t_us: int
    first_us: int


class ContactSide(StrEnum):
    """Propeller guard that touched the wall first; left and right are relative to the direction of flight."""

    LEFT = "left"
    RIGHT = "right"
    BOTH = "both"

    @classmethod
    def from_lead(cls, lead_m: float) -> ContactSide:
        """Return which guard touched first, from the lead of the right guard over the left guard."""
        if abs(lead_m) < MIN_LEAD_M:
            return cls.BOTH
        return cls.RIGHT if lead_m > 0.0 else cls.LEFT


class ImpactBody(Record, frozen=True, gc=False):
    """Geometry and torque of an impact, sent after the end of the impact (docs/torque.md)."""

    topic: ClassVar[str] = "/event/impact_body"
    t_us: int  # stamp of the newest sample used
    first_us: int  # first sample in contact, as in the `ImpactOnset`
    side: ContactSide
    lead_m: float  # lead of the right guard over the left one at the first touch, towards the wall
    incidence_rad: float  # angle from the wall to the leading edge at first touch; positive: turned left
    incidence_sigma_rad: float
    torque_peak_frd: Vec3  # largest external torque
    peak_torque_nm: float  # magnitude of the largest external torque


class WallEstimate(Record, frozen=True, gc=False):
    """Properties of the wall and the arms, estimated at the end of a planned contact (docs/contact_fit.md).

    The coefficients are posterior means, and hold for the estimated mode of the arms. If the mode cannot be
    estimated from the contact, the coefficients hold for the mode that the lock reports.
    """

    topic: ClassVar[str] = "/estimate/wall"
    t_us: int  # stamp of the newest sample used
    first_us: int  # first sample in contact, as in the `ImpactOnset`
    wall: str  # name of the wall
    mode_reported: Mode | None  # mode reported by the lock at the onset, or None if not settled
    mode_felt: Mode | None  # mode estimated from the contact, or None if undecided
    log_odds: float  # natural logarithm of the odds of rigid to flexible arms, with prior odds of 1
    k_n_per_m: float  # stiffness
    f_ns_per_m: float  # damping
    mu_s_per_m: float  # friction
    nu_n: float  # nu, the bound of the vertical force
    k_sd: float  # relative standard deviation of the stiffness
    f_sd: float  # relative standard deviation of the damping
    mu_sd: float  # relative standard deviation of the friction
    nu_sd: float  # relative standard deviation of nu
    incidence_rad: float  # angle from the wall to the leading edge at first touch; positive: turned left
    incidence_sigma_rad: float
    plane_offset_m: float  # measured plane minus the mission's plane, along the wall's normal
    plane_offset_sigma_m: float
    # Measured plane on which the vehicle's centre lies at first touch; None if there were too few readings.
    plane_point_mission: Vec2 | None = None  # point of first touch on the measured plane
    plane_normal_mission: Vec2 | None = None  # outward unit normal of the measured plane
    plane_normal_sigma_rad: float | None = None
    centre_mission: Vec2 | None = None  # vehicle's centre at the first touch
    material: str | None = None  # material with the nearest coefficients, if the wall's material is unknown
    problem: str = ""  # reason why the contact was not evaluated


class DetectionFloor(Record, frozen=True, gc=False):
    """Smallest force, N, that can be detected in the current noise (docs/force.md).

    The record is written once, when the mission begins to expect a wall.
    """

    topic: ClassVar[str] = "/estimate/detection"
    t_us: int
    threshold_n: float  # lowest of the detector's thresholds
    noise_short_n: float  # standard deviation of one component of the force averaged over the short window
    noise_long_n: float  # standard deviation of one component of the force averaged over the long window
    rigid_n: float  # lowest peak of a rigid contact with this wall that is always detected
    flexible_n: float | None = None  # lowest peak of a flexible contact that is always detected, or None


class PhaseChange(Record, frozen=True, gc=False):
    """Transition of the mission executive from one phase to the next."""

    topic: ClassVar[str] = "/event/phase"
    t_us: int
    before: Phase
    after: Phase
    reason: str
    collision: int | None = None  # 1-based index of the collision


class PosesWithheld(Record, frozen=True, gc=False):
    """End of pose forwarding, because the poses are wrong; PX4 then navigates with its IMU.

    If only the attitudes of the poses are wrong, the positions are still forwarded.
    """

    topic: ClassVar[str] = "/event/poses_withheld"
    t_us: int
    reason: str
    attitude_only: bool = False  # whether only the attitudes are withheld


class GuardEvent(Record, frozen=True, gc=False):
    """Firing of a guard rule."""

    topic: ClassVar[str] = "/event/guard"
    t_us: int
    rule: str
    action: Override
    detail: str


class GoalPassed(Record, frozen=True, gc=False):
    """Closest approach to the goal after the last contact; the vehicle then flies to the goal and holds."""

    topic: ClassVar[str] = "/event/goal"
    t_us: int
    miss_m: float  # distance from the goal at the closest approach
    timed_out: bool = False  # whether limits.collision_timeout_s elapsed before the vehicle passed the goal


class PlanTaken(Record, frozen=True, gc=False):
    """Acceptance or rejection of a `PlanAnswer`."""

    topic: ClassVar[str] = "/event/plan"
    t_us: int
    number: int  # request number
    taken: bool  # whether the trajectory is accepted
    reason: str = ""  # reason for the rejection


class ProbeEnd(Record, frozen=True, gc=False):
    """A probe that ended without contact, or a leg that was skipped because of a probe's result."""

    topic: ClassVar[str] = "/event/probe"
    t_us: int
    what: str  # description of the probe or the leg


class FrameAnchor(Record, frozen=True, gc=False):
    """Correction of the mission frame along a wall's normal, from a contact (docs/anchors.md)."""

    topic: ClassVar[str] = "/event/anchor"
    t_us: int
    wall: str
    moved_mission: Vec2  # displacement of the frame's origin, in the frame's previous axes
    expected_sd_m: float  # standard deviation of the frame along the normal before the correction
    sd_m: float  # standard deviation of the frame along the normal after the correction
    age_s: float | None  # age of the previous anchor along this normal, or None if there was none
    normal: Vec2  # normal of the wall as assumed before the contact
    felt_us: int  # time of the contact
    start_us: int  # time at which the frame was first set


class MissionEnd(Record, frozen=True, gc=False):
    """End of the flight, as decided by the core."""

    topic: ClassVar[str] = "/event/end"
    t_us: int
    outcome: Outcome
    reason: str | None
    final_error_m: float | None


Output = (
    Setpoint
    | VehicleCommand
    | LockCommand
    | LockPermission
    | PlanRequest
    | ContactRequest
    | Silence
    | ForceEstimate
    | TorqueEstimate
    | ImpactOnset
    | ImpactPeak
    | ContactEnd
    | DetectionFloor
    | ImpactBody
    | WallEstimate
    | PhaseChange
    | PosesWithheld
    | GuardEvent
    | GoalPassed
    | PlanTaken
    | ProbeEnd
    | FrameAnchor
    | MissionEnd
)


# --- records of the shells: truth and timing ---------------------------------------------------------


class TruthSample(Record, frozen=True, gc=False):
    """True state of the simulated vehicle, mission frame."""

    topic: ClassVar[str] = "/truth/state"
    frequent: ClassVar[bool] = True
    t_us: int
    position_mission: Vec3
    velocity_mission: Vec3
    contact_force_mission: Vec3
    q_frd_to_ned: Quaternion
    mode: Mode
    contact_torque_frd: Vec3 = (0.0, 0.0, 0.0)  # torque of the walls about the centre of mass, N m


class ComputerSample(Record, frozen=True, gc=False):
    """State of the onboard computer, once a second; values that the kernel does not report are None."""

    topic: ClassVar[str] = "/computer"
    t_us: int  # host's monotonic clock
    temperature_c: float | None = None  # temperature of the hottest zone
    undervoltage: bool | None = None  # whether the supply voltage is too low
    throttled: bool | None = None  # whether the clock frequency is reduced
    was_undervoltage: bool | None = None  # whether the voltage was too low since power-on
    was_throttled: bool | None = None  # whether the clock frequency was reduced since power-on


class TruthContact(Record, frozen=True, gc=False):
    """One simulated contact, start to end."""

    topic: ClassVar[str] = "/truth/contact"
    t_us: int  # time of the first force
    end_us: int
    wall: str
    mode: Mode
    normal_in_m_s: float
    tangential_in_m_s: float
    normal_out_m_s: float
    tangential_out_m_s: float
    peak_normal_force_n: float
    peak_friction_force_n: float
    position_mission: Vec3
    incidence_rad: float = 0.0  # angle from the wall to the leading edge at first touch; positive: left
    tilt_rad: float = 0.0  # tilt at first touch
    rate_out_frd: Vec3 = (0.0, 0.0, 0.0)  # body rate at the end of the contact, rad/s
    lead_m: float = 0.0  # lead of the right guard over the left one at first touch, towards the wall
    peak_torque_nm: float = 0.0  # largest torque of the wall about the centre of mass


class SetpointSent(Record, frozen=True, gc=False):
    """Transmission of a recovery setpoint."""

    topic: ClassVar[str] = "/shell/setpoint_sent"
    t_us: int  # time of the setpoint
    sent_us: int  # host time
    latency_us: int  # time since receipt of the triggering sample


class LogFailure(Record, frozen=True, gc=False):
    """Loss of records in the flight's log; shown to the operator, and logged if the log continues."""

    topic: ClassVar[str] = "/shell/log_failure"
    t_us: int
    reason: str


Note = TruthSample | TruthContact | ComputerSample | SetpointSent | LogFailure
