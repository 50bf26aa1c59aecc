"""Conversion of a mission file's probes to legs that search for walls, and to walls at assumed positions."""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import Key, unknown_name
from dart_flight.config.flight_space import FlightSpace
from dart_flight.config.mission_file import CollisionSpec, MissionFile, PlaceAtWall, ProbeSpec, WaypointSpec

# Assumed length of a wall that a probe has found, and standard deviation of the direction before contact.
_SOUGHT_LENGTH_M, _SOUGHT_SD_RAD = 1.0, math.radians(15.0)
_NOT_OF_PROBES = (
    "approach",
    "impact_point_m",
    "impact_along_m",
    "alpha_m_per_n",
    "alpha_wall_m_per_n",
    "trajectory",
    "predicted",
)
_ON_PLANE_M = 1e-6


class Probe(msgspec.Struct, frozen=True):
    """A leg that searches for a wall, from `begin` to `end` (mission frame, metres) at `speed_m_s`.

    The vehicle then waits `back_m` from the wall. With `from_here` the leg begins where the vehicle rests.
    """

    begin: Vec2
    end: Vec2
    speed_m_s: float
    back_m: float
    from_here: bool = False

    def starting_at(self, here: Vec2) -> Probe:
        """Return the leg from another start (mission frame, m), with the same length and direction."""
        (bx, by), (ex, ey) = self.begin, self.end
        return msgspec.structs.replace(self, begin=here, end=(here[0] + ex - bx, here[1] + ey - by))


def unknown_walls(spec: MissionFile, space: FlightSpace) -> dict[str, Wall]:
    """Return the walls at unknown positions, by name, each at the end of its probe's leg, square to the leg.

    Raise InputError if a probe has no direction, an unknown material or a name in use. Also raise it if a
    collision with an unknown wall precedes its probe, or if a condition names a wall without earlier probe.
    """
    walls, materials = space.walls, space.vehicle.materials
    stiffest = max(materials, key=lambda name: materials[name].coefficients(Mode.RIGID).k)
    looked_for = {one.wall for one in spec.collisions if one.probe is not None}
    sought: dict[str, Wall] = {}
    probed: set[str] = set()
    for i, one in enumerate(spec.collisions):
        key: Key = ("collisions", i)
        _check_conditions(one, probed, key, space)
        for j, waypoint in enumerate(spec.waypoints):
            if waypoint.after == i:
                _check_waypoint_wall(waypoint, probed, ("waypoints", j), space)
        if one.probe is None:
            if one.wall not in walls and one.wall not in probed and one.wall in looked_for:
                raise space.error((*key, "wall"), f"no earlier probe searches for wall {one.wall}")
            continue
        if one.wall in walls:
            probed.add(one.wall)
            continue
        if one.wall in probed:
            text = f"two probes search for {one.wall}; give the second wall another name"
            raise space.error((*key, "wall"), text)
        probed.add(one.wall)
        if one.wall in spec.simulated_walls:
            raise space.error((*key, "wall"), f"a simulated wall already has the name {one.wall}")
        if one.probe.direction is None:
            known = ", ".join(walls) or "none"
            text = f"{one.wall} is not a wall of the mission ({known}): a probe for it needs a direction"
            raise space.error((*key, "probe"), text)
        material = one.probe.material
        if material is not None:
            space.check_material(material, (*key, "probe", "material"))
        dx, dy = one.probe.direction
        length = math.hypot(dx, dy)
        if not length > 1e-9:
            raise space.error((*key, "probe", "direction"), "the direction has length 0")
        sought[one.wall] = Wall(
            one.wall,
            _probe_end(one.probe, None),
            (-(dx / length), -(dy / length)),
            _SOUGHT_LENGTH_M,
            material or stiffest,
            yaw_sd_rad=_SOUGHT_SD_RAD,
            half_vehicle_m=space.vehicle.airframe.contact_distance_m,
            sought=True,
            material_known=material is not None,
        )
    for j, waypoint in enumerate(spec.waypoints):
        if waypoint.after >= len(spec.collisions):
            _check_waypoint_wall(waypoint, probed, ("waypoints", j), space)
    return sought


