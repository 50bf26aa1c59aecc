"""PX4 sends LOCAL_POSITION_NED whether or not it has a position: what its estimator says counts."""

from __future__ import annotations

import json

import pytest

from dart_flight.vehicle.local_position import LocalPosition, is_healthy, position_sd_m

ATTITUDE, VELOCITY, RELATIVE, ABSOLUTE, ASSUMED = 1, 2, 8, 16, 128


@pytest.mark.parametrize(
    ("flags", "healthy"),
    [
        (ATTITUDE | VELOCITY | RELATIVE, True),
        (ATTITUDE | VELOCITY | ABSOLUTE, True),
        (ATTITUDE | ASSUMED, False),
        (ATTITUDE | VELOCITY, False),
        (VELOCITY | RELATIVE, False),
    ],
)
def test_flags_of_the_estimator(flags: int, healthy: bool) -> None:
    assert is_healthy(json.dumps({"flags": flags, "time_usec": 1})) is healthy


def test_a_message_without_flags_says_nothing() -> None:
    assert is_healthy("{}") is None


def test_a_position_counts_until_the_estimator_says_that_it_has_none() -> None:
    place = LocalPosition()
    assert not place.ok
    place.healthy = True
    assert not place.ok, "none has come yet"
    place.sent = True
    assert place.ok
    place.healthy = False
    assert not place.ok
    place.healthy = None  # a vehicle that does not send ESTIMATOR_STATUS
    assert place.ok


def test_how_sure_px4_is_of_its_position() -> None:
    assert position_sd_m(json.dumps({"flags": 831, "pos_horiz_accuracy": 0.2298})) == 0.2298
    assert position_sd_m('{"pos_horiz_accuracy":4e-3}') == 0.004
    assert position_sd_m('{"pos_horiz_accuracy": null}') is None
