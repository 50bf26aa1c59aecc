"""A simulated world that differs at random from the mission, for one flight (docs/draws.md).

`--vary` selects the quantities that differ, and a seed determines their values; this is called drawing. The
flight core uses the mission, and the simulated vehicle flies in the drawn world. Every quantity has its own
random sequence. Therefore the other values stay the same if one more quantity is drawn.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Mapping
from typing import Final, NamedTuple

import msgspec

from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError, unknown_name
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import ImuRinging, Material, VehicleConfig
from dart_flight.lock.drivers.mock import MockFaults
from dart_flight.lock.servo import ServoFaults

Drawn = dict[str, float | str]

_RINGING_M_S2 = (2.0, 3.0)  # range of standard deviations of IMU samples in hover (docs/results/real_data.md)
_RINGING_WHITE_M_S2 = 0.8  # the white noise in this deviation, from 32 ms means of the same recordings
_MIN_FACTOR = 0.1  # lower limit of a factor on a nominal value
# Default spreads: standard deviations, relative if there is no unit.
SPREADS: Final[Mapping[str, float]] = {
    "contact": 0.2,  # friction on wood varied in 2 of 5 flights of the paper
    "contact_scatter": 0.05,  # scatter between impacts on the same wall
    "lock_true_mode": 0.01,  # probability that the lock is stuck or half engaged, regardless of its report
    "wall_offset_m": 0.03,  # metres: error of a tape measure, plus displacement of a panel
    "wall_yaw_deg": 4.0,
    "guard_height_m": 0.02,  # metres; applies if the vehicle's configuration has no guard_height_sd_m
    "mass": 0.03,
    "wind_m_s": 0.5,  # a room with an open door, and the vehicle's own wash; gusts are half as large
    "servo": 0.2,  # travel of 60 degrees: 0.15 to 0.19 s without load, longer with load (manufacturer)
    "battery": 0.05,
    "imu": 0.02,  # metres: the flight controller may lie beside the battery
    "replan_latency_s": 0.02,  # 15 to 25 ms on one core (docs/replanning.md)
}
NAMES = tuple(SPREADS)
LOCK_TRUE_MODE, AS_COMMANDED = "lock_true_mode", "as commanded"  # the value in `drawn` for a faultless lock
_OF_LOCK = (LOCK_TRUE_MODE, "servo")


class DrawnWorld(NamedTuple):
    """The result of a draw.

    Attributes:
        mission: mission with the true vehicle and the true walls; only the simulated vehicle uses it.
        drawn: drawn values by name, for log and verdict.
    """

    mission: Mission
    lock_faults: MockFaults | None
    drawn: Drawn


def parse_vary(settings: Iterable[str], vehicle: VehicleConfig) -> dict[str, float]:
    """Parse settings `NAME[=SD]`, and return the standard deviation of each named quantity.

    `all` selects every quantity that the vehicle has, with its default spread. Raise InputError if a name is
    unknown or refers to a part that the vehicle lacks, or if a number is below 0.
    """
    names = [n for n in NAMES if vehicle.has_lock or n not in _OF_LOCK]
    spreads = {**SPREADS, "guard_height_m": vehicle.simulation.contact.guard_height_sd_m}
    wanted: dict[str, float] = {}
    for setting in settings:
        name, given, text = setting.partition("=")
        if name == "all" and not given:
            wanted = {**{n: spreads[n] for n in names}, **wanted}
            continue
        if name in _OF_LOCK and name not in names:
            raise InputError(f"--vary {setting}: this vehicle has no lock")
        if name not in NAMES:
            raise InputError(f"--vary {setting}: {unknown_name(name, [*names, 'all'])}")
        try:
            sd = float(text) if given else spreads[name]
        except ValueError:
            sd = math.nan
        if not 0.0 <= sd <= 100.0:
            raise InputError(
                f"--vary {setting}: the spread must be a number from 0 to 100, such as {name}=0.1"
            )
        wanted[name] = sd
    return wanted


def draw_world(mission: Mission, seed: int, spreads: Mapping[str, float]) -> DrawnWorld:
    """Draw the world for one flight of a mission; `parse_vary` describes `spreads`."""
    world = DrawnWorld(mission, None, {})
    for name in NAMES:  # draw in the table's order, whatever the order of the request
        if spreads.get(name):
            world = _DRAWS[name](world, random.Random(f"{seed} {name}"), spreads[name])
    return world


def _factor(rng: random.Random, sd: float) -> float:
    return max(_MIN_FACTOR, 1.0 + sd * rng.gauss(0.0, 1.0))


def _with_vehicle(world: DrawnWorld, vehicle: VehicleConfig, **drawn: float | str) -> DrawnWorld:
    mission = msgspec.structs.replace(world.mission, vehicle=vehicle)
    return world._replace(mission=mission, drawn=world.drawn | drawn)


def _with_simulation(world: DrawnWorld, drawn: Drawn, **changes: object) -> DrawnWorld:
    vehicle = world.mission.vehicle
    simulation = msgspec.structs.replace(vehicle.simulation, **changes)
    return _with_vehicle(world, msgspec.structs.replace(vehicle, simulation=simulation), **drawn)


def _with_contact(world: DrawnWorld, drawn: Drawn, **changes: object) -> DrawnWorld:
    contact = msgspec.structs.replace(world.mission.vehicle.simulation.contact, **changes)
    return _with_simulation(world, drawn, contact=contact)


def _contact(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw the coefficients of every wall and mode; they are constant in flight."""
    mission = world.mission
    materials, drawn = dict(mission.vehicle.materials), Drawn()
    renamed: dict[str, Wall] = {}
    for wall in _independent_walls(mission):
        old, name = materials[wall.material], f"{wall.material} of {wall.name}"
        per_mode = {}
        for mode in mission.vehicle.modes:
            factors = [_factor(rng, sd) for _ in range(4)]
            c = old.coefficients(mode)
            per_mode[mode] = c.scaled(*factors)
            for symbol, factor in zip(("k", "f", "mu", "nu"), factors, strict=True):
                drawn[f"contact.{wall.name}.{mode.value}.{symbol}"] = factor
        materials[name] = Material(per_mode[Mode.RIGID], per_mode.get(Mode.FLEXIBLE), old.source)
        renamed[wall.name] = msgspec.structs.replace(wall, material=name)
    world = with_walls(world, renamed)
    vehicle = msgspec.structs.replace(mission.vehicle, materials=materials)
    return _with_vehicle(world, vehicle, **drawn)


