"""What the studio's room view shows, as data: no viser, no matplotlib.

Points are in the mission frame, metres, (x, y, z), z up. Objects have the ids of `objects`. A partition is
one object with two faces.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.walls import Post, Wall
from dart_flight.config.document import Document, InputError
from dart_flight.config.file_kinds import FileKind, kind_of_tree
from dart_flight.config.flight_space import resolve_walls
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.mission_file import BoundsSpec, GoalSpec, PostSpec, StartSpec, WallSpec, WaypointSpec
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import Airframe, VehicleConfig, load_vehicle
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import DrawnWall, Line, at_altitude, drawn_walls, uncertainty_band
from dart_flight.lab.mission_map import PlannedHit, mission_map, planned_hits
from dart_flight.lab.search.scenario import Scenario, VisitSpec, parse_scenario
from dart_flight.lab.studio.objects import base_name, entry_of
from dart_flight.lab.studio.open_file import Tree
from dart_flight.planning.predicted_flight import PredictedFlight

_NO_BOUNDS = BoundsSpec((-2.0, 2.0), (-2.0, 2.0), (0.0, 2.0))


class WallShape(NamedTuple):
    """A wall, or one face of a partition; both faces have the id of the partition."""

    id: str
    drawn: DrawnWall

    @property
    def yaw_rad(self) -> float:
        """Direction of the normal."""
        return math.atan2(self.drawn.plane.normal[1], self.drawn.plane.normal[0])

    @property
    def simulated(self) -> bool:
        """Whether the wall exists only in simulation."""
        return self.id.startswith("simulated/")

    def band(self) -> Array | None:
        """Return the corners (n, 2) of the area of three standard deviations around the surface, or None."""
        wall, surface = self.drawn.plane, self.drawn.surface
        if not wall.is_uncertain:
            return None
        along = np.linspace(-0.5, 0.5, 2 if not wall.yaw_sd_rad else 21) * wall.length_m
        line = np.array(surface.point) + along[:, None] * np.array(surface.tangent)
        turned = along * math.tan(wall.yaw_sd_rad or 0.0)
        return uncertainty_band(line, wall.normal, np.hypot(wall.position_sd_m or 0.0, turned))


class PlaceShape(NamedTuple):
    """Start, goal, a waypoint or a visit.

    Attributes:
        label: text beside it, such as `goal` or `2: 1.5 m high`.
        radius_m: capture radius of the goal or tolerance of a visit; 0 without one.
    """

    id: str
    label: str
    at: Vec3
    radius_m: float = 0.0


class Handle(NamedTuple):
    """What the mouse can move; `edits.drag` makes the edit. A wall's `yaw_rad` is that of its normal."""

    id: str
    position: Vec3
    yaw_rad: float | None = None


