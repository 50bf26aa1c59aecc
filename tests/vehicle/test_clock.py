"""The clock of a vehicle in real time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dart_flight.vehicle.clock import ClockEstimate

_AHEAD_US = 7_000_000
_KEPT_S = 8


@given(st.lists(st.tuples(st.integers(1, 900_000), st.integers(0, 400_000)), min_size=1, max_size=60))
def test_the_offset_follows_the_least_delayed_message_of_the_last_seconds(
    steps: list[tuple[int, int]],
) -> None:
    """Each step holds the time since the previous message and the delay of the message."""
    clock, host_us = ClockEstimate(), 0
    best: dict[int, int] = {}  # second -> largest difference
    reported: int | None = None
    for interval_us, delay_us in steps:
        host_us += interval_us
        second = host_us // 1_000_000
        best[second] = max(best.get(second, -delay_us), -delay_us)
        expected = _AHEAD_US + max(list(best.values())[-_KEPT_S:])
        announced = clock.update(host_us - delay_us + _AHEAD_US, host_us)
        assert clock.offset_us == expected
        noticeable = reported is None or abs(expected - reported) >= 200
        assert announced == (expected if noticeable else None)
        reported = expected if noticeable else reported
        assert clock.to_autopilot(host_us) == host_us + expected


def test_another_vehicles_clock_is_adopted_only_after_fifty_messages() -> None:
    clock = ClockEstimate()
    clock.update(1_000_000, 500_000)
    for i in range(49):
        assert clock.update(900_000_000 + 4000 * i, 504_000 + 4000 * i) is None
    assert clock.offset_us == 500_000
    assert clock.update(900_000_000 + 4000 * 49, 504_000 + 4000 * 49) == 899_496_000
