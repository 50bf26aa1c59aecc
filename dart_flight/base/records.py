"""The immutable records that flow through the flight core.

SI units. `t_us` is the autopilot's time in integer microseconds, `received_us` the host's monotonic time
at receipt. What the core takes in is an `Input`, what it gives out is an `Output`: a command that a shell
carries out, or a record of what was estimated or decided, which is only logged.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar, Final

import msgspec

from dart_flight.base.geometry import Quaternion, Vec2, Vec3
from dart_flight.base.walls import Wall

MIN_LEAD_M: Final = 0.002  # a smaller lead is none: both points at once

# Pulse widths of the motor outputs at the commands 0 and 1: PX4's PWM_<bank>_MIN and _MAX as it ships.
MOTOR_STOP_US, MOTOR_FULL_US = 1000.0, 2000.0


class Mode(StrEnum):
    """State of the arms: Γ = 1 rigid (locked), Γ = 2 flexible (unlocked)."""

    RIGID = "rigid"
    FLEXIBLE = "flexible"

    @property
    def other(self) -> Mode:
        """The opposite mode."""
        return Mode.FLEXIBLE if self is Mode.RIGID else Mode.RIGID


class FlightMode(StrEnum):
    """PX4's flight modes as far as the core tells them apart."""

    UNKNOWN = "unknown"
    READY = "ready"
    TAKEOFF = "takeoff"
    HOLD = "hold"
    MISSION = "mission"
    RETURN = "return"
    LAND = "land"
    OFFBOARD = "offboard"
    MANUAL = "manual"  # any mode that a pilot's sticks fly: manual, stabilized, altitude, position, acro


class LandedState(StrEnum):
    """PX4's land detector."""

    UNKNOWN = "unknown"
    ON_GROUND = "on_ground"
    IN_AIR = "in_air"
    TAKING_OFF = "taking_off"
    LANDING = "landing"


class SystemStatus(StrEnum):
    """MAV_STATE of the autopilot's heartbeat; PX4 reports critical during a failsafe."""

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
    """Where a flight takes place (docs/architecture.md)."""

    DRONE = "drone"
    PX4 = "px4"  # a real PX4 on our plant
    HITL = "hitl"  # a flight controller in hardware in the loop, on our plant
    EMBEDDED = "embedded"  # our small autopilot, through MAVSDK
    FAST = "fast"  # in process, simulated time


class Outcome(StrEnum):
    """How a flight ended."""

    COMPLETED = "completed"
    ABORTED = "aborted"
    RELEASED = "released"  # a person took over


class AfterImpact(StrEnum):
    """What follows an impact."""

    SETPOINT = "setpoint"  # the paper's recovery setpoint
    REPLAN = "replan"  # the same, until a trajectory planned from what was felt begins


class Request(StrEnum):
    """What an operator, or the shell itself, asks of a flight under way."""

    LAND = "land"  # leave the wall, land
    CONTINUE = "continue"  # the pause is over
    RELEASE = "release"
    WORLD_DIED = "world_died"  # by the shell: simulated vehicle terminated


class ModeMismatch(StrEnum):
    """What follows where a contact indicates the other mode than the lock reports."""

    NOTE_ONLY = "go_on"  # noted in log and verdict
    LAND = "land"


class Phase(StrEnum):
    """Where the mission stands; `core/mission/phases.py` says what follows what."""

    READYING = "readying"  # waiting for telemetry, lock in the transit mode
    OFFBOARD = "offboard"  # asking PX4 for offboard mode
    ARMING = "arming"
    CLIMB = "climb"
    WAYPOINT = "waypoint"  # to a waypoint, and holding there
    PAUSE = "pause"  # holding until the operator's word
    TRANSIT = "transit"  # to the run-up point, turning parallel to the wall
    PREPARE = "prepare"  # lock to the collision's mode
    APPROACH = "approach"
    CONTACT = "contact"  # from onset to the peak of the normal force
    RECOVERY = "recovery"
    GOAL = "goal"  # holding the goal
    LANDING = "landing"
    DONE = "done"
    OVERRULED = "overruled"  # the guard flies: break off, hold, land, or silence


class Override(StrEnum):
    """What an override of the guard does; a later one in this list replaces an earlier one."""

    NONE = "none"
    GIVE_UP = "give_up"  # on the ground: the mission ends before it has begun
    BREAK_OFF = "break_off"  # away from the wall, hold, land
    HOLD = "hold"  # stop here, then land
    LAND = "land"
    KILL = "kill"  # motors off, whatever PX4 believes
    RELEASE = "release"  # silence: the pilot or PX4 flies

    @property
    def rank(self) -> int:
        """Position in the order of replacement."""
        return _RANKS[self]


