"""Estimates from synthetic motions by hand, with known latency, axes, scale and handedness."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    Quaternion,
    quaternion_conjugate,
    quaternion_from_euler,
    quaternion_multiply,
    rotate_back,
)
from dart_flight.check.bringup.pose_motion import MotionEstimate, NotEnoughMotionError, estimate_motion

Array = NDArray[np.float64]


class Hand(NamedTuple):
    """A smooth motion by hand: sums of sines with drawn phases."""

    seed: int = 1

    def position(self, t: float) -> tuple[float, float, float]:
        a = 0.7 * self.seed
        return (
            0.5 * math.sin(2.1 * t + a) + 0.2 * math.sin(3.7 * t),
            0.4 * math.sin(2.6 * t + 2 * a) + 0.15 * math.sin(4.1 * t + a),
            -1.0 + 0.2 * math.sin(1.9 * t + 3 * a),
        )

    def attitude(self, t: float) -> Quaternion:
        a = 1.3 * self.seed
        return quaternion_from_euler(
            0.4 * math.sin(2.3 * t + a), 0.3 * math.sin(3.1 * t), 1.2 * math.sin(1.1 * t + 2 * a)
        )


class Room(NamedTuple):
    """Latency, scale, axes and noise of the poses of a motion."""

    latency_s: float = 0.03
    scale: float = 1.0
    body_yaw: float = 0.0
    heading: float = 0.0
    mirror: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise: float = 1.0


def mirrored(q: Quaternion, mirror: tuple[float, float, float]) -> Quaternion:
    w, x, y, z = q
    det = math.prod(mirror)
    return (w, det * mirror[0] * x, det * mirror[1] * y, det * mirror[2] * z)


def samples(
    hand: Hand, room: Room, seconds: float = 15.0, pose_hz: float = 100.0
) -> tuple[Array, Array, Array, Array, Array, Array]:
    rng = np.random.default_rng(7)
    imu_s = np.arange(0.0, seconds, 0.004)
    rates, forces = [], []
    for t in imu_s:
        h, q = 1e-4, hand.attitude(t)
        turn = quaternion_multiply(quaternion_conjugate(hand.attitude(t - h)), hand.attitude(t + h))
        rates.append([c / h for c in turn[1:]])
        p = [hand.position(t + k * h) for k in (-1, 0, 1)]
        acceleration = [(p[0][i] - 2 * p[1][i] + p[2][i]) / h**2 for i in range(3)]
        acceleration[2] -= GRAVITY_M_S2
        forces.append(rotate_back(q, (acceleration[0], acceleration[1], acceleration[2])))
    shown_s = np.arange(0.5, seconds - 0.5, 1.0 / pose_hz)
    heading, nose = (quaternion_from_euler(0.0, 0.0, angle) for angle in (room.heading, room.body_yaw))
    positions, attitudes = [], []
    for t in shown_s:
        c, s = math.cos(room.heading), math.sin(room.heading)
        x, y, z = (m * v for m, v in zip(room.mirror, hand.position(t), strict=True))
        positions.append([room.scale * v for v in (c * x - s * y, s * x + c * y, z)])
        q = quaternion_multiply(mirrored(hand.attitude(t), room.mirror), nose)
        attitudes.append(quaternion_multiply(heading, q))
    n, noise = len(shown_s), room.noise
    return (
        shown_s + room.latency_s + noise * 0.002 * rng.random(n) - noise * 0.001,
        np.array(positions) + noise * rng.normal(0.0, 0.0005, (n, 3)),
        np.array(attitudes) + noise * rng.normal(0.0, 0.001, (n, 4)),
        imu_s,
        np.array(rates) + noise * rng.normal(0.0, 0.02, (len(imu_s), 3)),
        np.array(forces) + noise * rng.normal(0.0, 0.2, (len(imu_s), 3)),
    )


def estimate(room: Room, hand: Hand | None = None, **options: float) -> MotionEstimate:
    return estimate_motion(*samples(hand or Hand(), room, **options))


@settings(max_examples=12, deadline=None)
@given(
    latency_s=st.floats(0.0, 0.3),
    scale=st.floats(0.3, 3.0),
    body_yaw=st.floats(-math.pi, math.pi),
    heading=st.floats(-math.pi, math.pi),
    seed=st.integers(1, 20),
)
def test_latency_yaw_and_scale_are_estimated(
    latency_s: float, scale: float, body_yaw: float, heading: float, seed: int
) -> None:
    found = estimate(Room(latency_s, scale, body_yaw, heading), Hand(seed))
    assert found.latency_s == pytest.approx(latency_s, abs=0.002)
    assert found.rate_correlation > 0.98
    assert found.scale == pytest.approx(scale, rel=0.03)
    assert found.force_correlation > 0.97
    c, s = math.cos(body_yaw), math.sin(body_yaw)
    assert found.body_to_frd == pytest.approx(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), abs=0.03)
    assert found.up_room == pytest.approx((0.0, 0.0, -1.0), abs=0.03)


@settings(max_examples=6, deadline=None)
@given(
    mirror=st.sampled_from([(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, -1.0)]),
    heading=st.floats(-math.pi, math.pi),
)
def test_a_mirrored_room_has_a_negative_force_correlation(
    mirror: tuple[float, float, float], heading: float
) -> None:
    found = estimate(Room(mirror=mirror, heading=heading))
    assert found.force_correlation < -0.97
    assert found.rate_correlation > 0.98
    assert found.latency_s == pytest.approx(0.03, abs=0.002)


def test_another_vehicles_body_does_not_correlate() -> None:
    own, other = samples(Hand(1), Room()), samples(Hand(4), Room())
    found = estimate_motion(*other[:3], *own[3:])
    assert found.rate_correlation < 0.8


@pytest.mark.parametrize("pose_hz", [30.0, 240.0])
def test_the_estimate_does_not_depend_on_the_camera_rate(pose_hz: float) -> None:
    found = estimate(Room(latency_s=0.047), pose_hz=pose_hz)
    assert found.latency_s == pytest.approx(0.047, abs=0.003)
    assert found.scale == pytest.approx(1.0, abs=0.04)


def test_gaps_in_the_poses_do_not_affect_the_estimate() -> None:
    pose_s, position, attitude, *imu = samples(Hand(), Room())
    kept = (np.abs(pose_s - 4.0) > 0.4) & (np.abs(pose_s - 9.0) > 0.2)
    found = estimate_motion(pose_s[kept], position[kept], attitude[kept], *imu)
    assert found.latency_s == pytest.approx(0.03, abs=0.002)
    assert found.force_correlation > 0.97


@pytest.mark.parametrize(("seconds", "text"), [(4.0, "overlap"), (1.05, "too few")])
def test_too_short_a_motion_is_refused(seconds: float, text: str) -> None:
    with pytest.raises(NotEnoughMotionError, match=text):
        estimate(Room(), seconds=seconds)


def test_a_vehicle_at_rest_shows_no_rates() -> None:
    pose_s, position, attitude, imu_s, rates, forces = samples(Hand(), Room())
    found = estimate_motion(
        pose_s, 0.0 * position, 0.0 * attitude + [1.0, 0.0, 0.0, 0.0], imu_s, 0.0 * rates, 0.0 * forces
    )
    assert max(found.turned_rad_s) < 1e-9
    assert found.carried_m_s2 < 1e-9
