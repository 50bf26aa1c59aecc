"""The checked mission that the flight core flies, and its conversion from a mission file.

The file contains the keys that a person writes (`config.mission_file`). `Mission` is the resolved form with
unit normals, gains in the wall's axes, and impact points. A wall is the plane in which the vehicle's centre
lies when the vehicle first touches the wall. A mission keeps the keys of its file, and only `Mission.replace`
changes the resolved parts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3
from dart_flight.base.records import AfterImpact, Mode
from dart_flight.base.walls import Post, Wall
from dart_flight.config.document import IN_PYTHON, Document, InputError, Key, unknown_name
from dart_flight.config.file_kinds import FileKind, load_document, refuse_other_keys
from dart_flight.config.flight_space import LIMITED_KEYS, FlightSpace, apply_limits
from dart_flight.config.mission_file import (
    BoundsSpec,
    CollisionKeys,
    CollisionSpec,
    MissionFile,
    MissionKeys,
    TrajectoryPieces,
    WaypointKeys,
    WaypointSpec,
)
from dart_flight.config.probes import Probe, resolve_place, resolve_probe, unknown_walls
from dart_flight.config.provenance import LoadedVehicle, VehicleSource, display_path, find_vehicle
from dart_flight.config.section import shared_keys, without_defaults
from dart_flight.config.settings import apply_changes
from dart_flight.config.vehicle import Flying, VehicleConfig, load_vehicle
from dart_flight.lab_entries import MISSION_SCENE, load_entry

_PAUSE_S = 60.0
# After power-on, the position estimate of a resting vehicle drifts. The frame follows it until arming.
ESTIMATE_MOVED_M = 0.05
# Tolerances: a trajectory is rounded, and ends at the onset of the force, slightly before the plane.
_TRAJECTORY_OFF_M, _TRAJECTORY_OFF_M_S = 0.05, 0.05


class Collision(CollisionKeys, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """A planned collision, converted from its keys.

    Attributes:
        index: number of the collision in the order of flight, from 1.
        mode: mode in the mission file, or the vehicle's only mode if the file gives none.
        approach_m_s: (normal, tangential) velocity at the impact in the collision frame, or None if the
            previous recovery leads to this wall.
        impact_point: position of the vehicle's centre at the impact, mission frame, or None if the
            previous recovery leads to this wall.
        alpha_normal_m_per_n, alpha_tangential_m_per_n: gains A_n, A_t of the recovery setpoint.
        probe: leg that searches for the wall, or None if the position of the wall is known well enough.
    """

    index: int
    wall: Wall
    mode: Mode
    approach_m_s: Vec2 | None
    impact_point: Vec2 | None
    alpha_normal_m_per_n: float
    alpha_tangential_m_per_n: float
    probe: Probe | None = None

    @property
    def is_conditional(self) -> bool:
        """Whether the mission remains valid if this collision ends without a contact."""
        unsure = self.probe is not None or self.wall.sought
        return unsure or self.if_met is not None or self.if_not_met is not None

    def approach_velocity(self) -> Vec3:
        """Return the approach velocity in the mission frame, m/s; zero without an approach."""
        if self.approach_m_s is None:
            return (0.0, 0.0, 0.0)
        return self.wall.from_collision((self.approach_m_s[0], self.approach_m_s[1], 0.0))


class Waypoint(WaypointKeys, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """A waypoint or a pause, converted from its keys.

    Attributes:
        index: number in the list, from 1.
        position: mission frame, metres; None for a pause, which holds position. A position relative to a wall
            that a probe searches for assumes the wall at the end of the probe.
        speed_m_s: maximum speed of the leg to the waypoint.
        hold_s: hold time at a waypoint; for a pause, the timeout after which the vehicle lands.
        wall_at: the wall that `at_wall` names, or None.
    """

    index: int
    position: Vec3 | None
    speed_m_s: float
    hold_s: float
    wall_at: Wall | None = None

    @property
    def name(self) -> str:
        """Name in messages, such as `waypoint 2`."""
        return f"{'pause' if self.position is None else 'waypoint'} {self.index}"


class WrittenForm(msgspec.Struct, frozen=True, eq=False):
    """The keys of a mission as written, for `Mission.replace`; comparisons of missions ignore them.

    Attributes:
        tree: keys and values of the file, without the vehicle.
        flying: section `flying` of the vehicle, without the limits of the mission.
    """

    tree: dict[str, Any]
    flying: Flying

    def __eq__(self, other: object) -> bool:
        return isinstance(other, WrittenForm)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(WrittenForm)


class Mission(MissionKeys, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """A checked mission with its vehicle.

    Attributes:
        source: the file.
        start: [x, y], mission frame; altitude_m is the altitude at the start.
        walls: walls at known positions, and the tangent planes of posts to be hit; walls that probes search
            for are not included.
        simulated_walls: additional walls that exist only in simulation.
        posts: the posts.
        vehicle_source: origin of the vehicle's configuration, or None if built in Python.
        written: the keys as written, or None if the mission comes from a log without these keys.
    """

    source: str
    vehicle: VehicleConfig
    start: Vec2
    altitude_m: float
    bounds: BoundsSpec
    walls: tuple[Wall, ...]
    collisions: tuple[Collision, ...]
    waypoints: tuple[Waypoint, ...] = ()
    posts: tuple[Post, ...] = ()
    simulated_walls: tuple[Wall, ...] = ()
    vehicle_source: VehicleSource | None = None
    written: WrittenForm | None = None

    @property
    def flat_walls(self) -> tuple[Wall, ...]:
        """The walls of the mission without the tangent planes of posts."""
        return tuple(wall for wall in self.walls if not wall.post_radius_m)

    @property
    def standing_walls(self) -> tuple[Wall, ...]:
        """The walls that exist in simulation, including the posts' tangent planes."""
        return (*self.walls, *self.simulated_walls)

    def altitude_at(self, flown: int) -> float:
        """Return the altitude, metres, after the first `flown` collisions and their waypoints."""
        reached = [w.position[2] for w in self.waypoints if w.after <= flown and w.position is not None]
        return reached[-1] if reached else self.altitude_m

    def place_before(self, flown: int) -> Vec2 | None:
        """Return the vehicle's resting position after the first `flown` collisions and their waypoints.

        The result is None if the vehicle does not rest, but flies the recovery from a collision.
        """
        reached = [w.position for w in self.waypoints if w.after == flown and w.position is not None]
        if reached:
            return reached[-1][:2]
        return self.start if flown == 0 else None

    @property
    def recovers_to_goal(self) -> bool:
        """Whether the last recovery leads to the goal; if not, the vehicle flies to the goal from rest."""
        count = len(self.collisions)
        if count == 0 or self.collisions[-1].probe is not None:
            return False
        return not any(w.after == count for w in self.waypoints)

    @property
    def is_anchored(self) -> bool:
        """Whether contacts correct the mission frame."""
        return self.frame.anchored_by == "touch"

    def flown_vehicle(self) -> VehicleSource:
        """Return the identification of the vehicle for reports on the mission."""
        mass_kg = self.vehicle.airframe.mass_kg
        if self.vehicle_source is None:
            return VehicleSource(None, None, mass_kg)
        return msgspec.structs.replace(self.vehicle_source, mass_kg=mass_kg)

    @property
    def digest(self) -> str:
        """Fingerprint of mission and vehicle, without file names, links and lock driver.

        Keys with default values are excluded, so a later version can add keys without changing the
        fingerprint.
        """
        bare = msgspec.structs.replace(self, source="", vehicle_source=None, flown=None, standoff_m=None)
        mocap = msgspec.structs.replace(self.vehicle.mocap, url=None)
        vehicle = msgspec.structs.replace(self.vehicle, mocap=mocap)
        bare = msgspec.structs.replace(bare, written=None, vehicle=vehicle)
        tree = without_defaults(bare)
        tree["vehicle"].pop("connection", None)
        tree["vehicle"].get("lock", {}).pop("driver", None)
        return hashlib.sha256(msgspec.json.encode(tree, order="sorted")).hexdigest()[:32]

    def to_dict(self) -> dict[str, Any]:
        """Return all keys of the mission's file, and all keys of its vehicle; `load_mission` can read them.

        The name of the vehicle's file is not included.

        Raises:
            InputError: code has changed walls or other resolved parts of the mission without `replace`.
        """
        file = Document.from_tree(self._keys_as_written(self.vehicle_as_written())).convert(MissionFile)
        return {**msgspec.to_builtins(file), "vehicle": self.vehicle.to_dict()}

    def show(self, height: int = 600) -> None:
        """Show the room and the predicted path below a notebook's cell or, from a script, in the browser.

        Args:
            height: height of the view, pixels.

        Raises:
            InputError: viser (extra `studio`) is missing.
        """
        load_entry(MISSION_SCENE)(self, height)

    def replace(self, changes: Mapping[str, Any]) -> Mission:
        """Return the mission that the file would define with some keys changed.

        Args:
            changes: value by dotted key of the mission file, such as `{"collisions[0].approach.normal_m_s":
                -1.2}`. `vehicle.KEY` is a key of the vehicle's configuration; `vehicle` is a whole
                configuration.

        Raises:
            InputError: a key is unknown, a value has the wrong type or is out of range, or the parts
                contradict each other; or code has changed resolved parts without `replace`.
        """
        own = {key: value for key, value in changes.items() if key.partition(".")[0] != "vehicle"}
        own_vehicle = self.vehicle_as_written()
        vehicle, source = changes.get("vehicle", own_vehicle), self.vehicle_source
        if not isinstance(vehicle, VehicleConfig):
            raise InputError(
                f"expected a vehicle configuration, not {type(vehicle).__name__}", key=("vehicle",)
            )
        if vehicle is not own_vehicle:
            source = None
        of_vehicle = {key.partition(".")[2]: v for key, v in changes.items() if key.startswith("vehicle.")}
        if of_vehicle:
            vehicle = vehicle.replace(of_vehicle)
            if source is not None:
                given = tuple(f"{key}={value}" for key, value in of_vehicle.items())
                source = msgspec.structs.replace(
                    source, mass_kg=vehicle.airframe.mass_kg, set=(*source.set, *given)
                )
        document = Document.from_tree(self._keys_as_written(own_vehicle), IN_PYTHON)
        apply_changes(own, document)
        return msgspec.structs.replace(parse_mission(document, vehicle), vehicle_source=source)

    def vehicle_as_written(self) -> VehicleConfig:
        """Return the vehicle without the limits of the mission."""
        if self.written is None:
            return self.vehicle
        own = {name: getattr(self.written.flying, name) for name in LIMITED_KEYS}
        flying = msgspec.structs.replace(self.vehicle.flying, **own)
        vehicle = msgspec.structs.replace(self.vehicle, flying=flying)
        # Python code may have given the mission another vehicle.
        return vehicle if apply_limits(vehicle, self.limits) == self.vehicle else self.vehicle

    def _keys_as_written(self, vehicle: VehicleConfig) -> dict[str, Any]:
        """Return the keys of the file, with the values that code has changed since (`standoff_m`)."""
        if self.written is None:
            raise InputError("this log lacks the mission's keys: load the mission file", source=self.source)
        same = parse_mission(Document.from_tree(self.written.tree), vehicle)
        unequal = {n for n in self.__struct_fields__ if getattr(self, n) != getattr(same, n)}
        unequal -= {"source", "vehicle", "vehicle_source"}
        resolved = sorted(unequal - set(MissionKeys.__struct_fields__))
        if resolved:
            raise InputError(f"the program has changed {', '.join(resolved)} of a mission without `replace`")
        changed: dict[str, Any] = msgspec.to_builtins({name: getattr(self, name) for name in unequal})
        return self.written.tree | changed

    def frame_at(self, takeoff_ned: Vec3) -> MissionFrame:
        """Return the mission frame for a take-off point (local NED, metres)."""
        north, east = self.frame.north_m, self.frame.east_m
        if self.frame.origin == "takeoff":
            # At take-off, the vehicle is on the ground below `start`.
            heading = math.radians(self.frame.heading_deg)
            frame = MissionFrame(heading_rad=heading)
            offset = frame.vector_to_ned((self.start[0], self.start[1], 0.0))
            north += takeoff_ned[0] - offset[0]
            east += takeoff_ned[1] - offset[1]
        return MissionFrame(north, east, takeoff_ned[2], math.radians(self.frame.heading_deg))


