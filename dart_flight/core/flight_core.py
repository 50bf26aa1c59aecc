"""The flight core: one input in, what follows from it out. Synchronous, no I/O, no clock.

    core = FlightCore(mission)
    for output in core.step(sample): ...

`step` never raises: a fault in the mission's code becomes a decision of the guard (land), with its reason.
"""

from __future__ import annotations

import traceback

from dart_flight.config.mission import Mission
from dart_flight.core.guard.guard import Guard
from dart_flight.core.guard.rules import RULES, Action, Rule
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.phases import ON_GROUND, Phase
from dart_flight.core.sense.senses import Event, Senses
from dart_flight.samples import ImpactOnset, Input, MissionEnd, OperatorRequest, Output


class FlightCore:
    """Estimates, detects, recovers, walks through one mission, and says no.

    Args:
        mission: checked and resolved.
        rules: of the guard; another table only in tests.

    Raises:
        NoApproachError: an approach of the mission has no room (`planning.approach`).
    """

    def __init__(self, mission: Mission, rules: tuple[Rule, ...] = RULES) -> None:
        self.mission = mission
        self._senses = Senses(mission)
        self.state, self.detector = self._senses.state, self._senses.detector
        self.guard = Guard(mission, rules)
        self.executive = Executive(mission, self.detector, self.guard)
        self._failed = False

    @property
    def phase(self) -> Phase:
        """Where the mission stands."""
        return self.executive.phase

    @property
    def end(self) -> MissionEnd | None:
        """How the flight ended, once it has."""
        return self.executive.outcome

    def step(self, item: Input) -> list[Output]:
        """Take one input; returns commands to carry out and records to log, in order."""
        out: list[Output] = []
        if self.end is not None:
            return out
        try:
            events = self._ingest(item, out)
            if self.guard.action is Action.NONE:
                self.executive.step(item, self.state, events, out)
        except Exception:
            self._fault(out)
        return self._dispose(item, out)

    def _ingest(self, item: Input, out: list[Output]) -> list[Event]:
        if isinstance(item, OperatorRequest):
            self._operator(item, out)
            return []
        estimate, events = self._senses.take(item)
        if estimate is not None:
            out.append(estimate)
        for event in events:
            if isinstance(event, ImpactOnset):
                self.guard.note_impact(event.t_us)
            out.append(event)
        return events

    def _operator(self, item: OperatorRequest, out: list[Output]) -> None:
        state = self.state
        if item.request == "release":
            self.guard.latch("operator_release", "released by the operator", state, out)
        elif item.request == "world_died":
            self.guard.latch("world_died", item.detail or "the simulated vehicle is gone", state, out)
        elif self.phase in ON_GROUND and not state.status.armed:
            self.executive.overrule(state, out, "operator")
            self.guard.latch("operator_ground", "stopped before take-off", state, out)
        else:
            self.guard.latch("operator", "land asked for", state, out)

    def _fault(self, out: list[Output]) -> None:
        """A fault in the mission's code: land, once, and say where."""
        if self._failed:
            return
        self._failed = True
        where = traceback.format_exc(limit=-2).strip().replace("\n", " | ")
        self.guard.latch("mission_fault", where, self.state, out)

    def _dispose(self, item: Input, out: list[Output]) -> list[Output]:
        try:
            kept = self.guard.review(item, self.state, self.phase, out)
            if self.guard.action is not Action.NONE:
                self.executive.overrule(self.state, kept, self.guard.reason or "")
            if self.guard.end is not None and self.end is None:
                self.executive.finish(self.state, kept, self.guard.end)
        except Exception:
            # The guard itself is broken: nothing of this step goes out, PX4's own failsafe is the last line.
            self._fault(out)
            return [o for o in out if not o.topic.startswith("/out/")]
        return kept
