"""Mission files (version 1): the YAML types, and the checked mission the flight core flies.

The file says what a person writes; `Mission` is what it means: walls as planes of the vehicle's centre,
unit normals, gains in the wall's own axes, the point of impact. `docs/missions.md` explains every key.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3, Wall
from dart_flight.base.records import AfterImpact, Mode, ModeMismatch
from dart_flight.config.document import IN_PYTHON, Document, InputError, Key, unknown_name
from dart_flight.config.kinds import FileKind, load_document, refuse_other_keys
from dart_flight.config.provenance import FoundVehicle, VehicleSource, find_vehicle, shown_path
from dart_flight.config.section import Section
from dart_flight.config.settings import apply_changes
from dart_flight.config.vehicle import VehicleConfig, load_vehicle

Coordinate = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]
Velocity = Annotated[float, Meta(ge=-20.0, le=20.0)]
Direction = Annotated[float, Meta(ge=-1e6, le=1e6)]
# Metres of set-point per newton: the paper's largest is 0.12. At 1 a weak hit already leads across a room.
Alpha = Annotated[float, Meta(ge=0.0, le=1.0)]
Point2 = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]
Standoff = Annotated[float, Meta(ge=0.1, le=2.0)]

_AXIS_TOLERANCE = 1e-6
_PAUSE_S = 60.0
_UNIT_TOLERANCE = 1e-15


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
        altitude_m: above the take-off point; kept until a way-point has another one.
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

    def excess2(self, p: Vec2 | Vec3) -> float:
        """How far a point lies outside horizontally, metres; 0 inside."""
        return max(self.x[0] - p[0], p[0] - self.x[1], self.y[0] - p[1], p[1] - self.y[1], 0.0)


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
        position_sd_m: how well the place along the normal is known, standard deviation; null: to a few
            centimetres, as `guard` tolerates.
        yaw_sd_deg: how well the direction is known, standard deviation, about the middle; null: likewise.
    """

    point_m: Point2
    normal: tuple[Direction, Direction]
    length_m: Annotated[float, Meta(gt=0.0, le=1000.0)]
    material: str
    given_at: GivenAt = GivenAt.CENTRE
    position_sd_m: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    yaw_sd_deg: Annotated[float, Meta(ge=0.0, le=30.0)] | None = None


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
        mode: state of the arms at the impact; to be left out only of a vehicle without a lock: it is rigid.
        approach: velocity to meet the wall with; required for the first collision. Without it the recovery of
            the collision before leads to this wall.
        impact_point_m: [x, y] on the wall's plane; without it, where the ray from start along the approach
            meets the wall.
        impact_along_m: the same as a distance along the wall from its middle, positive to the right when
            looking along the normal; at most one of the two is given.
        alpha_m_per_n: recovery gains along the mission's x and y axes (the paper's form), m of set-point per
            N of peak force; for walls along an axis, or both the same.
        alpha_wall_m_per_n: the same as [normal, tangential] of the wall, for any wall; exactly one of the
            two is given.
        predicted: written by plan.
    """

    wall: str
    mode: Mode | None = None
    approach: ApproachSpec | None = None
    impact_point_m: Point2 | None = None
    impact_along_m: Coordinate | None = None
    alpha_m_per_n: tuple[Alpha, Alpha] | None = None
    alpha_wall_m_per_n: tuple[Alpha, Alpha] | None = None
    predicted: CollisionPrediction | None = None


class PauseFor(StrEnum):
    """Whose word ends a pause."""

    OPERATOR = "operator"


class WaypointSpec(Section, frozen=True):
    """A way-point, flown to from rest to rest, or a pause where the vehicle is; exactly one of the two.

    Attributes:
        position_m: [x, y] of a way-point, mission frame.
        altitude_m: of a way-point, above the take-off point, and of what comes after it; without it the
            altitude stays as it is.
        speed_m_s: largest speed on the way there; by default flying.transit_speed_m_s. The vertical part of
            the way is flown at flying.climb_speed_m_s at most.
        hold_s: how long a way-point is held.
        pause: operator: hold until the operator says to go on (Enter, or SIGUSR1).
        timeout_s: of a pause; without a word the vehicle lands.
        after: how many collisions are flown before it; it never falls from one to the next.
    """

    position_m: Point2 | None = None
    altitude_m: Annotated[float, Meta(gt=0.0, le=100.0)] | None = None
    speed_m_s: Annotated[float, Meta(ge=0.05, le=20.0)] | None = None
    hold_s: Annotated[float, Meta(ge=0.0, le=600.0)] | None = None
    pause: PauseFor | None = None
    timeout_s: Annotated[float, Meta(ge=1.0, le=600.0)] | None = None
    after: Annotated[int, Meta(ge=0, le=1000)] = 0


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
        collisions: in the order of the hits; none: a flight without one.
        waypoints: way-points and pauses before, between and after the collisions, in the order in which they
            are flown.
        vehicle: vehicle configuration: a file, relative to this one, or its keys and values themselves;
            without it, the default one.
        transit_mode: state of the arms in take-off, transit and landing.
        predicted: written by plan.
        after_impact: setpoint: the paper's recovery set-point leads on; replan: a way that is planned in
            flight, from what was felt, takes over from it.
        tolerance: by how much a flight may differ from the plan; for the goal that is its capture radius.
        mode_mismatch: where a contact was felt in the other mode than the lock reports; go_on: it is noted
            in log and verdict; land: the guard lands.
        standoff_m: a rehearsal: every contact is replaced by stopping so far before its wall, as with
            --standoff; null: the contacts are flown.
    """

    version: Literal[1]
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,63}$")]
    start: StartSpec
    goal: GoalSpec
    bounds_m: BoundsSpec
    walls: dict[str, WallSpec] = msgspec.field(default_factory=dict)
    collisions: list[CollisionSpec] = msgspec.field(default_factory=list)
    waypoints: list[WaypointSpec] = msgspec.field(default_factory=list)
    vehicle: str | dict[str, Any] | None = None
    frame: FrameSpec = FrameSpec()
    transit_mode: Mode = Mode.RIGID
    limits: Limits = Limits()
    predicted: MissPrediction | None = None
    after_impact: AfterImpact = AfterImpact.SETPOINT
    tolerance: Tolerance = Tolerance()
    mode_mismatch: ModeMismatch = ModeMismatch.GO_ON
    standoff_m: Standoff | None = None


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


