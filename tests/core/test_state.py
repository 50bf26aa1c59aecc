"""The state that core, guard and senses share, by the samples it is made of."""

from __future__ import annotations

import pytest

from dart_flight.base.geometry import MissionFrame
from dart_flight.base.records import OdometrySample
from dart_flight.core.sense.state import FlightState


def test_the_newest_odometry_counts_in_a_frame_that_comes_after_it() -> None:
    frame, sample = (
        MissionFrame(3.0, 1.0, -0.2, 0.7),
        OdometrySample(8, 8, (4.0, -1.0, -1.5), (0.3, 0.1, 0.2)),
    )
    after, before = FlightState(), FlightState()
    after.take_odometry(sample)
    after.anchor(frame)
    before.anchor(frame)
    before.take_odometry(sample)
    assert after.position == before.position == pytest.approx(frame.point_from_ned(sample.position_ned))
    assert after.velocity == before.velocity == pytest.approx(frame.vector_from_ned(sample.velocity_ned))
