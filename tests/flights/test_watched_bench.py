"""What the bench of watched flights reads from a log."""

from __future__ import annotations

import pytest

from tests.shared_flights import SharedFlights
from tools.bench.watched import timing


def test_a_set_point_follows_every_odometry_sample(flown: SharedFlights) -> None:
    """In the fast world they come every 8 ms of simulated time, and nothing is ever late."""
    found = timing(flown("paper_single_wall", 1).log)
    assert found.median == pytest.approx(8.0)
    assert found.mean == pytest.approx(8.0, rel=0.05)
    assert found.longest <= 16.0
