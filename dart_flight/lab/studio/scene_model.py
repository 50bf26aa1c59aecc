"""What the studio's room view shows, as data: no viser, no matplotlib.

Points are in the mission frame, metres, (x, y, z), z up. Objects have an `id`, which findings and edits use,
too: `wall/NAME`, `simulated/NAME`, `post/NAME`, `start`, `goal`, `waypoint/I`, `visit/I`, `corner/I`, `hit/I`
(I counts from 0). A partition is one object with two faces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import Document, InputError
from dart_flight.config.file_kinds import FileKind, kind_of_tree
from dart_flight.config.flight_space import FlightSpace
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.mission_file import (
    BoundsSpec,
    GoalSpec,
    MissionFile,
    PostSpec,
    StartSpec,
    WallSpec,
    WaypointSpec,
)
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import VehicleConfig, load_vehicle
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import DrawnWall, MapKind, arms_m, at_altitude, drawn_walls, uncertainty_band
from dart_flight.lab.mission_map import PlannedHit, mission_map, planned_hits
from dart_flight.lab.search.scenario import Scenario, VisitSpec, parse_scenario
from dart_flight.lab.studio.objects import entry_of
from dart_flight.lab.studio.open_file import Tree
from dart_flight.planning.predicted_flight import PredictedFlight

M_PER_N = 0.003  # length of a force's arrow
_M_PER_M_S = 0.3  # length of a velocity's arrow
# A room in which each wall of a file resolves on its own, even if start, goal or bounds do not load.
_EMPTY_ROOM = MissionFile(
    version=1,
    name="empty room",
    start=StartSpec((0.0, 0.0), 1.0),
    goal=GoalSpec((0.0, 0.0)),
    bounds_m=BoundsSpec((-1.0, 1.0), (-1.0, 1.0), (0.0, 2.0)),
)


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


class LoadedFile(NamedTuple):
    """A text as the commands load it, as far as it loads.

    Attributes:
        document: values and lines of the text.
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
        if kind_of_tree(document.tree) is FileKind.SCENARIO:
            scenario = parse_scenario(document)
            return LoadedFile(document, scenario.vehicle, scenario, None)
        mission = parse_mission(document)
        return LoadedFile(document, mission.vehicle, mission, None)
    except InputError as error:
        return LoadedFile(document, _vehicle_of(document), None, error)


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


def build_scene(text: str, path: Path) -> Scene:
    """Return the scene of a mission's or scenario's text, without a prediction; `path` is the text's file.

    Parts that do not load are left out, so that a text with an error still shows its room.

    Raises:
        InputError: the text is not YAML, or no vehicle loads.
    """
    return scene_of(load_text(text, path))


def scene_of_mission(mission: Mission, planned: PredictedFlight | None = None) -> Scene:
    """Return the scene of a mission that is not an open file, such as that of a recorded flight."""
    # Not from `Mission.to_dict`, because a log may lack the keys as written.
    room = MissionFile(
        version=1,
        name=mission.name,
        frame=mission.frame,
        start=StartSpec(mission.start, mission.altitude_m),
        goal=mission.goal,
        bounds_m=mission.bounds,
        walls=_wall_specs(mission.flat_walls),
        simulated_walls=_wall_specs(mission.simulated_walls),
        posts={post.name: PostSpec(post.centre, post.radius_m, post.material) for post in mission.posts},
    )
    document = Document.from_tree(msgspec.to_builtins(room), mission.source)
    return scene_of(LoadedFile(document, mission.vehicle, mission, None), planned)


def _wall_specs(walls: Sequence[Wall]) -> dict[str, WallSpec]:
    """Return walls as in a file, each face of a partition on its own."""
    return {
        wall.name: WallSpec(
            wall.point,
            wall.normal,
            wall.length_m,
            wall.material,
            "centre",
            wall.position_sd_m,
            None if wall.yaw_sd_rad is None else math.degrees(wall.yaw_sd_rad),
        )
        for wall in walls
    }