def _check_conditions(
    one: CollisionSpec | WaypointSpec, probed: set[str], key: Key, space: FlightSpace
) -> None:
    """Raise InputError if a condition names a wall that no earlier probe searches for."""
    for name in ("if_met", "if_not_met"):
        wall = getattr(one, name)
        if wall is not None and wall not in probed:
            text = unknown_name(wall, sorted(probed)) if probed else "there is no earlier probe"
            raise space.error((*key, name), text)


def _check_waypoint_wall(one: WaypointSpec, probed: set[str], key: Key, space: FlightSpace) -> None:
    _check_conditions(one, probed, key, space)
    known = {*probed, *space.walls}
    if one.at_wall is not None and one.at_wall.wall not in known:
        text = unknown_name(one.at_wall.wall, sorted(known))
        raise space.error((*key, "at_wall", "wall"), text)


def _probe_end(probe: ProbeSpec, wall: Wall | None) -> Vec2:
    """Return the end of a probe; without a direction, the probe leads to the wall along the wall's normal."""
    dx, dy = probe.direction or ((-wall.normal[0], -wall.normal[1]) if wall is not None else (0.0, 0.0))
    share = probe.length_m / math.hypot(dx, dy)
    return (probe.from_m[0] + share * dx, probe.from_m[1] + share * dy)


def resolve_probe(
    i: int, spec: CollisionSpec, mission: MissionFile, wall: Wall, space: FlightSpace
) -> tuple[Probe, Vec2, Vec2]:
    """Return a probe, its nominal impact velocity (normal, tangential), and its nominal impact point.

    The nominal values hold for the assumed position of the wall; the point is in the mission frame. Raise
    InputError if the probe has keys that only collisions without a probe may have, leads out of the bounds or
    away from its wall, or is too fast.
    """
    key: Key = ("collisions", i)
    probe = spec.probe
    assert probe is not None
    for name in _NOT_OF_PROBES:
        if getattr(spec, name) is not None:
            raise space.error((*key, name), "a probe cannot have this key")
    if not wall.sought and probe.material is not None:
        raise space.error(
            (*key, "probe", "material"),
            f"wall {wall.name} of the mission already has a material: remove this key",
        )
    end = _probe_end(probe, wall)
    for name, place in (("from_m", probe.from_m), ("length_m", end)):
        excess_m = mission.bounds_m.excess2(place)
        if excess_m > 0.0:
            where = f"({place[0]:.2f}, {place[1]:.2f})"
            raise space.error((*key, "probe", name), f"{where} is {excess_m:.2f} m outside bounds_m")
    if probe.speed_m_s > mission.limits.speed_m_s:
        text = f"{probe.speed_m_s:g} m/s exceeds limits.speed_m_s {mission.limits.speed_m_s:g}"
        raise space.error((*key, "probe", "speed_m_s"), text)
    share = probe.speed_m_s / probe.length_m
    vx, vy = share * (end[0] - probe.from_m[0]), share * (end[1] - probe.from_m[1])
    normal_m_s, tangential_m_s, _ = wall.to_collision((vx, vy, 0.0))
    if not normal_m_s < -0.5 * probe.speed_m_s or wall.signed_distance(probe.from_m) <= 0.0:
        text = f"begins behind wall {wall.name}, or the angle between probe and normal exceeds 60 degrees"
        raise space.error((*key, "probe"), text)
    reach_m = wall.signed_distance(probe.from_m) / -normal_m_s * probe.speed_m_s
    if reach_m > probe.length_m + _ON_PLANE_M:
        text = (
            f"wall {wall.name} is {reach_m:.2f} m away; length_m must be this distance plus the wall's "
            "uncertainty"
        )
        raise space.error((*key, "probe", "length_m"), text)
    met = reach_m / probe.length_m
    impact = (
        probe.from_m[0] + met * (end[0] - probe.from_m[0]),
        probe.from_m[1] + met * (end[1] - probe.from_m[1]),
    )
    flown = Probe(probe.from_m, end, probe.speed_m_s, probe.back_m, probe.from_here)
    return flown, (normal_m_s, tangential_m_s), impact


def resolve_place(wall: Wall, place: PlaceAtWall) -> Vec2:
    """Return a place at a wall as a position in the mission frame, with the wall at its assumed position."""
    (x, y), (nx, ny), (tx, ty) = wall.point, wall.normal, wall.tangent
    return (x + place.away_m * nx + place.along_m * tx, y + place.away_m * ny + place.along_m * ty)