_RANKS = {override: rank for rank, override in enumerate(Override)}


class Record(msgspec.Struct, frozen=True, gc=False):
    """Base of everything that flows and is logged.

    Attributes:
        topic: names its channel in the log.
        frequent: it comes many times a second and decides nothing: what goes first where room is short.
    """

    topic: ClassVar[str] = ""
    frequent: ClassVar[bool] = False


# --- inputs: telemetry -----------------------------------------------------------------------------


class ImuSample(Record, frozen=True, gc=False):
    """HIGHRES_IMU: specific force (bias-corrected, gravity not in it) and body rate, FRD."""

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
    """ODOMETRY: PX4's position (m) and velocity (m/s) estimate in local NED."""

    topic: ClassVar[str] = "/in/odometry"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    position_ned: Vec3
    velocity_ned: Vec3


class ActuatorSample(Record, frozen=True, gc=False):
    """ACTUATOR_OUTPUT_STATUS: what PX4 sends to the motors, 0 (stopped) to 1."""

    topic: ClassVar[str] = "/in/actuator"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    motors: tuple[float, ...]  # in PX4's order
    stamp_is_estimated: bool = True  # the stream has no stamp: mapped host time


class EscSample(Record, frozen=True, gc=False):
    """ESC_STATUS: measured speed of the motors, revolutions per minute."""

    topic: ClassVar[str] = "/in/esc"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    rpm: tuple[float, ...]  # revolutions per minute, in PX4's order


class StatusSample(Record, frozen=True, gc=False):
    """Slow state of the autopilot, one record for every change of any part of it."""

    topic: ClassVar[str] = "/in/status"
    t_us: int
    received_us: int
    armed: bool = False
    flight_mode: FlightMode = FlightMode.UNKNOWN
    landed: LandedState = LandedState.UNKNOWN
    local_position_ok: bool = False  # a position has come, and ESTIMATOR_STATUS, where sent, has one
    battery_v: float | None = None
    battery_remaining: float | None = None  # 0 to 1
    system_status: SystemStatus = SystemStatus.UNKNOWN  # MAV_STATE in the heartbeat
    battery_id: int | None = None  # id in BATTERY_STATUS of the judged battery


class EstimatorSample(Record, frozen=True, gc=False):
    """What PX4 says of its estimator: ODOMETRY's reset counter, ESTIMATOR_STATUS's flags; None: not said."""

    topic: ClassVar[str] = "/in/estimator"
    frequent: ClassVar[bool] = True
    t_us: int
    received_us: int
    reset_counter: int | None = None  # counts up to 255, then from 0
    healthy: bool | None = None  # attitude, horizontal velocity and a horizontal position are valid
    position_sd_m: float | None = None  # of the horizontal position, by PX4 itself


class StatusText(Record, frozen=True, gc=False):
    """STATUSTEXT of the autopilot, an event of PX4 in words, or what this program finds on the link."""

    topic: ClassVar[str] = "/in/statustext"
    t_us: int
    received_us: int
    severity: str  # emergency, alert, critical, error, warning, notice, info or debug
    text: str
    event: str = ""  # PX4's name of the event; empty for a STATUSTEXT
    found_here: bool = False  # by this program, not said by PX4


class HealthReport(Record, frozen=True, gc=False):
    """PX4's health and arming checks, one record for every change: what keeps it from arming or flying on."""

    topic: ClassVar[str] = "/in/health"
    t_us: int
    received_us: int
    can_arm: bool  # in the mode that it is in
    blocking: tuple[str, ...]  # in that mode, warnings and worse
    others: tuple[str, ...]  # what else is wrong, for other modes


class OtherVehicle(Record, frozen=True, gc=False):
    """Another autopilot on the same link, by its system id; what it sends is told apart."""

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
    tracked: bool  # whether the source reports the body as tracked; the pose is meaningless if not
    position_room: Vec3  # m, in the axes of the room
    q_body_to_room: Quaternion
    frame_number: int | None = None  # counter of the source, or None if it has none
    source_us: int | None = None  # the source's own stamp, on its clock
    sender: str = ""  # address of the source, to detect a second one


# --- inputs: lock, results, operator, time -----------------------------------------------------------


