"""A rule of the guard: when it is evaluated, and the function that evaluates it.

`rules` has the table of all rules. `stream_watch`, `pose_watch` and `estimator_watch` define the rules about
the streams, the poses and PX4's estimator.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

from dart_flight.base.records import Override, Phase
from dart_flight.core.mission.phases import ON_GROUND

# A function that describes the current problem from the flight's conditions, or returns None.
Cause = Callable[[Any], str | None]


class Scope(StrEnum):
    """The part of a flight in which a rule is evaluated."""

    ALWAYS = "always"
    GROUND = "before take-off"
    AIR = "in the air"
    GUIDED = "while the mission or the guard flies the vehicle"  # not while landing
    FLYING = "while the mission flies the vehicle"  # neither while landing nor while the guard flies


class RuleCondition(NamedTuple):
    """The condition that fires a rule.

    Attributes:
        description: the condition in words, for the manual's table.
        threshold: limits that `cause` applies, as text: keys of configuration or mission, or constants.
        cause: if None, a finding of the mission fires the rule.
    """

    description: str
    threshold: str = ""
    cause: Cause | None = None


def condition(description: str, threshold: str = "") -> Callable[[Cause], RuleCondition]:
    """Turn a cause function into a `RuleCondition`."""

    def wrap(cause: Cause) -> RuleCondition:
        return RuleCondition(description, threshold, cause)

    return wrap


class Rule(NamedTuple):
    """One rule.

    Attributes:
        name: the rule's name in log and verdict.
        at_once: types of the inputs that trigger an immediate evaluation. Modes, arming and requests are
            urgent; some other conditions last for a single sample only.
        by_person: whether a person has taken over when the rule fires. The flight then counts as released,
            not as aborted.
        explains: rules that may fire earlier for the same cause. If the flight's recorded reason is one of
            these rules, this rule replaces it.
        of_streams: whether the rule concerns failing telemetry. The rule's detail then also describes the
            state of link and computer.
        noted: whether log and verdict record the rule, once per flight, even if an equally strong action is
            already active.
    """

    name: str
    action: Override
    scope: Scope
    condition: RuleCondition
    at_once: tuple[type, ...] = ()
    by_person: bool = False
    explains: frozenset[str] = frozenset()
    of_streams: bool = False
    noted: bool = False


def in_scope(rule: Rule, phase: Phase) -> bool:
    if phase is Phase.DONE:
        return False
    if rule.scope is Scope.ALWAYS:
        return True
    # On the ground, the mission's timeouts cover most other faults.
    if rule.scope is Scope.GROUND or phase in ON_GROUND:
        return rule.scope is Scope.GROUND and phase in ON_GROUND
    if rule.scope is Scope.AIR or phase is Phase.LANDING:
        return rule.scope is Scope.AIR
    return rule.scope is Scope.GUIDED or phase is not Phase.OVERRULED
