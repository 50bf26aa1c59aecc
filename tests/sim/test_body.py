"""The simulated vehicle with guards: an independent integration as reference, and its physical limits."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame, Vec3, quaternion_from_euler
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import BodyModel, Coefficients, ContactBody
from dart_flight.contact.law import Onset
from dart_flight.contact.propeller_guards import BodyMotion, GuardLaw, Plane, propeller_guards, touch
from dart_flight.sim.plant import Plant
from tests.oracles.rigid_body import fly
from tests.sim.plants import (
    HOVER,
    VEHICLE,
    WALL,
    before_the_wall,
    body_vehicle,
    first_contact,
    leave_only_contacts,
    motor_load,
    oracle_of,
    rotation,
)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("speed", [-0.6, -1.0, -2.0])
def test_a_symmetric_collision_agrees_with_the_point_model(mode: Mode, speed: float) -> None:
    """A vertical force through the centre turns nothing, and the normal law is the published one."""
    vehicle = body_vehicle(vertical_lever_m=0.0)
    point = msgspec.structs.replace(
        vehicle,
        simulation=msgspec.structs.replace(vehicle.simulation, contact=ContactBody(body=BodyModel.POINT)),
    )
    hits = [first_contact(before_the_wall(v, mode, speed, 0.0, 0.0)) for v in (vehicle, point)]
    guards, centre = hits
    assert guards.peak_normal_force_n == pytest.approx(centre.peak_normal_force_n, rel=0.03)
    assert guards.normal_out_m_s == pytest.approx(centre.normal_out_m_s, rel=0.03)
    durations = [hit.end_us - hit.t_us for hit in hits]
    assert durations[0] == pytest.approx(durations[1], rel=0.03)
    # Flexible arms swing back with their motors: the lift in front drops, and the nose goes down.
    nose_up = guards.rate_out_frd[1]
    assert nose_up == pytest.approx(0.0, abs=1e-6) if mode is Mode.RIGID else -2.5 < nose_up < -0.1
    assert guards.rate_out_frd[::2] == pytest.approx((0.0, 0.0), abs=1e-6)


def motor_torque(plant: Plant, forces: list[float]) -> Vec3:
    """Return the torque of the motors with these forces in the present state."""
    return motor_load(plant, [VEHICLE.thrust.command_for(force) for force in forces])[1]


def test_folded_arms_move_their_motors_back_and_outwards() -> None:
    """At the deepest point, a front motor is share x penetration further back and further out."""
    plant = before_the_wall(body_vehicle(vertical_lever_m=0.0), Mode.FLEXIBLE, -1.0, 0.0, 0.0)
    straight = motor_torque(plant, [3.0, 0.0, 0.0, 0.0])
    while plant.velocity[0] > 0.0:
        plant.advance((HOVER,) * 4)
    depth = plant.position[0] - 1.0
    folded = motor_torque(plant, [3.0, 0.0, 0.0, 0.0])  # the front right one alone
    assert depth > 0.015
    assert (straight[1] - folded[1]) / 3.0 == pytest.approx(0.7 * depth, rel=0.15)
    assert (straight[0] - folded[0]) / 3.0 == pytest.approx(0.7 * depth, rel=0.15)
    rear_motor = [motor_torque(plant, [0.0, 3.0, 0.0, 0.0])[i] for i in (0, 1)]
    assert rear_motor == pytest.approx([0.39, -0.39], abs=1e-6)
    first_contact(plant)
    for _ in range(20):
        plant.advance((HOVER,) * 4)
    assert motor_torque(plant, [3.0, 0.0, 0.0, 0.0]) == pytest.approx(straight)


@pytest.mark.parametrize(("mode", "half", "share"), [(Mode.RIGID, False, 0.0), (Mode.RIGID, True, 0.35)])
def test_locked_arms_do_not_fold_and_half_engaged_arms_fold_by_half(
    mode: Mode, half: bool, share: float
) -> None:
    plant = before_the_wall(body_vehicle(vertical_lever_m=0.0, half_engaged=half), mode, -1.0, 0.0, 0.0)
    straight = motor_torque(plant, [3.0, 0.0, 0.0, 0.0])
    while plant.velocity[0] > 0.0:
        plant.advance((HOVER,) * 4)
    moved = (straight[1] - motor_torque(plant, [3.0, 0.0, 0.0, 0.0])[1]) / 3.0
    assert moved == pytest.approx(share * (plant.position[0] - 1.0), rel=0.15, abs=1e-9)


def test_a_leading_guard_turns_the_vehicle_away_from_its_side() -> None:
    """Turned clockwise towards the north wall, the left guard leads and the vehicle turns further."""
    hit = first_contact(before_the_wall(body_vehicle(), Mode.RIGID, -1.0, 0.0, math.radians(8.0)))
    assert abs(math.degrees(hit.incidence_rad)) == pytest.approx(8.0, abs=0.5)
    assert hit.peak_normal_force_n < 60.0  # 63.6 with both guards at once
    assert hit.rate_out_frd[2] < -0.5
    assert hit.peak_torque_nm > 1.0


# NED to the wall's frame: X = south, Z = X x Y = down, Y = west (right when looking along X).
TO_WALL = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
# FRD to forward, left, up.
TO_FLU = np.diag([1.0, -1.0, -1.0])


@settings(max_examples=6, phases=(Phase.explicit, Phase.generate))  # shrinking would take minutes
@given(
    st.sampled_from(list(Mode)),
    st.floats(-2.5, -0.3),
    st.floats(-1.0, 1.0),
    st.floats(-0.25, 0.25),
    st.floats(-0.15, 0.15),
    st.floats(-2.0, 2.0),
    st.floats(0.0, 1.0),
    st.floats(-0.03, 0.03),
)
def test_a_contact_agrees_with_an_independent_rigid_body(
    mode: Mode,
    normal: float,
    tangential: float,
    yaw: float,
    roll: float,
    rate: float,
    share: float,
    height: float,
) -> None:
    vehicle = body_vehicle(friction_lever_share=share, guard_height_m=height)
    plant = before_the_wall(vehicle, mode, normal, tangential, yaw)
    plant.q = quaternion_from_euler(roll, 0.5 * roll, yaw)
    plant.rate = (0.3 * rate, -0.2 * rate, rate)
    contact = vehicle.simulation.contact
    body, law = oracle_of(vehicle, mode)
    surface = np.array([1.0 + contact.guard_out_m, 0.0, 0.0])
    x = TO_WALL @ (np.array(plant.position) - surface)
    r = TO_WALL @ rotation(plant.q) @ TO_FLU
    w = TO_FLU @ np.array(plant.rate)
    steps = 150
    leave_only_contacts(plant)
    plant.advance((0.0,) * 4, steps)
    x, v, r, w = fly(body, law, x, TO_WALL @ _start_velocity(normal, tangential), r, w, 1e-3 * steps)
    assert TO_WALL @ (np.array(plant.position) - surface) == pytest.approx(x, abs=1e-4)
    assert TO_WALL @ np.array(plant.velocity) == pytest.approx(v, abs=2e-3)
    assert rotation(plant.q) == pytest.approx(TO_WALL.T @ r @ TO_FLU, abs=1e-3)


def _start_velocity(normal: float, tangential: float) -> np.ndarray:
    return np.array(MissionFrame().vector_to_ned(WALL.from_collision((normal, tangential, 0.0))))


vectors = st.tuples(*[st.floats(-2.0, 2.0)] * 3)


@given(
    st.floats(-0.04, 0.02),
    vectors,
    vectors,
    st.floats(-0.5, 0.5),
    st.floats(0.0, 1.0),
    st.floats(0.0, 10.0),
)
def test_friction_never_adds_energy(
    depth: float, velocity: Vec3, rate: Vec3, yaw: float, share: float, mu: float
) -> None:
    """The power of friction at its own lever is never positive, for any share that turns the vehicle."""
    contact = ContactBody(body=BodyModel.GUARDS, friction_lever_share=share)
    q = quaternion_from_euler(0.0, 0.0, yaw)
    plane = Plane((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
    where = (-0.2 - depth, 0.0, 0.0)

    def power(friction: float) -> float:
        c = Coefficients(4200.0, 15.0, friction, 0.0)
        motion = BodyMotion(where, velocity, q, rate)
        contact_load = touch(propeller_guards(contact), c, plane, motion, GuardLaw(Onset.LCP, -1, 0.0))
        linear = sum(f * v for f, v in zip(contact_load.force, velocity, strict=True))
        return linear + sum(t * w for t, w in zip(contact_load.torque, rate, strict=True))

    assert power(mu) - power(0.0) <= 1e-9


def test_an_imu_off_the_centre_measures_the_rotation() -> None:
    """The reference is the second derivative of the lever's path on a freely rotating body."""
    lever = (0.05, 0.04, -0.03)

    def reading(at: Vec3) -> tuple[np.ndarray, np.ndarray]:
        simulation = msgspec.structs.replace(VEHICLE.simulation, imu_position_m=at)
        imu = msgspec.structs.replace(VEHICLE.imu, antialias_hz=1e6)
        plant = Plant(msgspec.structs.replace(VEHICLE, simulation=simulation, imu=imu), (), MissionFrame())
        plant.position, plant.rate = (0.0, 0.0, -5.0), (6.0, -4.0, 3.0)
        forces, path = [], []
        for _ in range(5):
            path.append(rotation(plant.q) @ np.array(lever))
            forces.append(rotation(plant.q) @ np.array(plant.advance((0.9, 0.2, 0.1, 0.6))))
        return np.array(forces), np.array(path)

    off, path = reading(lever)
    centre, _ = reading((0.0, 0.0, 0.0))
    swings = np.diff(path, n=2, axis=0) / 1e-6
    assert np.linalg.norm(swings[2]) > 3.0
    # The mean over 1 ms is centred half a step beside the difference.
    assert (off - centre)[2] == pytest.approx(0.5 * (swings[1] + swings[2]), abs=0.3)


def test_the_guards_hit_a_moved_wall_at_its_new_position() -> None:
    plants = [before_the_wall(body_vehicle(), Mode.RIGID, -1.0, 0.0, 0.0) for _ in range(2)]
    plants[1].planes[0].move(0.02)
    here, nearer = (first_contact(plant).position_mission[0] for plant in plants)
    assert here - nearer == pytest.approx(0.02, abs=1e-3)