class LockPhase(StrEnum):
    """What the lock's state machine knows; `settled` means travel time is over, not that a sensor saw it."""

    UNKNOWN = "unknown"
    TRAVELLING = "travelling"
    SETTLED = "settled"
    FAULT = "fault"


class LockState(Record, frozen=True, gc=False):
    """State of the locking mechanism on the core's time base."""

    topic: ClassVar[str] = "/in/lock"
    t_us: int
    phase: LockPhase
    mode: Mode | None  # commanded while travelling, reached when settled
    commanded_us: int | None = None
    settled_us: int | None = None
    feedback: bool = False  # confirmed by a switch; otherwise "settled (no feedback)"
    reason: str | None = None


class CommandResult(Record, frozen=True, gc=False):
    """How a vehicle command ended, by telemetry and not by its acknowledgement."""

    topic: ClassVar[str] = "/in/result"
    t_us: int
    command: str
    ok: bool
    detail: str = ""


class OperatorRequest(Record, frozen=True, gc=False):
    """What the person at the keyboard asked for; `detail` says what of the simulated vehicle has died."""

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
    """The vehicle has answered a request: how long that takes bounds how late telemetry comes."""

    topic: ClassVar[str] = "/in/round_trip"
    received_us: int  # the answer
    sent_us: int  # the request, host's monotonic time
    autopilot_us: int | None  # autopilot's time as it answered; none: not told, or its clock goes at any pace


class PlanAnswer(Record, frozen=True, gc=False):
    """What the planner makes of a `PlanRequest`: a trajectory from a coming moment on, and what it leads to.

    It is x and y as polynomials of fifth order in the seconds since `begin_us`, constant term first,
    then straight on at the velocity of its end.
    """

    topic: ClassVar[str] = "/in/plan"
    received_us: int
    number: int  # of the request
    begin_us: int  # autopilot's time at which the trajectory begins
    duration_s: float = 0.0  # of the polynomials
    x_mission: tuple[float, ...] = ()  # coefficients, m, m/s, ...; six for each polynomial
    y_mission: tuple[float, ...] = ()  # coefficients, m, m/s, ...; six for each polynomial
    collision: int | None = None  # 1-based index of the collision that it leads to; none: to the goal
    impact_s: float | None = None  # from its beginning to the wall's plane
    normal_m_s: float | None = None  # velocity there, collision frame
    tangential_m_s: float | None = None  # velocity there, collision frame
    peak_force_n: float | None = None  # of the normal force, by the coefficients felt so far
    pieces_s: tuple[float, ...] = ()  # duration of each polynomial, where there are several
    problem: str = ""  # why there is no way


class ContactAnswer(Record, frozen=True, gc=False):
    """What a contact says, by the fit of a `ContactRequest`; the core hands the records on."""

    topic: ClassVar[str] = "/in/contact"
    received_us: int
    number: int  # of the request
    body: ImpactBody | None = None  # how it met the body; none: nothing is known
    wall: WallEstimate | None = None  # of its wall; none: the contact was not planned
    problem: str = ""  # why nothing is known


class Tick(Record, frozen=True, gc=False):
    """Host time goes by, at least every 20 ms, so that silence can be judged."""

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
    """Offboard setpoint in local NED; velocity and acceleration are feed-forward where present."""

    topic: ClassVar[str] = "/out/setpoint"
    frequent: ClassVar[bool] = True
    t_us: int
    trigger_received_us: int  # receipt of the sample that led to it
    position_ned: Vec3
    yaw_ned_rad: float
    velocity_ned: Vec3 | None = None
    acceleration_ned: Vec3 | None = None
    recovery: bool = False  # the setpoint of an impact: its latency is measured


class VehicleAction(StrEnum):
    """What the core asks of the autopilot beside setpoints."""

    OFFBOARD = "offboard"
    ARM = "arm"
    LAND = "land"
    DISARM = "disarm"
    KILL = "kill"  # disarms whether or not PX4 believes itself on the ground


class VehicleCommand(Record, frozen=True, gc=False):
    """An action for the autopilot; its result comes back as a `CommandResult`."""

    topic: ClassVar[str] = "/out/command"
    t_us: int
    action: VehicleAction


class LockCommand(Record, frozen=True, gc=False):
    """Move the lock; given only when the core knows that locking is permitted."""

    topic: ClassVar[str] = "/out/lock"
    t_us: int
    mode: Mode


