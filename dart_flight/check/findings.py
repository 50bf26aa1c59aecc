"""Findings of the checks before a flight, and the decision between go and no-go.

Every no-go has a name. The operator must give this name to overrule the no-go.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import VehicleSource


class CheckFinding(msgspec.Struct, frozen=True):
    """The result of one check.

    Attributes:
        item: name of the finding, for `--overrule`.
        go: whether the finding allows the flight.
        message: the finding as text for the operator.
        remark: whether the finding allows the flight, but deviates from the recommendation.
        overruled: whether the operator has overruled this no-go.
        figures: computed values; their names contain the units.
    """

    item: str
    go: bool
    message: str
    remark: bool = False
    overruled: bool = False
    figures: dict[str, float] = {}


class EndOfStageError(Exception):
    """An error that carries findings after which the remaining checks of the stage are meaningless."""

    def __init__(self, findings: Sequence[CheckFinding]) -> None:
        super().__init__()
        self.findings = findings


class CheckReport(msgspec.Struct, frozen=True):
    """All findings and the decision."""

    mission: str
    go: bool
    findings: list[CheckFinding]
    vehicle: VehicleSource


def decide(mission: Mission, findings: Iterable[CheckFinding], overrule: Iterable[str] = ()) -> CheckReport:
    """Decide between go and no-go.

    Raises:
        InputError: an item to overrule is not a no-go.
    """
    found, wanted = list(findings), set(overrule)
    unknown = wanted - {f.item for f in found if not f.go}
    if unknown:
        bad = ", ".join(sorted({f.item for f in found if not f.go})) or "none"
        raise InputError(
            f"{sorted(unknown)[0]!r} is not a failed check of this mission; failed checks: {bad}",
            key=("--overrule",),
        )
    judged = [
        msgspec.structs.replace(f, overruled=True) if not f.go and f.item in wanted else f for f in found
    ]
    go = all(f.go or f.overruled for f in judged)
    return CheckReport(mission.name, go, judged, mission.flown_vehicle())
