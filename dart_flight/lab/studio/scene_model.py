"""What the studio's room view shows, as data: no viser, no matplotlib.

Points are in the mission frame, metres, (x, y, z), z up. Objects have an `id`, which findings and edits use,
too: `wall/NAME`, `simulated/NAME`, `post/NAME`, `start`, `goal`, `waypoint/I`, `visit/I`, `corner/I`, `hit/I`
(I counts from 0). A partition is one object with two faces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import MapKind


class WallShape(msgspec.Struct):
    """A wall, or one face of a partition.

    Attributes:
        id: the object in the file; both faces of a partition have the same.
        surface: the left and right end of the surface, looking along the normal.
        outline: corners (4, 2) of the solid behind the surface.
        plane: ends of the plane where the vehicle's centre is at first touch.
        centre: middle of the surface.
        yaw_rad: direction of the normal.
        height_m: drawn height above the ground: that of the bounds.
        band: corners (n, 2) of the area of three standard deviations around the surface, or None.
        simulated: whether the wall exists only in simulation.
    """

    id: str
    name: str
    material: str
    surface: tuple[Vec2, Vec2]
    outline: Array
    plane: tuple[Vec2, Vec2]
    centre: Vec2
    yaw_rad: float
    height_m: float
    band: Array | None = None
    simulated: bool = False


class PostShape(msgspec.Struct):
    """A post, as a cylinder that stands on the ground."""

    id: str
    name: str
    material: str
    centre: Vec2
    radius_m: float
    height_m: float


class PlaceShape(msgspec.Struct):
    """Start, goal, a waypoint or a visit.

    Attributes:
        label: text beside it, such as `goal` or `2: 1.5 m high`.
        radius_m: capture radius of the goal or tolerance of a visit; 0 without one.
    """

    id: str
    kind: str
    label: str
    at: Vec3
    radius_m: float = 0.0


class HitShape(msgspec.Struct):
    """A planned hit, where the flight model predicts it, or where the mission plans it.

    Attributes:
        number: number in the order of flight, from 1.
        wall: name of the wall or post.
        vehicle_yaw_rad: heading of the vehicle at the hit.
        arrow: velocity before the hit as an arrow that ends at the hit: begin and end; None if unknown.
        force: peak force as an arrow from the hit: begin and end; None if unknown.
        setpoint: recovery setpoint, or None.
        label: mode, speed and force, in lines.
    """

    id: str
    number: int
    wall: str
    mode: Mode
    at: Vec3
    vehicle_yaw_rad: float
    speed_m_s: float | None
    label: str
    arrow: tuple[Vec3, Vec3] | None = None
    force: tuple[Vec3, Vec3] | None = None
    setpoint: Vec3 | None = None


class PathShape(msgspec.Struct):
    """A line; `points` is (n, 3)."""

    kind: MapKind
    points: Array
    legend: str = ""


class VehicleShape(msgspec.Struct):
    """The vehicle from above, in its own axes (forward, left), metres.

    Attributes:
        guards: closed outlines (n, 2).
        arms: lines (2, 2) from the frame to each motor.
        reach_m: distance from the centre to the side.
    """

    guards: list[Array]
    arms: list[Array]
    reach_m: float
    has_lock: bool


class Handle(msgspec.Struct):
    """What the mouse can move; `edits.drag` makes the edit.

    Attributes:
        position: place of the handle.
        yaw_rad: direction, if the handle can be turned (a wall's normal), or None.
    """

    id: str
    kind: str
    position: Vec3
    yaw_rad: float | None = None


class Scene(msgspec.Struct):
    """Everything that the room view shows of a file.

    Attributes:
        bounds: low and high corner.
        north_rad: direction of north, counter-clockwise from x.
        predicted: whether paths and hits are those of the flight model; without it, the file has an error, or
            the scene was built without a prediction.
        problem: why the file does not load, in one line, or None; the scene then shows what does load.
    """

    name: str
    bounds: tuple[Vec3, Vec3]
    north_rad: float
    vehicle: VehicleShape
    walls: list[WallShape] = []
    posts: list[PostShape] = []
    places: list[PlaceShape] = []
    hits: list[HitShape] = []
    paths: list[PathShape] = []
    handles: list[Handle] = []
    predicted: bool = False
    problem: str | None = None


def build_scene(text: str, path: Path) -> Scene:
    """Return the scene of a mission's or scenario's text, without a prediction; `path` is the text's file.

    Parts that do not load are left out, so that a text with an error still shows its room.

    Raises:
        InputError: the text is not YAML, or has no vehicle that loads.
    """
    raise NotImplementedError


def encode_scene(value: Any) -> Any:
    """Convert arrays for msgspec (`enc_hook`)."""
    if isinstance(value, np.ndarray):
        return value.round(5).tolist()
    raise TypeError(type(value).__name__)


def decode_scene(kind: Any, value: Any) -> Any:
    """Convert lists to arrays for msgspec (`dec_hook`)."""
    return np.asarray(value, dtype=float)