def _independent_walls(mission: Mission) -> list[Wall]:
    """Return all walls except the backs of partitions, which follow from the fronts."""
    return [wall for wall in mission.standing_walls if not wall.is_back]


def with_walls(world: DrawnWorld, walls: Mapping[str, Wall]) -> DrawnWorld:
    """Return the world with other walls, by name.

    `walls` must contain every wall except the backs of partitions, which follow from the fronts. If a wall is
    the tangent plane of a post, the post moves with the wall.
    """
    mission = world.mission
    fronts = [wall for wall in walls.values() if wall.thickness_m is not None and not wall.is_back]
    walls = {**walls, **{back.name: back for back in (front.back() for front in fronts)}}
    collisions = tuple(
        msgspec.structs.replace(c, wall=walls.get(c.wall.name, c.wall)) for c in mission.collisions
    )
    posts = {post.name: post for post in mission.posts}
    for old in mission.walls:
        if old.post_radius_m:
            new, post = walls[old.name], posts[old.name]
            centre = (
                post.centre[0] + new.point[0] - old.point[0],
                post.centre[1] + new.point[1] - old.point[1],
            )
            posts[old.name] = msgspec.structs.replace(post, centre=centre, material=new.material)
    changed = msgspec.structs.replace(
        mission,
        walls=tuple(walls[w.name] for w in mission.walls),
        simulated_walls=tuple(walls[w.name] for w in mission.simulated_walls),
        collisions=collisions,
        posts=tuple(posts.values()),
    )
    return world._replace(mission=changed)