class LockPermission(Record, frozen=True, gc=False):
    """Whether the arms are clear of contact and have sprung back, for the lock's state machine."""

    topic: ClassVar[str] = "/out/lock_permission"
    t_us: int
    permitted: bool


class PlanRequest(Record, frozen=True, gc=False):
    """Plan the rest of the mission anew, after a contact; the answer is a `PlanAnswer` of the same number."""

    topic: ClassVar[str] = "/out/plan_request"
    t_us: int  # of the state below
    number: int  # counts up
    begin_us: int  # when the trajectory is to begin; an answer that comes later is not taken
    collision: int | None  # 1-based index of the next one; none: the goal is next
    position_mission: Vec3
    velocity_mission: Vec3
    acceleration_mission: Vec3  # of thrust and drag
    setpoint_mission: Vec3  # m; in force until then
    lock_ready_us: int | None  # when the lock can be settled and the vehicle square to the wall; none: never
    under_way: bool = False  # along a trajectory, not towards a setpoint
    contact_height_m: float | None = None  # of the walls' force above the centre of mass; none: not known
    coasts: bool = False  # no setpoint leads anywhere: the vehicle keeps its speed and thrust until then


class ContactRequest(Record, frozen=True, gc=False):
    """Fit a contact that is over; the answer is a `ContactAnswer` of the same number (docs/felt.md).

    Its IMU samples are columns, from a few before the first touch on.
    """

    topic: ClassVar[str] = "/out/contact_request"
    t_us: int  # of the newest sample
    number: int  # counts up
    onset: ImpactOnset
    wall: Wall | None  # that was expected; none: the contact was not planned
    normal: Vec2  # of that wall, otherwise along the force
    mode_reported: Mode | None  # what the lock reported at the onset; none: it was not settled
    frame_heading_rad: float  # of the mission's x axis, clockwise from north
    slow_force: Vec2  # horizontal force that is there all the time, mission frame, N
    noise_n: float  # white part of one force component's error, standard deviation
    noise_frd_nm: Vec3  # likewise, of the torque
    sample_us: tuple[int, ...] = ()
    force_mission: tuple[Vec3, ...] = ()
    push_mission: tuple[Vec2, ...] = ()  # N, of thrust and drag
    clipped: tuple[bool, ...] = ()  # at full scale
    torque_frd: tuple[Vec3, ...] = ()
    q_frd_to_ned: tuple[Quaternion, ...] = ()
    rate_frd: tuple[Vec3, ...] = ()  # mean over a sample's tick


class Silence(Record, frozen=True, gc=False):
    """Send nothing more: the pilot has the vehicle."""

    topic: ClassVar[str] = "/out/silence"
    t_us: int
    reason: str


# --- outputs: estimates and decisions --------------------------------------------------------------


class ForceEstimate(Record, frozen=True, gc=False):
    """External force on the vehicle at an IMU sample, mission frame, newton (docs/force.md).

    A sample stands for the mean over the IMU's tick that ends at `t_us`. Clipped samples are lower bounds.
    """

    topic: ClassVar[str] = "/estimate/force"
    frequent: ClassVar[bool] = True
    t_us: int
    force_mission: Vec3
    clipped: bool
    filtered_mission: Vec3 = (0.0, 0.0, 0.0)  # first-order low-pass of the force
    variance_n2: Vec3 = (0.0, 0.0, 0.0)  # N2, of each component's error, mission frame
    noise_n: float = 0.0  # white part of one component's error, standard deviation
    push_mission: Vec2 = (0.0, 0.0)  # horizontal force of thrust and drag, N: what leans on a wall


class TorqueEstimate(Record, frozen=True, gc=False):
    """External torque about the centre of mass at an IMU sample, body FRD (docs/torque.md).

    What turns the vehicle beside its motors: inertia times the change of the gyro's rate over the tick, the
    gyroscopic term, less the torque of the motors. A sample stands for the mean over the tick that ends at
    `t_us`.
    """

    topic: ClassVar[str] = "/estimate/torque"
    frequent: ClassVar[bool] = True
    t_us: int
    torque_frd: Vec3
    noise_frd_nm: Vec3 = (0.0, 0.0, 0.0)  # white part of each component's error, standard deviation


