"""The simulated autopilot's controllers with a large heading error after a collision."""

import math

import pytest

from dart_flight.base.geometry import MissionFrame, quaternion_from_euler, tilt_of, yaw_ned_of
from dart_flight.sim.cascade import Cascade, TrajectorySetpoint
from dart_flight.sim.embedded_autopilot import default_parameters
from dart_flight.sim.plant import Plant
from tests.sim.plants import HOVER, VEHICLE


@pytest.mark.parametrize("yaw_deg", [5.0, 90.0, -150.0, 178.0])
def test_tilt_is_corrected_before_any_heading_error(yaw_deg: float) -> None:
    """As with PX4, a vehicle that a collision has spun must not topple while it turns back."""
    parameters = {name: float(value) for name, value in default_parameters(VEHICLE).items()}
    cascade = Cascade(parameters, VEHICLE.hover_thrust_fraction(), VEHICLE.thrust, VEHICLE.airframe.motors)
    plant = Plant(VEHICLE, (), MissionFrame())
    plant.position, plant.ground_down = (0.0, 0.0, -5.0), 100.0
    plant.q = quaternion_from_euler(0.2, 0.1, math.radians(yaw_deg))
    plant.rate = (2.0, -1.0, 0.0)
    plant.motor = [HOVER] * 4
    hold = TrajectorySetpoint((0.0, 0.0, -5.0), yaw=0.0)
    tilts = []
    for tick in range(500):
        if tick % 2 == 0:
            cascade.update_position(hold, plant.position, plant.velocity, yaw_ned_of(plant.q), 0.008)
        plant.advance(cascade.update_attitude(plant.q, plant.rate, 0.004), 4)
        tilts.append(math.degrees(tilt_of(plant.q)))
    assert max(tilts) < 20.0
    assert max(tilts[250:]) < 3.0
    assert abs(math.degrees(yaw_ned_of(plant.q))) < max(1.0, 0.5 * abs(yaw_deg))
