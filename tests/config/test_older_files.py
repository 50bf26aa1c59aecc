"""Missions and configurations of earlier days mean what they meant: each is loaded and compared, key by key,
with what the program of 22 November 2026 (commit 5a9e062) made of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import load_vehicle
from dart_flight.run.prepare import load_flyable

OLDER = sorted((Path(__file__).parents[1] / "data" / "older").glob("*/missions/*.yaml"))


REMOVED = {".vehicle.estimation.observer", ".vehicle.estimation.momentum_gain_per_s"}


def as_json(mission: Mission) -> Any:
    return json.loads(msgspec.json.encode(mission))


def differing(then: Any, now: Any, key: str = "") -> list[str]:
    """Keys whose value has changed or gone; keys may be added, and none of them may decide anything alone."""
    if isinstance(then, dict) and isinstance(now, dict):
        return [at for name, value in then.items() for at in differing(value, now.get(name), f"{key}.{name}")]
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        return [
            at
            for i, (a, b) in enumerate(zip(then, now, strict=True))
            for at in differing(a, b, f"{key}[{i}]")
        ]
    return [] if then == now or key in REMOVED else [f"{key}: {then!r} became {now!r}"]


@pytest.mark.parametrize("path", OLDER, ids=lambda path: f"{path.parts[-3]} {path.stem}")
def test_an_older_mission_is_the_same_mission(path: Path) -> None:
    then = json.loads(path.with_suffix(".json").read_text())
    mission = load_flyable(path)
    assert differing(then, as_json(mission)) == []
    assert mission.waypoints == ()
    assert mission.vehicle.has_lock


def test_a_removed_observer_is_refused_where_it_would_mean_something() -> None:
    path = OLDER[0].parents[1] / "configs" / "dart.yaml"
    document = Document(path.read_text().replace("observer: acceleration", "observer: momentum"), "dart.yaml")
    with pytest.raises(InputError, match=r"estimation\.observer.*delete this key and momentum_gain_per_s"):
        load_vehicle(document)


def test_there_are_older_files_and_a_change_is_seen() -> None:
    assert {path.parts[-3] for path in OLDER} == {"2026-11-21", "2026-11-22"}
    path = OLDER[0]
    then = json.loads(path.with_suffix(".json").read_text())
    then["altitude_m"] = 2.0
    assert len(differing(then, as_json(load_mission(path)))) == 1
