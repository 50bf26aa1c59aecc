"""The guard: sees the same state as the mission and disposes of what it proposes.

`review` is the last stage of every step. An override latches, in the order release > land > hold > break
off; from then on the mission's set-points and commands go nowhere and the guard flies: it needs nothing of
the executive. Part of its rules are judged here at every step, others are reported by the executive through
`latch`, which knows the plan (wall not met, lock late).
"""

from __future__ import annotations

import math
from enum import IntEnum

from dart_flight.config.mission import Mission
from dart_flight.flight.phases import ALTITUDE_EXEMPT, ON_GROUND, Phase
from dart_flight.flight.state import FlightState
from dart_flight.geometry import Vec2, Vec3, norm
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
    StatusText,
    VehicleAction,
    VehicleCommand,
)

_STOP_TIME_S = 0.5  # PX4's position loop stops from a speed within about half a second of way
_SPEED_TOLERANCE = 1.1
_IMPACT_MEMORY_US = 2_000_000  # altitude may be off for this long after an impact
_HOLD_US = 3_000_000
_RETRY_US = 1_000_000
_FAILSAFE_WORDS = ("failsafe",)
_RELEASED_BY_A_PERSON = ("pilot", "operator")
_FAILSAFE_MEMORY_US = 3_000_000


class Action(IntEnum):
    """What an override does; a higher one replaces a lower one."""

    NONE = 0
    BREAK_OFF = 1  # away from the wall, hold, land
    HOLD = 2  # stop here, then land
    LAND = 3
    RELEASE = 4  # silence: somebody else flies


