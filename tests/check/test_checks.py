"""The list of checks: its contents, and the order in which checks run."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.check import checks
from dart_flight.check.bringup.steps import STEPS
from dart_flight.check.checks import CHECKS, Check, FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding, EndOfStageError
from dart_flight.config.mission import load_empty_room

MISSION = load_empty_room()
OUTCOMES = ("nothing", "one", "two", "ends")


def make_check(outcome: str, name: str, stage: Stage) -> Check:
    def run(_: FlightContext) -> list[CheckFinding]:
        if outcome == "ends":
            raise EndOfStageError([CheckFinding(f"{name} ends it", False, "")])
        return [CheckFinding(name, True, "")] * ("nothing", "one", "two").index(outcome)

    return Check(name, stage, run)


STAGES = (Stage.FILE, Stage.DESK, Stage.VEHICLE)
KINDS = st.lists(st.tuples(st.sampled_from(OUTCOMES), st.sampled_from(STAGES)))


@given(KINDS)
def test_findings_of_the_wanted_stages_come_in_order_until_their_stage_ends(
    kinds: list[tuple[str, Stage]],
) -> None:
    made = tuple(make_check(outcome, str(i), stage) for i, (outcome, stage) in enumerate(kinds))
    earlier = CheckFinding("earlier", True, "")
    context = FlightContext(MISSION, found=[earlier])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks, "CHECKS", made)
        found = [finding.item for finding in run_checks(context, Stage.VEHICLE, Stage.FILE)]
    expected: list[str] = []
    ended = {Stage.DESK}  # not wanted
    for i, (outcome, stage) in enumerate(kinds):
        if stage not in ended:
            expected += {"ends": [f"{i} ends it"], "one": [f"{i}"], "two": [f"{i}"] * 2}.get(outcome, [])
            ended |= {stage} if outcome == "ends" else set()
    assert found == expected
    assert [finding.item for finding in context.found] == ["earlier", *expected]


def test_an_unexpected_error_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(_: FlightContext) -> list[CheckFinding]:
        raise ZeroDivisionError

    monkeypatch.setattr(checks, "CHECKS", (Check("broken", Stage.FILE, run),))
    with pytest.raises(ZeroDivisionError):
        run_checks(FlightContext(MISSION), Stage.FILE)


def test_stage_and_name_identify_a_check() -> None:
    names = Counter([(check.stage, check.name) for check in CHECKS] + [("bench", s.name) for s in STEPS])
    assert max(names.values()) == 1
    assert {check.stage for check in CHECKS} == set(Stage)
