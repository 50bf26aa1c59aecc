"""The content of a map as data: the room of a mission, and the paths, places and vehicles in the room.

`lab/report/figures/map_drawing.py` draws a map from above and from the side, `lab/report/player.py` draws the
animation of a page, and `lab/scene/drawing.py` draws the scene of a viewer. Points are (x, y, z) in the
mission frame, metres, z up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import AfterImpact, Mode
from dart_flight.base.walls import Post, Wall
from dart_flight.config.mission import Mission
from dart_flight.config.mission_file import BoundsSpec
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.flight_arrays import Array
from dart_flight.planning.predicted_flight import PredictedFlight, predicted_segments

SURE = 3.0  # half width of the band around an uncertain wall, in standard deviations
THICKNESS_M = 0.12  # drawn thickness of a wall; the true thickness is unknown
_OPPOSED, _SAME_PLANE_M = (
    -0.9,
    0.01,
)  # largest cosine between opposite normals; largest offset between surfaces in one plane
_BACK_TO_BACK_M = 0.4  # if less space is behind a wall, its name is written in front of it
_LONGEST_ARROW_M = 0.45  # length of the arrow of the largest force


class MapKind(StrEnum):
    """The kind of a path, place or area; the value is its name in a legend."""

    BOUNDS = "bounds_m"
    WALL = "wall"
    PLANE = "vehicle's centre at first contact"
    CAPTURE = "capture radius"
    START = "start"
    GOAL = "goal"
    GOAL_ALTITUDE = "altitude of the goal"
    GROUND = "ground"
    WAYPOINT = "waypoint"
    RUN_UP = "run-up begins"
    PROBE = "probe"
    PREDICTED = "predicted trajectory"
    DRAW = "draw of the walls"
    PLANNED = "planned"
    REPLANNED = "planned in flight"
    TRUE = "flown (true)"
    ESTIMATED = "flown (estimated)"
    ONE_OF_MANY = "flown"
    HIT = "hit"
    SECOND = "every second"
    LABELLED_SECOND = "labelled second"
    GUARD = "guard"
    RECOVERY = "recovery setpoint"
    FORCE = "peak force"
    TRUE_WALL = "true wall (simulation)"
    MEASURED_WALL = "measured wall"
    BAND = "uncertainty of the wall"
    CONTACT = "contact, the vehicle's centre"


_HUB_SHARE = 0.45  # inner end of the drawn arms, as a fraction of the distance to the motor
FlatLine = Array | Sequence[Vec2]


class Line(NamedTuple):
    """A line (n, 2) or (n, 3), or the outline of an area; an empty `legend` stands for the kind."""

    kind: MapKind
    points: Array
    legend: str = ""


class Place(NamedTuple):
    """A point with a symbol."""

    kind: MapKind
    at: Vec2 | Vec3
    legend: str = ""


class Arrow(NamedTuple):
    """An arrow that shows a force, or the direction of a path."""

    kind: MapKind
    begin: Vec2
    end: Vec2


class DrawnVehicle(NamedTuple):
    """The vehicle at a place.

    Attributes:
        mode: mode of the arms; None: unknown.
        number: number of the hit, or None if the vehicle is not at a hit.
    """

    at: Vec2 | Vec3
    yaw_rad: float
    mode: Mode | None
    number: int | None = None


class Label(NamedTuple):
    """A text at a point.

    Attributes:
        away: preferred direction from the point to the label. (0, 0) if no direction is preferred.
    """

    text: str
    at: Vec2
    away: Vec2 = (0.0, 0.0)
    colour: str = "#000000"


class DrawnWall(NamedTuple):
    """A wall as drawn.

    Attributes:
        plane: the plane of first touch, where the vehicle's centre is.
        surface: the wall's surface, which the vehicle's side touches.
        thickness_m: drawn thickness behind the surface; at most half the distance to an opposite surface.
        name_in_front: whether the name is in front of the wall, because the space behind it is too narrow.
    """

    plane: Wall
    surface: Wall
    thickness_m: float = THICKNESS_M
    name_in_front: bool = False

    @property
    def name(self) -> str:
        """The wall's name, and its material if the two differ."""
        return named_material(self.plane)

    @property
    def outline(self) -> Array:
        """The corners (4, 2), m: both ends of the surface, then both corners behind the surface."""
        surface = np.array(self.surface.ends)
        return np.vstack([surface, (surface - self.thickness_m * np.array(self.surface.normal))[::-1]])


def named_material(thing: Wall | Post) -> str:
    """Return the name of a wall or post, and its material if the two differ."""
    return thing.name if thing.name == thing.material else f"{thing.name} ({thing.material})"


class RoomMap(msgspec.Struct):
    """The content of a map.

    Attributes:
        north_rad: direction of north, counter-clockwise from x.
        goal: the goal, at the altitude of the flight after all waypoints.
        newton_per_m: scale of the force arrows.
    """

    airframe: Airframe
    bounds: BoundsSpec
    north_rad: float
    start: Vec3
    goal: Vec3
    capture_radius_m: float
    walls: tuple[DrawnWall, ...]
    posts: tuple[Post, ...]
    areas: list[Line] = []
    paths: list[Line] = []
    places: list[Place] = []
    arrows: list[Arrow] = []
    bodies: list[DrawnVehicle] = []
    labels: list[Label] = []
    newton_per_m: float = 0.0

    def add_forces(self, forces: Iterable[tuple[Vec2, Vec2]]) -> None:
        """Add an arrow for each force (place, newtons along x and y), to a common scale."""
        found = list(forces)
        self.newton_per_m = max((math.hypot(*n) for _, n in found), default=0.0) / _LONGEST_ARROW_M
        for (x, y), (along_x, along_y) in found if self.newton_per_m else []:
            tip = (x + along_x / self.newton_per_m, y + along_y / self.newton_per_m)
            self.arrows.append(Arrow(MapKind.FORCE, (x, y), tip))

    def add_hit(self, body: DrawnVehicle, setpoint: Vec2 | None) -> None:
        """Add the vehicle at its hit, and a line to the recovery setpoint."""
        self.bodies.append(body)
        if setpoint is not None:
            self.paths.append(Line(MapKind.RECOVERY, np.array([body.at[:2], setpoint])))


