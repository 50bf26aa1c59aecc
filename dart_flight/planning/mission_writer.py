"""A plan as a mission file: the scenario's own keys, the chosen collisions, and everything predicted."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.document import Document, writing
from dart_flight.config.mission import Mission, WallSpec, parse_mission
from dart_flight.config.scenario import Scenario
from dart_flight.planning.search import Plan

_DIGITS = 4
# Words and paths that YAML reads as text without quotes.
_PLAIN = re.compile(r"[A-Za-z_][\w-]*( [\w-]+)*|(\.\./)*[A-Za-z_][\w-]*(/[\w-]+)*\.ya?ml", re.ASCII)
_SPECIAL = frozenset(("true", "false", "null", "yes", "no", "on", "off"))


def mission_text(scenario: Scenario, plan: Plan, target: Path) -> str:
    """The mission file, block style.

    Args:
        scenario: what was planned.
        plan: the chosen candidate.
        target: where the file will be; paths in it are relative to that.
    """
    spec = scenario.spec
    lines = [
        f"# Planned by `dart-flight plan` from {Path(scenario.source).name}, objective "
        f"{scenario.objective.value}. `predicted` is what the flight model expects.",
        "version: 1",
        f"name: {_scalar(scenario.name)}",
    ]
    if scenario.vehicle_path is not None:
        relative = os.path.relpath(scenario.vehicle_path.resolve(), target.resolve().parent)
        lines.append(f"vehicle: {_scalar(Path(relative).as_posix())}")
    for name, section in (
        ("frame", spec.frame),
        ("start", spec.start),
        ("goal", spec.goal),
        ("bounds_m", spec.bounds_m),
    ):
        lines += _block(name, msgspec.to_builtins(section), 0)
    lines += _block("walls", {n: _given(w) for n, w in spec.walls.items()}, 0)
    lines.append(f"transit_mode: {spec.transit_mode.value}")
    lines.append("collisions:")
    for i, collision in enumerate(plan.collisions):
        lines += _collision(scenario, plan, i, collision.wall)
    lines += _block("limits", msgspec.to_builtins(spec.limits), 0)
    lines += _block("predicted", {"goal_miss_m": _short(plan.goal_miss_m)}, 0)
    return "\n".join(lines) + "\n"


def _collision(scenario: Scenario, plan: Plan, i: int, wall: str) -> list[str]:
    c = plan.collisions[i]
    body: dict[str, Any] = {"wall": wall, "mode": c.mode.value}
    if i == 0:
        body["approach"] = {"normal_m_s": plan.normal_m_s, "tangential_m_s": plan.tangential_m_s}
    spec = scenario.spec
    if wall in spec.alpha_m_per_n:
        body["alpha_m_per_n"] = list(spec.alpha_m_per_n[wall])
    else:
        body["alpha_wall_m_per_n"] = list(spec.alpha_wall_m_per_n[wall])
    body["predicted"] = {
        "t_s": _short(c.t_s),
        "position_m": [_short(v) for v in c.position_m],
        "normal_m_s": _short(c.normal_m_s),
        "tangential_m_s": _short(c.tangential_m_s),
        "peak_force_n": _short(c.peak_force_n),
        "contact_time_s": _short(c.contact_time_s),
    }
    lines = [line for key, value in body.items() for line in _block(key, value, 4)]
    return ["  - " + lines[0].lstrip(), *lines[1:]]


def planned_mission(scenario: Scenario, plan: Plan, text: str | None = None) -> Mission:
    """The mission of a plan, as its file will be read.

    Args:
        scenario: what was planned.
        plan: the chosen candidate.
        text: of the file, where there is one.
    """
    source = Path(scenario.source)
    document = Document(text or mission_text(scenario, plan, source), str(source))
    return parse_mission(document, scenario.vehicle)


def write_mission(scenario: Scenario, plan: Plan, target: Path) -> str:
    """Write the mission file and read it back as `dry-run` will; returns the text.

    Raises:
        InputError: it cannot be written.
    """
    text = mission_text(scenario, plan, target)
    planned_mission(scenario, plan, text)
    with writing(target):
        target.write_text(text, encoding="utf-8")
    return text


def _given(wall: WallSpec) -> dict[str, Any]:
    """A wall's keys without those that say nothing."""
    return {key: value for key, value in msgspec.to_builtins(wall).items() if value is not None}


def _block(key: str, value: Any, indent: int) -> list[str]:
    pad = " " * indent
    if isinstance(value, dict):
        return [
            f"{pad}{_scalar(key)}:",
            *(line for k, v in value.items() for line in _block(k, v, indent + 2)),
        ]
    if isinstance(value, list | tuple):
        return [f"{pad}{key}: {_flow(value)}"]
    return [f"{pad}{key}: {_scalar(value)}"]


def _flow(values: Iterable[Any]) -> str:
    return "[" + ", ".join(_scalar(v) for v in values) + "]"


def _scalar(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value)
    text = str(value)
    if _PLAIN.fullmatch(text) and text.lower() not in _SPECIAL:
        return text
    return msgspec.json.encode(text).decode()  # a JSON string is YAML


def _short(value: float) -> float:
    return round(value, _DIGITS) + 0.0