class Waypoint(msgspec.Struct, frozen=True):
    """A way-point or a pause, resolved.

    Attributes:
        index: 1 for the first in the list.
        after: how many collisions are flown before it.
        position: mission frame, metres; None: a pause, where the vehicle is.
        speed_m_s: largest on the way there.
        hold_s: how long it is held; of a pause the longest time, after which the vehicle lands.
    """

    index: int
    after: int
    position: Vec3 | None
    speed_m_s: float
    hold_s: float

    @property
    def name(self) -> str:
        """In words."""
        return f"{'pause' if self.position is None else 'way-point'} {self.index}"


class Mission(msgspec.Struct, frozen=True):
    """A checked mission and the vehicle that flies it; `altitude_m` is that of its start."""

    name: str
    source: str
    vehicle: VehicleConfig
    frame: FrameSpec
    start: Vec2
    altitude_m: float
    goal: GoalSpec
    bounds: BoundsSpec
    walls: tuple[Wall, ...]
    collisions: tuple[Collision, ...]
    transit_mode: Mode
    limits: Limits
    predicted: MissPrediction | None
    standoff_m: float | None = None  # a rehearsal: every contact replaced by stopping so far before the wall
    vehicle_source: VehicleSource | None = None  # where the configuration came from; None: built in Python
    after_impact: AfterImpact = AfterImpact.SETPOINT
    tolerance: Tolerance = Tolerance()
    mode_mismatch: ModeMismatch = ModeMismatch.GO_ON
    waypoints: tuple[Waypoint, ...] = ()

    def altitude_at(self, flown: int) -> float:
        """Altitude once so many collisions are flown and the way-points behind them, metres."""
        reached = [w.position[2] for w in self.waypoints if w.after <= flown and w.position is not None]
        return reached[-1] if reached else self.altitude_m

    def place_before(self, flown: int) -> Vec2 | None:
        """Where the vehicle is at rest once so many collisions are flown and the way-points behind them.

        None where that is where a recovery leads.
        """
        reached = [w.position for w in self.waypoints if w.after == flown and w.position is not None]
        if reached:
            return reached[-1][:2]
        return self.start if flown == 0 else None

    @property
    def recovers_to_goal(self) -> bool:
        """Whether the last recovery leads to the goal; else it is flown to from rest."""
        count = len(self.collisions)
        return count > 0 and not any(w.after == count for w in self.waypoints)

    def flown_vehicle(self) -> VehicleSource:
        """Which vehicle it is, for everything that is said of the mission."""
        mass_kg = self.vehicle.airframe.mass_kg
        if self.vehicle_source is None:
            return VehicleSource(None, None, mass_kg)
        return msgspec.structs.replace(self.vehicle_source, mass_kg=mass_kg)

    def to_dict(self) -> dict[str, Any]:
        """As a mission file says it, resolved, with its vehicle: `load_mission` makes the same mission of it.

        Walls are given at the vehicle's centre and gains in the wall's axes; a point of impact is left out
        where it follows from start and approach. From which file the vehicle came is not in it.
        """
        return {**self._own_keys(), "vehicle": self.vehicle.to_dict()}

    def _own_keys(self) -> dict[str, Any]:
        """As `to_dict`, without the vehicle."""
        tree: dict[str, Any] = {
            "version": 1,
            "name": self.name,
            "frame": self.frame,
            "start": StartSpec(self.start, self.altitude_m),
            "goal": self.goal,
            "bounds_m": self.bounds,
            "walls": {wall.name: _wall_spec(wall) for wall in self.walls},
            "transit_mode": self.transit_mode,
            "collisions": [_as_spec(collision, self.start) for collision in self.collisions],
            "waypoints": list(_waypoint_specs(self)),
            "limits": self.limits,
            "predicted": self.predicted,
            "after_impact": self.after_impact,
            "tolerance": self.tolerance,
            "mode_mismatch": self.mode_mismatch,
            "standoff_m": self.standoff_m,
        }
        found: dict[str, Any] = msgspec.to_builtins(tree)
        return found

    def replace(self, changes: Mapping[str, Any]) -> Mission:
        """Another mission, with some keys changed and everything validated again.

        Args:
            changes: dotted key of the mission file to value, such as
                `{"collisions[0].approach.normal_m_s": -1.2}`. `vehicle.KEY` is a key of the vehicle's
                configuration, `vehicle` a whole one.

        Raises:
            InputError: a key is unknown, a value is of the wrong kind or out of range, or the parts
                contradict each other.
        """
        own = {key: value for key, value in changes.items() if key.partition(".")[0] != "vehicle"}
        vehicle, source = changes.get("vehicle", self.vehicle), self.vehicle_source
        if not isinstance(vehicle, VehicleConfig):
            raise InputError(
                f"expected a vehicle configuration, not {type(vehicle).__name__}", key=("vehicle",)
            )
        if vehicle is not self.vehicle:
            source = None
        of_vehicle = {key.partition(".")[2]: v for key, v in changes.items() if key.startswith("vehicle.")}
        if of_vehicle:
            vehicle = vehicle.replace(of_vehicle)
            if source is not None:
                said = tuple(f"{key}={value}" for key, value in of_vehicle.items())
                source = msgspec.structs.replace(
                    source, mass_kg=vehicle.airframe.mass_kg, set=(*source.set, *said)
                )
        document = Document.of(self._own_keys(), IN_PYTHON)
        apply_changes(own, document)
        return msgspec.structs.replace(parse_mission(document, vehicle), vehicle_source=source)

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


