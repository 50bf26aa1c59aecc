"""The campaign of a body's hits: its cases lie in the ranges, its figures are what they say."""

import pytest

from dart_flight.lab.statistics import wilson
from tools.campaigns.body import (
    Job,
    default_case,
    fly,
)


def test_the_interval_is_wilsons() -> None:
    """Against the figures of Newcombe (1998), table I, method 3: 81 of 263 and 0 of 20."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_a_flight_tells_what_its_hits_did() -> None:
    found = fly(Job("paper_single_wall", 1, default_case(), yaw_deg=10.0))
    assert found.kind == "completed"
    assert found.hits[0].incidence_deg == pytest.approx(-10.0, abs=1.5)
    assert found.hits[0].rate_deg_s >= 0.9 * found.hits[0].rate_out_deg_s > 30.0
