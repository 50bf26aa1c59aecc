"""Writes the mission's state diagram, from the table in `flight/phases.py`, into `docs/mission_phases.md`.

python -m tools.phase_diagram
"""

from __future__ import annotations

from pathlib import Path

from dart_flight.flight.phases import TRANSITIONS, Event, Phase

PAGE = Path(__file__).resolve().parents[1] / "docs" / "mission_phases.md"
BEGIN, END = "<!-- begin: python -m tools.phase_diagram -->\n", "<!-- end -->"


def diagram() -> str:
    """The table as a Mermaid state diagram; what nearly every phase has, the guard, as a line below it."""
    lines = ["stateDiagram-v2", f"    [*] --> {next(iter(Phase))}"]
    lines += [
        f"    {before} --> {after}: {event}"
        for (before, event), after in TRANSITIONS.items()
        if event is not Event.OVERRULE
    ]
    lines += [
        f"    {phase} --> [*]" for phase in Phase if not any(before is phase for before, _ in TRANSITIONS)
    ]
    overruled = {before: after for (before, event), after in TRANSITIONS.items() if event is Event.OVERRULE}
    targets = sorted(set(overruled.values()))
    ways = [
        f"`{Event.OVERRULE}` leads to `{target}` from: "
        + ", ".join(f"`{before}`" for before, after in overruled.items() if after is target)
        + "."
        for target in targets
    ]
    return "```mermaid\n" + "\n".join(lines) + "\n```\n\n" + "\n".join(ways) + "\n"


def with_diagram(page: str) -> str:
    """The page with the diagram of today's table between its marks.

    Raises:
        ValueError: the marks are not there.
    """
    start, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:start]}{diagram()}{page[end:]}"


if __name__ == "__main__":
    PAGE.write_text(with_diagram(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
