"""The guard: it observes the same state as the mission and can overrule the mission's proposal.

`review` is the last stage of every step. It evaluates all rules of `rules` every 20 ms. Some rules name
inputs, and are also evaluated immediately after these inputs. The guard also receives the findings of the
mission. An override latches: only a stronger action replaces it (release > kill > land > hold > break off).
From then on the mission's setpoints and commands are dropped and the guard flies without the mission.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3, norm
from dart_flight.base.records import (
    FlightMode,
    GuardEvent,
    ImpactOnset,
    Input,
    LockCommand,
    MissionEnd,
    OdometrySample,
    Outcome,
    Output,
    Override,
    Phase,
    PoseSample,
    Setpoint,
    Silence,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.config.mission import Mission
from dart_flight.core.guard.dead_reckoning import WRONG_RAD, horizontal_ned
from dart_flight.core.guard.flight_conditions import FlightConditions
from dart_flight.core.guard.rule import Cause, Rule, Scope, in_scope
from dart_flight.core.guard.rules import RULES, RULES_BY_NAME
from dart_flight.core.mission.phases import DOWN_US
from dart_flight.core.mission.position_loop import STOP_TIME_S
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.setpoints import BOTH, FreeAxes, Reference, SetpointTrigger, make_setpoint
from dart_flight.core.mission.wall_uncertainty import early_m, position_margin_m
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

Causes = list[tuple[Rule, int, Cause]]  # rule, rank of its action, cause function

_NO_CAUSES: Final[Causes] = []
_COMMANDS: Final = (Setpoint, VehicleCommand)
_COMMANDS_AND_LOCK: Final = (Setpoint, VehicleCommand, LockCommand)
_EVALUATION_US: Final = 20_000  # longest host time between two evaluations of all rules: the tick's period
_HOLD_US: Final = 3_000_000
_RETRY_US: Final = 1_000_000
_STOPPED_M_S: Final = 0.3
_ELSEWHERE_M: Final = 0.3
_MOST_M_S2: Final = 5.0  # acceleration limit while PX4's heading is wrong; corresponds to 27 degrees of tilt
# PX4 disarms by itself after landing; if PX4 has not disarmed after this time, the guard disarms.
_DISARM_AFTER_US: Final = 15_000_000
_UNSURE_US: Final = 15_000_000
_LANDING_US: Final = 60_000_000  # limit of a landing's duration; a landing from 2 m at 0.7 m/s takes 5 s


class _PhaseRules(NamedTuple):
    """The rules of a phase: `all` are evaluated at every tick, `at_once[T]` after each input of type T."""

    all: Causes
    at_once: dict[type, Causes]


class Guard:
    """Stage that evaluates the rules and, once a rule has fired, flies the vehicle."""

    def __init__(self, mission: Mission, rules: tuple[Rule, ...] = RULES) -> None:
        self._mission = mission
        self._config = mission.vehicle.guard
        self._rules = {rule.name: rule for rule in rules}
        self._rules_by_phase = {phase: _rules_in(phase, rules) for phase in Phase}
        self._evaluated_us = 0  # host time of the last complete evaluation
        self._flight = FlightConditions(mission)
        # A landing may take longer than the time after which the guard stops the motors.
        self._landing_us = max(_LANDING_US, round(2e6 * (self._flight.landing_timeout_s or 0.0)))
        self.action = Override.NONE
        self.overrules = False  # whether the guard, not the mission, flies
        self._rank = self.action.rank
        self.reason: str | None = None
        self._rule: Rule | None = None  # the rule in force
        self._cause = ""  # rule that gives the reason: the first that fired, or one that explains it
        self._noted: set[str] = set()  # rules recorded while an equally strong action was active
        self.end: MissionEnd | None = None
        self._since_us = 0
        self._sent_us: int | None = None
        self._down_us: int | None = None  # time at which the vehicle was first landed and disarmed
        self._hold: Vec3 | None = None
        self._held_impact: ImpactOnset | None = None  # newest impact; the guard keeps away from its wall
        self._yaw_ned = 0.0
        self._altitude_m = mission.altitude_m

    # -- the last stage of every step --

    def review(
        self, item: Input, state: FlightState, sensed: Sensed, phase: Phase, proposal: Proposal
    ) -> list[Output]:
        """Return the actual outputs of a step. Once a rule has fired, the commands are the guard's own.

        Args:
            item: the step's input, which has updated `state`.
            phase: phase of the mission after this step's proposal.
            proposal: the mission's proposal.
        """
        self._flight.observe(item, state, sensed, phase)
        events: list[Output] = []
        if type(item) is PoseSample and self._flight.poses is not None:
            withheld = self._flight.poses.withhold(phase, state.now_us)
            if withheld is not None:
                events.append(withheld)
        for finding in proposal.findings:
            self._fire(finding.rule, finding.detail, state, events, finding.note_only)
        if self.end is None:
            self._evaluate(item, state, phase, events)
        if not self.overrules:
            if proposal.altitude_m is not None:
                self._altitude_m = proposal.altitude_m
            outputs = proposal.outputs
            if not outputs:  # the usual case
                return events
            if self._flight.mode_change_unexplained:  # a pilot may already be flying
                outputs = [o for o in outputs if not isinstance(o, _COMMANDS)]
            self._track_outputs(outputs)
            return outputs + events
        kept: list[Output] = [o for o in proposal.outputs if not isinstance(o, _COMMANDS_AND_LOCK)]
        kept += events
        self._fly_override(item, state, kept)
        return kept

    def land_after_fault(self, item: Input, state: FlightState, detail: str) -> list[Output]:
        """Land after an exception in `review`; do not evaluate the rules, which may have raised it.

        If every step raises the exception, this method continues the landing. `detail` names the exception.
        """
        outputs: list[Output] = []
        self._fire("mission_fault", detail, state, outputs)
        self._fly_override(item, state, outputs)
        return outputs

    @property
    def telemetry_late(self) -> bool:
        return self._flight.streams.delay.late

    @property
    def landing(self) -> bool:
        """Whether the mission or the guard has requested a landing."""
        return self._flight.land_asked

    def _evaluate(self, item: Input, state: FlightState, phase: Phase, events: list[Output]) -> None:
        phase_rules = self._rules_by_phase[phase]
        if type(item) is Tick or state.host_us - self._evaluated_us > _EVALUATION_US:
            self._evaluated_us, due = state.host_us, phase_rules.all
        else:
            due = phase_rules.at_once.get(type(item), _NO_CAUSES)
        landing = self._flight.land_asked
        for rule, rank, cause in due:
            if landing and rule.scope is Scope.GUIDED:
                continue  # a landing vehicle leaves the flight space downwards
            # If a rule's action is already active, evaluate the rule only if it can explain the active rule.
            if rank > self._rank:
                detail = cause(self._flight)
                if detail is not None:
                    self._fire(rule.name, detail, state, events)
            elif rank == self._rank and rule.explains:
                self._apply_explanation(rule, cause(self._flight), state, events)
            elif rule.noted and self._should_record(rule):
                detail = cause(self._flight)
                if detail is not None:
                    self._noted.add(rule.name)
                    self._fire(rule.name, detail, state, events, noted=True)

    def _should_record(self, rule: Rule) -> bool:
        """Return whether to record a rule that does not change the guard's action."""
        again = rule is self._rule or rule.name in self._noted
        return not again and not self._flight.status_unreliable

    def _apply_explanation(
        self, rule: Rule, detail: str | None, state: FlightState, events: list[Output]
    ) -> None:
        """If `rule` explains the rule that gave the reason, replace that rule by `rule` and its `detail`."""
        if detail is not None and self._cause in rule.explains:
            if rule.of_streams:
                detail += self._flight.circumstances
            events.append(GuardEvent(state.now_us, rule.name, rule.action, detail))
            self._rule = rule
            self._apply_reason(rule, detail)

    def _apply_reason(self, rule: Rule, detail: str) -> None:
        """Make `rule` the reason if there is no reason yet, or if `rule` explains the current reason.

        A release always becomes the reason, because it ends the program's control.
        """
        if not self._cause or self._cause in rule.explains or rule.action is Override.RELEASE:
            self._cause = rule.name
            self.reason = f"{rule.name}: {detail}" if detail else rule.name

    def _fire(
        self, name: str, detail: str, state: FlightState, events: list[Output], noted: bool = False
    ) -> None:
        """Overrule the mission from now on.

        If an action at least as strong is already active, nothing changes. If `noted`, only log the rule.
        """
        rule = self._rules.get(name)
        if rule is None:
            if name not in RULES_BY_NAME:
                raise KeyError(name)
            return  # a test has left this rule out of the table
        if noted:
            events.append(GuardEvent(state.now_us, rule.name, Override.NONE, detail))
            return
        if rule.action.rank <= self._rank or self.end is not None:
            return
        if rule.of_streams:
            detail += self._flight.circumstances
        events.append(GuardEvent(state.now_us, rule.name, rule.action, detail))
        if rule.action is Override.GIVE_UP:  # the vehicle is still on the ground
            if state.status.armed:
                events.append(VehicleCommand(state.now_us, VehicleAction.DISARM))
            self.end = MissionEnd(state.now_us, Outcome.ABORTED, f"{rule.name}: {detail}", None)
            return
        self._apply_reason(rule, detail)
        self.action, self._rule, self._rank = rule.action, rule, rule.action.rank
        self.overrules = True
        self._hold = None  # the new action selects another point
        self._since_us = state.now_us
        self._sent_us = None

    def _track_outputs(self, outputs: list[Output]) -> None:
        for one in outputs:
            if type(one) is Setpoint:
                self._yaw_ned = one.yaw_ned_rad
            elif type(one) is VehicleCommand and one.action is VehicleAction.LAND:
                self._flight.land_asked = True

    # -- flying --

    def _fly_override(self, item: Input, state: FlightState, out: list[Output]) -> None:
        released = self.action is Override.RELEASE
        if self.overrules and self.end is None and (released or not self._flight.mode_change_unexplained):
            self._fly(item, state, out)

    def _fly(self, item: Input, state: FlightState, out: list[Output]) -> None:
        if self.action is Override.RELEASE:
            out.append(Silence(state.now_us, self.reason or ""))
            by_person = self._rule is not None and self._rule.by_person
            outcome = Outcome.RELEASED if by_person else Outcome.ABORTED
            self.end = MissionEnd(state.now_us, outcome, self.reason, None)
            return
        killed = self.action is Override.KILL
        if self._is_down(state, killed) or state.now_us - self._since_us > self._landing_us:
            self.end = MissionEnd(state.now_us, Outcome.ABORTED, self.reason, None)
            return
        if killed:
            self._flight.kill_asked = True
            self._send_action(VehicleAction.KILL, state, out)
            return
        if self.action is Override.LAND:
            self._land(state, out)
            return
        if isinstance(item, OdometrySample) and state.frame is not None:
            impact = self._flight.impact
            again = impact is not self._held_impact  # a new impact moves the point to hold off the wall
            # After a jump in the estimate, hold position at the new estimate.
            jumped = bool(self._flight.estimator.jump) and "estimator_jump" in self._rules
            if self._hold is None or again or jumped or self._has_stopped_elsewhere(state, self._hold):
                self._hold, self._held_impact = self._hold_point(state), impact
            out.append(self._hold_setpoint(item, state, state.frame, self._hold))
        slow = norm(self._motion(state)[1]) < 0.1 and self._flight.estimator.resets.reckoned is None
        elapsed = state.now_us - self._since_us
        if elapsed > _HOLD_US or (slow and elapsed > _HOLD_US // 2):
            self._land(state, out)

    def _hold_setpoint(
        self, item: OdometrySample, state: FlightState, frame: MissionFrame, hold: Vec3
    ) -> Setpoint:
        """Return the setpoint that holds the vehicle at the point `hold` and at its true heading.

        After a wrong reset of the heading, PX4's position and velocity are wrong, and PX4 rotates every
        horizontal acceleration by its heading error. Until PX4's estimate has recovered, the guard leaves the
        axes free and commands an acceleration towards `hold`, rotated back by the heading error.
        """
        resets, trigger = self._flight.estimator.resets, SetpointTrigger(item.t_us, item.received_us)
        error_rad, reckoned = resets.heading_error_rad, resets.reckoned
        if reckoned is None and abs(error_rad) <= WRONG_RAD:
            return make_setpoint(frame, trigger, Reference(hold), frame.yaw_from_ned(self._yaw_ned))
        position, velocity = self._motion(state)
        px4 = self._mission.vehicle.px4
        ax, ay = (
            px4.mpc_xy_vel_p_acc * (px4.mpc_xy_p * (to - at) - v)
            for to, at, v in zip(hold[:2], position[:2], velocity[:2], strict=True)
        )
        share = min(1.0, _MOST_M_S2 / max(math.hypot(ax, ay), _MOST_M_S2))
        lean = horizontal_ned(frame.vector_to_ned((share * ax, share * ay, 0.0)), error_rad)
        reference = Reference(hold, (0.0, 0.0, 0.0), frame.vector_from_ned(lean))
        free = FreeAxes(BOTH, state.position, state.velocity)
        return make_setpoint(frame, trigger, reference, frame.yaw_from_ned(self._yaw_ned + error_rad), free)

    def _motion(self, state: FlightState) -> tuple[Vec3, Vec3]:
        """Return position and velocity in the mission frame, by dead reckoning if PX4's are wrong."""
        reckoned, frame = self._flight.estimator.resets.reckoned, state.frame
        if reckoned is None or frame is None:
            return state.position, state.velocity
        return frame.point_from_ned(reckoned.position_ned), frame.vector_from_ned(reckoned.velocity_ned)

    def _has_stopped_elsewhere(self, state: FlightState, hold: Vec3) -> bool:
        """Return whether the vehicle, after a break-off, rests far from `hold`, for example after a tilt.

        The guard then holds position where the vehicle rests. On the way back to `hold`, PX4's integrator
        would push the vehicle past `hold`, towards the wall.
        """
        position, velocity = self._motion(state)
        if self.action is not Override.BREAK_OFF or norm(velocity) > _STOPPED_M_S:
            return False
        return math.dist(position[:2], hold[:2]) > _ELSEWHERE_M

    def _is_down(self, state: FlightState, killed: bool) -> bool:
        """Return whether this vehicle, not another one on the same link, has landed and disarmed."""
        if state.status.armed or not (state.on_ground or killed or not self._flight.was_offboard):
            self._down_us = None
            return False
        if not self._flight.was_offboard:
            return True
        if self._down_us is None:
            self._down_us = state.now_us
        if self._flight.status_unreliable and state.now_us - self._since_us < _UNSURE_US:
            return False
        return state.now_us - self._down_us >= DOWN_US

    def _hold_point(self, state: FlightState) -> Vec3:
        """Return the point to hold: the current position, at the mission's altitude.

        After a break-off, the point keeps the retreat distance from the mission's walls, and from an unknown
        wall that was just touched.
        """
        (x, y, z), velocity = self._motion(state)
        if self.action is Override.BREAK_OFF:
            x, y = self._clear_of_unknown_wall(x, y)
            for wall in self._mission.walls:
                distance = wall.signed_distance((x, y))
                away_m = self._config.retreat_m + position_margin_m(wall, (x, y))
                nx, ny = wall.normal
                closing = max(0.0, -(velocity[0] * nx + velocity[1] * ny))
                # Keep the retreat distance. A more distant point brakes an approaching vehicle harder.
                push = max(away_m - distance, STOP_TIME_S * closing)
                behind_m = min(away_m, wall.behind_m)
                if wall.spans((x, y)) and -behind_m < distance < 1.0 and push > 0.0:
                    x, y = x + push * nx, y + push * ny
        return (x, y, max(z, min(self._altitude_m, self._mission.bounds.z[1])))

    def _clear_of_unknown_wall(self, x: float, y: float) -> Vec2:
        impact = self._flight.impact
        if impact is None or not self._flight.just_after_impact:
            return x, y
        (px, py, _), (fx, fy, _) = impact.position_mission, impact.force_mission
        size, place = math.hypot(fx, fy), (px, py)
        known = any(
            wall.spans(place)
            and -wall.behind_m <= wall.signed_distance(place) <= early_m(self._config, wall, place)
            for wall in self._mission.walls
        )
        if known or size == 0.0:
            return x, y
        ux, uy = fx / size, fy / size
        push = max(0.0, self._config.retreat_m - ((x - px) * ux + (y - py) * uy))
        return x + push * ux, y + push * uy

    def _land(self, state: FlightState, out: list[Output]) -> None:
        self._flight.land_asked = True
        if state.status.flight_mode is FlightMode.LAND:
            if state.on_ground and state.now_us - self._since_us > _DISARM_AFTER_US:
                self._send_action(VehicleAction.DISARM, state, out)
            return
        self._send_action(VehicleAction.LAND, state, out)

    def _send_action(self, action: VehicleAction, state: FlightState, out: list[Output]) -> None:
        if self._sent_us is None or state.now_us - self._sent_us >= _RETRY_US:
            self._sent_us = state.now_us
            out.append(VehicleCommand(state.now_us, action))


def _rules_in(phase: Phase, rules: tuple[Rule, ...]) -> _PhaseRules:
    causes = [
        (rule, rule.action.rank, rule.condition.cause)
        for rule in rules
        if rule.condition.cause is not None and in_scope(rule, phase)
    ]
    kinds = {kind for rule, _, _ in causes for kind in rule.at_once}
    return _PhaseRules(causes, {kind: [one for one in causes if kind in one[0].at_once] for kind in kinds})