def scene_of(loaded: LoadedFile, planned: PredictedFlight | None = None) -> Scene:
    """Return the scene of a file, with a mission's predicted path and hits if the flight is given."""
    tree, resolved = loaded.document.tree, loaded.resolved
    mission = resolved if isinstance(resolved, Mission) else None
    room = _LoadedRoom(tree, loaded.vehicle, mission)
    scene = Scene(
        name=str(tree.get("name") or Path(loaded.document.source).stem),
        bounds=room.bounds,
        north_rad=math.radians(_number(tree, "frame", "heading_deg") or 0.0),
        vehicle=_vehicle_shape(loaded.vehicle),
        walls=list(room.walls()),
        posts=list(room.posts()),
        places=list(room.places()),
        predicted=planned is not None,
        problem=None if loaded.error is None else loaded.error.one_line(),
    )
    if mission is not None:
        shown = mission_map(mission, planned)
        scene.paths = [PathShape(p.kind, _raised(p.points, room.altitude_m), p.legend) for p in shown.paths]
        scene.hits = [_hit_shape(hit) for hit in planned_hits(mission, planned)]
    scene.handles = list(_handles(scene, room))
    return scene


class _LoadedRoom:
    """The parts of a room that load, each on its own."""

    def __init__(self, tree: Tree, vehicle: VehicleConfig, mission: Mission | None) -> None:
        self.tree, self._vehicle, self._mission = tree, vehicle, mission
        self.altitude_m = _number(tree, "start", "altitude_m") or 1.0
        self.points = dict[str, Vec2]()  # id -> point of a wall in the file
        self.bounds = self._bounds()
        self._space = FlightSpace(_EMPTY_ROOM, vehicle, Document.from_tree({}))

    def _bounds(self) -> tuple[Vec3, Vec3]:
        spec = _converted(self.tree.get("bounds_m"), BoundsSpec)
        if spec is None:
            return (-2.0, -2.0, 0.0), (2.0, 2.0, 2.0)
        return (spec.x[0], spec.y[0], spec.z[0]), (spec.x[1], spec.y[1], spec.z[1])

    def walls(self) -> Iterator[WallShape]:
        for section, prefix in (("walls", "wall"), ("simulated_walls", "simulated")):
            found = [(f"{prefix}/{name}", wall) for name, wall in self._walls_of(section)]
            drawn = drawn_walls([wall for _, wall in found], self._vehicle.airframe)
            for (object_id, _), wall in zip(found, drawn, strict=True):
                self.points.setdefault(object_id, wall.plane.point)
                yield self._wall_shape(object_id, wall)

    def _walls_of(self, section: str) -> Iterator[tuple[str, Wall]]:
        known = next(iter(self._vehicle.materials), "")
        for name, value in _entries(self.tree, section):
            spec = _converted(value, WallSpec)
            if spec is None or not any(spec.normal):
                continue
            self.points[f"{'wall' if section == 'walls' else 'simulated'}/{name}"] = spec.point_m
            material = spec.material if spec.material in self._vehicle.materials else known
            given_at = spec.given_at or "centre"
            loads = msgspec.structs.replace(spec, material=material, given_at=given_at)
            resolved = self._space.resolve_walls({name: loads}, section)
            for wall in resolved.values():
                yield name, msgspec.structs.replace(wall, material=spec.material)

    def _wall_shape(self, object_id: str, drawn: DrawnWall) -> WallShape:
        wall, surface = drawn.plane, drawn.surface
        band = None
        if wall.is_uncertain:
            along = np.linspace(-0.5, 0.5, 2 if not wall.yaw_sd_rad else 21) * wall.length_m
            line = np.array(surface.point) + along[:, None] * np.array(surface.tangent)
            turned = along * math.tan(wall.yaw_sd_rad or 0.0)
            band = uncertainty_band(line, wall.normal, np.hypot(wall.position_sd_m or 0.0, turned))
        return WallShape(
            object_id,
            wall.name,
            wall.material,
            surface.ends,
            drawn.outline,
            wall.ends,
            surface.point,
            math.atan2(wall.normal[1], wall.normal[0]),
            self.bounds[1][2],
            band,
            object_id.startswith("simulated/"),
        )

    def posts(self) -> Iterator[PostShape]:
        for name, value in _entries(self.tree, "posts"):
            spec = _converted(value, PostSpec)
            if spec is not None:
                yield PostShape(
                    f"post/{name}", name, spec.material, spec.centre_m, spec.radius_m, self.bounds[1][2]
                )

    def places(self) -> Iterator[PlaceShape]:
        start = _converted(self.tree.get("start"), StartSpec)
        if start is not None:
            yield PlaceShape("start", "start", "start", (*start.position_m, self.altitude_m))
        z = self.altitude_m
        for shape in self._waypoints():
            z = shape.at[2]
            yield shape
        visits = self.tree.get("visits")
        for i, value in enumerate(visits if isinstance(visits, list) else []):
            visit = _converted(value, VisitSpec)
            if visit is not None:
                at = (*visit.position_m, self.altitude_m)
                yield PlaceShape(f"visit/{i}", "visit", f"visit {i + 1}", at, visit.within_m)
        goal = _converted(self.tree.get("goal"), GoalSpec)
        if goal is not None:
            yield PlaceShape("goal", "goal", "goal", (*goal.position_m, z), goal.capture_radius_m)

    def _waypoints(self) -> Iterator[PlaceShape]:
        if self._mission is not None:
            known = [waypoint.position for waypoint in self._mission.waypoints]
        else:
            known = list(self._waypoints_as_written())
        before = self.altitude_m
        for i, at in enumerate(known):
            if at is not None:
                label = f"{i + 1}" if at[2] == before else f"{i + 1}: {at[2]:g} m high"
                yield PlaceShape(f"waypoint/{i}", "waypoint", label, at)
                before = at[2]

    def _waypoints_as_written(self) -> Iterator[Vec3 | None]:
        z, written = self.altitude_m, self.tree.get("waypoints")
        for value in written if isinstance(written, list) else []:
            spec = _converted(value, WaypointSpec)
            z = z if spec is None or spec.altitude_m is None else spec.altitude_m
            yield None if spec is None or spec.position_m is None else (*spec.position_m, z)


