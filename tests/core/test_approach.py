"""What stands in the way of a straight run."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.walls import Wall
from dart_flight.core.mission.approach import CLEARANCE_M, is_blocked

beside = st.floats(-2.0, 2.0)
away = st.floats(CLEARANCE_M + 0.01, 2.0)


@given(
    angle=st.floats(-math.pi, math.pi),
    place=st.tuples(beside, beside),
    ends=st.tuples(away, beside, away, beside),
)
def test_a_way_is_blocked_where_it_crosses_the_wall_within_its_length(
    angle: float, place: tuple[float, float], ends: tuple[float, float, float, float]
) -> None:
    """Both ends as distance from the plane and place along it: by similar triangles where it is crossed."""
    wall = Wall("wall", place, (math.cos(angle), math.sin(angle)), 1.0, "wood")
    before, from_there, behind, to_there = ends

    def at(distance: float, along: float) -> tuple[float, float]:
        (x, y), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
        return x + distance * nx + along * tx, y + distance * ny + along * ty

    share = (before - CLEARANCE_M) / (before + behind)
    crossed = from_there + share * (to_there - from_there)
    a, b = at(before, from_there), at(-behind, to_there)
    if abs(abs(crossed) - 0.5) > 1e-6:
        assert is_blocked(wall, a, b) == (abs(crossed) < 0.5)
    assert not is_blocked(wall, a, at(behind, to_there))  # it stays on its side
