"""The map of a room measured by touch: its walls, their uncertainty, and the contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission
from dart_flight.lab.figure_style import FORCE, GREY, Look, in_style, new_figure, save_figure
from dart_flight.lab.report.figures.map_drawing import draw_vehicle
from dart_flight.planning.room import Room, RoomContact, RoomWall

_SHEET = Look(7.2, 6.4)
_SURE = 3.0  # standard deviations of the band around a wall
_OPEN_M = 0.7  # extension of a wall without a corner beyond its contacts
_MARGIN_M = 0.4


@in_style
def room_figure(mission: Mission, room: Room, touches: Sequence[RoomContact], *, look: Look = _SHEET) -> Any:
    """Draw the plan view of a room: contacts, and walls with a band of three standard deviations.

    The mission gives the start and, for a simulated room, the true walls. `touches` are the contacts from
    which the room was measured.
    """
    figure, axis = new_figure(look, 5.0)
    airframe = mission.vehicle.airframe
    for true_wall in mission.simulated_walls:
        ends = np.array(airframe.wall_surface(true_wall).ends)
        axis.plot(*ends.T, color=GREY, linewidth=3.0, alpha=0.5, label="true wall (simulation)")
    for k, wall in enumerate(room.walls):
        _draw_wall(axis, wall, room.corners[k - 1], room.corners[k], f"side {k + 1}", look)
    for touch in touches:
        draw_vehicle(axis, airframe, touch.place, touch.heading_rad, None, colour="#777777")
    places = np.array([touch.place for touch in touches] or [mission.start])
    axis.plot(*places.T, ".", color=FORCE, markersize=5, label="contact, the vehicle's centre", zorder=5)
    axis.plot(*mission.start, "o", color="#000000", markersize=5, label="start", zorder=5)
    reach = airframe.contact_distance_m + _MARGIN_M
    axis.set(
        xlim=(places[:, 0].min() - reach, places[:, 0].max() + reach),
        ylim=(places[:, 1].min() - reach, places[:, 1].max() + reach),
        aspect="equal", xlabel="x, m", ylabel="y, m",
    )  # fmt: skip
    axis.grid(visible=False)
    state = "closed" if room.is_closed else f"open in {len(room.gaps_rad)} directions"
    axis.set_title(f"{mission.name}: {len(touches)} contacts, outline {state}", loc="left")
    handles, labels = axis.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    figure.legend(once.values(), once.keys(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_wall(
    axis: Any, wall: RoomWall, before: Vec2 | None, after: Vec2 | None, name: str, look: Look
) -> None:
    """Draw a wall and its uncertainty band.

    The wall is drawn from corner to corner. If a corner is missing, the wall is drawn `_OPEN_M` beyond its
    outermost contacts.
    """
    normal, tangent = np.array(wall.normal), np.array([-wall.normal[1], wall.normal[0]])
    touched = np.array([touch.place for touch in wall.touches]) @ tangent
    corners = [float(np.array(corner) @ tangent) for corner in (before, after) if corner is not None]
    reach = [*touched, *corners] if len(corners) == 2 else [*(touched - _OPEN_M), *(touched + _OPEN_M)]
    t = np.linspace(float(min(reach)), float(max(reach)), 40)
    line = wall.offset_m * normal + t[:, None] * tangent
    beside = (t - touched.mean()) * math.tan(wall.normal_sd_rad)
    open_m = _SURE * np.hypot(wall.offset_sd_m, beside)[:, None]
    band = np.vstack([line + open_m * normal, (line - open_m * normal)[::-1]])
    axis.fill(*band.T, color="#8db4e2", alpha=0.5, linewidth=0.0, label=f"± {_SURE:g} standard deviations")
    axis.plot(*line.T, color="#000000", linewidth=1.6, label="measured wall")
    middle = line[len(line) // 2] - 0.16 * normal
    axis.text(*middle, name, ha="center", va="center", fontsize=look.small_pt)


def write_room_picture(mission: Mission, room: Room, touches: Sequence[RoomContact], path: Path) -> None:
    save_figure(room_figure(mission, room, touches), path)
