"""Recovery of the heading after a contact by PX4's yaw control, and its duration."""

import math

import pytest

from dart_flight.base.geometry import MissionFrame, quaternion_from_euler, yaw_ned_of
from dart_flight.core.mission.heading import Heading, HeadingControl
from dart_flight.sim.cascade import Cascade, TrajectorySetpoint
from dart_flight.sim.embedded_autopilot import default_parameters
from dart_flight.sim.plant import Plant
from tests.sim.plants import HOVER, VEHICLE

SQUARE_RAD = 0.09
STEP_S, WITHIN_S = 0.02, 5.0


def heading_over_time(error_rad: float, rate_rad_s: float, guided: bool) -> list[float]:
    """Return the heading error, rad, every 20 ms, of a hovering vehicle under the simulated cascade.

    Args:
        error_rad, rate_rad_s: initial heading error and yaw rate, NED.
        guided: whether `HeadingControl` leads the heading; otherwise the target is commanded at once.
    """
    parameters = {name: float(value) for name, value in default_parameters(VEHICLE).items()}
    cascade = Cascade(parameters, VEHICLE.hover_thrust_fraction(), VEHICLE.thrust, VEHICLE.airframe.motors)
    control, heading = HeadingControl(VEHICLE), Heading()
    plant = Plant(VEHICLE, (), MissionFrame())
    plant.position, plant.ground_down = (0.0, 0.0, -5.0), 100.0
    plant.q, plant.rate = quaternion_from_euler(0.0, 0.0, error_rad), (0.0, 0.0, rate_rad_s)
    plant.motor = [HOVER] * 4
    found = []
    for step in range(round(WITHIN_S / STEP_S)):
        yaw = yaw_ned_of(plant.q)
        found.append(yaw)
        heading = control.lead(heading, yaw, plant.rate[2], round(step * STEP_S * 1e6))
        commanded = heading.commanded if guided else 0.0
        for _ in range(5):
            hold = TrajectorySetpoint((0.0, 0.0, -5.0), yaw=commanded)
            cascade.update_position(hold, plant.position, plant.velocity, yaw_ned_of(plant.q), 0.004)
            plant.advance(cascade.update_attitude(plant.q, plant.rate, 0.004), 4)
    return found


def settling_time_s(headings: list[float]) -> float:
    return STEP_S * (1 + max(k for k, heading in enumerate(headings) if abs(heading) > SQUARE_RAD))


@pytest.mark.parametrize(
    ("error_rad", "rate_rad_s"),
    [(0.1, 0.8), (0.2, 1.5), (0.3, 2.0), (-0.2, -2.0), (0.6, 0.0), (0.6, -1.0), (-1.0, 1.0)],
)
def test_the_heading_returns_without_overshoot_in_the_predicted_time(
    error_rad: float, rate_rad_s: float
) -> None:
    guided, plain = (
        heading_over_time(error_rad, rate_rad_s, True),
        heading_over_time(error_rad, rate_rad_s, False),
    )
    predicted_s = HeadingControl(VEHICLE).time_to_s(error_rad, rate_rad_s, SQUARE_RAD)
    assert settling_time_s(guided) - 0.05 <= predicted_s <= settling_time_s(guided) + 0.2
    assert settling_time_s(guided) <= settling_time_s(plain) + 0.1
    if abs(rate_rad_s) >= 1.5:  # from this rate on, PX4 alone overshoots
        assert settling_time_s(guided) < 0.6 * settling_time_s(plain)
    # The side from which the heading returns.
    side = math.copysign(1.0, error_rad + 0.5 * rate_rad_s * abs(rate_rad_s) / 3.0)
    assert max(-side * heading for heading in guided[-150:]) < SQUARE_RAD


def test_a_square_heading_needs_no_time_and_is_commanded() -> None:
    control = HeadingControl(VEHICLE)
    assert control.time_to_s(0.05, 0.0, SQUARE_RAD) == 0.0
    assert control.time_to_s(2.0 * math.pi, 0.0, SQUARE_RAD) == 0.0
    assert control.lead(Heading(yaw=1.0), 1.0, 0.0, 20_000).commanded == pytest.approx(1.0)
