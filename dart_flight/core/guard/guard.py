"""The guard: sees the same state as the mission and disposes of what it proposes.

`review` is the last stage of every step. It judges the rules of `rules`, all of them every 20 ms and those
that name an input after it at once, and takes what the mission has found that only the mission can know. An
override latches, in the order release > kill > land > hold > break off; from then on the mission's setpoints
and commands go nowhere and the guard flies: it needs nothing of the mission.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2, Vec3, norm
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
    PosesWithheld,
    Setpoint,
    Silence,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.config.mission import Mission
from dart_flight.core.guard.flight_conditions import FlightConditions
from dart_flight.core.guard.rule import Cause, Rule, Scope, in_scope
from dart_flight.core.guard.rules import RULES, RULES_BY_NAME
from dart_flight.core.mission.phases import DOWN_US
from dart_flight.core.mission.position_loop import STOP_TIME_S
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.wall_uncertainty import early_m, position_margin_m
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

Causes = list[tuple[Rule, int, Cause]]  # with the rank of its action

_COMMANDS: Final = (Setpoint, VehicleCommand)
_COMMANDS_AND_LOCK: Final = (Setpoint, VehicleCommand, LockCommand)
_JUDGED_EVERY_US: Final = 20_000  # host time: at every tick, and where none comes in time
_HOLD_US: Final = 3_000_000
_RETRY_US: Final = 1_000_000
_STOPPED_M_S: Final = 0.3
_ELSEWHERE_M: Final = 0.3
# PX4 disarms by itself after landing; the command is for when it does not
_DISARM_AFTER_US: Final = 15_000_000
_UNSURE_US: Final = 15_000_000
_LANDING_US: Final = 60_000_000  # from 2 m at 0.7 m/s a landing takes 5 s


class _Judged(NamedTuple):
    """The rules that are judged in a phase: `all` of them at a tick, some `at_once` after another input."""

    all: Causes
    at_once: dict[type, Causes]


class Guard:
    """Rules and, once one has fired, the flying.

    Args:
        mission: bounds, limits, thresholds.
        rules: the table; another one only in tests.
    """

    def __init__(self, mission: Mission, rules: tuple[Rule, ...] = RULES) -> None:
        self._mission = mission
        self._config = mission.vehicle.guard
        self._rules = {rule.name: rule for rule in rules}
        self._judged = {phase: _judged_in(phase, rules) for phase in Phase}
        self._judged_us = 0  # when all were, host time
        self._watch = FlightConditions(mission)
        # A landing is waited for until the motors would have been stopped.
        self._landing_us = max(_LANDING_US, round(2e6 * (self._watch.surely_down_s or 0.0)))
        self.action = Override.NONE
        self.overrules = False  # a rule has fired: the mission is not heard any more
        self._rank = self.action.rank
        self.reason: str | None = None
        self._rule: Rule | None = None
        self._noted: set[str] = set()  # rules noted while an action as strong was in force
        self.end: MissionEnd | None = None
        self._since_us = 0
        self._asked_us: int | None = None
        self._down_us: int | None = None  # since when landed and disarmed
        self._hold: Vec3 | None = None
        self._held_impact: ImpactOnset | None = None  # that it keeps away from
        self._yaw_ned = 0.0
        self._altitude_m = mission.altitude_m

    # -- the last stage of every step --

    def review(
        self, item: Input, state: FlightState, sensed: Sensed, phase: Phase, proposal: Proposal
    ) -> list[Output]:
        """Judge a step's proposal.

        Args:
            item: the step's input, which has gone into `state`.
            state, sensed: what is known.
            phase: of the mission, after its proposal.
            proposal: what the mission wants.

        Returns:
            What really goes out. Once a rule has fired these are the guard's own commands.
        """
        self._watch.observe(item, state, sensed, phase)
        events: list[Output] = []
        if isinstance(item, PoseSample) and self._watch.poses is not None:
            wrong = self._watch.poses.withhold(phase)
            if wrong is not None:
                events.append(PosesWithheld(state.now_us, wrong))
        for finding in proposal.findings:
            self._fire(finding.rule, finding.detail, state, events, finding.note_only)
        if self.end is None:
            self._judge(item, state, phase, events)
        if not self.overrules:
            if proposal.altitude_m is not None:
                self._altitude_m = proposal.altitude_m
            outputs = proposal.outputs
            if not outputs:  # as of most inputs
                return events
            if self._watch.mode_change_unexplained:  # the vehicle may be a pilot's already
                outputs = [o for o in outputs if not isinstance(o, _COMMANDS)]
            self._remember(outputs)
            return outputs + events
        kept: list[Output] = [o for o in proposal.outputs if not isinstance(o, _COMMANDS_AND_LOCK)]
        kept += events
        if self.end is None and (self.action is Override.RELEASE or not self._watch.mode_change_unexplained):
            self._fly(item, state, kept)
        return kept

    @property
    def telemetry_late(self) -> bool:
        """Whether samples are old when they come."""
        return self._watch.streams.delay.late

    @property
    def landing(self) -> bool:
        """Whether a landing has been asked for, by the mission or by the guard."""
        return self._watch.land_asked

    def _judge(self, item: Input, state: FlightState, phase: Phase, events: list[Output]) -> None:
        judged = self._judged[phase]
        if isinstance(item, Tick) or state.host_us - self._judged_us > _JUDGED_EVERY_US:
            self._judged_us, due = state.host_us, judged.all
        else:
            due = judged.at_once.get(type(item), [])
        for rule, rank, cause in due:
            if rule.scope is Scope.GUIDED and self._watch.land_asked:
                continue  # a landing leaves the flight space downwards
            # A rule whose action is in force already has nothing to add but, some of them, what explains it.
            if rank > self._rank:
                detail = cause(self._watch)
                if detail is not None:
                    self._fire(rule.name, detail, state, events)
            elif rank == self._rank and rule.explains:
                self._explain(rule, cause(self._watch), state, events)
            elif rule.noted and self._may_note(rule):
                detail = cause(self._watch)
                if detail is not None:
                    self._noted.add(rule.name)
                    self._fire(rule.name, detail, state, events, noted=True)

    def _may_note(self, rule: Rule) -> bool:
        """Return whether a rule that changes no action should still be noted."""
        again = rule is self._rule or rule.name in self._noted
        return not again and not self._watch.status_unreliable

    def _explain(self, rule: Rule, detail: str | None, state: FlightState, events: list[Output]) -> None:
        """The cause of what is in force already shows: its rule is named, and is the reason from now on."""
        if detail is not None and self._rule is not None and self._rule.name in rule.explains:
            if rule.of_streams:
                detail += self._watch.circumstances
            events.append(GuardEvent(state.now_us, rule.name, rule.action, detail))
            self._rule, self.reason = rule, f"{rule.name}: {detail}"

    def _fire(
        self, name: str, detail: str, state: FlightState, events: list[Output], noted: bool = False
    ) -> None:
        """Overrule the mission from now on, by the rule of this name; a weaker action changes nothing.

        What is only `noted` goes into the log.

        Raises:
            KeyError: there is no such rule, and never was.
        """
        rule = self._rules.get(name)
        if rule is None:
            if name not in RULES_BY_NAME:
                raise KeyError(name)
            return  # taken out of this guard's table
        if noted:
            events.append(GuardEvent(state.now_us, rule.name, Override.NONE, detail))
            return
        if rule.action.rank <= self._rank or self.end is not None:
            return
        if rule.of_streams:
            detail += self._watch.circumstances
        events.append(GuardEvent(state.now_us, rule.name, rule.action, detail))
        if rule.action is Override.GIVE_UP:  # nothing has left the ground
            if state.status.armed:
                events.append(VehicleCommand(state.now_us, VehicleAction.DISARM))
            self.end = MissionEnd(state.now_us, Outcome.ABORTED, f"{rule.name}: {detail}", None)
            return
        if rule.action is not Override.KILL or self.reason is None:  # else it is what the landing began with
            self.reason = f"{rule.name}: {detail}" if detail else rule.name
        self.action, self._rule, self._rank = rule.action, rule, rule.action.rank
        self.overrules = True
        self._hold = None  # the new action chooses another place
        self._since_us = state.now_us
        self._asked_us = None

    def _remember(self, outputs: list[Output]) -> None:
        for one in outputs:
            if isinstance(one, Setpoint):
                self._yaw_ned = one.yaw_ned_rad
            elif isinstance(one, VehicleCommand) and one.action is VehicleAction.LAND:
                self._watch.land_asked = True

    # -- flying --

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
            self._ask(VehicleAction.KILL, state, out)
            return
        if self.action is Override.LAND:
            self._land(state, out)
            return
        if isinstance(item, OdometrySample) and state.frame is not None:
            impact = self._watch.impact
            again = impact is not self._held_impact  # hit again, it goes away from that
            # After a jump of the estimate, hold the place of the new estimate.
            jumped = bool(self._watch.estimator.jump) and "estimator_jump" in self._rules
            if self._hold is None or again or jumped or self._has_stopped_elsewhere(state, self._hold):
                self._hold, self._held_impact = self._clear_of_walls(state), impact
            out.append(
                Setpoint(
                    t_us=item.t_us,
                    trigger_received_us=item.received_us,
                    position_ned=state.frame.point_to_ned(self._hold),
                    yaw_ned_rad=self._yaw_ned,
                )
            )
        slow = norm(state.velocity) < 0.1
        elapsed = state.now_us - self._since_us
        if elapsed > _HOLD_US or (slow and elapsed > _HOLD_US // 2):
            self._land(state, out)

    def _has_stopped_elsewhere(self, state: FlightState, hold: Vec3) -> bool:
        """Whether it stands, well away from where it breaks off to, as a hit with much tilt sends it.

        It stays there: on the way back PX4's integral would lead it past, to the wall that it came from.
        """
        if self.action is not Override.BREAK_OFF or norm(state.velocity) > _STOPPED_M_S:
            return False
        return math.dist(state.position[:2], hold[:2]) > _ELSEWHERE_M

    def _is_down(self, state: FlightState, killed: bool) -> bool:
        """Whether the vehicle has landed and disarmed, and not another one that stands on the same link."""
        if state.status.armed or not (state.on_ground or killed or not self._watch.was_offboard):
            self._down_us = None
            return False
        if not self._watch.was_offboard:
            return True
        if self._down_us is None:
            self._down_us = state.now_us
        if self._watch.status_unreliable and state.now_us - self._since_us < _UNSURE_US:
            return False
        return state.now_us - self._down_us >= DOWN_US

    def _clear_of_walls(self, state: FlightState) -> Vec3:
        """The present place, moved away from walls to the retreat distance, at the mission's altitude.

        From the mission's walls, and from one that was felt where the mission has none.
        """
        x, y, z = state.position
        if self.action is Override.BREAK_OFF:
            x, y = self._clear_of_felt(x, y)
            for wall in self._mission.walls:
                distance = wall.signed_distance((x, y))
                away_m = self._config.retreat_m + position_margin_m(wall, (x, y))
                nx, ny = wall.normal
                closing = max(0.0, -(state.velocity[0] * nx + state.velocity[1] * ny))
                # Keep the retreat distance, and brake harder than by holding still where it is approached.
                push = max(away_m - distance, STOP_TIME_S * closing)
                if wall.spans((x, y)) and -away_m < distance and push > 0.0 and distance < 1.0:
                    x, y = x + push * nx, y + push * ny
        return (x, y, max(z, min(self._altitude_m, self._mission.bounds.z[1])))

    def _clear_of_felt(self, x: float, y: float) -> Vec2:
        impact = self._watch.impact
        if impact is None or not self._watch.just_after_impact:
            return x, y
        (px, py, _), (fx, fy, _) = impact.position_mission, impact.force_mission
        size, place = math.hypot(fx, fy), (px, py)
        known = any(
            wall.spans(place) and wall.signed_distance(place) <= early_m(self._config, wall, place)
            for wall in self._mission.walls
        )
        if known or size == 0.0:
            return x, y
        ux, uy = fx / size, fy / size
        push = max(0.0, self._config.retreat_m - ((x - px) * ux + (y - py) * uy))
        return x + push * ux, y + push * uy

    def _land(self, state: FlightState, out: list[Output]) -> None:
        self._watch.land_asked = True
        if state.status.flight_mode is FlightMode.LAND:
            if state.on_ground and state.now_us - self._since_us > _DISARM_AFTER_US:
                self._ask(VehicleAction.DISARM, state, out)
            return
        self._ask(VehicleAction.LAND, state, out)

    def _ask(self, action: VehicleAction, state: FlightState, out: list[Output]) -> None:
        if self._asked_us is None or state.now_us - self._asked_us >= _RETRY_US:
            self._asked_us = state.now_us
            out.append(VehicleCommand(state.now_us, action))


def _judged_in(phase: Phase, rules: tuple[Rule, ...]) -> _Judged:
    causes = [
        (rule, rule.action.rank, rule.judge.cause)
        for rule in rules
        if rule.judge.cause is not None and in_scope(rule, phase)
    ]
    kinds = {kind for rule, _, _ in causes for kind in rule.at_once}
    return _Judged(causes, {kind: [one for one in causes if kind in one[0].at_once] for kind in kinds})