def _vehicle_shape(vehicle: VehicleConfig) -> VehicleShape:
    airframe = vehicle.airframe
    return VehicleShape(
        [np.array([*guard, guard[0]]) for guard in airframe.guards_m],
        [np.array(arm) for arm in arms_m(airframe)],
        airframe.contact_distance_m,
        vehicle.has_lock,
    )


def _hit_shape(hit: PlannedHit) -> HitShape:
    speed = None if hit.velocity is None else math.hypot(*hit.velocity)
    label = hit.text or f"{hit.number} {hit.mode.value}" + ("" if speed is None else f"\n{speed:.2f} m/s")
    return HitShape(
        f"hit/{hit.number - 1}",
        hit.number,
        hit.wall.name,
        hit.mode,
        hit.at,
        hit.yaw_rad,
        speed,
        label,
        None if hit.velocity is None else (_beside(hit.at, hit.velocity, -_M_PER_M_S), hit.at),
        None if hit.force is None else (hit.at, _beside(hit.at, hit.force, M_PER_N)),
        None if hit.setpoint is None else (*hit.setpoint, hit.at[2]),
    )


def _beside(at: Vec3, vector: Vec2, scale: float) -> Vec3:
    return (at[0] + scale * vector[0], at[1] + scale * vector[1], at[2])


def _handles(scene: Scene, room: _LoadedRoom) -> Iterator[Handle]:
    z, faces = room.altitude_m, set[str]()
    for wall in scene.walls:
        if wall.id not in faces:  # a partition has one handle, at its front
            faces.add(wall.id)
            yield Handle(wall.id, "wall", (*room.points[wall.id], z), wall.yaw_rad)
    for post in scene.posts:
        yield Handle(post.id, "post", (*post.centre, z))
    for place in scene.places:
        written = entry_of(room.tree, place.id)
        if isinstance(written, dict) and "position_m" in written:
            yield Handle(place.id, place.kind, place.at)
    (x0, y0, _), (x1, y1, _) = scene.bounds
    for i, corner in enumerate(((x0, y0), (x1, y0), (x1, y1), (x0, y1))):
        yield Handle(f"corner/{i}", "corner", (*corner, z))


def _raised(points: Array, z: float) -> Array:
    """Return a line as (n, 3); a line without altitude is at `z`."""
    return points if points.shape[1] == 3 else at_altitude(points, z)


def _entries(tree: Tree, section: str) -> Iterator[tuple[str, Any]]:
    found = tree.get(section)
    yield from found.items() if isinstance(found, dict) else ()


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


def encode_scene(value: Any) -> Any:
    """Convert arrays for msgspec (`enc_hook`)."""
    if isinstance(value, np.ndarray):
        return value.round(5).tolist()
    raise TypeError(type(value).__name__)


def decode_scene(kind: Any, value: Any) -> Any:
    """Convert lists to arrays for msgspec (`dec_hook`)."""
    return np.asarray(value, dtype=float)
