"""Stopping point of the position loop, and distance of a setpoint outside the bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.walls import Wall
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.commitment import setpoint_outside_m
from dart_flight.core.mission.position_loop import _BEHIND_M, STOP_TIME_S, stop_share
from dart_flight.core.mission.wall_uncertainty import SURE_SD

BOUNDS = load_mission(packaged("missions", "paper_single_wall.yaml")).bounds
number = st.floats(-3.0, 3.0)


@given(st.floats(-math.pi, math.pi), st.floats(-0.29, 2.0), number, st.floats(-4.0, 4.0), number)
def test_a_wall_ahead_stops_the_vehicle_at_its_plane(
    angle: float, distance: float, along: float, closing: float, sliding: float
) -> None:
    """In the wall's axes, the vehicle travels from `distance` for half a second at `closing`."""
    wall = Wall("wall", (0.5, -0.3), (math.cos(angle), math.sin(angle)), 2.0, "wood")
    (px, py), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
    position = (px + distance * nx + along * tx, py + distance * ny + along * ty)
    velocity = (-closing * nx + sliding * tx, -closing * ny + sliding * ty)
    travel = STOP_TIME_S * closing
    if min(abs(abs(along) - 1.0), abs(distance - travel), abs(closing)) < 1e-6:
        return
    stops = closing > 0.0 and abs(along) < 1.0 and travel > distance
    expected = max(0.0, distance / travel) if stops else 1.0
    assert stop_share((), position, velocity) == 1.0
    assert stop_share((wall,), position, velocity) == pytest.approx(expected)
    further = wall.displaced(0.2)  # reached sooner
    both = stop_share((wall, further), position, velocity)
    assert both == pytest.approx(min(expected, float(stop_share((further,), position, velocity))))


def test_a_wall_does_not_stop_a_vehicle_behind_it() -> None:
    """An uncertain wall still stops a vehicle that is within its uncertainty behind the plane."""
    wall = Wall("wall", (0.0, 0.0), (-1.0, 0.0), 2.0, "wood")
    uncertain = Wall("wall", (0.0, 0.0), (-1.0, 0.0), 2.0, "wood", 0.1)
    onward = (1.0, 0.0)
    unsure_m = _BEHIND_M + SURE_SD * 0.1
    for x, certain_share, uncertain_share in (
        (_BEHIND_M - 0.01, 0.0, 0.0),
        (_BEHIND_M + 0.01, 1.0, 0.0),
        (unsure_m - 0.01, 1.0, 0.0),
        (unsure_m + 0.01, 1.0, 1.0),
    ):
        assert stop_share((wall,), (x, 0.0), onward) == certain_share
        assert stop_share((uncertain,), (x, 0.0), onward) == uncertain_share


def test_arrays_and_scalars_give_the_same_stop_share() -> None:
    rng = np.random.default_rng(2)
    walls = (Wall("a", (0.0, 0.0), (-0.6, 0.8), 2.0, "wood"), Wall("b", (1.0, 1.0), (0.0, -1.0), 3.0, "wood"))
    x, y, vx, vy = rng.uniform(-2.0, 2.0, (4, 300))
    together = stop_share(walls, (x, y), (vx, vy))
    single = [
        float(stop_share(walls, p, v))
        for p, v in zip(zip(x, y, strict=True), zip(vx, vy, strict=True), strict=True)
    ]
    assert together == pytest.approx(single)
    assert 20 < sum(share < 1.0 for share in single) < 280


@given(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_the_distance_outside_is_the_larger_of_both_axes(x: float, y: float) -> None:
    inside = (min(max(x, BOUNDS.x[0]), BOUNDS.x[1]), min(max(y, BOUNDS.y[0]), BOUNDS.y[1]))
    assert setpoint_outside_m(BOUNDS, x, y) == pytest.approx(max(abs(x - inside[0]), abs(y - inside[1])))
