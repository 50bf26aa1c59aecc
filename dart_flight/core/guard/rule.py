"""One rule of the guard, when it is judged, and the function that judges it.

`rules` has the table; the rules of the streams and of PX4's estimator come from `stream_watch` and
`estimator_watch`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

from dart_flight.base.records import Override, Phase
from dart_flight.core.mission.phases import ON_GROUND

# Says of the flight's conditions (`flight_conditions`) what is wrong now, or None.
Cause = Callable[[Any], str | None]


class Scope(StrEnum):
    """When a rule is judged."""

    ALWAYS = "always"
    GROUND = "before take-off"
    AIR = "in the air"
    GUIDED = "while mission or guard flies"  # not while landing
    FLYING = "while the mission flies"  # not while landing or once overruled


class Judge(NamedTuple):
    """What fires a rule.

    Attributes:
        description: what is wrong, for the manual's table.
        threshold: what is compared: keys of the vehicle's configuration or of the mission, and fixed limits.
        cause: says what is wrong now, or None; a rule without one comes as a finding of the mission.
    """

    description: str
    threshold: str = ""
    cause: Cause | None = None


def judge(description: str, threshold: str = "") -> Callable[[Cause], Judge]:
    """Return a decorator that makes a `Judge` of a cause."""

    def wrap(cause: Cause) -> Judge:
        return Judge(description, threshold, cause)

    return wrap


class Rule(NamedTuple):
    """One rule.

    Attributes:
        name: as in the log and in the verdict.
        action: what the guard does.
        scope: when it is judged.
        judge: what fires it.
        at_once: inputs after which it is judged without waiting: modes, arming and requests must not wait,
            and what is known only of one sample cannot.
        by_person: a person took over: the flight counts as released, not as aborted.
        explains: rules that may have fired for the same cause before it could be told: where their action is
            in force and no weaker, the reason becomes this rule's.
        of_streams: telemetry fails; what else is known of link and computer is said with it.
        noted: whether log and verdict note the rule, once a flight, while an action as strong is in force.
    """

    name: str
    action: Override
    scope: Scope
    judge: Judge
    at_once: tuple[type, ...] = ()
    by_person: bool = False
    explains: frozenset[str] = frozenset()
    of_streams: bool = False
    noted: bool = False


def in_scope(rule: Rule, phase: Phase) -> bool:
    """Return whether a rule is judged in a phase."""
    if phase is Phase.DONE:
        return False
    if rule.scope is Scope.ALWAYS:
        return True
    if rule.scope is Scope.GROUND or phase in ON_GROUND:  # else the mission's time-outs judge there
        return rule.scope is Scope.GROUND and phase in ON_GROUND
    if rule.scope is Scope.AIR or phase is Phase.LANDING:
        return rule.scope is Scope.AIR
    return rule.scope is Scope.GUIDED or phase is not Phase.OVERRULED
