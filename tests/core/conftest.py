"""A core fed by hand: no world, no clock, only samples."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest

from dart_flight.base.geometry import MissionFrame, Vec3, quaternion_from_euler
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    EstimatorSample,
    FlightMode,
    GuardEvent,
    ImuSample,
    Input,
    LandedState,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    OperatorRequest,
    Output,
    Phase,
    Request,
    StatusSample,
    Tick,
    VehicleAction,
    VehicleCommand,
    WallEstimate,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.guard.flight_conditions import FlightConditions
from dart_flight.core.guard.guard import Guard
from dart_flight.core.guard.rule import Rule
from dart_flight.core.guard.rules import RULES
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.impact_response import ImpactResponse
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.detector import Event
from dart_flight.core.sense.senses import Sensed, Senses
from dart_flight.core.sense.state import FlightState

ROOT = Path(__file__).parents[2]
HOVER = 0.5547  # command at which four motors of the configuration carry 1.3 kg


# Tests teleport the vehicle, so the rule against position jumps is left out.
RULES_WITHOUT_JUMP = tuple(rule for rule in RULES if rule.name != "estimator_jump")


_CORES_IN_APPROACH: dict[str, HandFedCore | None] = {}
NO_SETTINGS: Mapping[str, Any] = {}
SHORT_TIMEOUTS: Mapping[str, Any] = {"vehicle.flying.ready_timeout_s": 3.0}
DUAL = "missions/paper_dual_collision.yaml"
SINGLE = "missions/paper_single_wall.yaml"
GPS = "missions/dual_collision_gps.yaml"

R = TypeVar("R")


def of_kind(kind: type[R], records: Iterable[object]) -> list[R]:
    """Return the records of a type."""
    return [record for record in records if isinstance(record, kind)]


def known(value: R | None) -> R:
    """Return a value that must not be None."""
    assert value is not None
    return value


class HandFedCore:
    """A core that receives hovering telemetry at 250 Hz; tests set position, velocity and force.

    Args:
        mission: mission file.
        rules: rules of the guard.
        settings: mission keys to replace, as in `Mission.replace`.
    """

    def __init__(
        self,
        mission: str = DUAL,
        rules: tuple[Rule, ...] = RULES_WITHOUT_JUMP,
        settings: Mapping[str, Any] = NO_SETTINGS,
    ) -> None:
        loaded = load_mission(ROOT / mission)
        self.core = FlightCore(loaded.replace(settings) if settings else loaded, rules)
        self.rules = rules
        self.noise_m_s2 = 1e-4  # a real IMU never repeats itself
        self.odometry_every = 2
        self.t_us = 10_000_000
        self.host_ahead_us = 0  # ahead of the autopilot's clock
        self.position_ned: Vec3 = (0.0, 0.0, 0.0)
        self.velocity_ned: Vec3 = (0.0, 0.0, 0.0)
        self.force_ned: Vec3 = (0.0, 0.0, 0.0)
        self.q = quaternion_from_euler(0.0, 0.0, 0.0)
        self.status = StatusSample(self.t_us, self.t_us, local_position_ok=True, landed=LandedState.ON_GROUND)
        self.outputs: list[Output] = []
        self.records: list[Input | Output] = []  # inputs and outputs in the order of a log
        self.silent: set[str] = set()
        self.motors = (HOVER,) * 4
        self.falling = False
        self.feed(ClockOffset(self.t_us, 0))

    def feed(self, item: Input) -> list[Output]:
        out = self.core.step(item)
        self.outputs += out
        self.records += [item, *out]
        return out

    def run(self, seconds: float) -> list[Output]:
        """Feed telemetry for `seconds`; return the outputs."""
        before = len(self.outputs)
        for _ in range(round(seconds / 0.004)):
            self.t_us += 4000
            t, host = self.t_us, self.t_us + self.host_ahead_us
            m = self.core.mission.vehicle.airframe.mass_kg
            if "attitude" not in self.silent:
                self.feed(AttitudeSample(t, host, self.q))
            if "odometry" not in self.silent and (t // 4000) % self.odometry_every == 0:
                self.feed(OdometrySample(t, host, self.position_ned, self.velocity_ned))
            if "actuator" not in self.silent:
                self.feed(ActuatorSample(t, host, self.motors))
            if "imu" not in self.silent:
                f = self.force_ned
                noise = self.noise_m_s2 * ((t // 4000) % 2)
                lift = 0.0 if self.falling else 9.81
                self.feed(ImuSample(t, host, (f[0] / m, f[1] / m, f[2] / m - lift + noise), (0.0, 0.0, 0.0)))
            if (t // 4000) % 5 == 0:
                self.feed(Tick(host))
            if (t // 4000) % 50 == 0 and "status" not in self.silent:
                self.set_status()
        return self.outputs[before:]

    def pulse(self, peak_ned: tuple[float, float], seconds: float = 0.06) -> list[Output]:
        """Apply a half-sine force, as a contact does; return the outputs."""
        out = []
        steps = round(seconds / 0.004)
        for i in range(1, steps):
            share = math.sin(math.pi * i / steps)
            self.force_ned = (peak_ned[0] * share, peak_ned[1] * share, 0.0)
            out += self.run(0.004)
        self.force_ned = (0.0, 0.0, 0.0)
        return out

    def fly_to_wood(self) -> None:
        """Pass through the phases up to the approach, to just before the wooden wall."""
        self.enter_approach()
        self.meet_wood()

    def meet_wood(self) -> None:
        """Fly to just before the wooden wall, at mission (0.917, -1.09), with the approach velocity."""
        self.position_ned = (0.917, 1.09, -1.0)
        self.velocity_ned = (0.5, 0.6, 0.0)
        self.run(0.05)

    def leave_single_wall(self) -> None:
        """Hit the wall of `SINGLE` at 1.65 m north, switch the lock, and move clear of the wall."""
        self.enter_approach()
        self.position_ned, self.velocity_ned = (1.6, -0.5, -1.0), (1.0, -0.5, 0.0)
        self.run(0.05)
        self.pulse((-20.0, 10.0))
        self.position_ned, self.velocity_ned = (1.0, -0.5, -1.0), (0.0, 0.0, 0.0)
        self.set_lock(Mode.RIGID)
        self.run(0.1)
        assert self.core.phase is Phase.RECOVERY

    def set_status(self, **changes: object) -> list[Output]:
        received = self.t_us + self.host_ahead_us
        self.status = msgspec.structs.replace(self.status, t_us=self.t_us, received_us=received, **changes)
        return self.feed(self.status)

    @property
    def fired(self) -> list[GuardEvent]:
        """Rules of the guard that have fired."""
        return of_kind(GuardEvent, self.outputs)

    @property
    def fired_rules(self) -> list[str]:
        """Names of the rules that have fired."""
        return [event.rule for event in self.fired]

    @property
    def fired_actions(self) -> list[tuple[str, str]]:
        """Names and actions of the rules that have fired."""
        return [(event.rule, event.action.value) for event in self.fired]

    @property
    def fired_details(self) -> list[tuple[str, str]]:
        """Names and details of the rules that have fired."""
        return [(event.rule, event.detail) for event in self.fired]

    @property
    def actions(self) -> list[VehicleAction]:
        """Commands sent to PX4."""
        return [command.action for command in of_kind(VehicleCommand, self.outputs)]

    def request(self, kind: Request, detail: str = "") -> list[Output]:
        """Let the operator, or the world, request something."""
        return self.feed(OperatorRequest(self.t_us, kind, detail))

    def set_lock(self, mode: Mode | None, phase: LockPhase = LockPhase.SETTLED) -> None:
        self.feed(LockState(self.t_us, phase, mode))

    def silence(self) -> None:
        """Stop all telemetry."""
        self.silent |= {"imu", "attitude", "odometry", "actuator", "status"}

    def reset_estimator(self) -> None:
        """Let PX4 report that it has reset its estimator."""
        for count in (3, 4):
            self.feed(EstimatorSample(self.t_us, self.t_us, reset_counter=count))

    def shift(self, north_m: float = 0.0, east_m: float = 0.0) -> None:
        """Displace the vehicle."""
        north, east, down = self.position_ned
        self.position_ned = (north + north_m, east + east_m, down)

    def land_with_low_battery(self) -> None:
        """Let the guard land because of the battery, and PX4 obey."""
        self.set_status(battery_v=12.9)
        self.run(1.2)
        self.set_status(flight_mode=FlightMode.LAND)

    # -- phases --

    def enter(self, phase: Phase) -> None:
        """Pass through the phases up to `phase`; `TRANSIT` stands for the first phase after the climb."""
        if phase is not Phase.READYING:
            {
                Phase.ARMING: self.enter_arming,
                Phase.CLIMB: self.enter_climb,
                Phase.TRANSIT: self.finish_climb,
                Phase.PREPARE: self.enter_prepare,
                Phase.APPROACH: self.enter_approach,
            }[phase]()

    def enter_arming(self) -> None:
        """Pass through the phases up to the request to arm."""
        self.set_lock(Mode.RIGID)
        self.run(0.5)
        self.set_status(flight_mode=FlightMode.OFFBOARD)
        self.run(0.1)

    def enter_climb(self) -> None:
        """Pass through the phases up to the climb."""
        self.enter_arming()
        self.set_status(armed=True)
        self.run(0.1)
        self.set_status(landed=LandedState.IN_AIR)

    def finish_climb(self) -> None:
        """Pass through the climb, to the first phase of the mission: run-up, waypoint, pause or goal."""
        self.enter_climb()
        self.position_ned = (0.0, 0.0, -1.0)
        self.run(0.5)

    def enter_prepare(self) -> None:
        """Pass through the phases up to the run-up point, where the lock moves."""
        self.finish_climb()
        self.run(0.5)  # arrived at the run-up

    def enter_approach(self) -> None:
        """Pass through the phases up to the approach of the first collision.

        Only the first core of each kind flies there, under `RULES_WITHOUT_JUMP`. If no rule fires, later
        cores with the same rules or fewer start from a copy of it.
        """
        rules, first = self.rules, None
        if set(rules) <= set(RULES_WITHOUT_JUMP):
            first = self._cached_core()
        if first is None:
            self._approach()
            return
        shared = {id(one): one for one in (first.core.mission, *first.rules, *first.records)}
        vars(self).update(vars(copy.deepcopy(first, shared)))
        self.use_rules(rules)

    def _cached_core(self) -> HandFedCore | None:
        attributes = {name: value for name, value in vars(self).items() if name not in ("core", "rules")}
        kind = f"{type(self)} {self.core.mission} {attributes}"
        if kind not in _CORES_IN_APPROACH:
            first = copy.deepcopy(self, {id(self.core.mission): self.core.mission})
            first.use_rules(RULES_WITHOUT_JUMP)
            first._approach()
            quiet = not any(isinstance(output, GuardEvent) for output in first.outputs)
            _CORES_IN_APPROACH[kind] = first if quiet else None
        return _CORES_IN_APPROACH[kind]

    def _approach(self) -> None:
        self.enter_prepare()
        self.set_lock(Mode.FLEXIBLE)
        self.run(0.02)

    # -- inside of the core --
    #
    # The core shows no part of itself; these are the only places that reach for one: a fault must be put
    # into a part, and a test of one part's timing looks at it in the middle of a flight.

    @property
    def guard(self) -> Guard:
        return self.core._guard

    @property
    def conditions(self) -> FlightConditions:
        """What the guard has observed."""
        return self.core._guard._flight

    @property
    def senses(self) -> Senses:
        return self.core._senses

    @property
    def progress(self) -> MissionProgress:
        return self.core._executive.progress

    def report_findings(self, names: list[str]) -> None:
        """Let the mission report and remove one of these findings in each step."""
        propose = self.core._executive.propose

        def propose_with_finding(item: Input, state: FlightState, sensed: Sensed, p: Proposal) -> None:
            propose(item, state, sensed, p)
            if names:
                p.add_finding(names.pop(), "")

        self.core._executive.propose = propose_with_finding  # type: ignore[method-assign]

    def break_guard(self, *parts: str) -> None:
        """Make these methods of the guard, or the mission's `record_override`, raise from now on."""

        def raises(*_: object) -> None:
            raise ZeroDivisionError("guard")

        guard, executive = self.core._guard, self.core._executive
        for part in parts:
            owner: object = {"observe": guard._flight, "record_override": executive}.get(part, guard)
            setattr(owner, part, raises)

    def break_mission(self) -> None:
        """Make the mission code raise from now on."""

        def raises() -> None:
            raise ZeroDivisionError("mission")

        def broken(*_: object) -> None:
            raises()

        self.core._executive.propose = broken  # type: ignore[method-assign, assignment]

    def hide_peaks(self) -> None:
        """Keep the detector from detecting a peak from now on."""
        self.core._senses.detector._peak_is_past = lambda now_us: False  # type: ignore[method-assign]

    def use_rules(self, rules: tuple[Rule, ...]) -> None:
        """Replace the rules of the guard and keep its state."""
        self.rules, guard, whole = rules, self.core._guard, Guard(self.core.mission, rules)
        guard._rules, guard._rules_by_phase = whole._rules, whole._rules_by_phase


