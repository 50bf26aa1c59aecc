"""The mission executive: walks through the phases and proposes what the vehicle should do.

It proposes; the guard disposes. State and impacts come in, a `Proposal` comes out; nothing else is touched.
It changes phase only through the table in `phases`. `rehearsal` is the same walk without contacts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, Final

from dart_flight.base.geometry import Vec3, distance2, rotate, wrap_angle, yaw_ned_of
from dart_flight.base.records import (
    AfterImpact,
    DetectionFloor,
    GoalPassed,
    ImpactOnset,
    ImpactPeak,
    Input,
    MissionEnd,
    Mode,
    ModeMismatch,
    OdometrySample,
    OperatorRequest,
    Outcome,
    Output,
    Phase,
    PhaseChange,
    PlanAnswer,
    ProbeEnd,
    Request,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.base.walls import Wall
from dart_flight.config.mission import ESTIMATE_MOVED_M, Collision, Mission, Waypoint
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.approach import (
    Approach,
    NoApproachError,
    PlannedApproach,
    check_segments_clear,
    plan_approach,
)
from dart_flight.core.mission.commitment import STOP_MARGIN_M, may_commit
from dart_flight.core.mission.contact_feedforward import LONGEST_S, ContactFeedforward, balancing_m_s2
from dart_flight.core.mission.heading import HeadingControl
from dart_flight.core.mission.legs import collision_now, mission_now, waypoint_now, why_left_out
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.phases import (
    AT_WALL,
    BETWEEN,
    DOWN_US,
    TO_IMPACT,
    TRANSITIONS,
    WATCHING,
    PhaseTrigger,
)
from dart_flight.core.mission.planned_impact import expected_hit
from dart_flight.core.mission.position_loop import least_distance_m, meets_plane
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.mission.replan_requests import ReplanRequests
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.mission.trajectories import PlannedTrajectory, TrajectoryPoint
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls, early_m, late_s, overrun_m
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

PASSED_RISE_M: Final = 0.03  # the distance to the goal has risen by more than its noise
PASSED_AFTER_S: Final = 0.25  # the first moments after a contact do not yet show where it leads
_RETRY_US: Final = 1_000_000  # telemetry of mode and arming lags by up to a second
_SLOWEST: Final = 3.0  # host's time over vehicle's
_STREAMING_US: Final = 200_000  # PX4 accepts offboard only with setpoints already streaming
_COASTING_S: Final = 0.25  # before an impact: so long does the attitude take to come to what is asked
_TRAJECTORY_WAIT_S: Final = 1.5  # after a contact: by then a planner that lives has answered, even twice
_NEAR_S: Final = 0.3  # before an impact
_NOTHING_MET_S: Final = 0.3  # after the end of a probe: PX4 follows its setpoints a little late
_RUN_UP_US: Final = 5_000_000  # about so long from the transit's beginning to the impact
_REST_TIMEOUT_US: Final = 4_000_000
_REST_AFTER_US: Final = 500_000
_BOUNCES_US: Final = 1_000_000  # for so long after a hit its wall may be touched again, as PX4 leans on it
_LEFT_SHARE: Final = 0.5  # of how far it is to go back after a probe, at most, for the next leg to begin
_DISARM_AFTER_US: Final = 8_000_000
# The wall stops the vehicle in a contact (but for `yielding`), PX4 lands it.
_SILENT: Final = frozenset({Phase.READYING, Phase.CONTACT, Phase.LANDING, Phase.DONE, Phase.OVERRULED})
_SQUARE_RAD: Final = 0.09  # off in heading at a hit: a hit at 3 m/s turns the vehicle little from there
_COASTS_US: Final = 500_000  # after a contact, until when an answer is there, even to a second request
_TURNED: Final = frozenset({Phase.CONTACT, Phase.RECOVERY, Phase.GOAL})
_WORDS: Final = frozenset({PlanAnswer, OperatorRequest})
_ANY_WALL: Final = ExpectedContact(watching=True)
_NO_WALL: Final = ExpectedContact()


class Executive:
    """Phases of one mission.

    Raises:
        NoApproachError: an approach of the mission has no room (`approach`).
    """

    # Phases in which a reference leads to the target, from the phase's beginning on.
    _underway: ClassVar = frozenset({Phase.CLIMB, Phase.WAYPOINT, Phase.TRANSIT, Phase.APPROACH, Phase.GOAL})

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self.phase = Phase.READYING
        self._collisions = list(mission.collisions)  # at a wall that was sought, once that is met, with it
        self._index = 0  # of the collision that comes next or is under way
        self._stops = 0  # waypoints and pauses that are over
        self._approaches: dict[int, Approach | PlannedApproach] = {
            c.index: plan_approach(mission, c) for c in mission.collisions if c.approach_m_s is not None
        }
        check_segments_clear(mission)
        drift_m_s = mission.vehicle.estimation.position_drift_m_s
        self._anchors = FrameAnchors(drift_m_s) if mission.is_anchored else None
        self._survey = EstimatedWalls(self._anchors)
        self._references = SetpointGenerator(mission)
        self._lock = LockOrders(mission.vehicle.lock)
        self._replanning = ReplanRequests(mission)
        self._yielding = ContactFeedforward(mission.vehicle)
        # Of missions along trajectories: between their hits there is no time to come to rest.
        self._heading = None if mission.goal_trajectory is None else HeadingControl(mission.vehicle)
        # After a contact; by the collision that they lead to, None: to the goal.
        self._written = {
            index: PlannedTrajectory.from_pieces(pieces, mission.altitude_m)
            for index, pieces in (
                *((c.index, c.trajectory) for c in mission.collisions if c.approach_m_s is None),
                (None, mission.goal_trajectory),
            )
            if pieces is not None and mission.after_impact is AfterImpact.REPLAN
        }
        self._square_yaw = 0.0  # heading wanted before the first contact
        self._height_m: float | None = None  # of the walls' force above the centre of mass
        self._stood_at_ned: Vec3 = (0.0, 0.0, 0.0)
        self._entered_us: int | None = None
        self._entered_host_us: int | None = None
        self._asked_us: int | None = None  # last time a vehicle command was sent
        self._expected = _NO_WALL
        self._impact_s = 0.0  # of the approach under way, since its beginning
        self._least_miss_m = math.inf
        self._reached_us: int | None = None  # the waypoint under way
        self._captured_us: int | None = None
        self._final_error_m: float | None = None
        self._down_us: int | None = None  # since when landed and disarmed
        self._steps: dict[Phase, Callable[[FlightState, Sensed, Proposal], None]] = {
            Phase.READYING: self._readying,
            Phase.OFFBOARD: self._offboard,
            Phase.ARMING: self._arming,
            Phase.CLIMB: self._climb,
            Phase.WAYPOINT: self._fly_to_waypoint,
            Phase.PAUSE: self._pause,
            Phase.TRANSIT: self._transit,
            Phase.PREPARE: self._prepare,
            Phase.APPROACH: self._approach,
            Phase.CONTACT: self._contact,
            Phase.RECOVERY: self._recovery,
            Phase.GOAL: self._goal,
            Phase.LANDING: self._landing,
        }

    @property
    def _collision(self) -> Collision | None:
        """The collision that comes next or is under way."""
        collisions = self._collisions
        return collisions[self._index] if self._index < len(collisions) else None

    @property
    def _waypoint(self) -> Waypoint | None:
        """The waypoint or pause that comes next or is under way, before the next collision."""
        waypoints = self.mission.waypoints
        if self._stops < len(waypoints) and waypoints[self._stops].after == self._index:
            return waypoints[self._stops]
        return None

    # -- stepping --

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Fill a proposal, after an input that has gone into `state` and taught `sensed`."""
        if self._entered_us is None:
            if not state.now_us:
                return
            self._entered_us = state.now_us
        if self._entered_host_us is None:
            self._entered_host_us = state.host_us
        if sensed.estimate is not None:
            self._yielding.update(sensed)
            self._height_m = sensed.height_m
        if type(item) in _WORDS:
            self._take_word(item, state, p)
        for event in sensed.impacts:
            if isinstance(event, ImpactOnset):
                self._on_onset(event, state, p)
            elif isinstance(event, ImpactPeak):
                self._on_peak(event, state, p)
            elif isinstance(event, DetectionFloor):
                self._on_detection_floor(event, p)
            else:
                self._lock.contact_ends(event.t_us)
        if sensed.wall is not None:
            self._on_wall_estimate(sensed.wall, state, p)
        permission = self._lock.permission(state.now_us, sensed.in_contact)
        if permission is not None:
            p.outputs.append(permission)
        step = self._steps.get(self.phase)
        if step is not None and not (p.frame is not None and self._anchors is not None and sensed.wall):
            step(state, sensed, p)  # what has just moved the frame has not moved the state yet
        p.expected = self._expect(state)
        p.altitude_m = self._references.altitude_m
        if isinstance(item, OdometrySample):
            self._send_setpoint(item, state, p)

    def _take_word(self, item: Input, state: FlightState, p: Proposal) -> None:
        """What planner or operator say."""
        if isinstance(item, PlanAnswer):
            self._replanning.take(item, state.now_us, p)
        elif isinstance(item, OperatorRequest) and item.request is Request.CONTINUE:
            self._on_operator_continue(state, p)

    def overruled(self, now_us: int, reason: str) -> list[Output]:
        """The guard has taken over; returns the change of phase, once."""
        if self.phase in (Phase.DONE, Phase.OVERRULED):
            return []
        return [self._change(PhaseTrigger.OVERRULE, now_us, reason)]

    def ended(self, end: MissionEnd) -> list[Output]:
        """The guard has ended the flight, in the air or before it began; returns the last records."""
        if self.phase is Phase.OVERRULED:
            return [self._change(PhaseTrigger.LANDED, end.t_us, end.outcome.value), end]
        if self.phase is Phase.DONE:
            return [end]
        return [self._change(PhaseTrigger.GIVEN_UP, end.t_us, (end.reason or "").partition(": ")[2]), end]

    def _go(self, cue: PhaseTrigger, state: FlightState, p: Proposal, reason: str = "") -> None:
        p.outputs.append(self._change(cue, state.now_us, reason or cue.value))

    def _change(self, cue: PhaseTrigger, now_us: int, reason: str) -> PhaseChange:
        before = self.phase
        self.phase = TRANSITIONS[before, cue]
        self._entered_us, self._entered_host_us, self._asked_us = now_us, None, None
        self._lock.phase_begins()
        self._references.phase_begins()
        collision = self._collision
        index = collision.index if collision and self.phase in WATCHING - BETWEEN else None
        return PhaseChange(now_us, before, self.phase, reason, index)

    def _elapsed_us(self, state: FlightState) -> int:
        assert self._entered_us is not None
        return state.now_us - self._entered_us

    def _takes_longer_than(self, limit_s: float, state: FlightState) -> bool:
        return self._elapsed_us(state) > limit_s * 1e6

    def _is_late(self, state: FlightState, travel_s: float = 0.0) -> bool:
        """Whether the phase lasts longer than anything should that is not a collision, and its way.

        Also where the autopilot's clock has jumped back and stands still for it: by the host's clock, with
        room for a simulation that is slower than time.
        """
        limit_s = self.mission.vehicle.flying.ready_timeout_s + travel_s
        host_us = state.host_us - (self._entered_host_us or state.host_us)
        return self._takes_longer_than(limit_s, state) or host_us > _SLOWEST * limit_s * 1e6

    def _expect(self, state: FlightState) -> ExpectedContact:
        collision = self._collision
        if (
            collision is None
            or not self._is_expected(collision)
            or self._is_at_wall_just_hit(state.position, state)
        ):
            return _ANY_WALL if self.phase in WATCHING else _NO_WALL
        wall, watching = collision.wall, self.phase in WATCHING
        if self._expected.wall is not wall or self._expected.watching is not watching:
            self._expected = ExpectedContact(watching, wall.normal, wall.material, wall)
        return self._expected

    def _is_expected(self, collision: Collision) -> bool:
        """Whether the plan has the vehicle meet this wall in this phase."""
        if self.phase is Phase.RECOVERY:
            return collision.approach_m_s is None
        return self.phase in AT_WALL

    def _is_due(self, collision: Collision) -> bool:
        """Whether an onset now is the plan's; a second one before the peak is not."""
        return self.phase is not Phase.CONTACT and self._is_expected(collision)

    def _ask(self, action: VehicleAction, state: FlightState, p: Proposal) -> None:
        """Send a vehicle command, again every second until telemetry confirms it."""
        if self._asked_us is None or state.now_us - self._asked_us >= _RETRY_US:
            self._asked_us = state.now_us
            p.outputs.append(VehicleCommand(state.now_us, action))

    def _lock_to(self, mode: Mode, state: FlightState, p: Proposal) -> bool:
        """Move the lock where it is not there yet and may move; True once it is settled in `mode`."""
        order = self._lock.command_mode(mode, state)
        if order is not None:
            p.outputs.append(order)
        return state.lock_is_in(mode)

    # -- on the ground --

    def _readying(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        locked = self._lock_to(self.mission.transit_mode, state, p)
        sd = state.position_sd_m or 0.0  # what is not told is not judged
        judged = self.mission.collisions and self._anchors is None
        limit = self.mission.vehicle.guard.position_sd_m if judged else math.inf
        sure = f"position to {limit:.2f} m (its standard deviation by PX4 is {sd:.2f} m)"
        there = {
            "imu": state.imu is not None,
            "attitude": state.attitude is not None,
            "odometry": state.odometry is not None,
            "local position": state.status.local_position_ok,
            sure: sd <= limit,
            _lock_name(self.mission): locked,
        }
        if all(there.values()):
            self._anchor_frame(state, p)
            self._go(PhaseTrigger.READY, state, p)
        elif self._is_late(state):
            missing = [name for name, yes in there.items() if not yes]
            # What keeps the lock is not PX4's to say, and of its uncertainty it says nothing more.
            why = "" if {*missing} <= {_lock_name(self.mission), sure} else state.reasons()
            p.add_finding("not_ready", "no " + ", no ".join(missing) + why)

    def _anchor_frame(self, state: FlightState, p: Proposal) -> None:
        """The vehicle stands at its take-off point."""
        assert state.odometry is not None
        assert state.attitude is not None
        self._stood_at_ned = state.odometry.position_ned
        p.frame = frame = self.mission.frame_at(self._stood_at_ned)
        position = frame.point_from_ned(self._stood_at_ned)
        yaw = frame.yaw_from_ned(yaw_ned_of(state.attitude.q_frd_to_ned))
        self._references.stand(position, yaw, state.now_us)

    def _offboard(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if state.in_offboard:
            self._go(PhaseTrigger.CONFIRMED, state, p)
            return
        if self._elapsed_us(state) > _STREAMING_US:
            self._ask(VehicleAction.OFFBOARD, state, p)
        if self._is_late(state):
            p.add_finding("offboard_refused", "PX4 refused offboard" + state.reasons("offboard"))

    def _arming(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if state.status.armed:
            assert state.odometry is not None
            moved_m = math.dist(state.odometry.position_ned, self._stood_at_ned)
            reason = ""
            if moved_m > ESTIMATE_MOVED_M:
                self._anchor_frame(state, p)
                reason = f"confirmed by telemetry; the position moved by {moved_m:.2f} m on the ground"
            self._references.climb()
            if self._anchors is not None:
                self._anchors.begin(state.now_us)
            self._go(PhaseTrigger.CONFIRMED, state, p, reason)
            return
        self._ask(VehicleAction.ARM, state, p)
        if self._is_late(state):
            p.add_finding("arming_refused", "PX4 refused to arm" + state.reasons("arm"))

    # -- between the collisions --

    def _climb(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._start_next(PhaseTrigger.ARRIVED, state, p)
        elif self._is_late(state):
            p.add_finding("climb_timeout", "altitude not reached")

    def _start_next(self, cue: PhaseTrigger, state: FlightState, p: Proposal) -> None:
        """From rest at the target to what comes next; `cue` is that for a collision."""
        self._leave_out(state, p)
        waypoint = self._waypoint
        if waypoint is not None:
            waypoint = waypoint_now(waypoint, self._survey)
        if waypoint is not None and waypoint.position is None:
            waits = f"waiting for the operator (Enter or SIGUSR1); landing after {waypoint.hold_s:g} s"
            self._go(PhaseTrigger.NEXT_PAUSE, state, p, waits)
        elif waypoint is not None and waypoint.position is not None:
            self._go(PhaseTrigger.NEXT_WAYPOINT, state, p, waypoint.name)
            self._reached_us = None
            self._references.fly_to_waypoint(waypoint.position, waypoint.speed_m_s)
        elif self._collision is not None:
            self._go(cue, state, p)
            self._begin_transit(state, p)
        else:
            self._go(PhaseTrigger.NEXT_GOAL, state, p)
            self._fly_to_goal()

    def _leave_out(self, state: FlightState, p: Proposal) -> None:
        """Pass over the legs that depend on a wall which was met, or was not."""
        while (leg := self._waypoint or self._collision) is not None:
            reason = why_left_out(leg, self._survey)
            if reason is None:
                return
            name = leg.name if isinstance(leg, Waypoint) else f"collision {leg.index}"
            p.outputs.append(ProbeEnd(state.now_us, f"{name} left out: {reason}"))
            if isinstance(leg, Waypoint):
                self._stops += 1
            else:
                self._index += 1

    def _fly_to_goal(self) -> None:
        """From rest, along the mission's trajectory where it has one."""
        written = self.mission.goal_trajectory
        if written is None or self._collisions:
            self._references.fly_to(self.mission.goal.position_m)
        else:
            altitude_m = self._references.altitude_m
            self._references.follow_trajectory(PlannedTrajectory.from_pieces(written, altitude_m))

    def _fly_to_waypoint(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self._waypoint
        assert waypoint is not None
        self._lock_to(self.mission.transit_mode, state, p)
        if self._reached_us is None and self._has_arrived(state):
            self._reached_us = state.now_us
        if self._reached_us is None:
            if self._is_late(state, self._references.duration_s):
                p.add_finding("transit_timeout", f"{waypoint.name} not reached")
        elif state.now_us - self._reached_us >= waypoint.hold_s * 1e6:
            self._stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _pause(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self._waypoint
        assert waypoint is not None
        self._lock_to(self.mission.transit_mode, state, p)
        if self._takes_longer_than(waypoint.hold_s, state):
            p.add_finding("pause_timeout", f"operator did not resume within {waypoint.hold_s:g} s")

    def _on_operator_continue(self, state: FlightState, p: Proposal) -> None:
        """The operator says to go on; where nothing waits for that, it means nothing."""
        if self.phase is Phase.PAUSE:
            self._stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _begin_transit(self, state: FlightState, p: Proposal) -> None:
        collision = self._collision
        assert collision is not None
        if collision.wall.sought or collision.probe is not None or self._anchors is not None:
            self._plan_approach_now(collision, state, p)
        self._references.fly_to(self._approaches[collision.index].begin)

    def _plan_approach_now(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        """The approach to a wall as it is known by now; a probe that begins at a place keeps its way."""
        if collision.trajectory is not None:
            return
        then_us = state.now_us + _RUN_UP_US
        here = self._references.target[:2]
        known = collision_now(collision, self._survey, then_us, here)
        self._collisions[self._index] = known
        if collision.probe is not None and not collision.probe.from_here:
            return
        try:
            mission = mission_now(self.mission, self._survey, then_us, here)
            self._approaches[collision.index] = plan_approach(mission, known)
        except NoApproachError as error:
            p.add_finding("no_approach", str(error))

    def _transit(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._set_off(state, p)
        elif self._is_late(state, self._references.duration_s):
            p.add_finding("transit_timeout", "run-up point not reached")

    def _set_off(self, state: FlightState, p: Proposal) -> None:
        """At the run-up point: the lock first, where there is one."""
        collision = self._collision
        assert collision is not None
        if self.mission.vehicle.has_lock:
            self._go(PhaseTrigger.ARRIVED, state, p)
        else:
            self._go(PhaseTrigger.NO_LOCK, state, p)
            self._begin_approach(collision)

    def _has_arrived(self, state: FlightState) -> bool:
        return self._references.has_arrived(state, self._wanted_yaw(state))

    def _prepare(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self._collision
        assert collision is not None
        lock = self.mission.vehicle.lock
        if self._lock_to(collision.mode, state, p):
            self._go(PhaseTrigger.MODE_SETTLED, state, p)
            self._begin_approach(collision)
        elif lock is not None and self._takes_longer_than(lock.timeout_s + 2.0, state):
            p.add_finding(
                "lock_not_ready", f"lock not {collision.mode.value} before collision {collision.index}"
            )

    def _begin_approach(self, collision: Collision) -> None:
        approach = self._approaches[collision.index]
        self._impact_s = approach.impact_s
        self._references.approach(approach)

    def _approach(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self._collision
        assert collision is not None
        if not state.lock_is_in(collision.mode):
            p.add_finding("lock_not_settled", f"lock left {collision.mode.value} during the approach")
        if collision.probe is not None:
            if self._takes_longer_than(self._impact_s + _NOTHING_MET_S, state):
                self._end_probe(collision, state, p)
            return
        since_s = self._elapsed_us(state) * 1e-6 - self._impact_s
        # A trajectory may begin beside its wall, behind the plane.
        if since_s > -_NEAR_S or isinstance(self._approaches[collision.index], Approach):
            self._check_wall_met(collision, state, sensed, p)
        if since_s <= 0.0:  # no wall is late before its time
            return
        approach, guard = self._approaches[collision.index], self.mission.vehicle.guard
        assert collision.approach_m_s is not None
        wall = self._survey.wall_now(collision.wall, state.now_us)
        if since_s > late_s(guard, wall, approach.impact, -collision.approach_m_s[0]):
            detail = f"wall {collision.wall.name} not met {since_s:.1f} s after the planned impact"
            p.add_finding("wall_not_met", detail)

    def _end_probe(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        """At its end, and nothing was met."""
        p.outputs.append(ProbeEnd(state.now_us, f"nothing met on the probe for wall {collision.wall.name}"))
        self._references.hold(state.position)
        self._lock.contact_ends(state.now_us)
        self._go(PhaseTrigger.NOT_MET, state, p)
        self._index += 1

    def _check_wall_met(self, collision: Collision, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        wall, (x, y, _) = self._survey.wall_now(collision.wall, state.now_us), state.position
        overrun = -wall.signed_distance((x, y))
        if overrun <= 0.0:
            return
        guard = self.mission.vehicle.guard
        if overrun > overrun_m(guard, wall, (x, y)) and not sensed.in_contact:
            p.add_finding(
                "wall_not_met", f"flew {overrun:.2f} m past wall {collision.wall.name} without contact"
            )

    # -- impact --

    def _on_onset(self, event: ImpactOnset, state: FlightState, p: Proposal) -> None:
        self._lock.contact_begins(event.t_us)
        if self._is_at_wall_just_hit(event.position_mission, state):
            self._on_bounce(event, state, p)
            return
        self._replanning.contact_begins()
        collision = self._collision
        if collision is None or not self._is_due(collision) or not event.planned:
            p.add_finding("unplanned_hit", f"unplanned {self._describe(event)}")
            return
        wall, (x, y, _) = self._survey.wall_now(collision.wall, state.now_us), event.position_mission
        distance = wall.signed_distance((x, y))
        if collision.probe is None and distance > early_m(self.mission.vehicle.guard, wall, (x, y)):
            p.add_finding("wall_met_early", f"{distance:.2f} m before wall {collision.wall.name}")
        elif not state.lock_is_in(collision.mode):
            detail = f"contact with wall {collision.wall.name} while the lock is not {collision.mode.value}"
            p.add_finding("lock_not_settled", detail)
        else:
            self._go(PhaseTrigger.ONSET, state, p)

    def _describe(self, event: ImpactOnset) -> str:
        force = math.hypot(event.force_mission[0], event.force_mission[1])
        return f"impact of {force:.0f} N in phase {self.phase.value}"

    def _is_at_wall_just_hit(self, place: Vec3, state: FlightState) -> bool:
        """Whether a contact here would be a bounce: at the wall hit last, and soon after that hit."""
        if self.phase is not Phase.RECOVERY or self._elapsed_us(state) > _BOUNCES_US:
            return False
        wall = self._survey.wall_now(self.mission.collisions[self._index - 1].wall, state.now_us)
        distance_m = abs(wall.signed_distance(place))
        if distance_m > early_m(self.mission.vehicle.guard, wall, place):
            return False
        following = self._collision
        if following is None or not self._is_expected(following):
            return True
        ahead = self._survey.wall_now(following.wall, state.now_us)
        return ahead.name != wall.name and distance_m < abs(ahead.signed_distance(place))

    def _on_bounce(self, event: ImpactOnset, state: FlightState, p: Proposal) -> None:
        """Note it, and get clear of the wall until a trajectory is planned from there."""
        p.add_finding("unplanned_hit", f"bounce, {self._describe(event)}", noted=True)
        if self._replanning.trajectory_since_us is not None:
            hit = self.mission.collisions[self._index - 1].wall
            (nx, ny), (x, y, _) = self._survey.wall_now(hit, state.now_us).normal, state.position
            away_m = self.mission.vehicle.guard.retreat_m
            self._references.hold((x + away_m * nx, y + away_m * ny))
        self._replanning.contact_begins()

    def _on_wall_estimate(self, felt: WallEstimate, state: FlightState, p: Proposal) -> None:
        hit = next(c.wall for c in self.mission.collisions if c.wall.name == felt.wall)
        known = self._survey.wall_now(hit)
        self._survey.add_estimate(felt, hit)
        if self._anchors is not None and not known.sought:
            self._anchor_at(known, felt, state, p)
        if felt.mode_felt is None or felt.mode_reported in (None, felt.mode_felt):
            return
        detail = (
            f"contact at wall {felt.wall} indicates {felt.mode_felt.value} arms, the lock reports "
            f"{felt.mode_reported.value} (log odds {abs(felt.log_odds):.1f})"
        )
        p.add_finding("mode_felt", detail, noted=self.mission.mode_mismatch is ModeMismatch.NOTE_ONLY)

    def _anchor_at(self, wall: Wall, felt: WallEstimate, state: FlightState, p: Proposal) -> None:
        """Put the mission frame right along the normal of a wall that was met."""
        anchors, frame = self._anchors, p.frame or state.frame
        assert anchors is not None
        assert frame is not None
        anchor = anchors.take(wall, felt, state.now_us)
        self._survey.move_frame(anchor.moved_mission)
        self._references.move_frame(anchor.moved_mission)
        p.frame = frame.moved(*anchor.moved_mission)
        p.outputs.append(anchor)

    def _on_detection_floor(self, event: DetectionFloor, p: Proposal) -> None:
        """Whether the planned hit can be told from the vibration at all; a wall not felt is flown into."""
        collision, vehicle = self._collision, self.mission.vehicle
        if collision is None or event.threshold_n <= vehicle.detection.force_threshold_n:
            return
        hit = expected_hit(self.mission, collision)
        floor = event.rigid_n if collision.mode is Mode.RIGID else event.flexible_n
        if hit is not None and floor is not None and hit.peak_normal_force_n < floor:
            what = f"{collision.mode.value}, {hit.peak_normal_force_n:.0f} N at wall {collision.wall.name}"
            says = f"{what}: below the detection limit at this vibration level ({floor:.0f} N)"
            p.add_finding("hit_in_noise", says)

    def _contact(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._takes_longer_than(2 * self.mission.vehicle.detection.peak_wait_s, state):
            p.add_finding("no_peak", "contact without a peak")

    def _on_peak(self, event: ImpactPeak, state: FlightState, p: Proposal) -> None:
        collision = self._collision
        if self.phase is not Phase.CONTACT or collision is None:
            return
        point = recovery_point(
            event.position_mission,
            event.normal,
            event.normal_force_n,
            event.tangential_force_n,
            collision.alpha_normal_m_per_n,
            collision.alpha_tangential_m_per_n,
            self._references.altitude_m,
        )
        if collision.probe is not None:
            away, (px, py, _), (nx, ny) = collision.probe.back_m, event.position_mission, event.normal
            point = (px + away * nx, py + away * ny, self._references.altitude_m)
        self._references.hold(point)
        assert state.frame is not None
        p.outputs.append(
            self._references.recovery_setpoint(
                state.frame, event.detected_us, event.received_us, self._yielding.feed_forward
            )
        )
        force = math.hypot(event.normal_force_n, event.tangential_force_n)
        if force > self.mission.limits.peak_force_n:
            p.add_finding("peak_force", f"{force:.0f} N at wall {collision.wall.name}")
        self._go(PhaseTrigger.PEAK, state, p)
        self._index += 1

    # -- recovery and goal --

    def _recovery(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        following, stops = self._collision, self._waypoint is not None
        probe = self.mission.collisions[self._index - 1].probe
        rests = stops or probe is not None
        if self._lock.contact_end_us is not None:
            self._lock_to(self._mode_after(following, stops), state, p)
            if not rests:
                self._replan(following, state, sensed, p)
        timed_out = self._takes_longer_than(self.mission.limits.collision_timeout_s, state)
        if rests or (following is not None and following.approach_m_s is not None):
            elapsed_us = self._elapsed_us(state)
            rested = elapsed_us > _REST_AFTER_US and self._references.is_slow(state)
            if probe is not None:  # a hit may end slow at its wall, and PX4's integrators still lean on that
                left_m = distance2(state.position, self._references.target)
                rested = rested and left_m < _LEFT_SHARE * probe.back_m
            if rested or elapsed_us > _REST_TIMEOUT_US:
                self._references.hold(state.position)
                self._start_next(PhaseTrigger.RESTED, state, p)
        elif following is None:
            self._watch_goal(state, p, timed_out)
        else:
            if self._replanning.impact_in_s(state) < _NEAR_S:
                self._check_wall_met(following, state, sensed, p)
            self._check_lock_in_time(following, state, sensed, p)
            wall = self._survey.wall_now(following.wall, state.now_us)
            if timed_out or self._replanning.is_late(wall, state):
                p.add_finding("wall_not_met", f"wall {following.wall.name} not reached by the recovery")

    def _mode_after(self, following: Collision | None, stops: bool) -> Mode:
        """Where the lock goes after a contact: waypoints and the goal are flown in the transit mode."""
        return self.mission.transit_mode if following is None or stops else following.mode

    def _check_lock_in_time(
        self, following: Collision, state: FlightState, sensed: Sensed, p: Proposal
    ) -> None:
        """Break off at the last moment at which holding still stops short of the wall."""
        if sensed.in_contact or state.lock_is_in(following.mode):
            return
        closing = -following.wall.to_collision(state.velocity)[0]
        if closing <= 0.0:
            return
        pushing = -following.wall.to_collision(state.acceleration)[0]
        distance = following.wall.signed_distance(state.position)
        px4 = self.mission.vehicle.px4
        if least_distance_m(distance, closing, pushing, distance, px4) >= STOP_MARGIN_M:
            return
        aim = following.wall.signed_distance(self._references.target)
        met = self._replanning.meets_plane(closing, state) or meets_plane(
            distance, closing, pushing, aim, px4
        )
        ready_us = self._lock.ready_us(following.mode, state)
        ready_s = math.inf if ready_us is None else (ready_us - state.now_us) * 1e-6
        if met is None or not may_commit(self.mission, following, met, ready_s, state):
            detail = (
                f"lock {state.lock.phase.value}, not {following.mode.value}, {distance:.2f} m before wall "
                f"{following.wall.name} at {closing:.2f} m/s"
            )
            p.add_finding("lock_late", detail)

    def _replan(self, following: Collision | None, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Ask for a way once the contact is over, and follow it once it begins."""
        planning, hit = self._replanning, self.mission.collisions[self._index - 1]
        square_us = state.now_us
        if self._heading is not None and following is not None:
            off = state.yaw - self._references.yaw
            square_us += round(1e6 * self._heading.time_to_s(off, _yaw_rate(state), _SQUARE_RAD))
        target = self._references.target
        coasts = self._coasts(state)
        planning.request_once(hit, following, state, sensed, target, self._lock, p, square_us, coasts)
        if following is not None and following.approach_m_s is not None:
            approach = planning.approach(following, state.now_us, p)
            if approach is not None:
                self._approaches[following.index] = approach
        else:
            way = planning.trajectory_due(state, p)
            if way is not None:
                self._references.follow_trajectory(way)
                self._least_miss_m = math.inf

    @property
    def _trajectory_since_us(self) -> int | None:
        """Since when a way leads on; None: the target is a step."""
        if self.phase in self._underway:
            return self._entered_us
        return self._replanning.trajectory_since_us if self.phase is Phase.RECOVERY else None

    def _watch_goal(self, state: FlightState, p: Proposal, timed_out: bool) -> None:
        if self._lock.contact_end_us is None:  # it comes: the detector waits for it only so long
            return
        miss = distance2(state.position, self.mission.goal.position_m)
        self._least_miss_m = min(self._least_miss_m, miss)
        if self._replanning.trajectory_since_us is not None:
            passed = self._replanning.is_over(state.now_us)  # it may lead away from the goal at first
        else:
            rising = miss > self._least_miss_m + PASSED_RISE_M
            # Where a trajectory is to come it is worth waiting for.
            after_s = PASSED_AFTER_S if self.mission.goal_trajectory is None else _TRAJECTORY_WAIT_S
            passed = rising and self._takes_longer_than(after_s, state)
        if passed or timed_out:
            p.outputs.append(GoalPassed(state.now_us, self._least_miss_m, not passed))
            self._head_for_goal(state, miss)
            self._go(PhaseTrigger.PASSED if passed else PhaseTrigger.TIMED_OUT, state, p)

    def _head_for_goal(self, state: FlightState, distance_m: float) -> None:
        """Hold the goal; where a step to it would be flown faster than a transit, make it a transit."""
        vehicle, goal = self.mission.vehicle, self.mission.goal.position_m
        if vehicle.px4.mpc_xy_p * distance_m > vehicle.flying.transit_speed_m_s:
            self._references.hold(state.position)
            self._references.fly_to(goal)
        else:
            self._references.hold(goal)

    def _goal(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._lock_to(self.mission.transit_mode, state, p)
        goal = self.mission.goal
        distance = distance2(state.position, goal.position_m)
        way = self._references
        underway = way.along_trajectory and not self._takes_longer_than(way.duration_s, state)
        if distance > goal.capture_radius_m or underway:
            self._captured_us = None
            allowed_s = self._references.duration_s + goal.hold_s + self.mission.limits.collision_timeout_s
            if self._takes_longer_than(allowed_s, state):
                p.add_finding("goal_not_reached", f"still {distance:.2f} m from the goal")
        elif self._captured_us is None:
            self._captured_us = state.now_us
        elif state.now_us - self._captured_us >= goal.hold_s * 1e6:
            self._final_error_m = distance
            self._go(PhaseTrigger.HELD, state, p)

    def _landing(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if not (state.on_ground and not state.status.armed):
            self._down_us = None
        elif self._down_us is None:
            self._down_us = state.now_us
        if self._down_us is not None and state.now_us - self._down_us >= DOWN_US:
            self._go(PhaseTrigger.LANDED, state, p)
            p.end = MissionEnd(state.now_us, Outcome.COMPLETED, None, self._final_error_m)
        elif state.on_ground and self._elapsed_us(state) > _DISARM_AFTER_US:
            self._ask(VehicleAction.DISARM, state, p)
        elif state.in_offboard or self._asked_us is None:
            self._ask(VehicleAction.LAND, state, p)

    # -- setpoints --

    def _until_impact_s(self, state: FlightState) -> float:
        """Time until the mission's own trajectory meets its wall; infinite where it leads to none."""
        collision = self._collision
        if collision is None or collision.trajectory is None:
            return math.inf
        if self.phase is Phase.APPROACH:
            return self._impact_s - self._elapsed_us(state) * 1e-6
        return self._replanning.impact_in_s(state) if self.phase is Phase.RECOVERY else math.inf

    def _wanted_yaw(self, state: FlightState) -> float:
        collision = self._collision
        if self._heading is not None and self.phase is Phase.RECOVERY:
            turned = 0.0 if collision is None else self._survey.turned(collision.wall)
            return wrap_angle(self._square_yaw + turned)
        if collision is None or self.phase not in TO_IMPACT:
            return self._references.yaw
        turned = 0.0 if self._heading is None else self._survey.turned(collision.wall)
        return wrap_angle(collision.wall.parallel_yaw(state.yaw - turned) + turned)

    def _coasts(self, state: FlightState) -> bool:
        """Whether a trajectory of the mission's is about to go on after a contact.

        A setpoint far away, as it leads a recovery, would have PX4's integral gather until then what puts
        the vehicle beside the trajectory.
        """
        if self.phase is not Phase.RECOVERY or self._written_next is None:
            return False
        end_us = self._lock.contact_end_us
        return end_us is None or state.now_us - end_us < _COASTS_US

    @property
    def _written_next(self) -> PlannedTrajectory | None:
        """The mission's own trajectory to what comes next."""
        return self._written.get(None if self._collision is None else self._collision.index)

    def _planned_after_contact(self, state: FlightState) -> TrajectoryPoint | None:
        """Where the mission's trajectory would be if it began where the contact ended.

        None: in contact, or the vehicle is as fast already, as one is that left the wall leaning away.
        """
        way, end_us = self._written_next, self._lock.contact_end_us
        if way is None or end_us is None:
            return None
        planned = way.at((state.now_us - end_us) * 1e-6)
        return planned if math.hypot(*state.velocity[:2]) < math.hypot(*planned.velocity[:2]) else None

    def _yaw_asked(self, state: FlightState) -> float | None:
        """The heading that leads to the wanted one, from a contact on; None: at once."""
        if self._heading is None or self.phase not in _TURNED:
            self._square_yaw = self._references.yaw
            if self._heading is not None:
                self._heading.begin(state.now_us)
            return None
        return self._heading.setpoint(self._references.yaw, state.yaw, _yaw_rate(state), state.now_us)

    def _send_setpoint(self, sample: OdometrySample, state: FlightState, p: Proposal) -> None:
        """One setpoint for every odometry sample, as the phase wants it."""
        frame = p.frame or state.frame
        if frame is None:
            return
        self._references.yaw_asked = self._yaw_asked(state)
        if self.phase is Phase.CONTACT:
            if not self._takes_longer_than(LONGEST_S, state):
                p.outputs.append(
                    self._references.contact_setpoint(frame, sample, self._yielding.feed_forward)
                )
            return
        if self.phase in _SILENT:
            return
        since_us = self._trajectory_since_us
        if since_us is None and self._coasts(state):
            self._references.slew_yaw(self._wanted_yaw(state), state.now_us)
            p.outputs.append(
                self._references.contact_setpoint(
                    frame, sample, self._yielding.feed_forward, self._planned_after_contact(state)
                )
            )
            return
        collision = self._collision
        if collision is not None and since_us is not None and self._until_impact_s(state) < _COASTING_S:
            leaned = self.phase is Phase.RECOVERY and self._replanning.is_leaned
            out_m = self.mission.vehicle.airframe.contact_distance_m
            push_m_s2 = 0.0 if leaned else balancing_m_s2(self._height_m, out_m)
            p.outputs.append(
                self._references.coasting_setpoint(frame, sample, since_us, collision.wall, push_m_s2)
            )
            return
        self._references.slew_yaw(self._wanted_yaw(state), state.now_us)
        forward = self._yielding.feed_forward if self.phase is Phase.RECOVERY else None
        p.outputs.append(self._references.setpoint(frame, sample.t_us, sample.received_us, since_us, forward))


def _yaw_rate(state: FlightState) -> float:
    """Of the heading, rad/s, mission frame."""
    if state.imu is None or state.attitude is None:
        return 0.0
    return -rotate(state.attitude.q_frd_to_ned, state.imu.rate_frd)[2]


def _lock_name(mission: Mission) -> str:
    return f"lock {mission.transit_mode.value}"
