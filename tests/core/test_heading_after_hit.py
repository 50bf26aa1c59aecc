"""The heading after a hit: square to the wall that comes next, as its contacts have found it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import wrap_angle
from dart_flight.base.records import Phase
from dart_flight.config.mission import load_mission
from dart_flight.core.mission.setpoint_selection import SetpointSelection

SHUTTLE = load_mission(Path(__file__).parents[2] / "missions" / "shuttle.yaml")
EAST, WEST = (next(c for c in SHUTTLE.collisions if c.wall.name == name) for name in ("east", "west"))
turns = st.floats(-0.17, 0.17)


def selection(yaw: float, turned: dict[str, float], phase: Phase, collision: Any) -> SetpointSelection:
    """As it is in a phase, on a heading, of walls that were felt to be turned."""
    progress: Any = SimpleNamespace(phase=phase, collision=collision)
    references: Any = SimpleNamespace(yaw=yaw)
    walls: Any = SimpleNamespace(turned=lambda wall: turned[wall.name])
    nothing: Any = None
    return SetpointSelection(SHUTTLE, progress, nothing, references, nothing, walls, nothing)


def off_square(yaw: float, collision: Any, turned: dict[str, float]) -> float:
    """Rad, of the nearest quarter turn."""
    square = collision.wall.parallel_yaw(yaw) + turned[collision.wall.name]
    return abs(wrap_angle(4.0 * (yaw - square))) / 4.0


@given(east=turns, west=turns, spun=st.floats(-0.7, 0.7))
def test_after_a_hit_the_heading_is_square_to_the_next_wall_whatever_the_last_one_asked_for(
    east: float, west: float, spun: float
) -> None:
    turned = {"east": east, "west": west}
    state: Any = SimpleNamespace(yaw=0.0, now_us=0)
    chosen = selection(0.0, turned, Phase.APPROACH, EAST)
    now: Any = chosen._progress
    approach = chosen.wanted_yaw(state)
    assert off_square(approach, EAST, turned) == pytest.approx(0.0, abs=1e-9)
    chosen._references.yaw = approach
    assert chosen._yaw_asked(state) is None
    # The hit has turned the vehicle; the next wall stands otherwise than the one that was hit.
    now.phase, now.collision = Phase.RECOVERY, WEST
    state.yaw = approach + spun
    wanted = chosen.wanted_yaw(state)
    assert off_square(wanted, WEST, turned) == pytest.approx(0.0, abs=1e-9)
    assert abs(wrap_angle(wanted - approach)) == pytest.approx(abs(west - east), abs=1e-9)


def test_to_the_goal_the_heading_before_the_hits_is_kept() -> None:
    state: Any = SimpleNamespace(yaw=0.3, now_us=0)
    chosen = selection(0.1, {}, Phase.TRANSIT, None)
    assert chosen._yaw_asked(state) is None
    chosen._progress.phase = Phase.RECOVERY
    chosen._references.yaw = 0.25
    assert chosen.wanted_yaw(state) == 0.1
