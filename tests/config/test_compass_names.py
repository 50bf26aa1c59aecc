"""A shipped wall that is named after a direction lies in this direction: x points north at heading 0."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dart_flight.base.geometry import Vec2
from dart_flight.config.document import Document
from dart_flight.config.mission import load_mission
from dart_flight.lab.search.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]
TOWARDS = {"north": (1.0, 0.0), "east": (0.0, 1.0), "south": (-1.0, 0.0), "west": (0.0, -1.0)}


def named_walls(path: Path) -> Iterator[tuple[str, Vec2]]:
    """Yield name and direction towards the wall (north, east) of every wall that has a compass name."""
    if "sequence" in Document.load(path).tree:
        scenario = load_scenario(path)
        frame, walls = None, list(scenario.walls.values())
        assert scenario.frame.heading_deg == 0.0
    else:
        mission = load_mission(path)
        frame = mission.frame_at((0.0, 0.0, 0.0))
        walls = [*mission.standing_walls, *(collision.wall for collision in mission.collisions)]
    for wall in walls:
        if wall.name in TOWARDS:
            nx, ny = wall.normal
            ned = (nx, -ny, 0.0) if frame is None else frame.vector_to_ned((nx, ny, 0.0))
            yield wall.name, (-ned[0], -ned[1])


SHIPPED = [path for path in sorted((ROOT / "missions").rglob("*.yaml")) if list(named_walls(path))]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_wall_lies_in_the_direction_of_its_name(path: Path) -> None:
    for name, (north, east) in named_walls(path):
        expected = TOWARDS[name]
        assert north * expected[0] + east * expected[1] > 0.9, name
