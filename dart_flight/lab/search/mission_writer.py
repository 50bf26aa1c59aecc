"""A plan as a mission file: the scenario's own keys, the chosen collisions, and everything predicted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import yaml

from dart_flight.config.document import Document, writing
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.mission_file import WallSpec
from dart_flight.lab.search.scenario import Scenario
from dart_flight.lab.search.search import Plan, PlannedCollision

_DIGITS = 4


def mission_text(scenario: Scenario, plan: Plan, target: Path) -> str:
    """The mission file.

    Args:
        scenario: what was planned.
        plan: the chosen candidate.
        target: where the file will be; paths in it are relative to that.
    """
    spec = scenario.spec
    tree: dict[str, Any] = {"version": 1, "name": scenario.name}
    if scenario.vehicle_path is not None:
        relative = os.path.relpath(scenario.vehicle_path.resolve(), target.resolve().parent)
        tree["vehicle"] = Path(relative).as_posix()
    tree |= {
        "frame": spec.frame,
        "start": spec.start,
        "goal": spec.goal,
        "bounds_m": spec.bounds_m,
        "walls": {name: _given(wall) for name, wall in spec.walls.items()},
        "transit_mode": spec.transit_mode,
        "collisions": [_collision(scenario, plan, c) for c in plan.collisions],
        "limits": spec.limits,
        "predicted": {"goal_miss_m": _short(plan.goal_miss_m)},
    }
    head = (
        f"# Planned by `dart-flight plan` from {Path(scenario.source).name}, objective "
        f"{scenario.objective.value}. `predicted` is what the flight model expects.\n"
    )
    # None: what holds nothing but figures stands in one line, all else in block style.
    return head + yaml.safe_dump(msgspec.to_builtins(tree), sort_keys=False, default_flow_style=None)


def _collision(scenario: Scenario, plan: Plan, c: PlannedCollision) -> dict[str, Any]:
    body: dict[str, Any] = {"wall": c.wall, "mode": c.mode}
    if c is plan.collisions[0]:
        body["approach"] = {"normal_m_s": plan.normal_m_s, "tangential_m_s": plan.tangential_m_s}
    spec = scenario.spec
    if c.wall in spec.alpha_m_per_n:
        body["alpha_m_per_n"] = spec.alpha_m_per_n[c.wall]
    else:
        body["alpha_wall_m_per_n"] = spec.alpha_wall_m_per_n[c.wall]
    body["predicted"] = {
        "t_s": _short(c.t_s),
        "position_m": [_short(v) for v in c.position_m],
        "normal_m_s": _short(c.normal_m_s),
        "tangential_m_s": _short(c.tangential_m_s),
        "peak_force_n": _short(c.peak_force_n),
        "contact_time_s": _short(c.contact_time_s),
    }
    return body


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


def _short(value: float) -> float:
    return round(value, _DIGITS) + 0.0