def load_mission(
    path: str | Path | Mapping[str, Any],
    config: str | Path | VehicleConfig | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """Load, validate and resolve a mission file.

    Args:
        path: the mission, or a mapping with the same content.
        config: vehicle configuration that replaces the mission's vehicle: a file or a loaded configuration.
        settings: `KEY=VALUE` pairs that override keys of the vehicle configuration.

    Raises:
        InputError: the mission or the configuration is invalid.
    """
    return parse_mission(load_document(path, FileKind.MISSION), config, settings)


def load_empty_room(config: str | Path | None = None, settings: Sequence[str] = ()) -> Mission:
    """Return a mission without walls, for commands that need a vehicle but no mission.

    The vehicle hovers above PX4's local origin. `config` and `settings` are those of `load_mission`.
    """
    bounds = {axis: [-10.0, 10.0] for axis in "xy"} | {"z": [0.3, 3.0]}
    place = {"position_m": [0.0, 0.0]}
    tree = {
        "version": 1,
        "name": "empty room",
        "start": {**place, "altitude_m": 1.0},
        "goal": place,
        "bounds_m": bounds,
    }
    return parse_mission(Document.from_tree(tree), config, settings)


def parse_mission(
    document: Document,
    config: str | Path | VehicleConfig | LoadedVehicle | None = None,
    settings: Sequence[str] = (),
) -> Mission:
    """Resolve a parsed mission, for `load_mission`; `config` may be a loaded configuration."""
    refuse_other_keys(document, FileKind.MISSION)
    spec = document.convert(MissionFile)
    if not isinstance(config, VehicleConfig | LoadedVehicle):
        config = _find_vehicle(spec, config, document, settings)
    vehicle, source = (config, None) if isinstance(config, VehicleConfig) else config
    space = FlightSpace(spec, vehicle, document)
    space.check_mode(spec.transit_mode, ("transit_mode",))
    _add_tangent_walls(spec, space)
    _check_goal_trajectory(spec, space)
    walls = space.walls | unknown_walls(spec, space)
    tree = {key: value for key, value in document.tree.items() if key != "vehicle"}
    return Mission(
        **shared_keys(spec, MissionKeys),
        source=document.source,
        vehicle=space.vehicle,
        start=spec.start.position_m,
        altitude_m=spec.start.altitude_m,
        bounds=spec.bounds_m,
        walls=tuple(space.walls.values()),
        collisions=tuple(_resolve_collisions(spec, walls, space)),
        waypoints=tuple(_resolve_waypoints(spec, walls, space)),
        posts=tuple(space.posts.values()),
        simulated_walls=tuple(space.resolve_walls(spec.simulated_walls, "simulated_walls").values()),
        vehicle_source=source,
        written=WrittenForm(tree, vehicle.flying),
    )


def _find_vehicle(
    spec: MissionFile, config: str | Path | None, document: Document, settings: Sequence[str]
) -> LoadedVehicle:
    """Return the vehicle of a mission: `config`, the mission's vehicle or the default, in this order."""
    if config is None and isinstance(spec.vehicle, dict):
        vehicle = load_vehicle(document.part("vehicle"), settings)
        source = None if document.source == IN_PYTHON else display_path(document.source)
        return LoadedVehicle(vehicle, VehicleSource(source, False, vehicle.airframe.mass_kg, tuple(settings)))
    if config is None and isinstance(spec.vehicle, str):
        config = Path(document.source).parent / spec.vehicle
    return find_vehicle(config, settings)


def _add_tangent_walls(spec: MissionFile, space: FlightSpace) -> None:
    """Add the tangent plane of each post to be hit to the walls.

    Raise InputError if an impact on a post has no point, if impacts on a post have different points, or if
    a probe searches for a post.
    """
    for i, one in enumerate(spec.collisions):
        if one.wall not in space.posts:
            continue
        key: Key = ("collisions", i)
        if one.probe is not None:
            raise space.error((*key, "probe"), f"{one.wall} is a post, but a probe searches for a wall")
        if one.impact_point_m is None:
            raise space.error(key, f"a collision with post {one.wall} needs impact_point_m")
        wall = space.tangent_wall(space.posts[one.wall], one.impact_point_m, key)
        if space.walls.setdefault(one.wall, wall) != wall:
            text = (
                f"an earlier collision hits post {one.wall} at a different point; all impacts on a post "
                "must be at the same point"
            )
            raise space.error((*key, "impact_point_m"), text)


def _resolve_waypoints(spec: MissionFile, walls: dict[str, Wall], space: FlightSpace) -> Iterator[Waypoint]:
    """Yield the waypoints and pauses; `walls` includes the walls that probes search for."""
    altitude_m, flown = spec.start.altitude_m, 0
    for i, one in enumerate(spec.waypoints):
        key: Key = ("waypoints", i)
        _check_order(one, flown, spec, key, space)
        flown = one.after
        wall_at = None if one.at_wall is None else walls[one.at_wall.wall]
        if one.pause is None:
            position = one.position_m
            if one.at_wall is not None and wall_at is not None:
                position = resolve_place(wall_at, one.at_wall)
            assert position is not None
            altitude_m = altitude_m if one.altitude_m is None else one.altitude_m
            space.check_place(position, one.altitude_m, key)
            space.check_clear_of_posts(position, key)
            speed = one.speed_m_s or space.vehicle.flying.transit_speed_m_s
            if speed > spec.limits.speed_m_s:
                raise space.error(
                    (*key, "speed_m_s"), f"{speed:g} m/s exceeds limits.speed_m_s {spec.limits.speed_m_s:g}"
                )
            place: Vec3 | None = (*position, altitude_m)
            hold_s = one.hold_s or 0.0
        else:
            place, speed, hold_s = None, 0.0, one.timeout_s or _PAUSE_S
        keys = shared_keys(one, WaypointKeys)
        yield Waypoint(**keys, index=i + 1, position=place, speed_m_s=speed, hold_s=hold_s, wall_at=wall_at)


def _check_order(one: WaypointSpec, flown: int, spec: MissionFile, key: Key, space: FlightSpace) -> None:
    """Raise InputError if an entry mixes keys of a waypoint and a pause, or if `after` is out of order."""
    if [one.position_m, one.at_wall, one.pause].count(None) != 2:
        raise space.error(key, "give exactly one key: position_m or at_wall for a waypoint, or pause")
    others = ("timeout_s",) if one.pause is None else ("altitude_m", "speed_m_s", "hold_s")
    for name in others:
        if getattr(one, name) is not None:
            what = "a waypoint" if one.pause is None else "a pause"
            raise space.error((*key, name), f"{what} cannot have this key")
    count = len(spec.collisions)
    if not flown <= one.after <= count:
        text = f"{one.after}, expected {flown} to {count}: the list is in the order of the flight"
        raise space.error((*key, "after"), text)
    following = spec.collisions[one.after] if one.after < count else None
    if 0 < one.after < count and following and following.approach is None and following.probe is None:
        text = f"needs an approach: the recovery from the previous collision leads to waypoints[{key[1]}]"
        raise space.error(("collisions", one.after), text)


def _resolve_collisions(
    mission: MissionFile, walls: dict[str, Wall], space: FlightSpace
) -> Iterator[Collision]:
    """Yield the collisions; `walls` includes the walls that probes search for."""
    for i, spec in enumerate(mission.collisions):
        key: Key = ("collisions", i)
        if spec.wall not in walls:
            raise space.error((*key, "wall"), unknown_name(spec.wall, [*walls, *mission.posts]))
        wall, mode = walls[spec.wall], spec.mode
        if mode is not None:
            space.check_mode(mode, (*key, "mode"))
        elif space.vehicle.has_lock:
            raise space.error(key, "missing key mode: " + " or ".join(space.vehicle.modes))
        else:
            (mode,) = space.vehicle.modes
        probe, alphas = None, (0.0, 0.0)
        approach: Vec2 | None
        impact: Vec2 | None
        if spec.probe is not None:
            probe, approach, impact = resolve_probe(i, spec, mission, wall, space)
        else:
            alphas = space.alphas(spec.alpha_m_per_n, spec.alpha_wall_m_per_n, wall, key)
            approach, impact = _resolve_approach(i, spec, mission, wall, space)
        yield Collision(
            **shared_keys(spec, CollisionKeys) | {"mode": mode},
            index=i + 1,
            wall=wall,
            approach_m_s=approach,
            impact_point=impact,
            alpha_normal_m_per_n=alphas[0],
            alpha_tangential_m_per_n=alphas[1],
            probe=probe,
        )


def _resolve_approach(
    i: int, spec: CollisionSpec, mission: MissionFile, wall: Wall, space: FlightSpace
) -> tuple[Vec2 | None, Vec2 | None]:
    """Return impact velocity (normal, tangential) and impact point; None if a recovery leads to the wall."""
    key: Key = ("collisions", i)
    if spec.approach is None and i > 0 and mission.collisions[i - 1].probe is not None:
        raise space.error(key, "needs an approach, because the vehicle is at rest after a probe")
    approach = None
    impact = None
    if spec.approach is not None:
        approach = (spec.approach.normal_m_s, spec.approach.tangential_m_s)
        speed = math.hypot(*approach)
        if speed > mission.limits.speed_m_s:
            raise space.error(
                (*key, "approach"), f"{speed:.2f} m/s exceeds limits.speed_m_s {mission.limits.speed_m_s:g}"
            )
        if spec.trajectory is None or (spec.impact_point_m or spec.impact_along_m) is not None:
            impact = _impact_point(spec, mission.start.position_m, wall, approach, key, space)
        else:
            impact = wall.foot(spec.trajectory.states()[-1].position)
        if not wall.spans(impact):
            raise space.error(
                (*key, "approach"),
                f"meets the plane of wall {wall.name} at ({impact[0]:.3f}, {impact[1]:.3f}), "
                f"beyond the end of the wall, which is {wall.length_m:g} m long",
            )
    elif i == 0:
        raise space.error(key, "the first collision needs an approach")
    if spec.trajectory is not None:
        _check_trajectory(spec.trajectory, i, spec, mission, wall, space)
    for name in ("impact_point_m", "impact_along_m"):
        if approach is None and getattr(spec, name) is not None and not wall.post_radius_m:
            raise space.error((*key, name), "only a collision with an approach can have this key")
    return approach, impact


def _check_trajectory(
    written: TrajectoryPieces,
    i: int,
    spec: CollisionSpec,
    mission: MissionFile,
    wall: Wall,
    space: FlightSpace,
) -> None:
    """Raise InputError if a trajectory does not lead from the vehicle to the expected impact."""
    key: Key = ("collisions", i, "trajectory")
    if spec.predicted is None:
        raise space.error(key, "needs the key `predicted`, which gives the expected impact")
    planned, end = spec.predicted, written.states()[-1]
    off_m = abs(wall.signed_distance(end.position))
    if off_m > _TRAJECTORY_OFF_M:
        raise space.error(key, f"ends {off_m:.2f} m off the plane of wall {wall.name}")
    normal, tangential, _ = wall.to_collision((*end.velocity, 0.0))
    off_m_s = math.hypot(normal - planned.normal_m_s, tangential - planned.tangential_m_s)
    if off_m_s > _TRAJECTORY_OFF_M_S:
        raise space.error(key, f"ends at ({normal:.2f}, {tangential:.2f}) m/s, not at the predicted velocity")
    if spec.approach is None:
        _check_replanned(mission, key, space)
    else:
        _check_from_rest(written, _rest_before(mission, i), key, space)


def _check_replanned(mission: MissionFile, key: Key, space: FlightSpace) -> None:
    if mission.after_impact is not AfterImpact.REPLAN:
        raise space.error(key, "a trajectory after a collision needs `after_impact: replan`")


def _rest_before(mission: MissionFile, flown: int) -> Vec2 | None:
    """Return the resting position after the first `flown` collisions, or None if a recovery follows."""
    reached = [w.position_m for w in mission.waypoints if w.after == flown and w.position_m is not None]
    return reached[-1] if reached else mission.start.position_m if flown == 0 else None


def _check_from_rest(written: TrajectoryPieces, place: Vec2 | None, key: Key, space: FlightSpace) -> None:
    if place is None:
        raise space.error(key, "a trajectory from rest must follow a waypoint")
    off_m = math.dist(written.position_m, place)
    if off_m > _TRAJECTORY_OFF_M or any((*written.velocity_m_s, *written.acceleration_m_s2)):
        text = f"must begin at rest at ({place[0]:g}, {place[1]:g}); its first point is {off_m:.2f} m away"
        raise space.error(key, text)


def _check_goal_trajectory(mission: MissionFile, space: FlightSpace) -> None:
    """Raise InputError if the trajectory to the goal cannot be flown or does not end at rest at the goal."""
    written, key = mission.goal_trajectory, ("goal_trajectory",)
    if written is None:
        return
    count = len(mission.collisions)
    if count and any(w.after == count for w in mission.waypoints):
        raise space.error(key, "the path from a waypoint to the goal is straight: remove this key")
    if count and mission.collisions[-1].probe is not None:
        raise space.error(key, "the path from a probe to the goal is straight: remove this key")
    if count:
        _check_replanned(mission, key, space)
    else:
        _check_from_rest(written, _rest_before(mission, 0), key, space)
    end = written.states()[-1]
    off_m, speed_m_s = math.dist(end.position, mission.goal.position_m), math.hypot(*end.velocity)
    if off_m > _TRAJECTORY_OFF_M or speed_m_s > _TRAJECTORY_OFF_M_S:
        text = f"ends {off_m:.2f} m from the goal at {speed_m_s:.2f} m/s, not at rest at the goal"
        raise space.error(key, text)


def _impact_point(
    spec: CollisionSpec, start: Vec2, wall: Wall, approach_m_s: Vec2, key: Key, space: FlightSpace
) -> Vec2:
    """Return the file's impact point, or the point where the approach from the start crosses the plane."""
    given, along = spec.impact_point_m, spec.impact_along_m
    if given is not None and along is not None:
        raise space.error((*key, "impact_along_m"), "give impact_along_m or impact_point_m, not both")
    if wall.sought:
        if given is not None:
            text = f"the position of wall {wall.name} is unknown: give impact_along_m"
            raise space.error((*key, "impact_point_m"), text)
        along = along or 0.0
    if given is not None:
        off = abs(wall.signed_distance(given))
        if off > 0.01:
            x, y = wall.foot(given)
            text = f"is {off:.3f} m off wall {wall.name}, whose nearest point is [{x:.3f}, {y:.3f}]; "
            text += f"or give impact_along_m: {wall.along((x, y)):.3f}"
            text += space.hint_at_surface(off)
            raise space.error((*key, "impact_point_m"), text)
        return given
    if along is None:
        if wall.signed_distance(start) <= 0.0:
            raise space.error((*key, "approach"), f"start is not in front of wall {wall.name}")
        return _project_onto_wall(start, wall, approach_m_s)
    (x, y), (tx, ty), reach = wall.point, wall.tangent, 0.5 * wall.length_m
    if abs(along) > reach:
        text = f"{along:g} m is beyond the wall, which extends from {-reach:g} to {reach:g} m"
        raise space.error((*key, "impact_along_m"), text)
    return (x + along * tx, y + along * ty)


def _project_onto_wall(start: Vec2, wall: Wall, approach_m_s: Vec2) -> Vec2:
    """Return the point where the ray from `start` along the approach velocity crosses the wall's plane."""
    v = wall.from_collision((approach_m_s[0], approach_m_s[1], 0.0))
    t = wall.signed_distance(start) / -approach_m_s[0]
    return (start[0] + v[0] * t, start[1] + v[1] * t)