class Guard:
    """Rules and, once one has fired, the flying."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._config = mission.vehicle.guard
        self.action = Action.NONE
        self.reason: str | None = None
        self._rule = ""
        self.end: MissionEnd | None = None
        self._since_us = 0
        self._asked_us: int | None = None
        self._hold: Vec3 | None = None
        self._yaw_ned = 0.0
        self._was_offboard = False
        self._land_asked = False
        self._impact_us: int | None = None
        self._failsafe_us: int | None = None
        self._bounded = False

    # -- latching --

    def latch(self, action: Action, rule: str, detail: str, state: FlightState, out: list[Output]) -> None:
        """Overrule the mission from now on; a weaker action than the one in force changes nothing."""
        if action <= self.action:
            return
        self.action, self._rule = action, rule
        self.reason = f"{rule}: {detail}" if detail else rule
        self._since_us = state.now_us
        self._asked_us = None
        self._hold = None
        out.append(GuardEvent(state.now_us, rule, action.name.lower(), detail))

    def note_impact(self, t_us: int) -> None:
        """An impact: for a while the altitude may be off by what the vertical contact force does."""
        self._impact_us = t_us

    # -- the last stage of every step --

    def review(self, item: Input, state: FlightState, phase: Phase, out: list[Output]) -> list[Output]:
        """Judge the step's proposals; returns what really goes out."""
        if isinstance(item, StatusText) and any(w in item.text.lower() for w in _FAILSAFE_WORDS):
            self._failsafe_us = state.now_us
        if phase is not Phase.DONE and self.end is None:
            self._judge(state, phase, out)
        if self.action is Action.NONE:
            self._remember(out)
            return out
        kept: list[Output] = [o for o in out if not isinstance(o, SetPoint | VehicleCommand | LockCommand)]
        if self.end is None:
            self._fly(item, state, kept)
        return kept

    def _remember(self, out: list[Output]) -> None:
        for one in out:
            if isinstance(one, SetPoint):
                self._yaw_ned = one.yaw_ned_rad
            elif isinstance(one, VehicleCommand) and one.action is VehicleAction.LAND:
                self._land_asked = True

    # -- rules --

    def _judge(self, state: FlightState, phase: Phase, out: list[Output]) -> None:
        self._judge_mode(state, out)
        if phase in ON_GROUND:
            return
        self._judge_streams(state, out)
        if phase is Phase.OVERRULED or phase is Phase.LANDING:
            return
        self._judge_space(state, phase, out)
        speed = norm(state.velocity)
        if speed > self._mission.limits.speed_m_s * _SPEED_TOLERANCE:
            self.latch(Action.HOLD, "speed", f"{speed:.2f} m/s", state, out)
        if state.tilt_rad > math.radians(self._config.tilt_deg):
            self.latch(Action.LAND, "tilt", f"{math.degrees(state.tilt_rad):.0f} deg", state, out)

    def _judge_mode(self, state: FlightState, out: list[Output]) -> None:
        mode = state.status.flight_mode
        if mode is FlightMode.OFFBOARD:
            self._was_offboard = True
            return
        if not self._was_offboard or mode is FlightMode.UNKNOWN:
            return
        if self._land_asked and (mode is FlightMode.LAND or state.on_ground):
            return
        self._was_offboard = False
        failsafe = self._failsafe_us is not None and state.now_us - self._failsafe_us < _FAILSAFE_MEMORY_US
        rule = "px4_failsafe" if failsafe else "pilot"
        self.latch(Action.RELEASE, rule, f"PX4 is in {mode.value}", state, out)

    def _judge_streams(self, state: FlightState, out: list[Output]) -> None:
        limit = self._config.stream_timeout_s * 1e6
        for name, sample in (
            ("imu", state.imu),
            ("attitude", state.attitude),
            ("odometry", state.odometry),
        ):
            age = state.age_us(sample)
            if age > limit:
                self.latch(Action.LAND, f"{name}_silent", f"for {age * 1e-3:.0f} ms", state, out)
        age = state.host_us - state.status.received_us
        if age > self._config.status_timeout_s * 1e6:
            self.latch(Action.LAND, "status_silent", f"for {age * 1e-6:.1f} s", state, out)

    def _judge_space(self, state: FlightState, phase: Phase, out: list[Output]) -> None:
        bounds = self._mission.bounds
        excess = bounds.excess2(state.position)
        if excess <= 0.0 and not self._bounded:
            self._bounded = True
        if excess > 0.0:
            self.latch(Action.HOLD, "bounds", f"{excess:.2f} m outside", state, out)
        elif self._bounded:
            excess = bounds.excess2(self._stop_point(state))
            if excess > 0.0:
                self.latch(Action.HOLD, "bounds", f"would stop {excess:.2f} m outside", state, out)
        if phase in ALTITUDE_EXEMPT:
            return
        shaken = self._impact_us is not None and state.now_us - self._impact_us < _IMPACT_MEMORY_US
        tolerance = self._config.altitude_tolerance_m if shaken else 0.05
        z = state.position[2]
        if not bounds.z[0] - tolerance <= z <= bounds.z[1] + tolerance:
            self.latch(Action.LAND, "altitude", f"{z:.2f} m", state, out)

    def _stop_point(self, state: FlightState) -> Vec2:
        """Where the vehicle would stop if told so now; a wall in the way stops it earlier."""
        x, y = state.position[0], state.position[1]
        dx, dy = _STOP_TIME_S * state.velocity[0], _STOP_TIME_S * state.velocity[1]
        share = 1.0
        for wall in self._mission.walls:
            here = wall.signed_distance((x, y))
            there = wall.signed_distance((x + dx, y + dy))
            if here > there and there < 0.0 and here > -0.3 and wall.spans((x, y)):
                share = min(share, max(0.0, here / (here - there)))
        return (x + share * dx, y + share * dy)

    # -- flying --

    def _fly(self, item: Input, state: FlightState, out: list[Output]) -> None:
        if self.action is Action.RELEASE:
            out.append(Silence(state.now_us, self.reason or ""))
            outcome = "released" if self._rule in _RELEASED_BY_A_PERSON else "aborted"
            self.end = MissionEnd(state.now_us, outcome, self.reason, None)
            return
        if not state.status.armed and (state.on_ground or not self._was_offboard):
            self.end = MissionEnd(state.now_us, "aborted", self.reason, None)
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
                push = max(self._config.retreat_m - distance, _STOP_TIME_S * closing)
                if (
                    wall.spans((x, y))
                    and -self._config.retreat_m < distance
                    and push > 0.0
                    and distance < 1.0
                ):
                    x, y = x + push * nx, y + push * ny
        return (x, y, max(z, min(self._mission.altitude_m, self._mission.bounds.z[1])))

    def _land(self, state: FlightState, out: list[Output]) -> None:
        self._land_asked = True
        if state.status.flight_mode is FlightMode.LAND:
            if state.on_ground and state.now_us - self._since_us > 15_000_000:
                self._ask(VehicleAction.DISARM, state, out)
            return
        self._ask(VehicleAction.LAND, state, out)

    def _ask(self, action: VehicleAction, state: FlightState, out: list[Output]) -> None:
        if self._asked_us is None or state.now_us - self._asked_us >= _RETRY_US:
            self._asked_us = state.now_us
            out.append(VehicleCommand(state.now_us, action))