class ImpactOnset(Record, frozen=True, gc=False):
    """The horizontal force crossed the threshold."""

    topic: ClassVar[str] = "/event/onset"
    t_us: int  # sample that crossed
    first_us: int  # first sample in contact, by the force rising out of the noise before it
    received_us: int
    force_mission: Vec3
    velocity_mission: Vec3  # last before contact
    position_mission: Vec3
    planned: bool = False  # a wall was expected and the force points out of it


class ImpactPeak(Record, frozen=True, gc=False):
    """The peaks of an impact, each component its own, as the recovery uses them."""

    topic: ClassVar[str] = "/event/peak"
    t_us: int  # moment of the normal peak, t_c
    detected_us: int  # sample at which the peak was known
    received_us: int
    normal: Vec2  # wall normal used, mission frame
    normal_force_n: float
    tangential_force_n: float  # signed, along the wall's tangent
    position_mission: Vec3  # p(t_c)
    clipped: bool
    normal_sigma_n: float = 0.0  # standard error of the normal force
    fitted: bool = False  # from the contact model's pulse; otherwise from a parabola through the top


class ContactEnd(Record, frozen=True, gc=False):
    """The force has gone back below the release level."""

    topic: ClassVar[str] = "/event/contact_end"
    t_us: int
    first_us: int


class ContactSide(StrEnum):
    """Which of the two points of a side met the wall first, as seen when flying into it."""

    LEFT = "left"
    RIGHT = "right"
    BOTH = "both"

    @classmethod
    def of_lead(cls, lead_m: float) -> ContactSide:
        """Return which point came first, by how much nearer to the wall the right one was."""
        if abs(lead_m) < MIN_LEAD_M:
            return cls.BOTH
        return cls.RIGHT if lead_m > 0.0 else cls.LEFT


class ImpactBody(Record, frozen=True, gc=False):
    """How an impact met the vehicle's body, after its end (docs/torque.md)."""

    topic: ClassVar[str] = "/event/impact_body"
    t_us: int  # newest sample that it rests on
    first_us: int  # of the impact's onset
    final: bool  # always; older logs have another one after the peak
    side: ContactSide
    lead_m: float  # how much nearer to the wall the right point was than the left one at the first touch
    incidence_rad: float  # leading edge against the wall at the first touch, signed: positive turned left
    incidence_sigma_rad: float
    torque_peak_frd: Vec3  # largest external torque so far
    peak_torque_nm: float  # its magnitude


class WallEstimate(Record, frozen=True, gc=False):
    """What a planned contact says of its wall and of the arms, at its end (docs/felt.md).

    Coefficients are posterior means of the wall in the mode felt; in the reported one where undecided.
    """

    topic: ClassVar[str] = "/estimate/wall"
    t_us: int  # newest sample that it rests on
    first_us: int  # of the impact's onset
    wall: str  # its name
    mode_reported: Mode | None  # what the lock said at the onset; none: it was not settled
    mode_felt: Mode | None  # none: undecided
    log_odds: float  # of rigid against flexible, natural logarithm, prior odds 1
    k_n_per_m: float  # stiffness
    f_ns_per_m: float  # damping
    mu_s_per_m: float  # friction
    nu_n: float  # bound of the vertical force
    k_sd: float  # relative standard deviation
    f_sd: float  # relative standard deviation
    mu_sd: float  # relative standard deviation
    nu_sd: float  # relative standard deviation
    incidence_rad: float  # leading edge against the wall at the first touch, signed: positive turned left
    incidence_sigma_rad: float
    plane_offset_m: float  # where the wall's plane stands along its normal, less where the mission has it
    plane_offset_sigma_m: float
    # Its plane as it was felt, where the vehicle's centre is at first touch; none: too few readings.
    plane_point_mission: Vec2 | None = None  # where it was met
    plane_normal_mission: Vec2 | None = None
    plane_normal_sigma_rad: float | None = None
    centre_mission: Vec2 | None = None  # of the vehicle at the first touch
    material: str | None = None  # of a wall of unknown material: the one of the table that fits best
    problem: str = ""  # why the contact says nothing: the wall is as before


class DetectionFloor(Record, frozen=True, gc=False):
    """What can be felt at the start of an approach, by the noise learnt so far, newton (docs/force.md)."""

    topic: ClassVar[str] = "/estimate/detection"
    t_us: int
    threshold_n: float  # the lowest that is in force
    noise_short_n: float  # deviation of a component of the short mean
    noise_long_n: float  # ... of the long mean
    rigid_n: float  # peak from which on a rigid contact with this wall is found for certain
    flexible_n: float | None = None  # ... a flexible contact; none: the vehicle has no lock


