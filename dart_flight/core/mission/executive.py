"""The mission executive: walks through the phases, proposes set-points, decides when the lock may move.

It proposes; `guard` disposes. Everything it needs comes in as state and events, everything it wants goes out
as records. It changes phase only through the table in `phases`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from dart_flight.config.mission import Collision, Mission
from dart_flight.core.guard.guard import Guard
from dart_flight.core.mission.approach import (
    Approach,
    ReferencePoint,
    Transit,
    plan_approach,
    stop_before,
    transit_to,
)
from dart_flight.core.mission.phases import TRANSITIONS, WATCHING, Event, Phase
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S, least_distance_m
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.sense.detector import ImpactDetector
from dart_flight.core.sense.state import FlightState
from dart_flight.geometry import Vec2, Vec3, distance2, norm, wrap_angle
from dart_flight.samples import (
    ContactEnd,
    GoalPassed,
    ImpactOnset,
    ImpactPeak,
    Input,
    LockCommand,
    LockPermission,
    LockPhase,
    MissionEnd,
    Mode,
    OdometrySample,
    Output,
    PhaseChange,
    SetPoint,
    VehicleAction,
    VehicleCommand,
)

_RETRY_US = 1_000_000  # telemetry of mode and arming lags by up to a second
# Of the prediction "holding still stops short of the wall"; small, because breaking off brakes harder.
_STOP_MARGIN_M = 0.02
_PASSED_RISE_M = 0.03  # the distance to the goal has risen by more than its noise
_PASSED_AFTER_US = 250_000  # the first moments after a contact do not yet show where it leads
_REST_TIMEOUT_US = 4_000_000


class Executive:
    """Phases, references and lock commands of one mission."""

    def __init__(self, mission: Mission, detector: ImpactDetector, guard: Guard) -> None:
        self.mission = mission
        self.phase = Phase.READYING
        self.collision_index = 0  # of the collision that comes next or is under way
        self.outcome: MissionEnd | None = None
        self._detector, self._guard = detector, guard
        self._approaches: dict[int, Approach] = {
            c.index: plan_approach(mission, c) for c in mission.collisions if c.approach_m_s is not None
        }
        self._entered_us: int | None = None
        self._asked_us: int | None = None  # last time a vehicle command was sent
        self._transit: Transit | None = None
        self._approach: Approach | None = None
        self._target: Vec3 = (0.0, 0.0, 0.0)
        self._yaw = 0.0
        self._yaw_us = 0
        self._arrived_us: int | None = None
        self._contact_end_us: int | None = None
        self._impact_us: int | None = None
        self._permitted: bool | None = None
        self._locked_for: Mode | None = None
        self._least_miss_m = math.inf
        self._captured_us: int | None = None
        self._final_error_m: float | None = None
        self._steps: dict[Phase, Callable[[FlightState, list[Output]], None]] = {
            Phase.READYING: self._readying,
            Phase.OFFBOARD: self._offboard,
            Phase.ARMING: self._arming,
            Phase.CLIMB: self._climb,
            Phase.TRANSIT: self._fly_transit,
            Phase.PREPARE: self._prepare,
            Phase.APPROACH: self._fly_approach,
            Phase.CONTACT: self._contact,
            Phase.RECOVERY: self._recovery,
            Phase.GOAL: self._goal,
            Phase.LANDING: self._landing,
        }

    # -- what others ask --

    @property
    def collision(self) -> Collision | None:
        """The collision that comes next or is under way."""
        collisions = self.mission.collisions
        return collisions[self.collision_index] if self.collision_index < len(collisions) else None

    # -- stepping --

    def step(
        self,
        item: Input,
        state: FlightState,
        events: list[ImpactOnset | ImpactPeak | ContactEnd],
        out: list[Output],
    ) -> None:
        """Take an input that has gone into `state`, and the detector's events; append proposals to `out`."""
        if self._entered_us is None:
            if not state.now_us:
                return
            self._entered_us = state.now_us
        for event in events:
            if isinstance(event, ImpactOnset):
                self._on_onset(event, state, out)
            elif isinstance(event, ImpactPeak):
                self._on_peak(event, state, out)
            else:
                self._contact_end_us = event.t_us
        self._permit(state, out)
        step = self._steps.get(self.phase)
        if step is not None:
            step(state, out)
        self._watch()
        if isinstance(item, OdometrySample):
            self._send_reference(item, state, out)

    def overrule(self, state: FlightState, out: list[Output], reason: str) -> None:
        """The guard has taken over; called at every step from then on."""
        if self.phase not in (Phase.DONE, Phase.OVERRULED):
            self._go(Event.OVERRULE, state, out, reason)
        # A wall met while the guard holds or backs off is an impact, the ground at the end is none.
        if self._guard.landing:
            self._detector.watching = False

    def finish(self, state: FlightState, out: list[Output], end: MissionEnd) -> None:
        """The flight is over."""
        if self.phase is Phase.OVERRULED:
            self._go(Event.LANDED, state, out, end.outcome)
        self.outcome = end
        out.append(end)

    def _go(self, event: Event, state: FlightState, out: list[Output], reason: str | None = None) -> None:
        before = self.phase
        self.phase = TRANSITIONS[before, event]
        self._entered_us = state.now_us
        self._asked_us = None
        self._arrived_us = None
        collision = self.collision
        out.append(
            PhaseChange(
                t_us=state.now_us,
                before=before.value,
                after=self.phase.value,
                reason=reason or event.value,
                collision=collision.index if collision and self.phase in WATCHING else None,
            )
        )

    def _elapsed_us(self, state: FlightState) -> int:
        assert self._entered_us is not None
        return state.now_us - self._entered_us

    def _watch(self) -> None:
        self._detector.watching = self.phase in WATCHING
        collision = self.collision
        expected = collision is not None and (
            self.phase in (Phase.APPROACH, Phase.CONTACT)
            or (self.phase is Phase.RECOVERY and collision.approach_m_s is None)
        )
        self._detector.expected_normal = collision.wall.normal if collision and expected else None
        self._detector.expected_material = collision.wall.material if collision and expected else None

    def _ask(self, action: VehicleAction, state: FlightState, out: list[Output]) -> None:
        """Send a vehicle command, again every second until telemetry confirms it."""
        if self._asked_us is None or state.now_us - self._asked_us >= _RETRY_US:
            self._asked_us = state.now_us
            out.append(VehicleCommand(state.now_us, action))

    def _give_up_after(self, state: FlightState, out: list[Output], rule: str, what: str) -> None:
        over = self._elapsed_us(state) > self.mission.vehicle.flying.ready_timeout_s * 1e6
        if over and self._guard.latch(rule, what, state, out):
            if state.status.armed:
                out.append(VehicleCommand(state.now_us, VehicleAction.DISARM))
            self._go(Event.GIVEN_UP, state, out, what)
            self.finish(state, out, MissionEnd(state.now_us, "aborted", f"{rule}: {what}", None))

    # -- lock --

    def _permit(self, state: FlightState, out: list[Output]) -> None:
        relaxed = (
            self._contact_end_us is not None
            and state.now_us - self._contact_end_us >= self.mission.vehicle.lock.relaxation_s * 1e6
        )
        permitted = not self._detector.in_contact and (self._impact_us is None or relaxed)
        if permitted != self._permitted:
            self._permitted = permitted
            out.append(LockPermission(state.now_us, permitted))

    def _lock_to(self, mode: Mode, state: FlightState, out: list[Output]) -> bool:
        """Move the lock where it is not there yet and may move; True once it is settled in `mode`."""
        if state.lock_is_in(mode):
            return True
        lock = state.lock
        moving = lock.phase is LockPhase.TRAVELLING and lock.mode is mode
        fresh = self._locked_for is not mode or self._asked_us is None
        stale = self._asked_us is not None and state.now_us - self._asked_us >= _RETRY_US
        if self._permitted and not moving and (fresh or stale):
            self._locked_for, self._asked_us = mode, state.now_us
            out.append(LockCommand(state.now_us, mode))
        return False

    # -- on the ground --

    def _readying(self, state: FlightState, out: list[Output]) -> None:
        ready = (
            state.imu is not None
            and state.attitude is not None
            and state.odometry is not None
            and state.status.local_position_ok
        )
        locked = self._lock_to(self.mission.transit_mode, state, out)
        if ready and locked:
            state.anchor()
            self._yaw, self._yaw_us = state.yaw, state.now_us
            self._target = (state.position[0], state.position[1], 0.0)
            self._go(Event.READY, state, out)
            return
        missing = [
            name
            for name, there in (
                ("imu", state.imu is not None),
                ("attitude", state.attitude is not None),
                ("odometry", state.odometry is not None),
                ("local position", state.status.local_position_ok),
                (f"lock {self.mission.transit_mode.value}", locked),
            )
            if not there
        ]
        self._give_up_after(state, out, "not_ready", "no " + ", no ".join(missing))

    def _offboard(self, state: FlightState, out: list[Output]) -> None:
        if state.in_offboard:
            self._go(Event.CONFIRMED, state, out)
            return
        # PX4 accepts offboard only with set-points already streaming.
        if self._elapsed_us(state) > 200_000:
            self._ask(VehicleAction.OFFBOARD, state, out)
        self._give_up_after(state, out, "offboard_refused", "PX4 refused offboard")

    def _arming(self, state: FlightState, out: list[Output]) -> None:
        if state.status.armed:
            flying = self.mission.vehicle.flying
            ground = self._target
            self._target = (ground[0], ground[1], self.mission.altitude_m)
            self._transit = Transit.between(
                ground, self._target, flying.climb_speed_m_s, flying.acceleration_m_s2
            )
            self._go(Event.CONFIRMED, state, out)
            return
        self._ask(VehicleAction.ARM, state, out)
        self._give_up_after(state, out, "arming_refused", "PX4 refused to arm")

    # -- between the collisions --

    def _climb(self, state: FlightState, out: list[Output]) -> None:
        if self._has_arrived(state):
            self._go(Event.ARRIVED, state, out)
            self._begin_transit(state)
        elif self._elapsed_us(state) > self.mission.vehicle.flying.ready_timeout_s * 1e6:
            self._guard.latch("climb_timeout", "altitude not reached", state, out)

    def _begin_transit(self, state: FlightState) -> None:
        collision = self.collision
        assert collision is not None
        self._approach = self._approaches[collision.index]
        begin = self._approach.begin
        target = (begin[0], begin[1], self.mission.altitude_m)
        self._transit = transit_to(self._target, target, self.mission.vehicle.flying)
        self._target = target

    def _fly_transit(self, state: FlightState, out: list[Output]) -> None:
        if self._has_arrived(state):
            self._go(Event.ARRIVED, state, out)
        elif self._elapsed_us(state) > self.mission.vehicle.flying.ready_timeout_s * 1e6:
            self._guard.latch("transit_timeout", "run-up point not reached", state, out)

    def _has_arrived(self, state: FlightState) -> bool:
        """At the target, slow, and heading as wanted, for the configured time."""
        flying = self.mission.vehicle.flying
        near = (
            math.dist(state.position, self._target) < flying.arrive_m
            and norm(state.velocity) < flying.arrive_speed_m_s
            and abs(wrap_angle(state.yaw - self._wanted_yaw(state))) < 0.05
        )
        if not near:
            self._arrived_us = None
            return False
        if self._arrived_us is None:
            self._arrived_us = state.now_us
        return state.now_us - self._arrived_us >= flying.arrive_s * 1e6

    def _prepare(self, state: FlightState, out: list[Output]) -> None:
        collision = self.collision
        assert collision is not None
        if self._lock_to(collision.mode, state, out):
            self._go(Event.MODE_SETTLED, state, out)
        elif self._elapsed_us(state) > (self.mission.vehicle.lock.timeout_s + 2.0) * 1e6:
            detail = f"lock not {collision.mode.value} before collision {collision.index}"
            self._guard.latch("lock_not_ready", detail, state, out)

    def _fly_approach(self, state: FlightState, out: list[Output]) -> None:
        collision, approach = self.collision, self._approach
        assert collision is not None
        assert approach is not None
        if self.mission.standoff_m is not None:
            self._rehearse_approach(approach, collision, state, out)
            return
        if not state.lock_is_in(collision.mode):
            detail = f"lock left {collision.mode.value} during the approach"
            self._guard.latch("lock_not_settled", detail, state, out)
        self._check_wall_met(collision, state, out)
        late = self._elapsed_us(state) * 1e-6 - approach.impact_s
        if late > self.mission.vehicle.guard.wall_late_s:
            detail = f"wall {collision.wall.name} not met {late:.1f} s after the planned impact"
            self._guard.latch("wall_not_met", detail, state, out)

    def _check_wall_met(self, collision: Collision, state: FlightState, out: list[Output]) -> None:
        overrun = -collision.wall.signed_distance(state.position)
        if overrun > self.mission.vehicle.guard.wall_overrun_m and not self._detector.in_contact:
            detail = f"{overrun:.2f} m behind wall {collision.wall.name} without a contact"
            self._guard.latch("wall_not_met", detail, state, out)

    # -- rehearsal: every contact replaced by stopping before the wall --

    def _rehearse_approach(
        self, approach: Approach, collision: Collision, state: FlightState, out: list[Output]
    ) -> None:
        """Along the approach, but from rest to rest, to a stop before the wall."""
        if self._target[:2] == approach.begin:
            stop = stop_before(self.mission, collision, approach.begin, approach.impact)
            self._fly_to(stop, min(approach.speed_m_s, self.mission.limits.speed_m_s))
        elif self._has_arrived(state):
            self._stand_off(state, out)
        elif self._elapsed_us(state) > self.mission.vehicle.flying.ready_timeout_s * 1e6:
            self._guard.latch("transit_timeout", "stand-off point not reached", state, out)

    def _stand_off(self, state: FlightState, out: list[Output]) -> None:
        """At rest before the wall: the next collision, or the goal, comes next."""
        self._contact_end_us = state.now_us
        self._transit = None
        if self.phase is Phase.APPROACH:
            self._go(Event.STOOD_OFF, state, out)
        self.collision_index += 1

    def _fly_to(self, point: Vec2, speed_m_s: float) -> None:
        target = (point[0], point[1], self.mission.altitude_m)
        self._transit = Transit.between(
            self._target, target, speed_m_s, self.mission.vehicle.flying.acceleration_m_s2
        )
        self._target = target

    def _rehearse_recovery(self, state: FlightState, out: list[Output]) -> None:
        """What the recovery would do, from rest to rest: on to the next wall, or to the goal."""
        following = self.collision
        locked = self._lock_to(following.mode if following else self.mission.transit_mode, state, out)
        if following is None:
            goal = self.mission.goal.position_m
            self._fly_to(goal, self.mission.vehicle.flying.transit_speed_m_s)
            self._captured_us = None
            self._go(Event.PASSED, state, out)
        elif following.approach_m_s is not None:
            self._go(Event.RESTED, state, out)
            self._begin_transit(state)
        elif self._transit is None:
            if locked:
                here = (state.position[0], state.position[1])
                self._entered_us = state.now_us
                foot = stop_before(self.mission, following, here, following.wall.foot(here))
                self._fly_to(foot, self.mission.vehicle.flying.transit_speed_m_s)
        elif self._has_arrived(state):
            self._stand_off(state, out)
        if self._elapsed_us(state) > self.mission.vehicle.flying.ready_timeout_s * 1e6:
            self._guard.latch("transit_timeout", "stand-off point not reached", state, out)

    # -- impact --

    def _on_onset(self, event: ImpactOnset, state: FlightState, out: list[Output]) -> None:
        self._impact_us, self._contact_end_us = event.t_us, None
        collision = self.collision
        planned = (
            collision is not None
            and self.mission.standoff_m is None
            and (
                self.phase is Phase.APPROACH
                or (self.phase is Phase.RECOVERY and collision.approach_m_s is None)
            )
        )
        if not planned or not event.planned or collision is None:
            force = math.hypot(event.force_mission[0], event.force_mission[1])
            detail = f"hit with {force:.0f} N in {self.phase.value}, no wall planned"
            self._guard.latch("unplanned_hit", detail, state, out)
            return
        distance = collision.wall.signed_distance(event.position_mission)
        if distance > self.mission.vehicle.guard.wall_early_m:
            detail = f"{distance:.2f} m before wall {collision.wall.name}"
            self._guard.latch("wall_met_early", detail, state, out)
            return
        if not state.lock_is_in(collision.mode):
            detail = f"contact with wall {collision.wall.name} while the lock is not {collision.mode.value}"
            self._guard.latch("lock_not_settled", detail, state, out)
            return
        self._go(Event.ONSET, state, out)

    def _contact(self, state: FlightState, out: list[Output]) -> None:
        if self._elapsed_us(state) > 2 * self.mission.vehicle.detection.peak_wait_s * 1e6:
            self._guard.latch("no_peak", "contact without a peak", state, out)

    def _on_peak(self, event: ImpactPeak, state: FlightState, out: list[Output]) -> None:
        collision = self.collision
        if self.phase is not Phase.CONTACT or collision is None:
            return
        self._target = recovery_point(
            event.position_mission,
            event.normal,
            event.normal_force_n,
            event.tangential_force_n,
            collision.alpha_normal_m_per_n,
            collision.alpha_tangential_m_per_n,
            self.mission.altitude_m,
        )
        out.append(self._setpoint(state, event.detected_us, event.received_us, self._target, recovery=True))
        force = math.hypot(event.normal_force_n, event.tangential_force_n)
        if force > self.mission.limits.peak_force_n:
            detail = f"{force:.0f} N at wall {collision.wall.name}"
            self._guard.latch("peak_force", detail, state, out)
        self._least_miss_m = math.inf
        self._go(Event.PEAK, state, out)
        self.collision_index += 1

    # -- recovery and goal --

    def _recovery(self, state: FlightState, out: list[Output]) -> None:
        if self.mission.standoff_m is not None:
            self._rehearse_recovery(state, out)
            return
        following = self.collision
        if self._contact_end_us is not None:
            self._lock_to(following.mode if following else self.mission.transit_mode, state, out)
        elapsed = self._elapsed_us(state)
        timeout = self.mission.limits.collision_timeout_s * 1e6
        if following is None:
            self._watch_goal(state, out, elapsed > timeout)
        elif following.approach_m_s is not None:
            slow = norm(state.velocity) < self.mission.vehicle.flying.arrive_speed_m_s
            if (slow and elapsed > 500_000) or elapsed > _REST_TIMEOUT_US:
                self._target = (state.position[0], state.position[1], self.mission.altitude_m)
                self._go(Event.RESTED, state, out)
                self._begin_transit(state)
        else:
            self._check_wall_met(following, state, out)
            self._check_lock_in_time(following, state, out)
            if elapsed > timeout:
                detail = f"wall {following.wall.name} not reached by the recovery"
                self._guard.latch("wall_not_met", detail, state, out)

    def _check_lock_in_time(self, following: Collision, state: FlightState, out: list[Output]) -> None:
        """Break off at the last moment at which holding still stops short of the wall."""
        if self._detector.in_contact or state.lock_is_in(following.mode):
            return
        n = following.wall.normal
        closing = -(state.velocity[0] * n[0] + state.velocity[1] * n[1])
        if closing <= 0.0:
            return
        distance = following.wall.signed_distance(state.position)
        nearest = least_distance_m(
            distance,
            closing,
            -(state.acceleration[0] * n[0] + state.acceleration[1] * n[1]),
            distance,
            self.mission.vehicle.px4,
        )
        if nearest < _STOP_MARGIN_M:
            detail = (
                f"lock {state.lock.phase.value}, not {following.mode.value}, {distance:.2f} m before wall "
                f"{following.wall.name} at {closing:.2f} m/s"
            )
            self._guard.latch("lock_late", detail, state, out)

    def _watch_goal(self, state: FlightState, out: list[Output], timed_out: bool) -> None:
        if self._contact_end_us is None and not timed_out:
            return
        miss = distance2(state.position, self.mission.goal.position_m)
        self._least_miss_m = min(self._least_miss_m, miss)
        rising = miss > self._least_miss_m + _PASSED_RISE_M and self._elapsed_us(state) > _PASSED_AFTER_US
        if rising or timed_out:
            out.append(GoalPassed(state.now_us, self._least_miss_m))
            self._head_for_goal(state, miss)
            self._captured_us = None
            self._go(Event.PASSED, state, out)

    def _head_for_goal(self, state: FlightState, distance_m: float) -> None:
        """Hold the goal; where a step to it would be flown faster than a transit, make it a transit."""
        vehicle, goal = self.mission.vehicle, self.mission.goal.position_m
        if vehicle.px4.mpc_xy_p * distance_m > vehicle.flying.transit_speed_m_s:
            self._target = (state.position[0], state.position[1], self.mission.altitude_m)
            self._fly_to(goal, vehicle.flying.transit_speed_m_s)
        else:
            self._transit = None
            self._target = (goal[0], goal[1], self.mission.altitude_m)

    def _goal(self, state: FlightState, out: list[Output]) -> None:
        self._lock_to(self.mission.transit_mode, state, out)
        goal = self.mission.goal
        distance = distance2(state.position, goal.position_m)
        if distance > goal.capture_radius_m:
            self._captured_us = None
            way_s = self._transit.duration_s if self._transit is not None else 0.0
            if (
                self._elapsed_us(state)
                > (way_s + goal.hold_s + self.mission.limits.collision_timeout_s) * 1e6
            ):
                detail = f"still {distance:.2f} m from the goal"
                self._guard.latch("goal_not_reached", detail, state, out)
        elif self._captured_us is None:
            self._captured_us = state.now_us
        elif state.now_us - self._captured_us >= goal.hold_s * 1e6:
            self._final_error_m = distance
            self._go(Event.HELD, state, out)

    def _landing(self, state: FlightState, out: list[Output]) -> None:
        if state.on_ground and not state.status.armed:
            self._go(Event.LANDED, state, out)
            self.finish(state, out, MissionEnd(state.now_us, "completed", None, self._final_error_m))
        elif state.on_ground and self._elapsed_us(state) > 8_000_000:
            self._ask(VehicleAction.DISARM, state, out)
        elif state.in_offboard or self._asked_us is None:
            self._ask(VehicleAction.LAND, state, out)

    # -- set-points --

    def _wanted_yaw(self, state: FlightState) -> float:
        collision = self.collision
        if collision is None or self.phase not in (Phase.TRANSIT, Phase.PREPARE, Phase.APPROACH):
            return self._yaw
        return collision.wall.parallel_yaw(state.yaw)

    def _slew_yaw(self, state: FlightState) -> None:
        wanted = self._wanted_yaw(state)
        most = math.radians(self.mission.vehicle.flying.yaw_rate_deg_s) * (state.now_us - self._yaw_us) * 1e-6
        self._yaw = wrap_angle(self._yaw + max(-most, min(most, wrap_angle(wanted - self._yaw))))
        self._yaw_us = state.now_us

    def _send_reference(self, sample: OdometrySample, state: FlightState, out: list[Output]) -> None:
        """One set-point for every odometry sample, as the phase wants it."""
        if state.frame is None or self._entered_us is None:
            return
        self._slew_yaw(state)
        t_s = (sample.t_us - self._entered_us) * 1e-6
        reference: ReferencePoint | None = None
        rehearsal = self.mission.standoff_m is not None
        on_rails = (Phase.CLIMB, Phase.TRANSIT, Phase.GOAL) if not rehearsal else tuple(Phase)
        if self.phase in on_rails and self._transit is not None and self.phase is not Phase.PREPARE:
            reference = self._transit.at(t_s)
        elif self.phase is Phase.APPROACH and self._approach is not None:
            reference = self._approach.at(t_s)
        elif self.phase in (Phase.OFFBOARD, Phase.ARMING, Phase.PREPARE, Phase.RECOVERY, Phase.GOAL):
            out.append(self._setpoint(state, sample.t_us, sample.received_us, self._target))
        if reference is not None:
            out.append(
                self._setpoint(
                    state, sample.t_us, sample.received_us, reference.position, reference=reference
                )
            )

    def _setpoint(
        self,
        state: FlightState,
        t_us: int,
        received_us: int,
        position: Vec3,
        reference: ReferencePoint | None = None,
        recovery: bool = False,
    ) -> SetPoint:
        assert state.frame is not None
        velocity = acceleration = None
        if reference is not None:
            velocity = state.frame.vector_to_ned(reference.velocity)
            b, v, a = self.mission.vehicle.airframe.drag_per_s, reference.velocity, reference.acceleration
            # Fed forward beside the acceleration: the drag that the reference will meet, and what PX4's D
            # term takes away again, so that no error builds up for the position loop to make up for.
            # The lead in time makes up for the attitude's lag, so that a wall is met at the planned velocity.
            d = 1.0 + self.mission.vehicle.px4.mpc_xy_vel_d_acc
            lead, j = ATTITUDE_LAG_S, reference.jerk
            acceleration = state.frame.vector_to_ned(
                (
                    (d + lead * b[0]) * a[0] + b[0] * v[0] + lead * j[0],
                    (d + lead * b[1]) * a[1] + b[1] * v[1] + lead * j[1],
                    a[2] + b[2] * v[2],
                )
            )
        return SetPoint(
            t_us=t_us,
            trigger_received_us=received_us,
            position_ned=state.frame.point_to_ned(position),
            yaw_ned_rad=state.frame.yaw_to_ned(self._yaw),
            velocity_ned=velocity,
            acceleration_ned=acceleration,
            recovery=recovery,
        )
