"""A second vehicle under the same system id, which `check` detects by its clock or its position."""

from __future__ import annotations

import pytest

from dart_flight.base.records import ImuSample, OdometrySample
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.vehicle.ground_link import _Listener  # its owner opens a connection for some seconds

ORIGIN = (0.0, 0.0, 0.0)
_TICK_US = 8_000


def feed_listener(ahead_us: int, north_m: float, alternating: bool = True) -> _Listener:
    """Feed a listener two vehicles that send alternately, or one after the other."""
    listener = _Listener(MotionCapture())
    for tick in range(400):
        second = tick % 2 == 1 if alternating else tick > 200
        t_us = tick * _TICK_US
        stamp_us = t_us + (ahead_us if second else 0)
        position = (north_m if second else 0.0, 0.0, 0.0)
        listener.update(ImuSample(stamp_us, t_us, (0.0, 0.0, -9.8), ORIGIN))
        listener.update(OdometrySample(stamp_us, t_us, position, ORIGIN))
    return listener


@pytest.mark.parametrize(
    ("ahead_us", "north_m", "problem"),
    [
        (238_000_000, 0.0, "two clocks alternate"),
        (0, 2.0, "two positions alternate in the samples of one system id, 2.0 m"),
    ],
)
def test_two_alternating_vehicles_are_detected(ahead_us: int, north_m: float, problem: str) -> None:
    assert problem in str(feed_listener(ahead_us, north_m).seen.other_vehicle)


@pytest.mark.parametrize("north_m", [0.0, 0.1, 5.0])
def test_a_vehicle_that_is_moved_once_counts_as_one_vehicle(north_m: float) -> None:
    assert feed_listener(0, north_m, alternating=False).seen.other_vehicle is None