class PhaseChange(Record, frozen=True, gc=False):
    """The mission executive went from one phase to the next."""

    topic: ClassVar[str] = "/event/phase"
    t_us: int
    before: Phase
    after: Phase
    reason: str
    collision: int | None = None  # 1-based index of the collision it concerns


class GuardEvent(Record, frozen=True, gc=False):
    """A rule of the guard fired."""

    topic: ClassVar[str] = "/event/guard"
    t_us: int
    rule: str
    action: Override
    detail: str


class GoalPassed(Record, frozen=True, gc=False):
    """The closest approach to the goal after the last contact; from here on the goal is held."""

    topic: ClassVar[str] = "/event/goal"
    t_us: int
    miss_m: float
    timed_out: bool = False  # it was not passed: limits.collision_timeout_s was over


class PlanTaken(Record, frozen=True, gc=False):
    """What became of a `PlanAnswer`: flown, or not, and why not."""

    topic: ClassVar[str] = "/event/plan"
    t_us: int
    number: int  # of the request
    taken: bool
    reason: str = ""  # why it is not flown


class ProbeEnd(Record, frozen=True, gc=False):
    """A probe is over that has met nothing, or a leg is left out that depends on one."""

    topic: ClassVar[str] = "/event/probe"
    t_us: int
    what: str  # in words


class FrameAnchor(Record, frozen=True, gc=False):
    """A contact has put the mission frame right along its wall's normal (docs/anchors.md)."""

    topic: ClassVar[str] = "/event/anchor"
    t_us: int
    wall: str
    moved_mission: Vec2  # the frame's origin, in its axes before
    expected_sd_m: float  # of the frame along the normal, before
    sd_m: float  # ... after
    age_s: float | None  # of the anchor before, along this normal; none: there was none
    normal: Vec2  # of the wall as it was known before the contact
    felt_us: int  # the contact
    start_us: int  # when the frame was laid at the start


class MissionEnd(Record, frozen=True, gc=False):
    """The flight is over for the core."""

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
    | GuardEvent
    | GoalPassed
    | PlanTaken
    | ProbeEnd
    | FrameAnchor
    | MissionEnd
)


# --- records of the shells: truth and timing ---------------------------------------------------------


class TruthSample(Record, frozen=True, gc=False):
    """What the simulated vehicle really did, mission frame."""

    topic: ClassVar[str] = "/truth/state"
    frequent: ClassVar[bool] = True
    t_us: int
    position_mission: Vec3
    velocity_mission: Vec3
    contact_force_mission: Vec3
    q_frd_to_ned: Quaternion
    mode: Mode
    contact_torque_frd: Vec3 = (0.0, 0.0, 0.0)  # of walls, about the centre of mass, N m


class ComputerSample(Record, frozen=True, gc=False):
    """How the computer is, once a second; None: its kernel does not tell (a Raspberry Pi's does)."""

    topic: ClassVar[str] = "/computer"
    t_us: int  # host's monotonic clock
    temperature_c: float | None = None  # of the hottest zone
    undervoltage: bool | None = None
    throttled: bool | None = None  # its clock is held back
    was_undervoltage: bool | None = None  # since it was switched on
    was_throttled: bool | None = None


class TruthContact(Record, frozen=True, gc=False):
    """One simulated contact, start to end."""

    topic: ClassVar[str] = "/truth/contact"
    t_us: int  # first force
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
    incidence_rad: float = 0.0  # leading edge against the wall at first touch, signed: positive turned left
    tilt_rad: float = 0.0  # at first touch
    rate_out_frd: Vec3 = (0.0, 0.0, 0.0)  # body rate at the end, rad/s
    lead_m: float = 0.0  # how much nearer the right guard was than the left one at first touch
    peak_torque_nm: float = 0.0  # largest torque of the wall about the centre of mass


class SetpointSent(Record, frozen=True, gc=False):
    """A recovery setpoint left the program."""

    topic: ClassVar[str] = "/shell/setpoint_sent"
    t_us: int  # of the setpoint
    sent_us: int  # host
    latency_us: int  # since receipt of the sample that triggered it


class LogFailure(Record, frozen=True, gc=False):
    """The flight's log lacks records: shown, and in the log itself where that goes on."""

    topic: ClassVar[str] = "/shell/log_failure"
    t_us: int
    reason: str


Note = TruthSample | TruthContact | ComputerSample | SetpointSent | LogFailure
