"""The heading after a hit: square to the next wall, with the rotation measured by its contacts."""

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
from dart_flight.core.mission.heading import Heading
from dart_flight.core.mission.setpoint_selection import SetpointSelection

SHUTTLE = load_mission(Path(__file__).parents[2] / "missions" / "shuttle.yaml")
NORTH, SOUTH = (next(c for c in SHUTTLE.collisions if c.wall.name == name) for name in ("north", "south"))
turns = st.floats(-0.17, 0.17)


SELECTION = SetpointSelection(SHUTTLE)


def progress_at(yaw: float, rotations: dict[str, float], phase: Phase, collision: Any) -> Any:
    """Return a mission state in a phase, with a heading and measured wall rotations."""
    walls: Any = SimpleNamespace(rotation=lambda wall: rotations[wall.name])
    return SimpleNamespace(phase=phase, collision=collision, heading=Heading(yaw), walls=walls)


def off_square(yaw: float, collision: Any, rotations: dict[str, float]) -> float:
    """Return the angle to the nearest quarter turn, rad."""
    square = collision.wall.parallel_yaw(yaw) + rotations[collision.wall.name]
    return abs(wrap_angle(4.0 * (yaw - square))) / 4.0


@given(north=turns, south=turns, spun=st.floats(-0.7, 0.7))
def test_the_heading_after_a_hit_is_square_to_the_next_wall(north: float, south: float, spun: float) -> None:
    rotations = {"north": north, "south": south}
    state: Any = SimpleNamespace(yaw=0.0, now_us=0)
    now = progress_at(0.0, rotations, Phase.APPROACH, NORTH)
    approach = SELECTION.wanted_yaw(now, state)
    assert off_square(approach, NORTH, rotations) == pytest.approx(0.0, abs=1e-9)
    now.heading = now.heading._replace(yaw=approach)
    now.heading = SELECTION.heading(now, state)
    assert now.heading.asked is None
    # The hit has turned the vehicle; the next wall has another rotation.
    now.phase, now.collision = Phase.RECOVERY, SOUTH
    state.yaw = approach + spun
    target = SELECTION.wanted_yaw(now, state)
    assert off_square(target, SOUTH, rotations) == pytest.approx(0.0, abs=1e-9)
    assert abs(wrap_angle(target - approach)) == pytest.approx(abs(south - north), abs=1e-9)


def test_the_heading_from_before_the_hits_is_kept_to_the_goal() -> None:
    state: Any = SimpleNamespace(yaw=0.3, now_us=0)
    now = progress_at(0.1, {}, Phase.TRANSIT, None)
    now.heading = SELECTION.heading(now, state)
    assert now.heading.asked is None
    now.phase, now.heading = Phase.RECOVERY, now.heading._replace(yaw=0.25)
    assert SELECTION.wanted_yaw(now, state) == 0.1


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.floats(0.1, 2.0), st.floats(0.0, 3.0))
def test_a_heading_turns_in_the_shorter_direction_at_its_rate(
    yaw: float, target: float, rate_rad_s: float, for_s: float
) -> None:
    before = Heading(yaw, 1_000_000)
    after = before.turn(target, 1_000_000 + round(for_s * 1e6), rate_rad_s)
    angle = abs(wrap_angle(target - yaw))
    assert abs(wrap_angle(after.yaw - yaw)) == pytest.approx(min(angle, rate_rad_s * for_s), abs=1e-5)
    left = abs(wrap_angle(target - after.yaw))
    assert left == pytest.approx(max(0.0, angle - rate_rad_s * for_s), abs=1e-5)
