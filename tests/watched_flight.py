"""A flight in the fast world that continues until landing, and the check that the vehicle stayed controlled.

A flight is controlled if all of these conditions hold:

* No exception escaped.
* The mission or the guard landed and disarmed the vehicle. If the program had ended, PX4's failsafe did this.
  Alternatively a pilot took over, and the vehicle holds still outside offboard mode.
* A flight that did not complete gives a reason. This is not required if the program itself hung or was
  killed.
* The true motion stays within the limits of `dart_flight.recording.uncontrolled`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from dart_flight.base.geometry import distance2
from dart_flight.base.records import FlightMode, GuardEvent, Outcome, Override, Record, TruthSample, World
from dart_flight.config.mission import Mission
from dart_flight.recording.uncontrolled import OUT_M, TruthExtremes, find_uncontrolled
from dart_flight.recording.verdict import Verdict, VerdictBuilder
from dart_flight.run.fast import FastFlight
from dart_flight.run.shell import Observe
from dart_flight.sim.draws import DrawnWorld, with_walls
from dart_flight.sim.faults.fault_table import Fault

_DOWN_M = 0.2  # height of the centre of a vehicle that lies on its side
_STILL_M_S = 0.3
_RUN_OUT_S, _HELD_S = 60.0, 3.0


def place_walls(
    world: DrawnWorld, away_m: Mapping[str, float], turned_deg: Mapping[str, float]
) -> DrawnWorld:
    """Return the world with walls moved along their normals and turned about their centres, by name."""
    walls = {
        w.name: w.displaced(away_m.get(w.name, 0.0)).rotated(math.radians(turned_deg.get(w.name, 0.0)))
        for w in world.mission.walls
    }
    return with_walls(world, walls)


class WatchedFlight:
    """A flight in the fast world, its extremes of the true motion, and the reasons why it is uncontrolled.

    Args:
        mission: the mission with the assumed walls.
        world: the drawn world. None means a world that equals the mission.

    Attributes:
        onlookers: functions called with every record and its number.
        truth: extremes of the true motion so far.
        decided_us: host time of the first decision of guard or autopilot after the fault began.
        problems: reasons why the flight is uncontrolled, after `run`; empty for a controlled flight.
    """

    def __init__(
        self, mission: Mission, seed: int, world: DrawnWorld | None = None, fault: Fault | None = None
    ) -> None:
        self.seed, self.fault = seed, fault
        self.onlookers: list[Observe] = []
        self.truth = TruthExtremes(mission.bounds)
        self.decided_us: int | None = None
        self.problems: list[str] = []
        self._builder = VerdictBuilder(mission)
        self.flight = FastFlight(mission, seed, observe=self._observe, fault=fault, world=world)
        self._send_status_text = self.flight.autopilot.send_text
        self.flight.autopilot.send_text = self._on_status_text

    def run(self) -> Verdict:
        """Fly until the vehicle has landed or a pilot holds the vehicle."""
        try:
            self.flight.run()
            self._run_out()
        except Exception as error:
            self.problems.append(f"exception {type(error).__name__}: {error}")
        verdict = self._builder.build(World.FAST, self.seed)
        self.problems += self._find_problems(verdict)
        return verdict

    def _observe(self, record: Record, number: int) -> None:
        self._builder.add(record)
        if isinstance(record, GuardEvent):
            self._note_decision()
        elif isinstance(record, TruthSample):
            self.truth.update(record)
        for onlooker in self.onlookers:
            onlooker(record, number)

    def _on_status_text(self, severity: str, text: str) -> None:
        if "failsafe" in text.lower():
            self._note_decision()
        self._send_status_text(severity, text)

    def _note_decision(self) -> None:
        faulted = self.flight.faulted
        if self.decided_us is None and faulted is not None and faulted.began_us is not None:
            self.decided_us = self.flight.host_us

    def _run_out(self) -> None:
        """Continue the simulation until the vehicle has landed, or a pilot has held it for a while."""
        autopilot = self.flight.autopilot
        until_s = autopilot.now_s + _RUN_OUT_S
        while autopilot.armed and autopilot.now_s < until_s:
            self.flight.tick()
            if autopilot.mode is FlightMode.MANUAL:
                until_s = min(until_s, autopilot.now_s + _HELD_S)

    def _find_problems(self, verdict: Verdict) -> Iterator[str]:
        a, last = self.flight.autopilot, self.truth.last
        falls = self.fault is not None and self.fault.name == "kill-switch"  # the fall is intended
        gone = self.flight.faulted is not None and self.flight.faulted.app_silent
        if self.flight.core.end is None and not gone:
            yield "the flight did not end"
        if a.armed:
            speed = distance2(a.plant.velocity, (0.0, 0.0))
            held = a.mode in (FlightMode.MANUAL, FlightMode.HOLD) and speed < _STILL_M_S
            if not (verdict.outcome is Outcome.RELEASED and held):
                yield f"still armed in {a.mode.value} at {speed:.2f} m/s"
        elif not falls and last is not None and last.position_mission[2] > _DOWN_M:
            yield "disarmed in the air"
        explained = gone or bool(verdict.reason and verdict.guard)
        completed = verdict.outcome is Outcome.COMPLETED
        yield from find_uncontrolled(self.truth, completed, explained, excursion_allowed_m(self.fault), falls)


def excursion_allowed_m(fault: Fault | None) -> float:
    """Return how far out of the mission's bounds a controlled flight may go.

    The limit is half a metre for braking, plus the position error that the fault causes.
    """
    wrong = abs(fault.value) if fault is not None and fault.name == "ekf-jump" else 0.0
    return OUT_M + wrong if math.isfinite(wrong) else math.inf


def rule_of(verdict: Verdict) -> str:
    """Return the first guard rule that acted in a flight; empty if there is none or the flight completed.

    The first rule is the cause, because other rules may act during the landing.
    """
    if verdict.outcome is Outcome.COMPLETED:
        return ""
    return next((event.rule for event in verdict.guard if event.action is not Override.NONE), "")