def _wall_spec(wall: Wall) -> WallSpec:
    """A resolved wall as a file says it."""
    # Rounded, so that the angle that was written comes back.
    yaw_sd_deg = None if wall.yaw_sd_rad is None else round(math.degrees(wall.yaw_sd_rad), 12)
    return WallSpec(
        point_m=wall.point,
        normal=wall.normal,
        length_m=wall.length_m,
        material=wall.material,
        position_sd_m=wall.position_sd_m,
        yaw_sd_deg=yaw_sd_deg,
    )


def _waypoint_specs(mission: Mission) -> Iterator[WaypointSpec]:
    """Resolved way-points and pauses as a file says them, without what follows from others or the vehicle."""
    altitude_m, usual_m_s = mission.altitude_m, mission.vehicle.flying.transit_speed_m_s
    for one in mission.waypoints:
        if one.position is None:
            yield WaypointSpec(pause=PauseFor.OPERATOR, timeout_s=one.hold_s, after=one.after)
            continue
        x, y, z = one.position
        yield WaypointSpec(
            position_m=(x, y),
            altitude_m=None if z == altitude_m else z,
            speed_m_s=None if one.speed_m_s == usual_m_s else one.speed_m_s,
            hold_s=one.hold_s,
            after=one.after,
        )
        altitude_m = z


