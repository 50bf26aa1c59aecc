"""State diagrams for the docs: the mission's from `core/mission/phases.py`, the lock's from its table."""

from __future__ import annotations

from dart_flight.base.records import LockPhase, Phase
from dart_flight.core.mission.phases import TRANSITIONS, PhaseTrigger
from dart_flight.lock import state_machine


def diagram() -> str:
    """Return the mission's table as a Mermaid state diagram, with the guard's transitions below it."""
    lines = ["stateDiagram-v2", f"    [*] --> {next(iter(Phase))}"]
    lines += [
        f"    {before} --> {after}: {event}"
        for (before, event), after in TRANSITIONS.items()
        if event is not PhaseTrigger.OVERRULE
    ]
    lines += [
        f"    {phase} --> [*]" for phase in Phase if not any(before is phase for before, _ in TRANSITIONS)
    ]
    overruled = {
        before: after for (before, event), after in TRANSITIONS.items() if event is PhaseTrigger.OVERRULE
    }
    targets = sorted(set(overruled.values()))
    exits = [
        f"`{PhaseTrigger.OVERRULE}` leads to `{target}` from: "
        + ", ".join(f"`{before}`" for before, after in overruled.items() if after is target)
        + "."
        for target in targets
    ]
    return "```mermaid\n" + "\n".join(lines) + "\n```\n\n" + "\n".join(exits) + "\n"


def lock_diagram() -> str:
    """Return the lock's table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", f"    [*] --> {LockPhase.UNKNOWN}"]
    for before, row in state_machine.TRANSITIONS.items():
        lines += [f"    {before} --> {after}: {event}" for event, after in row.items()]
    return "```mermaid\n" + "\n".join(lines) + "\n```\n"
