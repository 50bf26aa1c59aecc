"""Mission files (version 1): the YAML types, and the checked mission the flight core flies.

The file says what a person writes; `Mission` is what it means: walls as planes of the vehicle's centre,
unit normals, gains in the wall's own axes, the point of impact. `docs/missions.md` explains every key.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal, Protocol

import msgspec
from msgspec import Meta

from dart_flight.config.document import Document, InputError, Key, unknown_name
from dart_flight.config.kinds import FileKind, load_document, refuse_other_keys
from dart_flight.config.provenance import FoundVehicle, VehicleSource, find_vehicle
from dart_flight.config.section import Section
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.geometry import MissionFrame, Vec2, Vec3, Wall
from dart_flight.samples import AfterImpact, Mode, ModeMismatch

Coordinate = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]
Velocity = Annotated[float, Meta(ge=-20.0, le=20.0)]
Direction = Annotated[float, Meta(ge=-1e6, le=1e6)]
# Metres of set-point per newton: the paper's largest is 0.12. At 1 a weak hit already leads across a room.
Alpha = Annotated[float, Meta(ge=0.0, le=1.0)]
Point2 = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]

_AXIS_TOLERANCE = 1e-6


class FrameOrigin(StrEnum):
    """Where the mission frame is anchored."""

    LOCAL = "local"
    TAKEOFF = "takeoff"


class FrameSpec(Section, frozen=True):
    """Mission frame (x along the heading, y left, z up) relative to PX4's local NED.

    Attributes:
        origin: local: PX4's local origin, moved by north_m and east_m (motion capture, surveyed room);
            takeoff: as if the vehicle had taken off below start, moved likewise.
        north_m, east_m: the frame's origin from there, m.
        heading_deg: direction of the mission's x axis, clockwise from north.
    """

    origin: FrameOrigin = FrameOrigin.LOCAL
    north_m: Coordinate = 0.0
    east_m: Coordinate = 0.0
    heading_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] = 0.0


class StartSpec(Section, frozen=True):
    """Where the mission starts, in the air.

    Attributes:
        position_m: [x, y], mission frame; take-off is below it in simulation.
        altitude_m: above the take-off point; kept for the whole mission.
    """

    position_m: Point2
    altitude_m: Annotated[float, Meta(gt=0.0, le=100.0)]


class GoalSpec(Section, frozen=True):
    """Where it ends.

    Attributes:
        position_m: [x, y], mission frame.
        capture_radius_m: the goal counts as held while the vehicle is this near.
        hold_s: how long the goal is held before landing.
    """

    position_m: Point2
    capture_radius_m: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.15
    hold_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 2.0


class BoundsSpec(Section, frozen=True):
    """The flight space, mission frame: [low, high] per axis.

    Attributes:
        x, y: judged by the measured position and by where the vehicle would stop, m.
        z: likewise, above the take-off point, m; take-off and landing are exempt.
    """

    x: Range
    y: Range
    z: Range


class GivenAt(StrEnum):
    """What a wall's point means."""

    CENTRE = "centre"
    SURFACE = "surface"


class WallSpec(Section, frozen=True):
    """A finite, upright wall.

    Attributes:
        point_m: [x, y] of its middle, mission frame; what of the vehicle is there at first touch: given_at.
        normal: [x, y], points into free space; any length.
        length_m: along the wall, half of it to each side of the middle.
        material: a key of materials in the vehicle configuration.
        given_at: centre: point_m is where the vehicle's centre is at first touch, as in the paper; surface:
            it is on the wall itself, and airframe.contact_distance_m is added.
    """

    point_m: Point2
    normal: tuple[Direction, Direction]
    length_m: Annotated[float, Meta(gt=0.0, le=1000.0)]
    material: str
    given_at: GivenAt = GivenAt.CENTRE


class ApproachSpec(Section, frozen=True):
    """Velocity at the impact in the wall's collision frame.

    Attributes:
        normal_m_s: along the wall's normal; negative, towards the wall.
        tangential_m_s: along the wall, positive to the right when looking along the normal.
    """

    normal_m_s: Annotated[float, Meta(lt=0.0, ge=-20.0)]
    tangential_m_s: Velocity = 0.0


