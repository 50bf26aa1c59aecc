"""Mapping a room by touch: walls and corners from contacts of a body of known size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import wrap_angle
from dart_flight.planning.room import RoomContact, RoomFit, room_keys

ALONG_M, OUT_M = 0.13, 0.2
BODY = np.array(
    [(s * OUT_M, t * ALONG_M) for s in (1, -1) for t in (1, -1)]
    + [(s * ALONG_M, t * OUT_M) for s in (1, -1) for t in (1, -1)]
)
SQUARE = [(0.0, 1.5), (90.0, 1.4), (180.0, 1.6), (270.0, 1.3)]  # outward, degrees, and distance of the wall


def star_of_contacts(
    walls: list[tuple[float, float]], turned_deg: float, count: int = 16
) -> list[RoomContact]:
    """Return the first contact along each heading of a body that flies out from the middle."""
    found = []
    for k in range(count):
        heading = math.radians(turned_deg) + 2.0 * math.pi * k / count
        c, s = math.cos(heading), math.sin(heading)
        corners = BODY @ np.array([[c, s], [-s, c]])
        distance = math.inf
        for degrees, away in walls:
            n = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
            if n @ (c, s) > 1e-3:
                distance = min(distance, (away - float((corners @ n).max())) / float(n @ (c, s)))
        found.append(RoomContact((distance * c, distance * s), heading))
    return found


def room_fit(touches: list[RoomContact]) -> RoomFit:
    return RoomFit((0.0, 0.0), touches, ALONG_M, OUT_M)


@given(st.floats(0.0, 22.0), st.floats(-15.0, 15.0), st.floats(-15.0, 15.0))
@settings(max_examples=15)
def test_a_star_of_contacts_closes_a_room_at_any_incidence(turned: float, first: float, third: float) -> None:
    walls = [(0.0 + first, 1.5), (90.0, 1.4), (180.0 + third, 1.6), (270.0, 1.3)]
    room = room_fit(star_of_contacts(walls, turned)).fit()
    assert len(room.walls) == 4
    assert room.is_closed
    for degrees, away in walls:
        off = [abs(wrap_angle(wall.normal_rad - math.radians(degrees + 180.0))) for wall in room.walls]
        wall = room.walls[int(np.argmin(off))]
        assert math.degrees(min(off)) < 1.5
        assert -wall.offset_m == pytest.approx(away, abs=0.03)


def test_the_walls_written_for_a_mission_reach_from_corner_to_corner() -> None:
    room = room_fit(star_of_contacts(SQUARE, 3.0)).fit()
    keys = room_keys(room, "wood")
    lengths = sorted(wall["length_m"] for wall in keys.values())
    assert lengths == pytest.approx([2.7, 2.7, 3.1, 3.1], abs=0.03)
    assert all(wall["given_at"] == "surface" and wall["position_sd_m"] <= 0.02 for wall in keys.values())


def test_a_wall_with_a_single_contact_leaves_a_gap_to_probe() -> None:
    room = room_fit([t for k, t in enumerate(star_of_contacts(SQUARE, 0.0)) if k not in (2, 3, 5, 6)]).fit()
    assert not room.is_closed
    gaps = sorted(math.degrees(angle) for angle in room.gaps_rad)
    assert any(70.0 < gap < 110.0 for gap in gaps)


def test_two_contacts_give_no_walls() -> None:
    room = room_fit(star_of_contacts(SQUARE, 0.0)[:2]).fit()
    assert (room.walls, room.is_closed) == ([], False)
    assert len(room.gaps_rad) == 8