def room_map(mission: Mission) -> RoomMap:
    """Return a map of the mission's bounds, walls, posts, waypoints, start and goal."""
    start = (*mission.start, mission.altitude_m)
    goal = (*mission.goal.position_m, mission.altitude_at(len(mission.collisions)))
    airframe = mission.vehicle.airframe
    return RoomMap(
        airframe,
        mission.bounds,
        math.radians(mission.frame.heading_deg),
        start,
        goal,
        mission.goal.capture_radius_m,
        tuple(drawn_walls(mission.flat_walls, airframe)),
        mission.posts,
        paths=[Line(MapKind.CAPTURE, circle(goal, mission.goal.capture_radius_m))],
        places=[
            *(Place(MapKind.WAYPOINT, w.position) for w in mission.waypoints if w.position is not None),
            Place(MapKind.START, start),
            Place(MapKind.GOAL, goal),
        ],
        labels=[Label(named_material(post), post.centre, colour="#333333") for post in mission.posts],
    )


def drawn_walls(walls: Sequence[Wall], airframe: Airframe) -> Iterator[DrawnWall]:
    surfaces = [airframe.wall_surface(wall) for wall in walls]
    for wall, surface in zip(walls, surfaces, strict=True):
        gap_m = _gap_behind_m(surface, surfaces)
        yield DrawnWall(wall, surface, min(THICKNESS_M, 0.5 * gap_m), gap_m < _BACK_TO_BACK_M)


def _gap_behind_m(own: Wall, surfaces: Sequence[Wall]) -> float:
    """Return the distance to the nearest opposite surface behind `own`; infinity if there is none."""
    gaps = [math.inf]
    for face in surfaces:
        opposed = own.normal[0] * face.normal[0] + own.normal[1] * face.normal[1] < _OPPOSED
        # Surfaces that do not overlap along the wall are not back to back.
        beside_m = abs(own.along(face.point)) - 0.5 * (own.length_m + face.length_m)
        if opposed and beside_m < 0.0:
            gap_m = -own.signed_distance(face.point)
            gaps += [gap_m] if gap_m > -_SAME_PLANE_M else []
    return max(0.0, min(gaps))


def planned_lines(mission: Mission, planned: PredictedFlight) -> list[Array]:
    """Return the predicted path in the air as lines (n, 3).

    If a recovery has no predicted leg, its line leads straight from the hit to the setpoint. With
    `after_impact: replan`, the last recovery leads to the goal instead.
    """
    last = len(mission.collisions)
    replans = mission.after_impact is AfterImpact.REPLAN and mission.goal_trajectory is None
    to_goal = last if replans and mission.recovers_to_goal else None
    legs = {index: leg for index, leg in planned.legs.items() if index != to_goal}
    found = [np.array([s.begin or s.end, s.end]) for s in predicted_segments(mission, planned.hits)]
    for index, hit in planned.hits.items():
        if index not in legs and mission.standoff_m is None:
            end = mission.goal.position_m if index == to_goal else hit.setpoint
            found.append(at_altitude([hit.position, end], mission.altitude_at(index - 1)))
    lines: list[tuple[int, FlatLine]] = [*planned.approaches.items(), *legs.items()]
    return found + [at_altitude(line, mission.altitude_at(index - 1)) for index, line in lines]


def uncertainty_band(line: Array, normal: Vec2, sd_m: Array) -> Array:
    """Return the outline of the band that extends `SURE` times `sd_m` (n,) to both sides of a line (n, 2)."""
    apart = SURE * sd_m[:, None] * np.array(normal)
    return np.vstack([line + apart, (line - apart)[::-1]])


def circle(centre: Sequence[float], radius_m: float) -> Array:
    """Return points on a horizontal circle, with as many coordinates as its centre."""
    angle = np.linspace(0.0, 2.0 * math.pi, 49)
    around = np.zeros((angle.size, len(centre)))
    around[:, :2] = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(around + np.array(centre))


def placed(points: Sequence[Vec2], at: Vec2 | Vec3, yaw_rad: float) -> Array:
    """Convert points from body axes (forward, left) to the mission frame, (n, 2)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([(at[0] + c * x - s * y, at[1] + s * x + c * y) for x, y in points])


def arms_m(airframe: Airframe) -> list[tuple[Vec2, Vec2]]:
    """Return a line for each arm, from the frame to the motor (forward, left), m."""
    return [
        ((_HUB_SHARE * motor.x_m, -_HUB_SHARE * motor.y_m), (motor.x_m, -motor.y_m))
        for motor in airframe.motors
    ]


def at_altitude(line: FlatLine, z: float) -> Array:
    """Return a line (n, 2 or more), whose first columns are x and y, as (n, 3) at an altitude."""
    points = np.asarray(line, dtype=float)[:, :2]
    return np.column_stack([points, np.full(len(points), z)])