class CollisionPrediction(Section, frozen=True):
    """What the planner predicted for a collision; written by `plan`, for flight and report to compare.

    Attributes:
        t_s: onset of the contact, from the start of the run-up.
        position_m: [x, y] of the impact, mission frame.
        normal_m_s, tangential_m_s: velocity at the impact, collision frame.
        peak_force_n: largest normal force.
        contact_time_s: how long the contact lasts.
    """

    t_s: Annotated[float, Meta(ge=0.0, le=3600.0)]
    position_m: Point2
    normal_m_s: Velocity
    tangential_m_s: Velocity
    peak_force_n: Annotated[float, Meta(ge=0.0, le=10_000.0)]
    contact_time_s: Annotated[float, Meta(ge=0.0, le=10.0)]


class MissPrediction(Section, frozen=True):
    """What the planner predicted for the whole mission.

    Attributes:
        goal_miss_m: smallest distance to the goal after the last contact.
    """

    goal_miss_m: Annotated[float, Meta(ge=0.0, le=10_000.0)]


class CollisionSpec(Section, frozen=True):
    """One planned collision.

    Attributes:
        wall: a key of walls.
        mode: state of the arms at the impact.
        approach: velocity to meet the wall with; required for the first collision. Without it the recovery of
            the collision before leads to this wall.
        impact_point_m: [x, y] on the wall's plane; without it, where the ray from start along the approach
            meets the wall.
        alpha_m_per_n: recovery gains along the mission's x and y axes (the paper's form), m of set-point per
            N of peak force; for walls along an axis, or both the same.
        alpha_wall_m_per_n: the same as [normal, tangential] of the wall, for any wall; exactly one of the
            two is given.
        predicted: written by plan.
    """

    wall: str
    mode: Mode
    approach: ApproachSpec | None = None
    impact_point_m: Point2 | None = None
    alpha_m_per_n: tuple[Alpha, Alpha] | None = None
    alpha_wall_m_per_n: tuple[Alpha, Alpha] | None = None
    predicted: CollisionPrediction | None = None


class Limits(Section, frozen=True):
    """Limits of the mission, judged before and during the flight.

    The defaults stay below the accelerometer's full scale on every surface that was flown with a real PX4
    (docs/px4.md): 150 N of 204 N; a rigid hit on acrylic at 3 m/s, the speed limit, is 191 N.

    Attributes:
        speed_m_s: largest speed of an approach and of the flight.
        peak_force_n: largest contact force, normal and friction together.
        collision_timeout_s: longest recovery; then the goal is flown to, or the next wall given up.
    """

    speed_m_s: Annotated[float, Meta(gt=0.0, le=20.0)] = 3.0
    peak_force_n: Annotated[float, Meta(gt=0.0, le=2000.0)] = 150.0
    collision_timeout_s: Annotated[float, Meta(gt=0.0, le=120.0)] = 8.0


class Tolerance(Section, frozen=True):
    """By how much a flight may differ from the plan and still have followed it (`plan_followed`).

    Attributes:
        impact_m_s: of each component of the velocity at an impact.
        peak_force_share: of the planned peak force.
        place_m: from the planned place of an impact.
    """

    impact_m_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.15
    peak_force_share: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.25
    place_m: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.25


class MissionFile(Section, frozen=True):
    """A mission as written in YAML.

    Attributes:
        version: of the format.
        name: letters, digits and ' _.-', at most 64; names the flight's folder.
        walls: by name.
        collisions: in the order of the hits, at least one.
        vehicle: vehicle configuration, relative to this file; without it, the default one.
        transit_mode: state of the arms in take-off, transit and landing.
        predicted: written by plan.
        after_impact: setpoint: the paper's recovery set-point leads on; replan: a way that is planned in
            flight, from what was felt, takes over from it.
        tolerance: by how much a flight may differ from the plan; for the goal that is its capture radius.
        mode_mismatch: where a contact was felt in the other mode than the lock reports; go_on: it is noted
            in log and verdict; land: the guard lands.
    """

    version: Literal[1]
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,63}$")]
    start: StartSpec
    goal: GoalSpec
    bounds_m: BoundsSpec
    walls: dict[str, WallSpec]
    collisions: list[CollisionSpec]
    vehicle: str | None = None
    frame: FrameSpec = FrameSpec()
    transit_mode: Mode = Mode.RIGID
    limits: Limits = Limits()
    predicted: MissPrediction | None = None
    after_impact: AfterImpact = AfterImpact.SETPOINT
    tolerance: Tolerance = Tolerance()
    mode_mismatch: ModeMismatch = ModeMismatch.GO_ON


