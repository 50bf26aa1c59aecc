"""The mechanism of the checks: each check belongs to a stage, and `run_checks` runs a list of checks.

The lists are `checks.CHECKS` before a flight and `bringup.steps.STEPS` on the bench.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar


class Stage(StrEnum):
    """The stage of a check; all checks of a stage need the same kind of inputs."""

    FILE = "file"  # the mission alone
    COMPUTER = "computer"  # the onboard computer
    DESK = "desk"  # values that are not measured, and the operator's claims
    VEHICLE = "vehicle"
    BENCH = "bench"
    HITL = "hardware in the loop"


Found = TypeVar("Found")


class EndOfStageError(Exception, Generic[Found]):
    """Findings that make the remaining checks of their stage meaningless."""

    def __init__(self, findings: Sequence[Found]) -> None:
        super().__init__()
        self.findings = findings


class CheckContext(Generic[Found]):
    """The inputs that the checks of a list share.

    Attributes:
        found: the findings of the earlier checks.
        own_errors: exceptions of a check that `explain` converts to a finding.
    """

    found: list[Found]
    own_errors: ClassVar[tuple[type[Exception], ...]] = ()

    def explain(self, error: Exception) -> Found:
        raise NotImplementedError(
            f"{type(self).__name__} lists `own_errors` but does not implement `explain`"
        ) from error


Context = TypeVar("Context", bound=CheckContext[Any])


class Check(NamedTuple, Generic[Context, Found]):
    """A named check of a list.

    Attributes:
        name: name, unique within the stage.
        subject: the subject of the check, as text for the operator.
        by_hand: whether the check needs an operator at the vehicle.
    """

    name: str
    stage: Stage
    run: Callable[[Context], Iterable[Found]]
    subject: str = ""
    by_hand: bool = False


def run_checks(checks: Iterable[Check[Context, Found]], context: Context) -> list[Found]:
    """Run checks in order and return their findings, including those of `own_errors`.

    After `EndOfStageError`, skip the remaining checks of that stage.
    """
    first, ended = len(context.found), set[Stage]()
    for check in checks:
        if check.stage in ended:
            continue
        try:
            context.found += check.run(context)
        except EndOfStageError as end:
            context.found += end.findings
            ended.add(check.stage)
        except context.own_errors as error:
            context.found.append(context.explain(error))
    return context.found[first:]
