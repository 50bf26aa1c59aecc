"""A core fed by hand: no world, no clock, only samples."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dart_flight.base.geometry import Vec3, quaternion_from_euler
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    FlightMode,
    GuardEvent,
    ImuSample,
    Input,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    Output,
    StatusSample,
    Tick,
)
from dart_flight.config.mission import load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.guard.guard import Guard
from dart_flight.core.guard.rule import Rule
from dart_flight.core.guard.rules import RULES

ROOT = Path(__file__).parents[2]
HOVER = 0.5547  # command at which four motors of the configuration carry 1.3 kg


# Tests put the vehicle where they need it: only the rule about just that must not see it.
TELEPORTING = tuple(rule for rule in RULES if rule.name != "estimator_jump")


_APPROACHING: dict[str, HandFedCore | None] = {}
NOTHING_SET: Mapping[str, Any] = {}
IMPATIENT: Mapping[str, Any] = {"vehicle.flying.ready_timeout_s": 3.0}


class HandFedCore:
    """Feeds hovering telemetry at 250 Hz; position, velocity and force are set by the test.

    Args:
        mission: file.
        rules: of the guard.
        settings: keys of the mission that differ from the file, `vehicle.KEY` of its vehicle, as in
            `Mission.replace`.
    """

    def __init__(
        self,
        mission: str = "missions/paper_dual_collision.yaml",
        rules: tuple[Rule, ...] = TELEPORTING,
        settings: Mapping[str, Any] = NOTHING_SET,
    ) -> None:
        loaded = load_mission(ROOT / mission)
        self.core = FlightCore(loaded.replace(settings) if settings else loaded, rules)
        self.rules = rules
        self.noise_m_s2 = 1e-4  # a real IMU never repeats itself
        self.odometry_every = 2
        self.t_us = 10_000_000
        self.host_ahead_us = 0  # of the autopilot's clock
        self.position_ned: Vec3 = (0.0, 0.0, 0.0)
        self.velocity_ned: Vec3 = (0.0, 0.0, 0.0)
        self.force_ned: Vec3 = (0.0, 0.0, 0.0)
        self.q = quaternion_from_euler(0.0, 0.0, 0.0)
        self.status = StatusSample(self.t_us, self.t_us, local_position_ok=True, landed=LandedState.ON_GROUND)
        self.outputs: list[Output] = []
        self.seen: list[Input | Output] = []  # as a log has them
        self.silent: set[str] = set()
        self.motors = (HOVER,) * 4
        self.falling = False
        self.give(ClockOffset(self.t_us, 0))

    def give(self, item: Input) -> list[Output]:
        out = self.core.step(item)
        self.outputs += out
        self.seen += [item, *out]
        return out

    def run(self, seconds: float) -> list[Output]:
        """Telemetry for a while; returns what came out."""
        before = len(self.outputs)
        for _ in range(round(seconds / 0.004)):
            self.t_us += 4000
            t, host = self.t_us, self.t_us + self.host_ahead_us
            m = self.core.mission.vehicle.airframe.mass_kg
            if "attitude" not in self.silent:
                self.give(AttitudeSample(t, host, self.q))
            if "odometry" not in self.silent and (t // 4000) % self.odometry_every == 0:
                self.give(OdometrySample(t, host, self.position_ned, self.velocity_ned))
            if "actuator" not in self.silent:
                self.give(ActuatorSample(t, host, self.motors))
            if "imu" not in self.silent:
                f = self.force_ned
                noise = self.noise_m_s2 * ((t // 4000) % 2)
                lift = 0.0 if self.falling else 9.81
                self.give(ImuSample(t, host, (f[0] / m, f[1] / m, f[2] / m - lift + noise), (0.0, 0.0, 0.0)))
            if (t // 4000) % 5 == 0:
                self.give(Tick(host))
            if (t // 4000) % 50 == 0 and "status" not in self.silent:
                self.set_status()
        return self.outputs[before:]

    def pulse(self, peak_ned: tuple[float, float], seconds: float = 0.06) -> list[Output]:
        """A half-sine of force, as a contact gives."""
        out = []
        steps = round(seconds / 0.004)
        for i in range(1, steps):
            share = math.sin(math.pi * i / steps)
            self.force_ned = (peak_ned[0] * share, peak_ned[1] * share, 0.0)
            out += self.run(0.004)
        self.force_ned = (0.0, 0.0, 0.0)
        return out

    def at_the_wood(self) -> None:
        """Just before the wooden wall (mission (0.917, -1.1)) at the approach velocity; NED: y is west."""
        self.to_flight()
        self.position_ned = (0.917, 1.09, -1.0)
        self.velocity_ned = (0.5, 0.6, 0.0)
        self.run(0.05)

    def set_status(self, **changes: object) -> list[Output]:
        import msgspec

        received = self.t_us + self.host_ahead_us
        self.status = msgspec.structs.replace(self.status, t_us=self.t_us, received_us=received, **changes)
        return self.give(self.status)

    def set_lock(self, mode: Mode | None, phase: LockPhase = LockPhase.SETTLED) -> None:
        self.give(LockState(self.t_us, phase, mode))

    def to_climb(self) -> None:
        """Through the phases up to the climb."""
        self.set_lock(Mode.RIGID)
        self.run(0.5)
        self.set_status(flight_mode=FlightMode.OFFBOARD)
        self.run(0.1)
        self.set_status(armed=True)
        self.run(0.1)
        self.set_status(landed=LandedState.IN_AIR)

    def climbed(self) -> None:
        """Through the climb, to what the mission begins with: run-up, waypoint, pause, goal."""
        self.to_climb()
        self.position_ned = (0.0, 0.0, -1.0)
        self.run(0.5)

    def to_prepare(self) -> None:
        """Through the phases up to the run-up point, where the lock is to move."""
        self.climbed()
        self.run(0.5)  # arrived at the run-up

    def to_flight(self) -> None:
        """Through the phases up to the approach of the first collision.

        The first core of its kind flies there, under all rules of `TELEPORTING`. If none fires, those that
        follow, under the same rules or fewer, begin with a copy of it.
        """
        rules, first = self.rules, None
        if set(rules) <= set(TELEPORTING):
            first = self._first_of_its_kind()
        if first is None:
            self._approach()
            return
        shared = {id(one): one for one in (first.core.mission, *first.rules, *first.seen)}
        vars(self).update(vars(copy.deepcopy(first, shared)))
        self.judge_by(rules)

    def _first_of_its_kind(self) -> HandFedCore | None:
        told = {name: value for name, value in vars(self).items() if name not in ("core", "rules")}
        kind = f"{type(self)} {self.core.mission} {told}"
        if kind not in _APPROACHING:
            first = copy.deepcopy(self, {id(self.core.mission): self.core.mission})
            first.judge_by(TELEPORTING)
            first._approach()
            quiet = not any(isinstance(output, GuardEvent) for output in first.outputs)
            _APPROACHING[kind] = first if quiet else None
        return _APPROACHING[kind]

    def _approach(self) -> None:
        self.to_prepare()
        self.set_lock(Mode.FLEXIBLE)
        self.run(0.02)

    def break_mission(self) -> None:
        """From now on the mission code raises."""

        def raises() -> None:
            raise ZeroDivisionError("mission")

        def broken(*_: object) -> None:
            raises()

        self.core._executive.propose = broken  # type: ignore[method-assign, assignment]

    def hide_peaks(self) -> None:
        """From now on the detector sees no peak, however long it waits."""
        self.core._senses.detector._peak_is_past = lambda now_us: False  # type: ignore[method-assign]

    def judge_by(self, rules: tuple[Rule, ...]) -> None:
        """From now on the guard has these rules; what it has seen stays."""
        self.rules, guard, whole = rules, self.core._guard, Guard(self.core.mission, rules)
        guard._rules, guard._rules_by_phase = whole._rules, whole._rules_by_phase


@pytest.fixture
def hand_fed() -> HandFedCore:
    return HandFedCore()


@pytest.fixture
def impatient() -> HandFedCore:
    """A core that waits 3 s instead of 20 s for each phase."""
    return HandFedCore(settings=IMPATIENT)