def _as_spec(collision: Collision, start: Vec2) -> CollisionSpec:
    """A resolved collision as a file says it."""
    approach, impact = None, collision.impact_point
    if collision.approach_m_s is not None:
        approach = ApproachSpec(*collision.approach_m_s)
        if impact == _ray_meets_wall(start, collision.wall, collision.approach_m_s):
            impact = None
    return CollisionSpec(
        wall=collision.wall.name,
        mode=collision.mode,
        approach=approach,
        impact_point_m=impact,
        alpha_wall_m_per_n=(collision.alpha_normal_m_per_n, collision.alpha_tangential_m_per_n),
        predicted=collision.predicted,
    )


def load_mission(
    path: str | Path | Mapping[str, Any],
    config: str | Path | VehicleConfig | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """Load, validate and resolve a mission file.

    Args:
        path: the mission, or a mapping of what a file would hold.
        config: vehicle configuration that overrides the one the mission names: a file, or already loaded.
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
        config = _find_vehicle(spec, config, document, settings)
    mission = resolve(spec, config.config, document)
    return msgspec.structs.replace(mission, vehicle_source=config.source)


def _find_vehicle(
    spec: MissionFile, config: str | Path | None, document: Document, settings: Sequence[str]
) -> FoundVehicle:
    """The vehicle of a mission: `config`, else what the mission has or names, else the default one."""
    if config is None and isinstance(spec.vehicle, dict):
        vehicle = load_vehicle(document.part("vehicle"), settings)
        source = None if document.source == IN_PYTHON else shown_path(document.source)
        return FoundVehicle(vehicle, VehicleSource(source, False, vehicle.airframe.mass_kg, tuple(settings)))
    if config is None and isinstance(spec.vehicle, str):
        config = Path(document.source).parent / spec.vehicle
    return find_vehicle(config, settings)


def resolve(spec: MissionFile, vehicle: VehicleConfig, document: Document) -> Mission:
    """What a mission file means for a vehicle.

    Raises:
        InputError: the parts of the mission contradict each other.
    """
    walls = resolve_space(spec, vehicle, document)
    refuse_mode(spec.transit_mode, vehicle, ("transit_mode",), document)
    collisions = tuple(
        _resolve_collision(i, one, spec, vehicle, walls, document) for i, one in enumerate(spec.collisions)
    )
    return Mission(
        name=spec.name,
        source=document.source,
        vehicle=vehicle,
        frame=spec.frame,
        start=spec.start.position_m,
        altitude_m=spec.start.altitude_m,
        goal=spec.goal,
        bounds=spec.bounds_m,
        walls=tuple(walls.values()),
        collisions=collisions,
        transit_mode=spec.transit_mode,
        limits=spec.limits,
        predicted=spec.predicted,
        after_impact=spec.after_impact,
        tolerance=spec.tolerance,
        mode_mismatch=spec.mode_mismatch,
        standoff_m=spec.standoff_m,
        waypoints=_resolve_waypoints(spec, vehicle, walls, document),
    )


def resolve_space(spec: Any, vehicle: VehicleConfig, document: Document) -> dict[str, Wall]:
    """Check what missions and scenarios share: start, goal, bounds, walls; returns the walls by name.

    Raises:
        InputError: bounds are empty, start or goal lies outside them or in a wall, or as `resolve_walls`.
    """
    _check_space(spec, document)
    walls = resolve_walls(spec.walls, vehicle, document)
    for key, point in (("start", spec.start.position_m), ("goal", spec.goal.position_m)):
        _check_not_in_wall(point, walls, (key, "position_m"), document)
    return walls


def _check_not_in_wall(point: Vec2, walls: dict[str, Wall], key: Key, document: Document) -> None:
    for name, wall in walls.items():
        if wall.spans(point) and -0.5 < wall.signed_distance(point) <= 0.0:
            raise document.error(key, f"lies in or behind wall {name}")


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
        normal = spec.normal
        if abs(length - 1.0) > _UNIT_TOLERANCE:  # else it stays what it is, to the bit
            normal = (spec.normal[0] / length, spec.normal[1] / length)
        if spec.material not in vehicle.materials:
            raise document.error((*key, "material"), unknown_name(spec.material, list(vehicle.materials)))
        offset = vehicle.airframe.contact_distance_m if spec.given_at is GivenAt.SURFACE else 0.0
        point = (spec.point_m[0] + offset * normal[0], spec.point_m[1] + offset * normal[1])
        yaw_sd_rad = None if spec.yaw_sd_deg is None else math.radians(spec.yaw_sd_deg)
        half_m = vehicle.airframe.contact_distance_m
        walls[name] = Wall(
            name, point, normal, spec.length_m, spec.material, spec.position_sd_m, yaw_sd_rad, half_m
        )
    return walls


def _check_space(spec: Any, document: Document) -> None:
    for axis in ("x", "y", "z"):
        low, high = getattr(spec.bounds_m, axis)
        if not low < high:
            raise document.error(("bounds_m", axis), f"[low, high] needs low < high, not [{low:g}, {high:g}]")
    _check_within(spec.bounds_m, spec.start.position_m, spec.start.altitude_m, ("start",), document)
    _check_within(spec.bounds_m, spec.goal.position_m, None, ("goal",), document)


def _check_within(
    bounds: BoundsSpec, point: Vec2, altitude_m: float | None, key: Key, document: Document
) -> None:
    """Raises InputError: a place, or an altitude given there, lies outside of the bounds."""
    if bounds.excess2(point) > 0.0:
        raise document.error(
            (*key, "position_m"),
            f"({point[0]:g}, {point[1]:g}) is outside bounds_m x [{bounds.x[0]:g}, {bounds.x[1]:g}], "
            f"y [{bounds.y[0]:g}, {bounds.y[1]:g}]",
        )
    if altitude_m is not None and not bounds.z[0] <= altitude_m <= bounds.z[1]:
        raise document.error(
            (*key, "altitude_m"), f"must be within bounds_m z [{bounds.z[0]:g}, {bounds.z[1]:g}]"
        )


def _resolve_waypoints(
    spec: MissionFile, vehicle: VehicleConfig, walls: dict[str, Wall], document: Document
) -> tuple[Waypoint, ...]:
    altitude_m, flown = spec.start.altitude_m, 0
    found = []
    for i, one in enumerate(spec.waypoints):
        key: Key = ("waypoints", i)
        _check_place_in_order(one, flown, spec, key, document)
        flown = one.after
        if one.pause is None:
            assert one.position_m is not None
            altitude_m = altitude_m if one.altitude_m is None else one.altitude_m
            _check_within(spec.bounds_m, one.position_m, one.altitude_m, key, document)
            _check_not_in_wall(one.position_m, walls, (*key, "position_m"), document)
            speed = one.speed_m_s or vehicle.flying.transit_speed_m_s
            if speed > spec.limits.speed_m_s:
                raise document.error(
                    (*key, "speed_m_s"), f"{speed:g} m/s is over limits.speed_m_s {spec.limits.speed_m_s:g}"
                )
            place = (*one.position_m, altitude_m)
            found.append(Waypoint(i + 1, flown, place, speed, one.hold_s or 0.0))
        else:
            found.append(Waypoint(i + 1, flown, None, 0.0, one.timeout_s or _PAUSE_S))
    return tuple(found)


def _check_place_in_order(
    one: WaypointSpec, flown: int, spec: MissionFile, key: Key, document: Document
) -> None:
    """Raises InputError: keys of a way-point and of a pause are mixed, or `after` is not to be had."""
    if (one.position_m is None) == (one.pause is None):
        raise document.error(key, "give exactly one of position_m (a way-point) and pause")
    others = ("timeout_s",) if one.pause is None else ("altitude_m", "speed_m_s", "hold_s")
    for name in others:
        if getattr(one, name) is not None:
            what = "a way-point" if one.pause is None else "a pause"
            raise document.error((*key, name), f"{what} has no such key")
    count = len(spec.collisions)
    if not flown <= one.after <= count:
        says = f"{one.after}, expected {flown} to {count}: the list is in the order of the flight"
        raise document.error((*key, "after"), says)
    if 0 < one.after < count and spec.collisions[one.after].approach is None:
        says = f"needs an approach: the recovery before it leads to waypoints[{key[1]}]"
        raise document.error(("collisions", one.after), says)


def refuse_mode(mode: Mode, vehicle: VehicleConfig, key: Key, document: Document) -> None:
    """Make sure that the vehicle has a mode.

    Raises:
        InputError: it does not.
    """
    problem = vehicle.mode_problem(mode)
    if problem is not None:
        raise document.error(key, problem)


def _mode_of(spec: CollisionSpec, vehicle: VehicleConfig, key: Key, document: Document) -> Mode:
    """The mode of a collision: as given, or the only one."""
    if spec.mode is None:
        if vehicle.has_lock:
            raise document.error(key, "missing key mode: " + " or ".join(vehicle.modes))
        return vehicle.modes[0]
    refuse_mode(spec.mode, vehicle, (*key, "mode"), document)
    return spec.mode


def _resolve_collision(
    i: int,
    spec: CollisionSpec,
    mission: MissionFile,
    vehicle: VehicleConfig,
    walls: dict[str, Wall],
    document: Document,
) -> Collision:
    key: Key = ("collisions", i)
    if spec.wall not in walls:
        raise document.error((*key, "wall"), unknown_name(spec.wall, list(walls)))
    wall = walls[spec.wall]
    mode = _mode_of(spec, vehicle, key, document)
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
        impact = _impact_point(spec, mission.start.position_m, wall, approach, key, document)
        if (
            spec.impact_point_m is None
            and spec.impact_along_m is None
            and wall.signed_distance(mission.start.position_m) <= 0.0
        ):
            raise document.error((*key, "approach"), f"start is not in front of wall {wall.name}")
        if spec.impact_point_m is not None and abs(wall.signed_distance(impact)) > 0.01:
            x, y = wall.foot(impact)
            raise document.error(
                (*key, "impact_point_m"),
                f"is {abs(wall.signed_distance(impact)):.3f} m off wall {wall.name}, whose nearest point is "
                f"[{x:.3f}, {y:.3f}]; or give impact_along_m: {wall.along((x, y)):.3f}",
            )
        if not wall.spans(impact):
            raise document.error(
                (*key, "approach"),
                f"meets the plane of wall {wall.name} at ({impact[0]:.3f}, {impact[1]:.3f}), "
                f"beyond its length of {wall.length_m:g} m",
            )
    elif i == 0:
        raise document.error(key, "the first collision needs an approach")
    for name in ("impact_point_m", "impact_along_m"):
        if approach is None and getattr(spec, name) is not None:
            raise document.error((*key, name), "only a collision with an approach has one")
    return Collision(
        index=i + 1,
        wall=wall,
        mode=mode,
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


def _impact_point(
    spec: CollisionSpec, start: Vec2, wall: Wall, approach_m_s: Vec2, key: Key, document: Document
) -> Vec2:
    """Where the wall is to be met, as given, or where the approach leads to from the start."""
    if spec.impact_along_m is None:
        return spec.impact_point_m or _ray_meets_wall(start, wall, approach_m_s)
    if spec.impact_point_m is not None:
        raise document.error((*key, "impact_along_m"), "give this or impact_point_m, not both")
    (x, y), (tx, ty), along = wall.point, wall.tangent, spec.impact_along_m
    if abs(along) > 0.5 * wall.length_m:
        reach = 0.5 * wall.length_m
        raise document.error(
            (*key, "impact_along_m"), f"{along:g}, the wall reaches from {-reach:g} to {reach:g}"
        )
    return (x + along * tx, y + along * ty)


def _ray_meets_wall(start: Vec2, wall: Wall, approach_m_s: Vec2) -> Vec2:
    """Where the ray from `start` along the approach velocity meets the wall's plane."""
    v = wall.from_collision((approach_m_s[0], approach_m_s[1], 0.0))
    t = wall.signed_distance(start) / -approach_m_s[0]
    return (start[0] + v[0] * t, start[1] + v[1] * t)
