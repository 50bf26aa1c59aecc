"""The vehicle's attitude and the lock's position as published to viewers."""

from __future__ import annotations

import pytest
from hypothesis import given

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec3, attitude_in, rotate
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.lab.scene.translation import locked_fraction
from tests.base.test_geometry import frames, rotations, vectors


@given(frames, rotations(), vectors)
def test_the_published_attitude_rotates_body_vectors_as_the_frames_do(
    frame: MissionFrame, q: Quaternion, forward_left_up: Vec3
) -> None:
    x, y, z = forward_left_up
    by_ned = frame.vector_from_ned(rotate(q, (x, -y, -z)))
    assert rotate(attitude_in(frame, q), forward_left_up) == pytest.approx(by_ned, rel=1e-9, abs=1e-6)


def test_the_locked_fraction_follows_the_servo_pulse_and_is_clamped() -> None:
    lock = load_vehicle(packaged("configs", "dart.yaml")).lock
    assert lock is not None
    assert [locked_fraction(lock.servo, p) for p in (900.0, 1020.0, 1500.0, 1980.0, 2100.0)] == [
        0.0,
        0.0,
        pytest.approx(0.5),
        1.0,
        1.0,
    ]
