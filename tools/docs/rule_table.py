"""The table of the guard's rules for `docs/guard.md` (`tools/docs/generated.py`)."""

from __future__ import annotations

from dart_flight.core.guard.rules import RULES


def table() -> str:
    """Return the rules as a Markdown table, one row each."""
    rows = ["| rule | fires when | threshold | action | evaluated by |", "|---|---|---|---|---|"]
    for rule in RULES:
        description, threshold, cause = rule.condition
        evaluated_by = f"guard, {rule.scope.value}" if cause is not None else "mission"
        if rule.at_once:
            evaluated_by += ", immediately after " + ", ".join(f"`{kind.__name__}`" for kind in rule.at_once)
        parts = [part if part[0].isdigit() else f"`{part}`" for part in threshold.split(", ") if part]
        limits = ", ".join(parts) or "-"
        action = rule.action.value.replace("_", " ")
        rows.append(f"| `{rule.name}` | {description} | {limits} | {action} | {evaluated_by} |")
    return "\n".join(rows) + "\n"
