"""What viewers are told of the vehicle's attitude and of the rods."""

from __future__ import annotations

import pytest
from hypothesis import given

from dart_flight.base.geometry import MissionFrame, Quaternion, Vec3, rotate
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.lab.scene.translation import attitude_in, locked_fraction
from tests.base.test_geometry import frames, rotations, vectors


@given(frames, rotations(), vectors)
def test_an_attitude_turns_a_body_vector_as_the_frames_do(
    frame: MissionFrame, q: Quaternion, forward_left_up: Vec3
) -> None:
    x, y, z = forward_left_up
    by_ned = frame.vector_from_ned(rotate(q, (x, -y, -z)))
    assert rotate(attitude_in(frame, q), forward_left_up) == pytest.approx(by_ned, rel=1e-9, abs=1e-6)


def test_how_far_the_rods_are_in() -> None:
    lock = load_vehicle(packaged("configs", "dart.yaml")).lock
    assert lock is not None
    assert [locked_fraction(lock.servo, p) for p in (900.0, 1020.0, 1500.0, 1980.0, 2100.0)] == [
        0.0,
        0.0,
        pytest.approx(0.5),
        1.0,
        1.0,
    ]
