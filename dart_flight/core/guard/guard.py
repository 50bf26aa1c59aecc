"""The guard: sees the same state as the mission and disposes of what it proposes.

`review` is the last stage of every step. It judges the rules of `guard_rules` at every step; the executive
and the core report by name what only they can know (`latch`). An override latches, in the order release >
kill > land > hold > break off; from then on the mission's set-points and commands go nowhere and the guard
flies: it needs nothing of the executive.
"""

from __future__ import annotations

from dart_flight.config.mission import Mission
from dart_flight.core.guard.rules import RULES, RULES_BY_NAME, Action, Rule, in_scope
from dart_flight.core.guard.watch import STOP_TIME_S, View
from dart_flight.core.mission.phases import Phase
from dart_flight.core.sense.state import FlightState
from dart_flight.geometry import Vec3, norm
from dart_flight.samples import (
    FlightMode,
    GuardEvent,
    Input,
    LockCommand,
    MissionEnd,
    OdometrySample,
    Output,
    SetPoint,
    Silence,
    VehicleAction,
    VehicleCommand,
)

_HOLD_US = 3_000_000
_RETRY_US = 1_000_000
_DISARM_AFTER_US = 15_000_000  # PX4 disarms by itself after landing; the command is for when it does not
_LANDING_US = 60_000_000  # from 2 m at 0.7 m/s a landing takes 5 s


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
        # What is judged in which phase, sorted out once: this runs at every step of the flight.
        self._judged = {
            phase: [(r.action, r.cause, r.name) for r in rules if r.cause is not None and in_scope(r, phase)]
            for phase in Phase
        }
        self._view = View(mission)
        # A landing is waited for until the motors would have been stopped.
        self._landing_us = max(_LANDING_US, round(2e6 * (self._view.surely_down_s or 0.0)))
        self.action = Action.NONE
        self.reason: str | None = None
        self._rule: Rule | None = None
        self.end: MissionEnd | None = None
        self._since_us = 0
        self._asked_us: int | None = None
        self._hold: Vec3 | None = None
        self._yaw_ned = 0.0

    # -- latching --

    def latch(self, name: str, detail: str, state: FlightState, out: list[Output]) -> bool:
        """Overrule the mission from now on, by the rule of this name.

        A weaker action than the one in force changes nothing. Returns whether the rule is in the table: a
        rule that has been taken out of it does nothing.

        Raises:
            KeyError: there is no such rule, and never was.
        """
        rule = self._rules.get(name)
        if rule is None:
            assert name in RULES_BY_NAME, name
            return False
        if rule.action <= self.action:
            return True
        out.append(GuardEvent(state.now_us, rule.name, rule.action.name.lower(), detail))
        if rule.action is Action.GIVE_UP:
            return True  # the executive ends the mission: nothing has left the ground
        if rule.action is not Action.KILL or self.reason is None:  # the reason is what the landing began with
            self.reason = f"{rule.name}: {detail}" if detail else rule.name
        self.action, self._rule = rule.action, rule
        self._since_us = state.now_us
        self._asked_us = None
        self._hold = None
        return True

    def note_impact(self, t_us: int) -> None:
        """An impact: for a while the contact explains what estimator and altitude do."""
        self._view.impact_us = t_us

    @property
    def landing(self) -> bool:
        """Whether a landing has been asked for, by the mission or by the guard."""
        return self._view.land_asked

    # -- the last stage of every step --

    def review(self, item: Input, state: FlightState, phase: Phase, out: list[Output]) -> list[Output]:
        """Judge the step's proposals; returns what really goes out."""
        self._view.observe(item, state, phase, out)
        if phase is not Phase.DONE and self.end is None:
            self._judge(state, phase, out)
        if self.action is Action.NONE:
            self._remember(out)
            return out
        kept: list[Output] = [o for o in out if not isinstance(o, SetPoint | VehicleCommand | LockCommand)]
        if self.end is None:
            self._fly(item, state, kept)
        return kept

    def _judge(self, state: FlightState, phase: Phase, out: list[Output]) -> None:
        view = self._view
        for action, cause, name in self._judged[phase]:
            # A rule whose action is in force already has nothing to add.
            if action > self.action and (detail := cause(view)) is not None:
                self.latch(name, detail, state, out)

    def _remember(self, out: list[Output]) -> None:
        for one in out:
            if isinstance(one, SetPoint):
                self._yaw_ned = one.yaw_ned_rad
            elif isinstance(one, VehicleCommand) and one.action is VehicleAction.LAND:
                self._view.land_asked = True

    # -- flying --

    def _fly(self, item: Input, state: FlightState, out: list[Output]) -> None:
        if self.action is Action.RELEASE:
            out.append(Silence(state.now_us, self.reason or ""))
            outcome = "released" if self._rule is not None and self._rule.by_person else "aborted"
            self.end = MissionEnd(state.now_us, outcome, self.reason, None)
            return
        killed = self.action is Action.KILL
        down = not state.status.armed and (state.on_ground or killed or not self._view.was_offboard)
        if down or state.now_us - self._since_us > self._landing_us:
            self.end = MissionEnd(state.now_us, "aborted", self.reason, None)
            return
        if killed:
            self._ask(VehicleAction.KILL, state, out)
            return
        if self.action is Action.LAND:
            self._land(state, out)
            return
        if isinstance(item, OdometrySample) and state.frame is not None:
            if self._hold is None:
                self._hold = self._clear_of_walls(state)
            out.append(
                SetPoint(
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

    def _clear_of_walls(self, state: FlightState) -> Vec3:
        """The present place, moved away from walls to the retreat distance, at the mission's altitude."""
        x, y, z = state.position
        if self.action is Action.BREAK_OFF:
            for wall in self._mission.walls:
                distance = wall.signed_distance((x, y))
                nx, ny = wall.normal
                closing = max(0.0, -(state.velocity[0] * nx + state.velocity[1] * ny))
                # Keep the retreat distance, and brake harder than by holding still where it is approached.
                push = max(self._config.retreat_m - distance, STOP_TIME_S * closing)
                if (
                    wall.spans((x, y))
                    and -self._config.retreat_m < distance
                    and push > 0.0
                    and distance < 1.0
                ):
                    x, y = x + push * nx, y + push * ny
        return (x, y, max(z, min(self._mission.altitude_m, self._mission.bounds.z[1])))

    def _land(self, state: FlightState, out: list[Output]) -> None:
        self._view.land_asked = True
        if state.status.flight_mode is FlightMode.LAND:
            if state.on_ground and state.now_us - self._since_us > _DISARM_AFTER_US:
                self._ask(VehicleAction.DISARM, state, out)
            return
        self._ask(VehicleAction.LAND, state, out)

    def _ask(self, action: VehicleAction, state: FlightState, out: list[Output]) -> None:
        if self._asked_us is None or state.now_us - self._asked_us >= _RETRY_US:
            self._asked_us = state.now_us
            out.append(VehicleCommand(state.now_us, action))