class MissionInPhase:
    """An executive in a chosen phase, without an estimator and a guard; tests set `state` before each step.

    The phase began at time 0.

    Args:
        mission: the mission.
        phase: phase of the mission.
        index: number of completed collisions.
        now_us: present time of the autopilot.
    """

    def __init__(self, mission: Mission, phase: Phase, index: int = 0, now_us: int = 0) -> None:
        self.executive = Executive(mission)
        self.progress, self.impacts = self.executive.progress, ImpactResponse(mission)
        self.state, self.proposal = FlightState(), Proposal()
        self.state.anchor(MissionFrame())
        self.state.now_us = now_us
        self.progress.phase, self.progress.index, self.progress.entered_us = phase, index, 0

    def step(self, *impacts: Event, wall: WallEstimate | None = None) -> list[str]:
        """Process a tick and these results of the estimator; return the rules of the findings."""
        sensed = Sensed(impacts=impacts, in_contact=bool(impacts), wall=wall)
        return self._propose(Tick(self.state.now_us), sensed)

    def start_next_leg(self) -> list[str]:
        """Let the operator end a pause before the next leg; return the rules of the findings."""
        self.progress.phase, self.progress.stops = Phase.PAUSE, self.progress.stops - 1
        return self._propose(OperatorRequest(self.state.now_us, Request.CONTINUE), Sensed())

    def _propose(self, item: Input, sensed: Sensed) -> list[str]:
        self.proposal = Proposal()
        self.executive.propose(item, self.state, sensed, self.proposal)
        return [finding.rule for finding in self.proposal.findings]


def core_in(
    phase: Phase,
    mission: str = DUAL,
    rules: tuple[Rule, ...] = RULES_WITHOUT_JUMP,
    settings: Mapping[str, Any] = NO_SETTINGS,
) -> HandFedCore:
    """Return a core that has passed through the phases up to `phase`, as `HandFedCore.enter` does."""
    c = HandFedCore(mission, rules, settings)
    c.enter(phase)
    return c


@pytest.fixture
def hand_fed() -> HandFedCore:
    return HandFedCore()


@pytest.fixture
def hasty_core() -> HandFedCore:
    """A core whose phases time out after 3 s instead of 20 s."""
    return HandFedCore(settings=SHORT_TIMEOUTS)