class Bounds(msgspec.Struct, frozen=True):
    """The flight space, mission frame, metres."""

    x: Range
    y: Range
    z: Range

    def excess2(self, p: Vec2 | Vec3) -> float:
        """How far a point lies outside horizontally, metres; 0 inside."""
        return max(self.x[0] - p[0], p[0] - self.x[1], self.y[0] - p[1], p[1] - self.y[1], 0.0)


class Collision(msgspec.Struct, frozen=True):
    """A planned collision, resolved.

    Attributes:
        index: 1 for the first.
        approach_m_s: (normal, tangential) velocity at the impact in the collision frame, or None where the
            recovery of the collision before leads to this wall.
        impact_point: where the vehicle's centre meets the plane, mission frame; None likewise.
        alpha_normal_m_per_n, alpha_tangential_m_per_n: gains A_n, A_t of the recovery set-point.
    """

    index: int
    wall: Wall
    mode: Mode
    approach_m_s: Vec2 | None
    impact_point: Vec2 | None
    alpha_normal_m_per_n: float
    alpha_tangential_m_per_n: float
    predicted: CollisionPrediction | None

    def approach_velocity(self) -> Vec3:
        """Approach velocity in the mission frame, m/s; zero where there is no approach."""
        if self.approach_m_s is None:
            return (0.0, 0.0, 0.0)
        return self.wall.from_collision((self.approach_m_s[0], self.approach_m_s[1], 0.0))


class Mission(msgspec.Struct, frozen=True):
    """A checked mission and the vehicle that flies it."""

    name: str
    source: str
    vehicle: VehicleConfig
    frame: FrameSpec
    start: Vec2
    altitude_m: float
    goal: GoalSpec
    bounds: Bounds
    walls: tuple[Wall, ...]
    collisions: tuple[Collision, ...]
    transit_mode: Mode
    limits: Limits
    predicted: MissPrediction | None
    standoff_m: float | None = None  # a rehearsal: every contact replaced by stopping so far before the wall
    vehicle_source: VehicleSource | None = None  # where the configuration came from; old logs do not say
    after_impact: AfterImpact = AfterImpact.SETPOINT
    tolerance: Tolerance = Tolerance()
    mode_mismatch: ModeMismatch = ModeMismatch.GO_ON

    def flown_vehicle(self) -> VehicleSource:
        """Which vehicle it is, for everything that is said of the mission."""
        mass_kg = self.vehicle.airframe.mass_kg
        if self.vehicle_source is None:
            return VehicleSource(None, None, mass_kg)
        return msgspec.structs.replace(self.vehicle_source, mass_kg=mass_kg)

    def frame_at(self, takeoff_ned: Vec3) -> MissionFrame:
        """The mission frame once the take-off point is known (local NED, metres)."""
        north, east = self.frame.north_m, self.frame.east_m
        if self.frame.origin is FrameOrigin.TAKEOFF:
            # The vehicle stands below `start`.
            heading = math.radians(self.frame.heading_deg)
            frame = MissionFrame(heading_rad=heading)
            offset = frame.vector_to_ned((self.start[0], self.start[1], 0.0))
            north += takeoff_ned[0] - offset[0]
            east += takeoff_ned[1] - offset[1]
        return MissionFrame(north, east, takeoff_ned[2], math.radians(self.frame.heading_deg))


def load_mission(path: str | Path, config: str | Path | None = None, settings: Sequence[str] = ()) -> Mission:
    """Load, validate and resolve a mission file.

    Args:
        path: the mission.
        config: vehicle configuration that overrides the one the mission names.
        settings: `KEY=VALUE`, keys of the vehicle configuration that differ from the file.

    Raises:
        InputError: in the mission or in the configuration.
    """
    return parse_mission(load_document(path, FileKind.MISSION), config, settings)


