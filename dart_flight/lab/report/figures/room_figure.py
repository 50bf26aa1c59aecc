"""The map of a room measured by touch: its walls, their uncertainty, and the contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission
from dart_flight.lab.figure_style import Look, in_style, new_figure, save_figure
from dart_flight.lab.map_model import (
    SURE,
    DrawnVehicle,
    Label,
    Line,
    MapKind,
    Place,
    RoomMap,
    room_map,
    uncertainty_band,
)
from dart_flight.lab.report.figures.map_drawing import draw_map, finish_map, set_view
from dart_flight.planning.room import Room, RoomContact, RoomWall

_SHEET = Look(7.2, 6.4)
_OPEN_M = 0.7  # a wall without a corner extends this far beyond its contacts
_MARGIN_M = 0.4


@in_style
def room_figure(mission: Mission, room: Room, touches: Sequence[RoomContact], *, look: Look = _SHEET) -> Any:
    """Draw the plan view of a room: contacts, and walls with a band of three standard deviations.

    The mission gives the start and, for a simulated room, the true walls. `touches` are the contacts from
    which the room was measured.
    """
    shown, airframe = room_map(mission), mission.vehicle.airframe
    for true_wall in mission.simulated_walls:
        shown.paths.append(Line(MapKind.TRUE_WALL, np.array(airframe.wall_surface(true_wall).ends)))
    for k, wall in enumerate(room.walls):
        _add_wall(shown, wall, (room.corners[k - 1], room.corners[k]), f"side {k + 1}")
    shown.bodies += [DrawnVehicle(touch.place, touch.heading_rad, None) for touch in touches]
    shown.places += [Place(MapKind.CONTACT, touch.place) for touch in touches]
    places = np.array([touch.place for touch in touches] or [mission.start])
    reach = airframe.contact_distance_m + _MARGIN_M
    figure, axis = new_figure(look, 5.0)
    set_view(axis, np.stack([places.min(axis=0) - reach, places.max(axis=0) + reach]))
    draw_map(axis, shown)
    state = "closed" if room.is_closed else f"open in {len(room.gaps_rad)} directions"
    axis.set_title(f"{mission.name}: {len(touches)} contacts, outline {state}", loc="left")
    finish_map(figure, axis, shown, look)
    return figure


def _add_wall(shown: RoomMap, wall: RoomWall, corners: tuple[Vec2 | None, Vec2 | None], name: str) -> None:
    """Add a wall and its uncertainty band.

    The wall is drawn from corner to corner. If a corner is missing, the wall is drawn to `_OPEN_M` beyond its
    outermost contact.
    """
    normal, tangent = np.array(wall.normal), np.array([-wall.normal[1], wall.normal[0]])
    touched = np.array([touch.place for touch in wall.touches]) @ tangent
    known = [float(np.array(corner) @ tangent) for corner in corners if corner is not None]
    reach = [*touched, *known] if len(known) == 2 else [*(touched - _OPEN_M), *(touched + _OPEN_M)]
    t = np.linspace(float(min(reach)), float(max(reach)), 40)
    line = wall.offset_m * normal + t[:, None] * tangent
    beside = (t - touched.mean()) * math.tan(wall.normal_sd_rad)
    band = uncertainty_band(line, wall.normal, np.hypot(wall.offset_sd_m, beside))
    shown.areas.append(Line(MapKind.BAND, band, f"± {SURE:g} standard deviations"))
    shown.paths.append(Line(MapKind.MEASURED_WALL, line))
    (x, y), (nx, ny) = line[len(line) // 2], wall.normal
    shown.labels.append(Label(name, (float(x), float(y)), (-nx, -ny)))


def write_room_picture(mission: Mission, room: Room, touches: Sequence[RoomContact], path: Path) -> None:
    save_figure(room_figure(mission, room, touches), path)
