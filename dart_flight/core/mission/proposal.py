"""What the mission makes of a step: outputs that it would like to go out, and what the core hands on."""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import MissionEnd, Output
from dart_flight.core.sense.detector import ExpectedContact

_NO_WALL: Final = ExpectedContact()


class MissionFinding(NamedTuple):
    """Something that only the mission, which knows the plan, can see, by the name of the guard's rule for it.

    Attributes:
        rule: of `core.guard.rules`.
        detail: what was found, in words.
        note_only: it goes into the log, and the mission goes on.
    """

    rule: str
    detail: str
    note_only: bool = False


class Proposal:
    """One step's proposal; the guard disposes of it.

    Attributes:
        outputs: setpoints, commands and records of decisions, in the order in which they were taken.
        findings: for the guard's rules.
        expected: what contact comes next, for the detector at the next step.
        frame: where the mission frame lies, at the step that finds out.
        altitude_m: at which the mission flies now; None: as before.
        end: the flight is over as planned.
    """

    def __init__(self) -> None:
        self.outputs: list[Output] = []
        self.findings: list[MissionFinding] = []
        self.expected = _NO_WALL
        self.frame: MissionFrame | None = None
        self.altitude_m: float | None = None
        self.end: MissionEnd | None = None

    def add_finding(self, rule: str, detail: str, noted: bool = False) -> None:
        """Add a finding."""
        self.findings.append(MissionFinding(rule, detail, noted))
