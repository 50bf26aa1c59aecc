"""The plant's truth against the reference solutions, and its physical limits."""

import csv
import math
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import GRAVITY_M_S2, MissionFrame, quaternion_from_euler, tilt_of
from dart_flight.base.records import Mode
from dart_flight.sim.plant import Plant
from tests.sim.plants import HOVER, VEHICLE, before_the_wall, first_contact, in_still_air

ROOT = Path(__file__).parents[2]
ROWS = list(csv.DictReader((ROOT / "tests/data/wall_collisions.csv").open()))


def flying_plant(
    mode: Mode, normal_m_s: float, tangential_m_s: float = 0.0, heading: float = 0.0, onset: str = "lcp"
) -> Plant:
    """Return a hovering plant without drag before an acrylic wall, heading along the axes of the mission."""
    vehicle = in_still_air(msgspec.structs.replace(VEHICLE, onset=onset))
    return before_the_wall(vehicle, mode, normal_m_s, tangential_m_s, heading, heading)


@pytest.mark.parametrize("onset", ["lcp", "touch"])
@pytest.mark.parametrize("row", ROWS[::7], ids=lambda r: f"{r['mode']} {float(r['vx_in_m_s']):.2f}")
def test_truth_is_within_one_per_cent_of_the_reference(row: dict[str, str], onset: str) -> None:
    vx, vy = float(row["vx_in_m_s"]), float(row["vy_in_m_s"])
    contact = first_contact(flying_plant(Mode(row["mode"]), vx, vy, 0.7, onset))

    def reference(name: str) -> float:
        return float(row[f"{onset}_{name}"])

    assert contact.normal_out_m_s == pytest.approx(reference("vx_out_m_s"), rel=0.01)
    assert contact.tangential_out_m_s == pytest.approx(reference("vy_out_m_s"), abs=0.01 * abs(vy))
    assert (contact.end_us - contact.t_us) * 1e-6 == pytest.approx(reference("contact_time_s"), rel=0.01)
    assert contact.peak_normal_force_n == pytest.approx(reference("peak_normal_force_n"), rel=0.01)
    assert contact.peak_friction_force_n == pytest.approx(reference("peak_friction_force_n"), rel=0.01)


@settings(max_examples=25)
@given(
    st.sampled_from(list(Mode)),
    st.floats(-3.0, -0.2),
    st.floats(-2.0, 2.0),
    st.floats(-math.pi, math.pi),
)
def test_a_contact_never_creates_energy(mode: Mode, normal: float, tangential: float, heading: float) -> None:
    contact = first_contact(flying_plant(mode, normal, tangential, heading))
    before = contact.normal_in_m_s**2 + contact.tangential_in_m_s**2
    after = contact.normal_out_m_s**2 + contact.tangential_out_m_s**2
    assert after < before
    assert contact.normal_out_m_s > 0.0


def test_a_vehicle_beside_the_wall_flies_past() -> None:
    plant = flying_plant(Mode.RIGID, -1.0)
    plant.position = plant.frame.point_to_ned((0.95, 41.0, 5.0))
    for _ in range(200):
        plant.advance((HOVER,) * 4)
    assert not plant.finished
    assert plant.frame.point_from_ned(plant.position)[0] > 1.1


def test_flexible_arms_behave_rigidly_at_a_large_incidence() -> None:
    times = {}
    for incidence_deg in (0.0, 40.0):
        plant = flying_plant(Mode.FLEXIBLE, -1.0)
        plant.q = quaternion_from_euler(0.0, 0.0, math.radians(incidence_deg))
        contact = first_contact(plant)
        times[incidence_deg] = (contact.end_us - contact.t_us) * 1e-3
    assert times[0.0] == pytest.approx(101.9, abs=1.0)
    assert times[40.0] == pytest.approx(55.6, abs=1.0)


def test_the_arms_cannot_lock_during_a_contact() -> None:
    plant = flying_plant(Mode.FLEXIBLE, -1.0)
    while not plant.in_contact:
        plant.advance((HOVER,) * 4)
    plant.set_mode(Mode.RIGID)
    assert plant.truth().mode is Mode.FLEXIBLE
    first_contact(plant)
    plant.set_mode(Mode.RIGID)
    assert plant.truth().mode is Mode.RIGID


def test_a_vehicle_on_the_ground_stays_level_and_still() -> None:
    plant = Plant(VEHICLE, (), MissionFrame())
    plant.q = quaternion_from_euler(0.15, -0.1, 0.3)
    plant.velocity = (0.3, 0.0, 0.0)
    for _ in range(3000):
        force = plant.advance((0.0,) * 4)
    assert plant.on_ground
    assert math.hypot(*plant.velocity) < 1e-3
    assert tilt_of(plant.q) < 0.01
    assert plant.position[2] < 0.01
    assert force[2] == pytest.approx(-GRAVITY_M_S2, rel=1e-3)  # an IMU at rest reads minus gravity


def test_the_imu_saturates_at_full_scale() -> None:
    plant = flying_plant(Mode.RIGID, -4.0)
    largest = 0.0
    while not plant.finished:
        largest = max(largest, *(abs(f) for f in plant.advance((HOVER,) * 4)))
    assert plant.finished[0].peak_normal_force_n / VEHICLE.airframe.mass_kg > 180.0
    assert largest == pytest.approx(VEHICLE.imu.full_scale_m_s2)


def test_arm_vibration_shakes_the_imu_but_not_the_centre_of_mass() -> None:
    """After a flexible contact the IMU keeps shaking, while the true velocity hardly changes."""
    plant = flying_plant(Mode.FLEXIBLE, -1.0)
    first_contact(plant)
    speed = plant.velocity[0]
    shaken = max(abs(plant.advance((HOVER,) * 4)[0]) for _ in range(60))
    assert shaken > 0.2
    assert plant.velocity[0] == pytest.approx(speed, abs=0.01)
