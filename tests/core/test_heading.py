"""Recovery of the heading after a contact by PX4's yaw control, and its duration."""

import math

import msgspec
import pytest

from dart_flight.base.geometry import MissionFrame, quaternion_from_euler, yaw_ned_of
from dart_flight.base.records import Mode, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.heading import Heading, HeadingControl
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls
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


def test_a_walls_rotation_comes_from_a_certain_contact() -> None:
    """An uncertain contact does not change it."""
    wall = Wall("east", (2.0, 0.0), (-1.0, 0.0), 4.0, "acrylic")
    estimate = WallEstimate(
        t_us=0,
        first_us=0,
        wall="east",
        mode_reported=Mode.FLEXIBLE,
        mode_felt=None,
        log_odds=0.0,
        k_n_per_m=1250.0,
        f_ns_per_m=8.5,
        mu_s_per_m=5.0,
        nu_n=10.0,
        incidence_rad=0.12,
        plane_offset_m=0.0,
        plane_offset_sigma_m=0.01,
        plane_point_mission=(2.0, 0.0),
        plane_normal_mission=(-math.cos(0.07), math.sin(0.07)),
        plane_normal_sigma_rad=0.01,
        k_sd=0.1,
        f_sd=0.1,
        mu_sd=0.1,
        nu_sd=0.1,
        incidence_sigma_rad=0.01,
    )
    walls = EstimatedWalls()
    assert walls.rotation(wall) == 0.0
    walls.add_estimate(estimate, wall)
    assert walls.rotation(wall) == pytest.approx(-0.07)
    uncertain = msgspec.structs.replace(
        estimate, plane_normal_mission=(-1.0, 0.0), plane_normal_sigma_rad=0.1
    )
    walls.add_estimate(uncertain, wall)
    assert walls.rotation(wall) == pytest.approx(-0.07)


def test_measured_walls_stay_in_place_when_the_frame_moves() -> None:
    """Other walls keep their mission position; a resting vehicle keeps its distance to measured ones."""
    measured, other = (Wall(name, (2.0, 1.0), (-0.6, -0.8), 2.0, "acrylic") for name in ("met", "other"))
    coefficients, plane = (1.0,) * 8, (0.0, 0.1, 0.05, 0.02)
    walls, here = EstimatedWalls(), (0.5, 0.2)
    walls.add_estimate(WallEstimate(0, 0, "met", None, None, 0.0, *coefficients, *plane), measured)
    before_m = walls.known_wall(measured).signed_distance(here)
    assert before_m == pytest.approx(measured.signed_distance(here) - 0.05)
    shift = (0.3, -0.1)
    walls.move_frame(shift)
    moved = (here[0] - shift[0], here[1] - shift[1])
    assert walls.known_wall(measured).signed_distance(moved) == pytest.approx(before_m)
    assert walls.known_wall(other) == other


@pytest.mark.parametrize("sd_m", [0.3, None])
def test_wall_position_uncertainty_includes_the_frame(sd_m: float | None) -> None:
    wall = Wall("wood", (2.0, 1.0), (-0.6, -0.8), 2.0, "acrylic", position_sd_m=sd_m)
    anchors = FrameAnchors(0.1)
    known = EstimatedWalls(anchors).known_wall(wall, 5_000_000)
    assert known.position_sd_m == pytest.approx(math.hypot(sd_m or 0.0, anchors.sd_m(wall.normal, 5_000_000)))
    assert EstimatedWalls(anchors).known_wall(wall) == EstimatedWalls().known_wall(wall, 5_000_000) == wall