class Scene(msgspec.Struct):
    """Everything that the room view shows of a file or of a flight.

    Attributes:
        north_rad: direction of north, counter-clockwise from x.
        handles: what can be moved; empty without a file.
        predicted: whether paths and hits are those of the flight model.
        problem: why the file does not load, in one line, or None; the scene then shows what does load.
    """

    name: str
    bounds: BoundsSpec
    north_rad: float
    airframe: Airframe
    walls: list[WallShape]
    posts: list[Post]
    places: list[PlaceShape]
    hits: list[PlannedHit] = []
    paths: list[Line] = []
    handles: list[Handle] = []
    predicted: bool = False
    problem: str | None = None

    @property
    def size_m(self) -> float:
        """The longer side of the bounds."""
        (x0, x1), (y0, y1) = self.bounds.x, self.bounds.y
        return max(x1 - x0, y1 - y0)

    def extent(self) -> tuple[Vec2, Vec2]:
        """Return the low and high corner of the bounds with all walls."""
        corners = np.array([self.bounds.x, self.bounds.y]).T
        points = np.vstack([corners, *(wall.drawn.outline for wall in self.walls)])
        (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return (x0, y0), (x1, y1)


class LoadedFile(NamedTuple):
    """A text as the commands load it, as far as it loads.

    Attributes:
        vehicle: its vehicle, or the default one if its own does not load.
        resolved: mission or scenario, or None after an error.
        error: why the text does not load, or None.
    """

    document: Document
    vehicle: VehicleConfig
    resolved: Mission | Scenario | None
    error: InputError | None


def load_text(text: str, path: Path) -> LoadedFile:
    """Load the text of a mission or scenario as its file would load; `path` is that file.

    Raises:
        InputError: the text is not YAML, or no vehicle loads.
    """
    document = Document(text, str(path))
    try:
        scenario = kind_of_tree(document.tree) is FileKind.SCENARIO
        resolved = parse_scenario(document) if scenario else parse_mission(document)
    except InputError as error:
        return LoadedFile(document, _vehicle_of(document), None, error)
    return LoadedFile(document, resolved.vehicle, resolved, None)


def _vehicle_of(document: Document) -> VehicleConfig:
    named = document.tree.get("vehicle")
    try:
        if isinstance(named, dict):
            return load_vehicle(document.part("vehicle"))
        if isinstance(named, str):
            return find_vehicle(Path(document.source).parent / named).config
    except InputError:
        pass
    return find_vehicle().config


def scene_of_mission(mission: Mission, planned: PredictedFlight | None = None) -> Scene:
    """Return the scene of a mission, with its predicted path and hits if the flight is given."""
    airframe, z = mission.vehicle.airframe, mission.altitude_m
    walls = [(f"wall/{base_name(wall.name)}", wall) for wall in mission.flat_walls]
    walls += [(f"simulated/{base_name(wall.name)}", wall) for wall in mission.simulated_walls]
    waypoints = [waypoint.position for waypoint in mission.waypoints]
    return Scene(
        mission.name,
        mission.bounds,
        math.radians(mission.frame.heading_deg),
        airframe,
        _wall_shapes(walls, airframe),
        list(mission.posts),
        list(_places(z, StartSpec(mission.start, z), waypoints, [], mission.goal)),
        list(planned_hits(mission, planned)),
        [
            path if path.points.shape[1] == 3 else path._replace(points=at_altitude(path.points, z))
            for path in mission_map(mission, planned).paths
        ],
        predicted=planned is not None,
    )


def scene_of(loaded: LoadedFile, planned: PredictedFlight | None = None) -> Scene:
    """Return the scene of a file, with the handles of its objects."""
    if isinstance(loaded.resolved, Mission):
        scene = scene_of_mission(loaded.resolved, planned)
    else:
        scene = _scene_as_written(loaded)
    scene.handles = list(_handles(scene, loaded.document.tree))
    return scene


def _scene_as_written(loaded: LoadedFile) -> Scene:
    """Return the scene of a scenario, or of a text with an error without the parts that do not load."""
    tree, airframe = loaded.document.tree, loaded.vehicle.airframe
    z = _number(tree, "start", "altitude_m") or 1.0
    start, goal = _converted(tree.get("start"), StartSpec), _converted(tree.get("goal"), GoalSpec)
    visits = [_converted(value, VisitSpec) for value in _list(tree, "visits")]
    posts = [(name, _converted(value, PostSpec)) for name, value in _entries(tree, "posts")]
    return Scene(
        str(tree.get("name") or Path(loaded.document.source).stem),
        _converted(tree.get("bounds_m"), BoundsSpec) or _NO_BOUNDS,
        math.radians(_number(tree, "frame", "heading_deg") or 0.0),
        airframe,
        _wall_shapes(list(_walls_as_written(tree, loaded.vehicle)), airframe),
        [Post(name, post.centre_m, post.radius_m, post.material) for name, post in posts if post is not None],
        list(_places(z, start, _waypoints_as_written(tree, z), visits, goal)),
        problem=None if loaded.error is None else loaded.error.one_line(),
    )


def build_scene(text: str, path: Path) -> Scene:
    """Return the scene of a text without a prediction; raises as `load_text` does."""
    return scene_of(load_text(text, path))


def _wall_shapes(found: list[tuple[str, Wall]], airframe: Airframe) -> list[WallShape]:
    drawn = drawn_walls([wall for _, wall in found], airframe)
    return [WallShape(object_id, wall) for (object_id, _), wall in zip(found, drawn, strict=True)]


def _walls_as_written(tree: Tree, vehicle: VehicleConfig) -> Iterator[tuple[str, Wall]]:
    """Yield id and wall of each wall that loads, and of each face of a partition."""
    for section, kind in (("walls", "wall"), ("simulated_walls", "simulated")):
        for name, value in _entries(tree, section):
            spec = _converted(value, WallSpec)
            if spec is None or not any(spec.normal):
                continue
            known = spec.material if spec.material in vehicle.materials else next(iter(vehicle.materials))
            loads = msgspec.structs.replace(spec, material=known, given_at=spec.given_at or "centre")
            resolved = resolve_walls({name: loads}, vehicle, Document.from_tree({}), section)
            for wall in resolved.values():
                yield f"{kind}/{name}", msgspec.structs.replace(wall, material=spec.material)


def _places(
    z: float,
    start: StartSpec | None,
    waypoints: Iterable[Vec3 | None],
    visits: Iterable[VisitSpec | None],
    goal: GoalSpec | None,
) -> Iterator[PlaceShape]:
    if start is not None:
        yield PlaceShape("start", "start", (*start.position_m, z))
    flown = z
    for i, at in enumerate(waypoints):
        if at is not None:
            label = f"{i + 1}" if at[2] == flown else f"{i + 1}: {at[2]:g} m high"
            yield PlaceShape(f"waypoint/{i}", label, at)
            flown = at[2]
    for i, visit in enumerate(visits):
        if visit is not None:
            yield PlaceShape(f"visit/{i}", f"visit {i + 1}", (*visit.position_m, z), visit.within_m)
    if goal is not None:
        yield PlaceShape("goal", "goal", (*goal.position_m, flown), goal.capture_radius_m)


def _waypoints_as_written(tree: Tree, z: float) -> Iterator[Vec3 | None]:
    for value in _list(tree, "waypoints"):
        spec = _converted(value, WaypointSpec)
        z = z if spec is None or spec.altitude_m is None else spec.altitude_m
        yield None if spec is None or spec.position_m is None else (*spec.position_m, z)


def _handles(scene: Scene, tree: Tree) -> Iterator[Handle]:
    z = _number(tree, "start", "altitude_m") or 1.0
    fronts = {wall.id: wall for wall in reversed(scene.walls)}  # a partition has one handle, at its front
    for name, wall in fronts.items():
        x, y = entry_of(tree, name)["point_m"]
        yield Handle(name, (x, y, z), wall.yaw_rad)
    yield from (Handle(f"post/{post.name}", (*post.centre, z)) for post in scene.posts)
    for place in scene.places:
        written = entry_of(tree, place.id)
        if isinstance(written, dict) and "position_m" in written:
            yield Handle(place.id, place.at)
    (x0, x1), (y0, y1) = scene.bounds.x, scene.bounds.y
    for i, corner in enumerate(((x0, y0), (x1, y0), (x1, y1), (x0, y1))):
        yield Handle(f"corner/{i}", (*corner, z))


def _entries(tree: Tree, section: str) -> Iterator[tuple[str, Any]]:
    found = tree.get(section)
    yield from found.items() if isinstance(found, dict) else ()


def _list(tree: Tree, section: str) -> list[Any]:
    found = tree.get(section)
    return found if isinstance(found, list) else []


def _number(tree: Tree, section: str, key: str) -> float | None:
    found = tree.get(section)
    value = found.get(key) if isinstance(found, dict) else None
    return float(value) if isinstance(value, int | float) else None


S = TypeVar("S")


def _converted(value: Any, kind: type[S]) -> S | None:
    """Return a part of the file as its type, or None if it does not convert."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return None
