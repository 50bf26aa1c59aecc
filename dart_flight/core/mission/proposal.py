"""Result of the mission in one step: proposed outputs, and data that the core passes on."""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import MissionEnd, Output
from dart_flight.core.sense.detector import ExpectedContact

_NO_WALL: Final = ExpectedContact()


class MissionFinding(NamedTuple):
    """A finding that fires a guard rule. Only the mission can report findings, because it has the plan.

    Attributes:
        rule: name of the rule in `core.guard.rules`.
        note_only: whether the finding is only logged, so that the mission continues.
    """

    rule: str
    detail: str
    note_only: bool = False


class Proposal:
    """One step's proposal, which the guard may overrule.

    Attributes:
        outputs: setpoints, commands and records of decisions, in order.
        expected: next expected contact, for the detector at the next step.
        frame: the mission frame, if this step has set it.
        altitude_m: new altitude of the mission, or None if unchanged.
        end: the planned end of the flight, if this step reaches it; otherwise None.
    """

    def __init__(self) -> None:
        self.outputs: list[Output] = []
        self.findings: list[MissionFinding] = []
        self.expected = _NO_WALL
        self.frame: MissionFrame | None = None
        self.altitude_m: float | None = None
        self.end: MissionEnd | None = None

    def add_finding(self, rule: str, detail: str, noted: bool = False) -> None:
        self.findings.append(MissionFinding(rule, detail, noted))
