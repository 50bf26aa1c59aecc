"""The mission executive: walks through the phases and proposes what the vehicle should do.

It proposes; the guard disposes. State and impacts come in, a `Proposal` comes out; nothing else is touched.
Here are the phases in the air; those on the ground are in `ground_phases`, contacts in `impact_response`, the
setpoints of all phases in `setpoint_selection`. `rehearsal` is the same walk without contacts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from dart_flight.base.geometry import distance2
from dart_flight.base.records import (
    GoalPassed,
    Input,
    MissionEnd,
    Mode,
    OdometrySample,
    OperatorRequest,
    Output,
    Phase,
    PlanAnswer,
    ProbeEnd,
    Request,
)
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.approach import (
    NoApproachError,
    check_segments_clear,
    plan_approach,
)
from dart_flight.core.mission.commitment import STOP_MARGIN_M, may_commit
from dart_flight.core.mission.contact_feedforward import ContactFeedforward
from dart_flight.core.mission.ground_phases import GroundPhases
from dart_flight.core.mission.impact_response import ImpactResponse
from dart_flight.core.mission.legs import collision_now, mission_now, waypoint_now, why_left_out
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import PhaseTrigger
from dart_flight.core.mission.position_loop import least_distance_m, meets_plane
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.recovery import PASSED_AFTER_S, PASSED_RISE_M
from dart_flight.core.mission.replan_requests import ReplanRequests
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.mission.setpoint_selection import SetpointSelection
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls, late_s, overrun_m
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_TRAJECTORY_WAIT_S: Final = 1.5  # after a contact: by then a planner that lives has answered, even twice
_NEAR_S: Final = 0.3  # before an impact
_NOTHING_MET_S: Final = 0.3  # after the end of a probe: PX4 follows its setpoints a little late
_RUN_UP_US: Final = 5_000_000  # about so long from the transit's beginning to the impact
_REST_TIMEOUT_US: Final = 4_000_000
_REST_AFTER_US: Final = 500_000
_LEFT_SHARE: Final = 0.5  # of how far it is to go back after a probe, at most, for the next leg to begin
_WORDS: Final = frozenset({PlanAnswer, OperatorRequest})


class Executive:
    """Phases of one mission.

    Raises:
        NoApproachError: an approach of the mission has no room (`approach`).
    """

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self._approaches: dict[int, Trajectory] = {
            c.index: plan_approach(mission, c) for c in mission.collisions if c.approach_m_s is not None
        }
        check_segments_clear(mission)
        drift_m_s = mission.vehicle.estimation.position_drift_m_s
        anchors = self._anchors = FrameAnchors(drift_m_s) if mission.is_anchored else None
        self._walls = EstimatedWalls(anchors)
        self._references = SetpointGenerator(mission)
        self._lock = LockOrders(mission.vehicle.lock)
        self._replanning = ReplanRequests(mission)
        self.progress = MissionProgress(mission, self._lock, self._references)
        feedforward = ContactFeedforward(mission.vehicle)
        shared = (mission, self.progress, self._lock, self._references)
        self._ground = GroundPhases(*shared, anchors)
        self._impacts = ImpactResponse(*shared, self._replanning, self._walls, anchors, feedforward)
        self._setpoints = SetpointSelection(*shared, self._replanning, self._walls, feedforward)
        self._least_miss_m = math.inf
        self._reached_us: int | None = None  # the waypoint under way
        self._captured_us: int | None = None
        self._steps: dict[Phase, Callable[[FlightState, Sensed, Proposal], None]] = {
            Phase.READYING: self._ground.ready,
            Phase.OFFBOARD: self._ground.take_offboard,
            Phase.ARMING: self._ground.arm,
            Phase.CLIMB: self._climb,
            Phase.WAYPOINT: self._fly_to_waypoint,
            Phase.PAUSE: self._pause,
            Phase.TRANSIT: self._transit,
            Phase.PREPARE: self._prepare,
            Phase.APPROACH: self._approach,
            Phase.CONTACT: self._contact,
            Phase.RECOVERY: self._recovery,
            Phase.GOAL: self._goal,
            Phase.LANDING: self._ground.land,
        }

    # -- stepping --

    def propose(self, item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Fill a proposal, after an input that has gone into `state` and taught `sensed`."""
        progress = self.progress
        if not progress.begin(state):
            return
        self._setpoints.update(sensed)
        if type(item) in _WORDS:
            self._take_word(item, state, p)
        self._impacts.take(sensed, state, p)
        permission = self._lock.permission(state.now_us, sensed.in_contact)
        if permission is not None:
            p.outputs.append(permission)
        step = self._steps.get(progress.phase)
        if step is not None and not (p.frame is not None and self._anchors is not None and sensed.wall):
            step(state, sensed, p)  # what has just moved the frame has not moved the state yet
        p.expected = self._impacts.expected(state)
        p.altitude_m = self._references.altitude_m
        if isinstance(item, OdometrySample):
            self._setpoints.send(item, state, p)

    def _take_word(self, item: Input, state: FlightState, p: Proposal) -> None:
        """What planner or operator say."""
        if isinstance(item, PlanAnswer):
            self._replanning.take(item, state.now_us, p)
        elif isinstance(item, OperatorRequest) and item.request is Request.CONTINUE:
            self._on_operator_continue(state, p)

    def overruled(self, now_us: int, reason: str) -> list[Output]:
        """The guard has taken over; returns the change of phase, once."""
        if self.progress.phase in (Phase.DONE, Phase.OVERRULED):
            return []
        return [self.progress.change(PhaseTrigger.OVERRULE, now_us, reason)]

    def ended(self, end: MissionEnd) -> list[Output]:
        """The guard has ended the flight, in the air or before it began; returns the last records."""
        if self.progress.phase is Phase.OVERRULED:
            return [self.progress.change(PhaseTrigger.LANDED, end.t_us, end.outcome.value), end]
        if self.progress.phase is Phase.DONE:
            return [end]
        detail = (end.reason or "").partition(": ")[2]
        return [self.progress.change(PhaseTrigger.GIVEN_UP, end.t_us, detail), end]

    # -- between the collisions --

    def _climb(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._start_next(PhaseTrigger.ARRIVED, state, p)
        elif self.progress.is_late(state):
            p.add_finding("climb_timeout", "altitude not reached")

    def _start_next(self, cue: PhaseTrigger, state: FlightState, p: Proposal) -> None:
        """From rest at the target to what comes next; `cue` is that for a collision."""
        self._leave_out(state, p)
        waypoint = self.progress.waypoint
        if waypoint is not None:
            waypoint = waypoint_now(waypoint, self._walls)
        if waypoint is not None and waypoint.position is None:
            waits = f"waiting for the operator (Enter or SIGUSR1); landing after {waypoint.hold_s:g} s"
            self.progress.go(PhaseTrigger.NEXT_PAUSE, state, p, waits)
        elif waypoint is not None and waypoint.position is not None:
            self.progress.go(PhaseTrigger.NEXT_WAYPOINT, state, p, waypoint.name)
            self._reached_us = None
            self._references.fly_to_waypoint(waypoint.position, waypoint.speed_m_s)
        elif self.progress.collision is not None:
            self.progress.go(cue, state, p)
            self._begin_transit(state, p)
        else:
            self.progress.go(PhaseTrigger.NEXT_GOAL, state, p)
            self._fly_to_goal()

    def _leave_out(self, state: FlightState, p: Proposal) -> None:
        """Pass over the legs that depend on a wall which was met, or was not."""
        while (leg := self.progress.waypoint or self.progress.collision) is not None:
            reason = why_left_out(leg, self._walls)
            if reason is None:
                return
            name = leg.name if isinstance(leg, Waypoint) else f"collision {leg.index}"
            p.outputs.append(ProbeEnd(state.now_us, f"{name} left out: {reason}"))
            if isinstance(leg, Waypoint):
                self.progress.stops += 1
            else:
                self.progress.index += 1

    def _fly_to_goal(self) -> None:
        """From rest, along the mission's trajectory where it has one."""
        written = self.mission.goal_trajectory
        if written is None or self.progress.collisions:
            self._references.fly_to(self.mission.goal.position_m)
        else:
            altitude_m = self._references.altitude_m
            self._references.follow_trajectory(Trajectory.from_mission(written, altitude_m))

    def _fly_to_waypoint(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self.progress.waypoint
        assert waypoint is not None
        self._lock.move_to(self.mission.transit_mode, state, p)
        if self._reached_us is None and self._has_arrived(state):
            self._reached_us = state.now_us
        if self._reached_us is None:
            if self.progress.is_late(state, self._references.duration_s):
                p.add_finding("transit_timeout", f"{waypoint.name} not reached")
        elif state.now_us - self._reached_us >= waypoint.hold_s * 1e6:
            self.progress.stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _pause(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        waypoint = self.progress.waypoint
        assert waypoint is not None
        self._lock.move_to(self.mission.transit_mode, state, p)
        if self.progress.takes_longer_than(waypoint.hold_s, state):
            p.add_finding("pause_timeout", f"operator did not resume within {waypoint.hold_s:g} s")

    def _on_operator_continue(self, state: FlightState, p: Proposal) -> None:
        """The operator says to go on; where nothing waits for that, it means nothing."""
        if self.progress.phase is Phase.PAUSE:
            self.progress.stops += 1
            self._start_next(PhaseTrigger.NEXT_COLLISION, state, p)

    def _begin_transit(self, state: FlightState, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        if collision.wall.sought or collision.probe is not None or self._anchors is not None:
            self._plan_approach_now(collision, state, p)
        self._references.fly_to(self._approaches[collision.index].begin[:2])

    def _plan_approach_now(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        """The approach to a wall as it is known by now; a probe that begins at a place keeps its line."""
        if collision.trajectory is not None:
            return
        then_us = state.now_us + _RUN_UP_US
        here = self._references.target[:2]
        known = collision_now(collision, self._walls, then_us, here)
        self.progress.collisions[self.progress.index] = known
        if collision.probe is not None and not collision.probe.from_here:
            return
        try:
            mission = mission_now(self.mission, self._walls, then_us, here)
            self._approaches[collision.index] = plan_approach(mission, known)
        except NoApproachError as error:
            p.add_finding("no_approach", str(error))

    def _transit(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._set_off(state, p)
        elif self.progress.is_late(state, self._references.duration_s):
            p.add_finding("transit_timeout", "run-up point not reached")

    def _set_off(self, state: FlightState, p: Proposal) -> None:
        """At the run-up point: the lock first, where there is one."""
        collision = self.progress.collision
        assert collision is not None
        if self.mission.vehicle.has_lock:
            self.progress.go(PhaseTrigger.ARRIVED, state, p)
        else:
            self.progress.go(PhaseTrigger.NO_LOCK, state, p)
            self._begin_approach(collision)

    def _has_arrived(self, state: FlightState) -> bool:
        return self._references.has_arrived(state, self._setpoints.wanted_yaw(state))

    def _prepare(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        lock = self.mission.vehicle.lock
        if self._lock.move_to(collision.mode, state, p):
            self.progress.go(PhaseTrigger.MODE_SETTLED, state, p)
            self._begin_approach(collision)
        elif lock is not None and self.progress.takes_longer_than(lock.timeout_s + 2.0, state):
            p.add_finding(
                "lock_not_ready", f"lock not {collision.mode.value} before collision {collision.index}"
            )

    def _begin_approach(self, collision: Collision) -> None:
        self._references.approach(self._approaches[collision.index])

    def _approach(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        collision = self.progress.collision
        assert collision is not None
        if not state.lock_is_in(collision.mode):
            p.add_finding("lock_not_settled", f"lock left {collision.mode.value} during the approach")
        if collision.probe is not None:
            if self.progress.takes_longer_than(self._references.impact_s + _NOTHING_MET_S, state):
                self._end_probe(collision, state, p)
            return
        since_s = self.progress.elapsed_us(state) * 1e-6 - self._references.impact_s
        # A trajectory may begin beside its wall, behind the plane.
        if since_s > -_NEAR_S or collision.trajectory is None:
            self._check_wall_met(collision, state, sensed, p)
        if since_s <= 0.0:  # no wall is late before its time
            return
        guard, impact = self.mission.vehicle.guard, collision.impact_point
        assert collision.approach_m_s is not None
        assert impact is not None
        wall = self._walls.wall_now(collision.wall, state.now_us)
        if since_s > late_s(guard, wall, impact, -collision.approach_m_s[0]):
            detail = f"wall {collision.wall.name} not met {since_s:.1f} s after the planned impact"
            p.add_finding("wall_not_met", detail)

    def _end_probe(self, collision: Collision, state: FlightState, p: Proposal) -> None:
        """At its end, and nothing was met."""
        p.outputs.append(ProbeEnd(state.now_us, f"nothing met on the probe for wall {collision.wall.name}"))
        self._references.hold(state.position)
        self._lock.contact_ends(state.now_us)
        self.progress.go(PhaseTrigger.NOT_MET, state, p)
        self.progress.index += 1

    def _check_wall_met(self, collision: Collision, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        wall, (x, y, _) = self._walls.wall_now(collision.wall, state.now_us), state.position
        overrun = -wall.signed_distance((x, y))
        if overrun <= 0.0:
            return
        guard = self.mission.vehicle.guard
        if overrun > overrun_m(guard, wall, (x, y)) and not sensed.in_contact:
            p.add_finding(
                "wall_not_met", f"flew {overrun:.2f} m past wall {collision.wall.name} without contact"
            )

    # -- impact --

    def _contact(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self.progress.takes_longer_than(2 * self.mission.vehicle.detection.peak_wait_s, state):
            p.add_finding("no_peak", "contact without a peak")

    # -- recovery and goal --

    def _recovery(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        following, stops = self.progress.collision, self.progress.waypoint is not None
        probe = self.progress.last_collision.probe
        rests = stops or probe is not None
        if self._lock.contact_end_us is not None:
            self._lock.move_to(self._mode_after(following, stops), state, p)
            if not rests:
                self._replan(following, state, sensed, p)
        timed_out = self.progress.takes_longer_than(self.mission.limits.collision_timeout_s, state)
        if rests or (following is not None and following.approach_m_s is not None):
            elapsed_us = self.progress.elapsed_us(state)
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
            wall = self._walls.wall_now(following.wall, state.now_us)
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
        """Ask for a trajectory once the contact is over, and follow it once it begins."""
        planning, hit = self._replanning, self.progress.last_collision
        square_us = state.now_us if following is None else self._setpoints.square_us(state)
        target = self._references.target
        coasts = self._setpoints.coasts(state)
        planning.request_once(hit, following, state, sensed, target, self._lock, p, square_us, coasts)
        if following is not None and following.approach_m_s is not None:
            approach = planning.approach(following, state.now_us, p)
            if approach is not None:
                self._approaches[following.index] = approach
        else:
            trajectory = planning.trajectory_due(state, p)
            if trajectory is not None:
                self._references.follow_trajectory(trajectory)
                self._least_miss_m = math.inf

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
            passed = rising and self.progress.takes_longer_than(after_s, state)
        if passed or timed_out:
            p.outputs.append(GoalPassed(state.now_us, self._least_miss_m, not passed))
            self._head_for_goal(state, miss)
            self.progress.go(PhaseTrigger.PASSED if passed else PhaseTrigger.TIMED_OUT, state, p)

    def _head_for_goal(self, state: FlightState, distance_m: float) -> None:
        """Hold the goal; where a step to it would be flown faster than a transit, make it a transit."""
        vehicle, goal = self.mission.vehicle, self.mission.goal.position_m
        if vehicle.px4.mpc_xy_p * distance_m > vehicle.flying.transit_speed_m_s:
            self._references.hold(state.position)
            self._references.fly_to(goal)
        else:
            self._references.hold(goal)

    def _goal(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        self._lock.move_to(self.mission.transit_mode, state, p)
        goal = self.mission.goal
        distance = distance2(state.position, goal.position_m)
        references = self._references
        underway = references.along_trajectory and not self.progress.takes_longer_than(
            references.duration_s, state
        )
        if distance > goal.capture_radius_m or underway:
            self._captured_us = None
            allowed_s = self._references.duration_s + goal.hold_s + self.mission.limits.collision_timeout_s
            if self.progress.takes_longer_than(allowed_s, state):
                p.add_finding("goal_not_reached", f"still {distance:.2f} m from the goal")
        elif self._captured_us is None:
            self._captured_us = state.now_us
        elif state.now_us - self._captured_us >= goal.hold_s * 1e6:
            self._ground.final_error_m = distance
            self.progress.go(PhaseTrigger.HELD, state, p)
