"""The list of checks: its contents, and the order in which checks run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.check.bringup.steps import STEPS
from dart_flight.check.checks import CHECKS, select_checks
from dart_flight.check.stages import Check, CheckContext, EndOfStageError, Stage, run_checks


class NotThereError(Exception):
    """The error of a failing check."""


@dataclass
class Bench(CheckContext[str]):
    """A context whose findings are strings."""

    found: list[str] = field(default_factory=list)
    own_errors = (NotThereError,)

    def explain(self, error: Exception) -> str:
        return f"failed: {error}"


OUTCOMES = ("nothing", "one", "two", "fails", "ends")


def make_check(outcome: str, name: str, stage: Stage) -> Check[Bench, str]:
    def run(_: Bench) -> list[str]:
        if outcome == "fails":
            raise NotThereError(name)
        if outcome == "ends":
            raise EndOfStageError([f"{name} ends it"])
        return [name] * ("nothing", "one", "two").index(outcome)

    return Check(name, stage, run)


@given(st.lists(st.tuples(st.sampled_from(OUTCOMES), st.sampled_from([Stage.FILE, Stage.VEHICLE]))))
def test_findings_come_in_order_until_their_stage_ends(kinds: list[tuple[str, Stage]]) -> None:
    checks = [make_check(outcome, str(i), stage) for i, (outcome, stage) in enumerate(kinds)]
    bench = Bench(found=["earlier"])
    found = run_checks(checks, bench)
    expected: list[str] = []
    ended_stages = set()
    for i, (outcome, stage) in enumerate(kinds):
        if stage in ended_stages:
            continue
        if outcome == "ends":
            ended_stages.add(stage)
        texts = {"fails": [f"failed: {i}"], "ends": [f"{i} ends it"], "one": [f"{i}"], "two": [f"{i}"] * 2}
        expected += texts.get(outcome, [])
    assert found == expected
    assert bench.found == ["earlier", *expected]


def test_an_unexpected_error_is_not_hidden() -> None:
    def run(_: Bench) -> list[str]:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_checks([Check("broken", Stage.FILE, run)], Bench())


def test_stage_and_name_identify_a_check() -> None:
    names = Counter([*((check.stage, check.name) for check in CHECKS), *((s.stage, s.name) for s in STEPS)])
    assert max(names.values()) == 1
    assert {check.stage for check in CHECKS} | {Stage.BENCH} == set(Stage)
    assert {step.stage for step in STEPS} == {Stage.BENCH}


def test_selected_checks_keep_the_order_of_the_list() -> None:
    chosen = select_checks(Stage.VEHICLE, Stage.FILE)
    assert [check.stage for check in chosen] == sorted(
        (check.stage for check in chosen), key=[Stage.FILE, Stage.VEHICLE].index
    )
    assert chosen[0].name == "places"
