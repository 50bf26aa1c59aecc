"""The mechanism of all checks before a flight: a check belongs to a stage, and one function walks a list.

The lists are `checks.CHECKS` and, on the bench, `bringup.steps.STEPS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar


class Stage(StrEnum):
    """Where a check can be made."""

    FILE = "file"  # of the mission alone
    COMPUTER = "computer"  # that flies it
    DESK = "desk"  # what nobody has measured, and what the operator claims
    VEHICLE = "vehicle"
    BENCH = "bench"
    HITL = "hardware in the loop"


Found = TypeVar("Found")


class EndOfStageError(Exception, Generic[Found]):
    """A finding that makes the rest of its stage meaningless."""

    def __init__(self, findings: Sequence[Found]) -> None:
        super().__init__()
        self.findings = findings


class CheckContext(Generic[Found]):
    """The things that the checks of a list look at.

    Attributes:
        found: what earlier checks have found.
        own_errors: the errors with which a check fails instead of finding something.
    """

    found: list[Found]
    own_errors: ClassVar[tuple[type[Exception], ...]] = ()

    def explain(self, error: Exception) -> Found:
        """Return the finding that an own error stands for."""
        raise NotImplementedError(
            f"{type(self).__name__} has own errors and does not explain them"
        ) from error


Context = TypeVar("Context", bound=CheckContext[Any])


class Check(NamedTuple, Generic[Context, Found]):
    """One check.

    Attributes:
        name: within its stage.
        stage: where it can be made.
        run: returns the findings.
        what: what it looks at, for the operator.
        by_hand: whether it needs somebody at the vehicle.
    """

    name: str
    stage: Stage
    run: Callable[[Context], Iterable[Found]]
    what: str = ""
    by_hand: bool = False


def run_checks(checks: Iterable[Check[Context, Found]], context: Context) -> list[Found]:
    """Run checks in their order and return what they find, their own errors included.

    A check that raises `EndOfStageError` ends its stage.
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
