"""The campaign of a body's hits: its cases lie in the ranges, its figures are what they say."""

import pytest

from dart_flight.lab.statistics import wilson
from tools.campaigns.body import (
    MIDDLE,
    RANGES,
    WORST,
    Flown,
    HitFigures,
    Job,
    default_case,
    fly,
    vary_table,
    yaw_table,
)


def test_defaults_and_cases_lie_in_the_ranges() -> None:
    for case in (default_case(), MIDDLE, WORST):
        for name, (low, high) in RANGES.items():
            assert low <= getattr(case, name) <= high
    assert all(getattr(WORST, name) in limits for name, limits in RANGES.items()), "a corner"


def test_the_interval_is_wilsons() -> None:
    """Against the figures of Newcombe (1998), table I, method 3: 81 of 263 and 0 of 20."""
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def flown(seed: int, outcome: str, rule: str, *problems: str) -> Flown:
    hit = HitFigures("wood", "flexible", -0.6, 0.5, 15.0, 1.0, 0.0, 40.0, 14.0, 100.0 + seed, 0.01)
    return Flown(
        Job("paper_dual_collision", seed, default_case()), outcome, rule, list(problems), 15.0, 0.1, [hit], {}
    )


def test_no_failure_is_averaged_away() -> None:
    flights = [
        flown(1, "completed", ""),
        flown(2, "aborted", "lock_late"),
        flown(3, "aborted", "tilt", "met the ground at 2.00 m/s"),
    ]
    said = vary_table(flights)
    assert "1 of 3 completed" in said
    assert "| `lock_late` | 1 | 2 |" in said
    assert "uncontrolled, seed 3: met the ground at 2.00 m/s" in said
    row = yaw_table(flights).splitlines()[2].split(" | ")
    assert row[3:6] == ["1 of 3", "lock_late 1", "1"]
    assert row[7] == "102, 103", "median and worst"


def test_a_flight_tells_what_its_hits_did() -> None:
    found = fly(Job("paper_single_wall", 1, default_case(), yaw_deg=10.0))
    assert found.kind == "completed"
    assert found.hits[0].incidence_deg == pytest.approx(-10.0, abs=1.5)
    assert found.hits[0].rate_deg_s >= 0.9 * found.hits[0].rate_out_deg_s > 30.0