def parse_mission(
    document: Document,
    config: str | Path | VehicleConfig | FoundVehicle | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """As `load_mission`, from a document already read; `config` may be a configuration already loaded."""
    refuse_other_keys(document, FileKind.MISSION)
    spec = document.convert(MissionFile)
    if isinstance(config, VehicleConfig):
        return resolve(spec, config, document)
    if not isinstance(config, FoundVehicle):
        if config is None and spec.vehicle is not None:
            config = Path(document.source).parent / spec.vehicle
        config = find_vehicle(config, settings)
    mission = resolve(spec, config.config, document)
    return msgspec.structs.replace(mission, vehicle_source=config.source)


def resolve(spec: MissionFile, vehicle: VehicleConfig, document: Document) -> Mission:
    """What a mission file means for a vehicle.

    Raises:
        InputError: the parts of the mission contradict each other.
    """
    walls = resolve_space(spec, vehicle, document)
    if not spec.collisions:
        raise document.error(("collisions",), "a mission needs at least one collision")
    collisions = tuple(
        _resolve_collision(i, one, spec, walls, document) for i, one in enumerate(spec.collisions)
    )
    return Mission(
        name=spec.name,
        source=document.source,
        vehicle=vehicle,
        frame=spec.frame,
        start=spec.start.position_m,
        altitude_m=spec.start.altitude_m,
        goal=spec.goal,
        bounds=Bounds(spec.bounds_m.x, spec.bounds_m.y, spec.bounds_m.z),
        walls=tuple(walls.values()),
        collisions=collisions,
        transit_mode=spec.transit_mode,
        limits=spec.limits,
        predicted=spec.predicted,
        after_impact=spec.after_impact,
        tolerance=spec.tolerance,
        mode_mismatch=spec.mode_mismatch,
    )


class SpaceSpec(Protocol):
    """The keys that missions and scenarios share: where things are."""

    @property
    def start(self) -> StartSpec: ...
    @property
    def goal(self) -> GoalSpec: ...
    @property
    def bounds_m(self) -> BoundsSpec: ...
    @property
    def walls(self) -> dict[str, WallSpec]: ...


def resolve_space(spec: SpaceSpec, vehicle: VehicleConfig, document: Document) -> dict[str, Wall]:
    """Check start, goal, bounds and walls against each other; returns the walls by name.

    Raises:
        InputError: bounds are empty, start or goal lies outside them or in a wall, or as `resolve_walls`.
    """
    _check_space(spec, document)
    walls = resolve_walls(spec.walls, vehicle, document)
    for name, wall in walls.items():
        for key, point in (("start", spec.start.position_m), ("goal", spec.goal.position_m)):
            if wall.spans(point) and -0.5 < wall.signed_distance(point) <= 0.0:
                raise document.error((key, "position_m"), f"lies in or behind wall {name}")
    return walls


def resolve_walls(specs: dict[str, WallSpec], vehicle: VehicleConfig, document: Document) -> dict[str, Wall]:
    """Walls as planes of the vehicle's centre, by name.

    Raises:
        InputError: a normal has no length, a material is not in the vehicle's table.
    """
    walls = {}
    for name, spec in specs.items():
        key: Key = ("walls", name)
        length = math.hypot(*spec.normal)
        if not length > 1e-9:
            raise document.error((*key, "normal"), "the normal has no length")
        normal = (spec.normal[0] / length, spec.normal[1] / length)
        if spec.material not in vehicle.materials:
            raise document.error((*key, "material"), unknown_name(spec.material, list(vehicle.materials)))
        offset = vehicle.airframe.contact_distance_m if spec.given_at is GivenAt.SURFACE else 0.0
        point = (spec.point_m[0] + offset * normal[0], spec.point_m[1] + offset * normal[1])
        walls[name] = Wall(name, point, normal, spec.length_m, spec.material)
    return walls


def _check_space(spec: SpaceSpec, document: Document) -> None:
    for axis in ("x", "y", "z"):
        low, high = getattr(spec.bounds_m, axis)
        if not low < high:
            raise document.error(("bounds_m", axis), f"[low, high] needs low < high, not [{low:g}, {high:g}]")
    bounds = Bounds(spec.bounds_m.x, spec.bounds_m.y, spec.bounds_m.z)
    for key, point in (("start", spec.start.position_m), ("goal", spec.goal.position_m)):
        if bounds.excess2(point) > 0.0:
            raise document.error(
                (key, "position_m"),
                f"({point[0]:g}, {point[1]:g}) is outside bounds_m x [{bounds.x[0]:g}, {bounds.x[1]:g}], "
                f"y [{bounds.y[0]:g}, {bounds.y[1]:g}]",
            )
    if not bounds.z[0] <= spec.start.altitude_m <= bounds.z[1]:
        raise document.error(
            ("start", "altitude_m"), f"must be within bounds_m z [{bounds.z[0]:g}, {bounds.z[1]:g}]"
        )


def _resolve_collision(
    i: int, spec: CollisionSpec, mission: MissionFile, walls: dict[str, Wall], document: Document
) -> Collision:
    key: Key = ("collisions", i)
    if spec.wall not in walls:
        raise document.error((*key, "wall"), unknown_name(spec.wall, list(walls)))
    wall = walls[spec.wall]
    alpha_n, alpha_t = resolve_alphas(spec.alpha_m_per_n, spec.alpha_wall_m_per_n, wall, key, document)
    approach = None
    impact = None
    if spec.approach is not None:
        approach = (spec.approach.normal_m_s, spec.approach.tangential_m_s)
        speed = math.hypot(*approach)
        if speed > mission.limits.speed_m_s:
            raise document.error(
                (*key, "approach"), f"{speed:.2f} m/s is over limits.speed_m_s {mission.limits.speed_m_s:g}"
            )
        impact = spec.impact_point_m or _ray_meets_wall(mission.start.position_m, wall, approach)
        if spec.impact_point_m is None and wall.signed_distance(mission.start.position_m) <= 0.0:
            raise document.error((*key, "approach"), f"start is not in front of wall {wall.name}")
        if spec.impact_point_m is not None and abs(wall.signed_distance(spec.impact_point_m)) > 0.01:
            raise document.error((*key, "impact_point_m"), f"is not on wall {wall.name}")
        if not wall.spans(impact):
            raise document.error(
                (*key, "approach"),
                f"meets the plane of wall {wall.name} at ({impact[0]:.3f}, {impact[1]:.3f}), "
                f"beyond its length of {wall.length_m:g} m",
            )
    elif i == 0:
        raise document.error(key, "the first collision needs an approach")
    elif spec.impact_point_m is not None:
        raise document.error((*key, "impact_point_m"), "only a collision with an approach has one")
    return Collision(
        index=i + 1,
        wall=wall,
        mode=spec.mode,
        approach_m_s=approach,
        impact_point=impact,
        alpha_normal_m_per_n=alpha_n,
        alpha_tangential_m_per_n=alpha_t,
        predicted=spec.predicted,
    )


def resolve_alphas(
    per_axis: tuple[float, float] | None,
    per_wall: tuple[float, float] | None,
    wall: Wall,
    key: Key,
    document: Document,
) -> tuple[float, float]:
    """Gains (A_n, A_t) in the wall's axes, m/N, from either form (`alpha_m_per_n`, `alpha_wall_m_per_n`).

    Raises:
        InputError: both or neither is given, gains per mission axis differ at an oblique wall, or the gain
            along the normal is 0.
    """
    if (per_axis is None) == (per_wall is None):
        raise document.error(key, "give exactly one of alpha_m_per_n and alpha_wall_m_per_n")
    if per_wall is not None:
        alphas = per_wall
    else:
        assert per_axis is not None
        ax, ay = per_axis
        if abs(wall.normal[1]) < _AXIS_TOLERANCE:
            alphas = (ax, ay)
        elif abs(wall.normal[0]) < _AXIS_TOLERANCE:
            alphas = (ay, ax)
        elif ax == ay:
            alphas = (ax, ay)
        else:
            raise document.error(
                (*key, "alpha_m_per_n"),
                "different gains per mission axis could point into a wall that is not along an axis; "
                "use alpha_wall_m_per_n: [normal, tangential]",
            )
    if not alphas[0] > 0.0:
        raise document.error(key, "the gain along the wall's normal must be above 0")
    return alphas


def _ray_meets_wall(start: Vec2, wall: Wall, approach_m_s: Vec2) -> Vec2:
    """Where the ray from `start` along the approach velocity meets the wall's plane."""
    v = wall.from_collision((approach_m_s[0], approach_m_s[1], 0.0))
    t = wall.signed_distance(start) / -approach_m_s[0]
    return (start[0] + v[0] * t, start[1] + v[1] * t)


__all__ = [
    "Bounds",
    "Collision",
    "InputError",
    "Mission",
    "MissionFile",
    "load_mission",
    "parse_mission",
]
