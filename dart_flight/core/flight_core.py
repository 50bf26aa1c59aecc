"""The flight core: a synchronous step from one input to its outputs, without I/O or a clock.

    core = FlightCore(mission)
    for output in core.step(sample): ...

Data flows in one direction: *sense* converts the input to estimates, *mission* converts these to a proposal,
and *guard* decides. No part changes the data of another. This module passes the results on. `step` never
raises. After an exception in the mission's code, the guard lands and reports the exception.
"""

from __future__ import annotations

import contextlib
import traceback
from typing import Final

from dart_flight.base.records import Input, MissionEnd, Output, Override, Phase
from dart_flight.config.mission import Mission
from dart_flight.core.guard.guard import Guard
from dart_flight.core.guard.rule import Rule
from dart_flight.core.guard.rules import RULES
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.proposal import MissionFinding, Proposal
from dart_flight.core.mission.rehearsal import Rehearsal
from dart_flight.core.pace import Pace, pace_near_walls
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Sensed, Senses
from dart_flight.core.sense.state import FlightState

_NOTHING: Final = Sensed()


class FlightCore:
    """Core that estimates the force, detects impacts, flies one mission and applies the guard's rules.

    `rules` is the guard's table; tests may pass another one. If there is no room for an approach of the
    mission, the constructor raises NoApproachError (`core.mission.approach`).
    """

    def __init__(self, mission: Mission, rules: tuple[Rule, ...] = RULES) -> None:
        self.mission = mission
        self._senses = Senses(mission.vehicle)
        self._executive = Executive(mission) if mission.standoff_m is None else Rehearsal(mission)
        self._guard = Guard(mission, rules)
        self._expected = ExpectedContact()  # the mission's expected contact, for the detector's next step
        self.end: MissionEnd | None = None

    @property
    def state(self) -> FlightState:
        """Estimated state of the vehicle; read-only."""
        return self._senses.state

    @property
    def phase(self) -> Phase:
        return self._executive.progress.phase

    @property
    def override(self) -> Override:
        return self._guard.action

    @property
    def pace(self) -> Pace:
        """Pace at which the shell should pass the next inputs."""
        senses, phase = self._senses, self._executive.progress.phase
        if self._guard.telemetry_late:
            return Pace.BATCHED  # old samples are waiting, and batches process them sooner
        if senses.detector.in_contact:
            return Pace.IMMEDIATE
        return pace_near_walls(self.mission, senses.state, phase)

    def step(self, item: Input) -> list[Output]:
        """Process one input; return the commands to execute and the records to log, in order."""
        if self.end is not None:
            return []
        sensed, proposal, state = _NOTHING, Proposal(), self._senses.state
        try:
            sensed = self._senses.update(item, self._expected)
            if not self._guard.overrules:
                self._executive.propose(item, state, sensed, proposal)
                self._expected = proposal.expected
        except Exception:
            proposal.findings.append(MissionFinding("mission_fault", _active_exception()))
        if proposal.frame is not None:
            state.anchor(proposal.frame)
        known: list[Output] = []
        if sensed.estimate is not None:
            known = [sensed.estimate]
            if sensed.impacts:
                known += sensed.impacts
            if sensed.torque is not None:
                known.append(sensed.torque)
        if sensed.contact:
            known += sensed.contact
        guard = self._guard
        try:
            reviewed = guard.review(item, state, sensed, self._executive.progress.phase, proposal)
            if proposal.end is not None or guard.end is not None or guard.overrules:
                reviewed = reviewed + self._follow_guard(proposal.end)
            return known + reviewed if known else reviewed
        except Exception:
            # The guard itself has failed: suppress the commands of this step, and land.
            known += [o for o in proposal.outputs if not o.topic.startswith("/out/")]
            fault = _active_exception()
        # No exception leaves the core: if the landing fails too, PX4's failsafe lands without setpoints.
        with contextlib.suppress(Exception):
            known += guard.land_after_fault(item, state, fault)
        with contextlib.suppress(Exception):
            known += self._follow_guard(None)
        return known

    def _follow_guard(self, mission_end: MissionEnd | None) -> list[Output]:
        """Record an override by the guard and the end of the flight; return the records."""
        guard, executive, state = self._guard, self._executive, self._senses.state
        kept: list[Output] = []
        if guard.overrules:
            kept += executive.record_override(state.now_us, guard.reason or "")
            # While the guard holds or backs off, a contact with a wall counts as an impact.
            if guard.landing:
                self._expected = ExpectedContact()
        if guard.end is not None:
            self.end = guard.end
            kept += executive.record_end(guard.end)
        elif mission_end is not None and not guard.overrules:
            self.end = mission_end
            kept.append(mission_end)
        return kept


def _active_exception() -> str:
    """Return the active exception with its location in the code, on one line."""
    return traceback.format_exc(limit=-2).strip().replace("\n", " | ")
