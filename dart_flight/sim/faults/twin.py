"""A second simulated vehicle on the link of the first one, with the same system id."""

from __future__ import annotations

import msgspec

from dart_flight.base.geometry import add
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

_APART_NED = (0.0, 4.0, 0.0)  # outside the missions' flight space
_OTHER_SEED = 1000


def make_second_vehicle(mission: Mission, seed: int, ahead_s: float, now_us: int) -> SimulatedVehicle:
    """Return a second vehicle, disarmed on the ground, whose clock is `ahead_s` ahead of the first."""
    twin = SimulatedVehicle(msgspec.structs.replace(mission, walls=()), seed + _OTHER_SEED, LockDriver.PX4)
    plant, autopilot = twin.autopilot.plant, twin.autopilot
    plant.position = add(plant.position, _APART_NED)
    # The second vehicle has been on for a while, so its estimator has converged.
    autopilot.estimator.correct(0.0, plant.position, plant.q)
    twin.advance()
    while not autopilot.estimator.ok:
        autopilot.estimator.correct(autopilot.now_s, plant.position, plant.q)
    plant.time_offset_us += now_us - autopilot.time_us + round(ahead_s * 1e6)
    return twin