def _wall_offset(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Move every wall along its normal; a wall's own `position_sd_m` overrides `sd`."""
    walls, drawn = {}, Drawn()
    for wall in _independent_walls(world.mission):
        own = wall.position_sd_m
        away = (sd if own is None else own) * rng.gauss(0.0, 1.0)
        walls[wall.name] = wall.displaced(away)
        drawn[f"wall_offset_m.{wall.name}"] = away
    return with_walls(world, walls)._replace(drawn=world.drawn | drawn)


def _wall_yaw(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Rotate every wall about its middle (seen from above); a wall's own `yaw_sd_deg` overrides `sd`."""
    walls, drawn = {}, Drawn()
    for wall in _independent_walls(world.mission):
        own = wall.yaw_sd_rad
        angle_deg = (sd if own is None else math.degrees(own)) * rng.gauss(0.0, 1.0)
        walls[wall.name] = wall.rotated(math.radians(angle_deg))
        drawn[f"wall_yaw_deg.{wall.name}"] = angle_deg
    return with_walls(world, walls)._replace(drawn=world.drawn | drawn)


def _contact_scatter(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Set how much k, f and mu vary; the plant draws them again for every contact."""
    return _with_contact(world, {"contact_scatter": sd}, scatter=sd)


def _guard_height(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    height = world.mission.vehicle.simulation.contact.guard_height_m + sd * rng.gauss(0.0, 1.0)
    return _with_contact(world, {"guard_height_m": height}, guard_height_m=height)


def _mass(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw the mass; the inertia scales with it."""
    factor = _factor(rng, sd)
    vehicle = world.mission.vehicle
    ix, iy, iz = vehicle.airframe.inertia_kg_m2
    airframe = msgspec.structs.replace(
        vehicle.airframe,
        mass_kg=vehicle.airframe.mass_kg * factor,
        inertia_kg_m2=(ix * factor, iy * factor, iz * factor),
    )
    return _with_vehicle(world, msgspec.structs.replace(vehicle, airframe=airframe), mass=factor)


def _wind(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw a steady wind from any direction; the standard deviation of the gusts is half of `sd`."""
    north, east = world.mission.vehicle.simulation.wind_north_east_m_s
    north, east = north + sd * rng.gauss(0.0, 1.0), east + sd * rng.gauss(0.0, 1.0)
    drawn: Drawn = {"wind_north_m_s": north, "wind_east_m_s": east}
    return _with_simulation(world, drawn, wind_north_east_m_s=(north, east), gust_m_s=0.5 * sd)


def _servo(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw the travel time under load."""
    factor = _factor(rng, sd)
    faults = world.lock_faults or MockFaults()
    servo = msgspec.structs.replace(faults.servo, slow=factor)
    return world._replace(
        lock_faults=msgspec.structs.replace(faults, servo=servo), drawn=world.drawn | {"servo": factor}
    )


def _lock_true_mode(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """With probability `sd`, simulate a servo that is stuck from the start, or half-engaged rods."""
    if rng.random() >= sd:
        return world._replace(drawn=world.drawn | {LOCK_TRUE_MODE: AS_COMMANDED})
    if rng.random() < 0.5:
        faults = world.lock_faults or MockFaults()
        faults = msgspec.structs.replace(faults, servo=ServoFaults(stuck=True))
        return world._replace(lock_faults=faults, drawn=world.drawn | {"lock_true_mode": "stuck"})
    return _with_contact(world, {"lock_true_mode": "half engaged"}, half_engaged=True)


def _battery(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Scale the thrust of all motors, as with a battery that is fuller or emptier than assumed."""
    factor = _factor(rng, sd)
    vehicle = world.mission.vehicle
    vehicle = msgspec.structs.replace(vehicle, thrust=vehicle.thrust.scaled(factor))
    return _with_vehicle(world, vehicle, battery=factor)


def _imu(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw the IMU's offset from the centre of mass, and a frame vibration as strong as in a real hover."""
    x, y, z = world.mission.vehicle.simulation.imu_position_m
    position = (x + sd * rng.gauss(0.0, 1.0), y + sd * rng.gauss(0.0, 1.0), z + sd * rng.gauss(0.0, 1.0))
    shaking = rng.uniform(*_RINGING_M_S2)
    ringing = ImuRinging(_RINGING_WHITE_M_S2, math.sqrt(shaking**2 - _RINGING_WHITE_M_S2**2))
    drawn: Drawn = {f"imu_position_m.{axis}": p for axis, p in zip("xyz", position, strict=True)}
    drawn["imu_ringing_m_s2"] = shaking
    return _with_simulation(world, drawn, imu_position_m=position, imu_ringing=ringing)


def _replan_latency(world: DrawnWorld, rng: random.Random, sd: float) -> DrawnWorld:
    """Draw a latency that is at least the configured latency."""
    latency_s = world.mission.vehicle.simulation.replan_latency_s + sd * abs(rng.gauss(0.0, 1.0))
    return _with_simulation(world, {"replan_latency_s": latency_s}, replan_latency_s=latency_s)


_DRAWS: dict[str, Callable[[DrawnWorld, random.Random, float], DrawnWorld]] = {
    "contact": _contact,
    "contact_scatter": _contact_scatter,
    "lock_true_mode": _lock_true_mode,
    "wall_offset_m": _wall_offset,
    "wall_yaw_deg": _wall_yaw,
    "guard_height_m": _guard_height,
    "mass": _mass,
    "wind_m_s": _wind,
    "servo": _servo,
    "battery": _battery,
    "imu": _imu,
    "replan_latency_s": _replan_latency,
}
