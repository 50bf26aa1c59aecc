"""The mission executive: it runs through the phases and proposes the vehicle's actions; the guard decides.

Only the executive writes the `MissionProgress`. Its helpers read the progress and return a `Change`: the
phases on the ground (`ground_phases`), contacts (`impact_response`), planning after them (`replan_requests`),
and the setpoints of all phases (`setpoint_selection`). `rehearsal` runs the same phases without contacts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from dart_flight.base.geometry import distance2
from dart_flight.base.records import (
    DetectionFloor,
    FrameAnchor,
    GoalPassed,
    ImpactOnset,
    ImpactPeak,
    Input,
    MissionEnd,
    Mode,
    OdometrySample,
    OperatorRequest,
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
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.core.mission.approach import (
    NoApproachError,
    check_segments_clear,
    plan_approach,
)
from dart_flight.core.mission.commitment import STOP_MARGIN_M, may_commit
from dart_flight.core.mission.contact_feedforward import ContactFeedforward
from dart_flight.core.mission.course import ARRIVED_S, Arrival
from dart_flight.core.mission.ground_phases import GroundPhases
from dart_flight.core.mission.impact_response import ImpactResponse
from dart_flight.core.mission.legs import skip_reason, update_collision, update_mission, update_waypoint
from dart_flight.core.mission.lock_commands import LockCommands
from dart_flight.core.mission.mission_progress import NO_CHANGE, Change, MissionProgress
from dart_flight.core.mission.phases import BETWEEN, TRANSITIONS, WATCHING, PhaseTrigger
from dart_flight.core.mission.position_loop import least_distance_m, predict_impact
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.recovery import PASSED_AFTER_S, PASSED_RISE_M
from dart_flight.core.mission.replan_requests import ReplanRequests
from dart_flight.core.mission.setpoint_selection import SetpointSelection
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import late_s, overrun_m
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_TRAJECTORY_WAIT_S: Final = 1.5  # longest wait for a trajectory after a contact; two answers fit into it
_NEAR_S: Final = 0.3  # time before the planned impact from which a missing contact is checked
_NOTHING_MET_S: Final = 0.3  # PX4 reaches the end of a probe's line this much later than the setpoint
_RUN_UP_US: Final = 5_000_000  # typical time from the beginning of the transit to the impact
_REST_TIMEOUT_US: Final = 4_000_000
_REST_AFTER_US: Final = 500_000
_LEFT_SHARE: Final = 0.5  # a retreat after a probe ends when this fraction of its distance is left
_RETRY_US: Final = 1_000_000  # period of repeated commands; telemetry confirms them up to a second later
_EVENTS: Final = frozenset({PlanAnswer, OperatorRequest})


class Executive:
    """Runs the phases of one mission.

    If there is no room for an approach of the mission, the constructor raises NoApproachError (`approach`).
    """

    def __init__(self, mission: Mission) -> None:
        self.mission, self._flying = mission, mission.vehicle.flying
        approaches = {
            c.index: plan_approach(mission, c) for c in mission.collisions if c.approach_m_s is not None
        }
        check_segments_clear(mission)
        self.progress = MissionProgress(mission, approaches)
        self._lock, self._arrival = LockCommands(mission.vehicle.lock), Arrival(mission)
        self._ground, self._impacts = GroundPhases(mission), ImpactResponse(mission)
        self._replanning, self._setpoints = ReplanRequests(mission), SetpointSelection(mission)
        self._feedforward = ContactFeedforward(mission.vehicle)
        self._steps: dict[Phase, Callable[[FlightState, Sensed, Proposal], None]] = {
            Phase.READYING: self._ready,
            Phase.OFFBOARD: self._enter_offboard,
            Phase.ARMING: self._arm,
            Phase.CLIMB: self._climb,
            Phase.WAYPOINT: self._fly_to_waypoint,
            Phase.PAUSE: self._pause,
            Phase.TRANSIT: self._transit,
            Phase.PREPARE: self._prepare,
            Phase.APPROACH: self._approach,
            Phase.CONTACT: self._contact,
            Phase.RECOVERY: self._recovery,
            Phase.GOAL: self._goal,
            Phase.LANDING: self._land,
        }

    # -- stepping --

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Fill a proposal after an input; `state` and `sensed` already include the input."""
        progress = self.progress
        if not self._has_begun(state):
            return
        if sensed.estimate is not None:
            self._feedforward.update(sensed)
            progress.contact_height_m = sensed.height_m
        if type(item) in _EVENTS:
            self._handle_event(item, state, p)
        self._handle_contacts(sensed, state, p)
        permission = self._lock.permission(progress.lock, state.now_us, sensed.in_contact)
        if permission is not None:
            progress.lock = progress.lock._replace(permitted=permission.permitted)
            p.outputs.append(permission)
        step = self._steps.get(progress.phase)
        if step is not None and not (p.frame is not None and progress.anchors is not None and sensed.wall):
            step(state, sensed, p)  # not after a frame correction: the state is still in the old frame
        p.expected = progress.expected = self._impacts.expected(progress, state)
        p.altitude_m = progress.course.altitude_m
        if type(item) is OdometrySample:
            self._propose_setpoint(item, state, p)

    def _has_begun(self, state: FlightState) -> bool:
        """Record when the phase began; return False if no stamped sample has arrived yet."""
        progress = self.progress
        if progress.entered_us is None:
            if not state.now_us:
                return False
            progress.entered_us = state.now_us
        if progress.entered_host_us is None:
            progress.entered_host_us = state.host_us
        return True

    def _propose_setpoint(self, sample: OdometrySample, state: FlightState, p: Proposal) -> None:
        progress, frame = self.progress, p.frame or state.frame
        if frame is None:
            return
        progress.heading = self._setpoints.heading(progress, state)
        added = self._feedforward.feed_forward
        setpoint, progress.heading = self._setpoints.setpoint(sample, progress, state, frame, added)
        if setpoint is not None:
            p.outputs.append(setpoint)

    def _handle_event(self, item: Input, state: FlightState, p: Proposal) -> None:
        if isinstance(item, PlanAnswer):
            self._apply(self._replanning.accept(self.progress.replan, item, state.now_us), state, p)
        elif isinstance(item, OperatorRequest) and item.request is Request.CONTINUE:
            self._on_operator_continue(state, p)

    # -- changes requested by helpers --

    def _apply(self, change: Change, state: FlightState, p: Proposal) -> None:
        """Apply a change to the mission's state, and add its records and commands to the proposal `p`."""
        progress = self.progress
        if change is NO_CHANGE:
            return
        if change.course is not None:
            progress.course = change.course
        if change.heading is not None:
            progress.heading = change.heading
        if change.replan is not None:
            progress.replan = change.replan
        if change.approach is not None and progress.collision is not None:
            progress.approaches[progress.collision.index] = change.approach
        if change.frame is not None:
            p.frame, progress.stood_at_ned = change.frame, change.stood_at_ned
        if change.mode is not None:
            self._move_lock(change.mode, state, p)
        p.outputs += change.outputs
        if change.finding is not None:
            p.findings.append(change.finding)
        if change.action is not None:
            self._send_action(change.action, state, p)
        if change.phase_trigger is not None:
            self._transition(change.phase_trigger, state, p, change.reason)
        if change.end is not None:
            p.end = change.end

    def _transition(self, trigger: PhaseTrigger, state: FlightState, p: Proposal, reason: str = "") -> None:
        p.outputs.append(self._change_phase(trigger, state.now_us, reason or trigger.value))

    def _change_phase(self, trigger: PhaseTrigger, now_us: int, reason: str) -> PhaseChange:
        progress, before = self.progress, self.progress.phase
        progress.phase = TRANSITIONS[before, trigger]
        progress.entered_us, progress.entered_host_us, progress.asked_us = now_us, None, None
        progress.lock, progress.arrived_us = progress.lock.phase_begins(), None
        collision = progress.collision
        index = collision.index if collision and progress.phase in WATCHING - BETWEEN else None
        return PhaseChange(now_us, before, progress.phase, reason, index)

    def _send_action(self, action: VehicleAction, state: FlightState, p: Proposal) -> None:
        """Send a vehicle command, and repeat it every second until telemetry confirms it."""
        progress = self.progress
        if progress.asked_us is None or state.now_us - progress.asked_us >= _RETRY_US:
            progress.asked_us = state.now_us
            p.outputs.append(VehicleCommand(state.now_us, action))

    def _move_lock(self, mode: Mode, state: FlightState, p: Proposal) -> bool:
        """Command a mode of the lock if needed and permitted; return whether the lock has settled in it."""
        order = self._lock.command(self.progress.lock, mode, state)
        if order is not None:
            self.progress.lock = self.progress.lock._replace(commanded=mode, commanded_us=state.now_us)
            p.outputs.append(order)
        return state.lock_is_in(mode)

    def record_override(self, now_us: int, reason: str) -> list[Output]:
        """Record that the guard has taken over; the first call returns the phase change."""
        if self.progress.phase in (Phase.DONE, Phase.OVERRULED):
            return []
        return [self._change_phase(PhaseTrigger.OVERRULE, now_us, reason)]

    def record_end(self, end: MissionEnd) -> list[Output]:
        """Record that the guard has ended the flight, in the air or on the ground."""
        if self.progress.phase is Phase.OVERRULED:
            return [self._change_phase(PhaseTrigger.LANDED, end.t_us, end.outcome.value), end]
        if self.progress.phase is Phase.DONE:
            return [end]
        detail = (end.reason or "").partition(": ")[2]
        return [self._change_phase(PhaseTrigger.GIVEN_UP, end.t_us, detail), end]

    # -- contacts --

    def _handle_contacts(self, sensed: Sensed, state: FlightState, p: Proposal) -> None:
        progress = self.progress
        for event in sensed.impacts:
            if isinstance(event, ImpactOnset):
                progress.lock = progress.lock.contact_begins(event.t_us)
                self._apply(self._impacts.on_onset(event, progress, state), state, p)
            elif isinstance(event, ImpactPeak):
                added = self._feedforward.feed_forward
                change = self._impacts.on_peak(event, progress, state, added)
                self._apply(change, state, p)
                if change.phase_trigger is not None:
                    progress.index += 1
            elif isinstance(event, DetectionFloor):
                self._apply(self._impacts.on_detection_floor(event, progress), state, p)
            else:
                progress.lock = progress.lock.contact_ends(event.t_us)
        if sensed.wall is not None:
            self._handle_wall_estimate(sensed.wall, state, p)

    def _handle_wall_estimate(self, estimate: WallEstimate, state: FlightState, p: Proposal) -> None:
        progress = self.progress
        progress.replan = progress.replan._replace(has_wall_estimate=True)
        hit = next(c.wall for c in self.mission.collisions if c.wall.name == estimate.wall)
        known = progress.walls.known_wall(hit)
        progress.walls.add_estimate(estimate, hit)
        if progress.anchors is not None and not known.sought and not estimate.problem:
            self._correct_frame(progress.anchors.correct_frame(known, estimate, state.now_us), state, p)
        self._apply(self._impacts.on_wall_estimate(estimate), state, p)

    def _correct_frame(self, anchor: FrameAnchor, state: FlightState, p: Proposal) -> None:
        """Move the mission frame along the normal of the wall that was touched."""
        frame = p.frame or state.frame
        assert frame is not None
        self.progress.walls.move_frame(anchor.moved_mission)
        self.progress.course = self.progress.course.move_frame(anchor.moved_mission)
        p.frame = frame.displaced(*anchor.moved_mission)
        p.outputs.append(anchor)

    # -- on the ground --

    def _ready(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._apply(self._ground.ready(self.progress, state), state, p)

    def _enter_offboard(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._apply(self._ground.enter_offboard(self.progress, state), state, p)

    def _arm(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._apply(self._ground.arm(self.progress, state), state, p)
        if self.progress.anchors is not None and self.progress.phase is Phase.CLIMB:
            self.progress.anchors.begin(state.now_us)

    def _land(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        progress = self.progress
        if not (state.on_ground and not state.status.armed):
            progress.down_us = None
        elif progress.down_us is None:
            progress.down_us = state.now_us
        self._apply(self._ground.land(progress, state), state, p)

    # -- between the collisions --

    def _climb(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._start_next(PhaseTrigger.ARRIVED, state, p)
        elif self.progress.is_late(state):
            p.add_finding("climb_timeout", "the altitude was not reached in time")

    def _start_next(self, trigger: PhaseTrigger, state: FlightState, p: Proposal) -> None:
        """Begin the next leg at the target, from rest; `trigger` begins the phase of a collision."""
        self._skip_legs(state, p)
        waypoint = self.progress.waypoint
        if waypoint is not None:
            waypoint = update_waypoint(waypoint, self.progress.walls)
        if waypoint is not None and waypoint.position is None:
            waits = (
                f"waiting up to {waypoint.hold_s:g} s for the operator to continue (Enter or SIGUSR1); "
                "lands if nobody does"
            )
            self._transition(PhaseTrigger.NEXT_PAUSE, state, p, waits)
        elif waypoint is not None and waypoint.position is not None:
            self._transition(PhaseTrigger.NEXT_WAYPOINT, state, p, waypoint.name)
            self.progress.reached_us = None
            course = self.progress.course
            self.progress.course = course.fly_to_waypoint(waypoint.position, self._flying, waypoint.speed_m_s)
        elif self.progress.collision is not None:
            self._transition(trigger, state, p)
            self._begin_transit(state, p)
        else:
            self._transition(PhaseTrigger.NEXT_GOAL, state, p)
            self._fly_to_goal()

    def _skip_legs(self, state: FlightState, p: Proposal) -> None:
        while (leg := self.progress.waypoint or self.progress.collision) is not None:
            reason = skip_reason(leg, self.progress.walls)
            if reason is None:
                return
            name = leg.name if isinstance(leg, Waypoint) else f"collision {leg.index}"
            p.outputs.append(ProbeEnd(state.now_us, f"{name} skipped: {reason}"))
            if isinstance(leg, Waypoint):
                self.progress.stops += 1
            else:
                self.progress.index += 1

    def _fly_to_goal(self) -> None:
        """Fly from rest to the goal, along the mission's trajectory if there is one."""
        written, course = self.mission.goal_trajectory, self.progress.course
        if written is None or self.progress.collisions:
            self.progress.course = course.fly_to(self.mission.goal.position_m, self._flying)
        else:
            self.progress.course = course.follow(Trajectory.from_mission(written, course.altitude_m))

    def _fly_to_waypoint(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self.progress.waypoint
        assert waypoint is not None
        self._move_lock(self.mission.transit_mode, state, p)
        if self.progress.reached_us is None and self._has_arrived(state):
            self.progress.reached_us = state.now_us
        if self.progress.reached_us is None:
            if self.progress.is_late(state, self.progress.course.duration_s):
                p.add_finding("transit_timeout", f"{waypoint.name} was not reached in time")
        elif state.now_us - self.progress.reached_us >= waypoint.hold_s * 1e6:
            self.progress.stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _pause(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self.progress.waypoint
        assert waypoint is not None
        self._move_lock(self.mission.transit_mode, state, p)
        if self.progress.takes_longer_than(waypoint.hold_s, state):
            p.add_finding("pause_timeout", f"the operator did not resume within {waypoint.hold_s:g} s")

    def _on_operator_continue(self, state: FlightState, p: Proposal) -> None:
        if self.progress.phase is Phase.PAUSE:
            self.progress.stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _begin_transit(self, state: FlightState, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        if collision.wall.sought or collision.probe is not None or self.progress.anchors is not None:
            self._replan_approach(collision, state, p)
        begin = self.progress.approaches[collision.index].begin
        self.progress.course = self.progress.course.fly_to(begin[:2], self._flying)

    def _replan_approach(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        """Plan the approach to a wall's estimated position; only a probe with `from_here` gets a new line."""
        if collision.trajectory is not None:
            return
        then_us = state.now_us + _RUN_UP_US
        here = self.progress.course.target[:2]
        known = update_collision(collision, self.progress.walls, then_us, here)
        self.progress.collisions[self.progress.index] = known
        if collision.probe is not None and not collision.probe.from_here:
            return
        try:
            mission = update_mission(self.mission, self.progress.walls, then_us, here)
            self.progress.approaches[collision.index] = plan_approach(mission, known)
        except NoApproachError as error:
            p.add_finding("no_approach", str(error))

    def _transit(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._leave_run_up_point(state, p)
        elif self.progress.is_late(state, self.progress.course.duration_s):
            p.add_finding("transit_timeout", "the run-up point was not reached in time")

    def _leave_run_up_point(self, state: FlightState, p: Proposal) -> None:
        """Leave the run-up point; if the vehicle has a lock, switch the lock first."""
        collision = self.progress.collision
        assert collision is not None
        if self.mission.vehicle.has_lock:
            self._transition(PhaseTrigger.ARRIVED, state, p)
        else:
            self._transition(PhaseTrigger.NO_LOCK, state, p)
            self._begin_approach(collision)

    def _has_arrived(self, state: FlightState) -> bool:
        """Return whether the vehicle has been at its target for the required time."""
        progress = self.progress
        if not self._arrival.is_at(
            progress.course.target, self._setpoints.wanted_yaw(progress, state), state
        ):
            progress.arrived_us = None
            return False
        if progress.arrived_us is None:
            progress.arrived_us = state.now_us
        return state.now_us - progress.arrived_us >= ARRIVED_S * 1e6

    def _prepare(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        lock = self.mission.vehicle.lock
        if self._move_lock(collision.mode, state, p):
            self._transition(PhaseTrigger.MODE_SETTLED, state, p)
            self._begin_approach(collision)
        elif lock is not None and self.progress.takes_longer_than(lock.timeout_s + 2.0, state):
            p.add_finding(
                "lock_not_ready", f"the lock is not {collision.mode.value} before collision {collision.index}"
            )

    def _begin_approach(self, collision: Collision) -> None:
        approach = self.progress.approaches[collision.index]
        self.progress.course = self.progress.course.approach(approach)

    def _approach(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        if not state.lock_is_in(collision.mode):
            p.add_finding(
                "lock_not_settled", f"the lock left the mode {collision.mode.value} during the approach"
            )
        if collision.probe is not None:
            if self.progress.takes_longer_than(self.progress.course.duration_s + _NOTHING_MET_S, state):
                self._end_probe(collision, state, p)
            return
        since_s = self.progress.elapsed_us(state) * 1e-6 - self.progress.course.duration_s
        # A trajectory may begin beyond the wall's end and behind its plane, so check only near the impact.
        if since_s > -_NEAR_S or collision.trajectory is None:
            self._check_contact_due(collision, state, sensed, p)
        if since_s <= 0.0:  # the timeout begins at the planned impact
            return
        guard, impact = self.mission.vehicle.guard, collision.impact_point
        assert collision.approach_m_s is not None
        assert impact is not None
        wall = self.progress.walls.known_wall(collision.wall, state.now_us)
        if since_s > late_s(guard, wall, impact, -collision.approach_m_s[0]):
            detail = f"no contact with wall {collision.wall.name} {since_s:.1f} s after the planned impact"
            p.add_finding("wall_not_met", detail)

    def _end_probe(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        p.outputs.append(
            ProbeEnd(state.now_us, f"the probe for wall {collision.wall.name} ended without a contact")
        )
        self.progress.course = self.progress.course.hold(state.position)
        self.progress.lock = self.progress.lock.contact_ends(state.now_us)
        self._transition(PhaseTrigger.NOT_MET, state, p)
        self.progress.index += 1

    def _check_contact_due(
        self, collision: Collision, state: FlightState, sensed: Sensed, p: Proposal
    ) -> None:
        wall, (x, y, _) = self.progress.walls.known_wall(collision.wall, state.now_us), state.position
        overrun = -wall.signed_distance((x, y))
        if overrun <= 0.0:
            return
        guard = self.mission.vehicle.guard
        if overrun > overrun_m(guard, wall, (x, y)) and not sensed.in_contact:
            p.add_finding(
                "wall_not_met",
                f"no contact, but the vehicle is {overrun:.2f} m behind the plane of wall "
                f"{collision.wall.name}",
            )

    # -- impact --

    def _contact(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self.progress.takes_longer_than(2 * self.mission.vehicle.detection.peak_wait_s, state):
            p.add_finding("no_peak", "the contact force has no peak")

    # -- recovery and goal --

    def _recovery(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        following, stops = self.progress.collision, self.progress.waypoint is not None
        probe = self.progress.last_collision.probe
        rests = stops or probe is not None
        if self.progress.lock.contact_end_us is not None:
            self._move_lock(self._mode_after(following, stops), state, p)
            if not rests:
                self._replan(following, state, sensed, p)
        timed_out = self.progress.takes_longer_than(self.mission.limits.collision_timeout_s, state)
        if rests or (following is not None and following.approach_m_s is not None):
            elapsed_us = self.progress.elapsed_us(state)
            rested = elapsed_us > _REST_AFTER_US and self._arrival.is_slow(state)
            if probe is not None:  # a slow vehicle may still move, because PX4's integrators tilt it
                left_m = distance2(state.position, self.progress.course.target)
                rested = rested and left_m < _LEFT_SHARE * probe.back_m
            if rested or elapsed_us > _REST_TIMEOUT_US:
                self.progress.course = self.progress.course.hold(state.position)
                self._start_next(PhaseTrigger.RESTED, state, p)
        elif following is None:
            self._watch_goal(state, p, timed_out)
        else:
            if self.progress.replan.impact_in_s(state) < _NEAR_S:
                self._check_contact_due(following, state, sensed, p)
            self._check_lock_in_time(following, state, sensed, p)
            wall = self.progress.walls.known_wall(following.wall, state.now_us)
            if timed_out or self._replanning.is_late(self.progress.replan, wall, state):
                detail = f"the recovery did not reach wall {following.wall.name} in time"
                p.add_finding("wall_not_met", detail)

    def _mode_after(self, following: Collision | None, stops: bool) -> Mode:
        """Return the mode of the lock after a contact: the mode of the following collision.

        If the vehicle flies to waypoints or the goal next, the result is the transit mode.
        """
        return self.mission.transit_mode if following is None or stops else following.mode

    def _check_lock_in_time(
        self, following: Collision, state: FlightState, sensed: Sensed, p: Proposal
    ) -> None:
        """Report a finding if the lock is late, a hold stops too late, and the vehicle may not commit."""
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
        aim = following.wall.signed_distance(self.progress.course.target)
        met = self.progress.replan.predict_impact(closing, state) or predict_impact(
            distance, closing, pushing, aim, px4
        )
        ready_us = self._lock.ready_us(self.progress.lock, following.mode, state)
        ready_s = math.inf if ready_us is None else (ready_us - state.now_us) * 1e-6
        if met is None or not may_commit(self.mission, following, met, ready_s, state):
            detail = (
                f"the lock is {state.lock.phase.value}, not {following.mode.value}; wall "
                f"{following.wall.name} is {distance:.2f} m away, closing speed {closing:.2f} m/s"
            )
            p.add_finding("lock_late", detail)

    def _replan(self, following: Collision | None, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Request a trajectory after the contact, and follow the trajectory from its start time."""
        progress, planning = self.progress, self._replanning
        square_us = state.now_us if following is None else self._setpoints.square_us(progress, state)
        coasts = self._setpoints.coasts(progress, state)
        self._apply(planning.request(progress, state, sensed, square_us, coasts), state, p)
        if following is not None and following.approach_m_s is not None:
            self._apply(planning.approach(progress, state.now_us), state, p)
            return
        change = planning.trajectory(progress, state)
        self._apply(change, state, p)
        if change.course is not None:
            progress.least_miss_m = math.inf

    def _watch_goal(self, state: FlightState, p: Proposal, timed_out: bool) -> None:
        if self.progress.lock.contact_end_us is None:  # not ended; the detector limits its duration
            return
        miss = distance2(state.position, self.mission.goal.position_m)
        self.progress.least_miss_m = min(self.progress.least_miss_m, miss)
        if self.progress.replan.trajectory is not None:
            passed = self.progress.replan.is_over(state.now_us)  # the distance to the goal may first grow
        else:
            rising = miss > self.progress.least_miss_m + PASSED_RISE_M
            # If the mission has a trajectory to the goal, allow time for its replanned version.
            after_s = PASSED_AFTER_S if self.mission.goal_trajectory is None else _TRAJECTORY_WAIT_S
            passed = rising and self.progress.takes_longer_than(after_s, state)
        if passed or timed_out:
            p.outputs.append(GoalPassed(state.now_us, self.progress.least_miss_m, not passed))
            self._head_for_goal(state, miss)
            self._transition(PhaseTrigger.PASSED if passed else PhaseTrigger.TIMED_OUT, state, p)

    def _head_for_goal(self, state: FlightState, distance_m: float) -> None:
        """Command the goal as a step, or fly a transit if a step would be faster than the transit speed."""
        vehicle, goal, course = self.mission.vehicle, self.mission.goal.position_m, self.progress.course
        if vehicle.px4.mpc_xy_p * distance_m > vehicle.flying.transit_speed_m_s:
            self.progress.course = course.hold(state.position).fly_to(goal, self._flying)
        else:
            self.progress.course = course.hold(goal)

    def _goal(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._move_lock(self.mission.transit_mode, state, p)
        goal = self.mission.goal
        distance = distance2(state.position, goal.position_m)
        course = self.progress.course
        along = course.trajectory is not None and not course.on_transit
        underway = along and not self.progress.takes_longer_than(course.duration_s, state)
        if distance > goal.capture_radius_m or underway:
            self.progress.captured_us = None
            allowed_s = (
                self.progress.course.duration_s + goal.hold_s + self.mission.limits.collision_timeout_s
            )
            if self.progress.takes_longer_than(allowed_s, state):
                p.add_finding("goal_not_reached", f"the vehicle is still {distance:.2f} m from the goal")
        elif self.progress.captured_us is None:
            self.progress.captured_us = state.now_us
        elif state.now_us - self.progress.captured_us >= goal.hold_s * 1e6:
            self.progress.final_error_m = distance
            self._transition(PhaseTrigger.HELD, state, p)
