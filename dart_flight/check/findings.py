"""Findings and the decision from them: a no-go has a name, and only by that name can it be overruled."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import VehicleSource


class CheckFinding(msgspec.Struct, frozen=True):
    """One thing that was looked at.

    Attributes:
        item: its name, for `--overrule`.
        go: False: a reason not to fly.
        says: what was found, in words.
        remark: go, but not as it is recommended.
        overruled: a no-go that the operator has taken upon himself.
        figures: what was computed, units in the names.
    """

    item: str
    go: bool
    says: str
    remark: bool = False
    overruled: bool = False
    figures: dict[str, float] = {}


class CheckReport(msgspec.Struct, frozen=True):
    """All findings, and what follows."""

    mission: str
    go: bool
    findings: list[CheckFinding]
    vehicle: VehicleSource


def decide(mission: Mission, findings: Iterable[CheckFinding], overrule: Iterable[str] = ()) -> CheckReport:
    """Go or no-go.

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
