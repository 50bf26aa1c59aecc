"""Plants in front of walls and posts, for the tests of this room."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    MissionFrame,
    Quaternion,
    Vec3,
    quaternion_from_euler,
    rotate,
)
from dart_flight.base.records import Mode, TruthContact
from dart_flight.base.walls import Post, Wall
from dart_flight.config.vehicle import BodyModel, VehicleConfig
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.sim.plant import Plant
from tests.oracles.rigid_body import Body, Law

ROOT = Path(__file__).parents[2]
# The reference solutions model the vehicle as a point.
VEHICLE = load_vehicle(ROOT / "configs/dart.yaml", ["simulation.contact.body=point"])
HOVER = VEHICLE.thrust.command_for(VEHICLE.airframe.mass_kg * GRAVITY_M_S2 / 4.0)
WALL = Wall("wall", (1.0, 0.0), (-1.0, 0.0), 80.0, "acrylic")


def in_still_air(vehicle: VehicleConfig) -> VehicleConfig:
    """Return a vehicle without drag."""
    return vehicle.replace({"airframe.drag_per_s": [0.0, 0.0, 0.0]})


def body_vehicle(**changes: object) -> VehicleConfig:
    """Return the configured vehicle with guards and without drag."""
    contact = msgspec.structs.replace(VEHICLE.simulation.contact, body=BodyModel.GUARDS, **changes)
    simulation = msgspec.structs.replace(VEHICLE.simulation, contact=contact)
    airframe = msgspec.structs.replace(VEHICLE.airframe, incidence_rigid_deg=45.0)
    return in_still_air(msgspec.structs.replace(VEHICLE, simulation=simulation, airframe=airframe))


def before_the_wall(
    vehicle: VehicleConfig,
    mode: Mode,
    normal: float,
    tangential: float = 0.0,
    yaw: float = 0.0,
    heading: float = 0.0,
) -> Plant:
    """Return a hovering plant, 5 cm before an acrylic wall, whose yaw is in NED, radians.

    The wall is to the north if the mission frame has no heading.
    """
    plant = Plant(vehicle, (WALL,), MissionFrame(heading_rad=heading))
    plant.position = plant.frame.point_to_ned((0.95, 0.0, 5.0))
    plant.velocity = plant.frame.vector_to_ned(WALL.from_collision((normal, tangential, 0.0)))
    plant.q = quaternion_from_euler(0.0, 0.0, yaw)
    plant.motor = [HOVER] * 4
    plant.set_mode(mode)
    return plant


def first_contact(plant: Plant, limit_s: float = 3.0) -> TruthContact:
    """Hover until the first contact has ended, and return it."""
    while not plant.finished and plant.time_s < limit_s:
        plant.advance((HOVER,) * 4)
    return plant.finished[0]


def drifting_plant(
    vehicle: VehicleConfig,
    mode: Mode,
    obstacles: tuple[Wall | Post, ...],
    place: tuple[float, float],
    velocity: tuple[float, float],
    yaw: float,
    tilt: float = 0.0,
    rate: float = 0.0,
) -> Plant:
    """Return a plant in the air without motors or gravity; the mission frame is north and west."""
    plant = Plant(vehicle, obstacles, MissionFrame())
    plant.position = plant.frame.point_to_ned((*place, 5.0))
    plant.velocity = plant.frame.vector_to_ned((*velocity, 0.0))
    plant.q = quaternion_from_euler(tilt, 0.5 * tilt, -yaw)
    plant.rate = (0.0, 0.0, -rate)
    plant.set_mode(mode)
    leave_only_contacts(plant)
    return plant


def leave_only_contacts(plant: Plant) -> None:
    """Switch the motors off, and let the drag cancel gravity.

    The plant has no such world, and the oracles know only contacts: hence the private names.
    """
    plant._motors = lambda commands: (0.0, (0.0, 0.0, 0.0))  # type: ignore[method-assign]
    plant._drag = lambda: (0.0, 0.0, -GRAVITY_M_S2)  # type: ignore[method-assign]


def motor_load(plant: Plant, commands: list[float]) -> tuple[float, Vec3]:
    """Return thrust and torque of motors that follow these commands, in the present state.

    A step of the plant would also move its arms and its body: hence the private name.
    """
    plant.motor = list(commands)
    return plant._motors(tuple(commands))


def drift(plant: Plant, seconds: float) -> None:
    """Advance a plant whose motors are off."""
    for _ in range(round(1000 * seconds)):
        plant.advance((0.0,) * len(plant.motors))


def energy_j(plant: Plant) -> float:
    """Return the kinetic energy; there is no gravity."""
    moving = plant.mass * sum(v * v for v in plant.velocity)
    turning = sum(i * w * w for i, w in zip(plant.vehicle.airframe.inertia_kg_m2, plant.rate, strict=True))
    return 0.5 * (moving + turning)


def rotation(q: Quaternion) -> np.ndarray:
    """Return the matrix of a rotation."""
    return np.array([rotate(q, e) for e in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T


def oracle_of(vehicle: VehicleConfig, mode: Mode) -> tuple[Body, Law]:
    """Return the oracle's body and its contact law on acrylic."""
    contact, c = vehicle.simulation.contact, vehicle.materials["acrylic"].coefficients(mode)
    body = Body(
        vehicle.airframe.mass_kg,
        np.array(vehicle.airframe.inertia_kg_m2),
        contact.guard_out_m,
        contact.guard_along_m,
        contact.guard_height_m,
        contact.friction_lever_share,
        contact.vertical_lever_m,
    )
    return body, Law(c.k, c.f, c.mu, c.nu, vehicle.vertical_force_sign)
