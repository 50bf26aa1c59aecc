"""The clock of a vehicle in real time, and that of an autopilot on a simulator's time."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.vehicle.clock import ClockEstimate, LockstepClock

_AHEAD_US = 7_000_000


@given(st.lists(st.tuples(st.integers(1, 900_000), st.integers(0, 400_000)), min_size=1, max_size=60))
def test_the_offset_is_off_by_the_smallest_delay_of_the_last_seven_to_nine_seconds(
    steps: list[tuple[int, int]],
) -> None:
    """Each step holds the time since the previous message and the delay of the message."""
    clock, host_us, announced = ClockEstimate(), 0, 0
    delays: list[tuple[int, int]] = []  # time of receipt, delay
    for interval_us, delay_us in steps:
        host_us += interval_us
        delays.append((host_us, delay_us))
        announced = clock.update(host_us - delay_us + _AHEAD_US, host_us) or announced
        offset_us = clock.offset_us
        assert offset_us is not None
        error_us = _AHEAD_US - offset_us
        recent, wider = (
            min(delay for at_us, delay in delays if at_us >= host_us - seconds * 1_000_000)
            for seconds in (7, 9)
        )
        assert wider <= error_us <= recent
        assert abs(announced - offset_us) < 200  # the log follows every noticeable change
        assert clock.to_autopilot(host_us) - host_us == offset_us


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_the_offset_follows_a_clock_that_drifts(drift: float) -> None:
    clock = ClockEstimate()
    for host_us in range(0, 600_000_000, 50_000):
        clock.update(_AHEAD_US + round(host_us * (1.0 + drift)), host_us)
    assert clock.offset_us == pytest.approx(_AHEAD_US + drift * host_us, abs=8e6 * abs(drift) + 1.0)


def test_another_vehicles_clock_is_adopted_only_after_fifty_messages() -> None:
    clock = ClockEstimate()
    clock.update(1_000_000, 500_000)
    for i in range(49):
        assert clock.update(900_000_000 + 4000 * i, 504_000 + 4000 * i) is None
    assert clock.offset_us == 500_000
    assert clock.update(900_000_000 + 4000 * 49, 504_000 + 4000 * 49) == 899_496_000


def test_a_lockstep_clock_follows_stamps_at_any_pace() -> None:
    clock = LockstepClock(3.0)
    assert clock.to_autopilot(1234) == 1234  # no stamp yet
    for i in range(1000):
        clock.update(i * 12_000, 5_000_000 + i * 4_000)
    newest = 5_000_000 + 999 * 4_000
    assert clock.to_autopilot(newest) == 999 * 12_000
    assert clock.to_autopilot(newest + 2_000) == 999 * 12_000 + 6_000
    assert clock.offset_us == 999 * 12_000 - newest


def test_a_lockstep_clock_stops_when_the_simulator_stops() -> None:
    clock = LockstepClock(1.0)
    clock.update(1_000_000, 2_000_000)
    assert clock.to_autopilot(2_030_000) == 1_030_000
    assert clock.to_autopilot(4_000_000) == 1_050_000  # rather than two seconds later
    clock.update(1_004_000, 4_000_000)
    assert clock.to_autopilot(4_000_000) == 1_004_000


def test_a_lockstep_clock_reports_only_noticeable_changes_and_ignores_old_stamps() -> None:
    clock = LockstepClock()
    assert clock.update(1_000_000, 2_000_000) == -1_000_000
    assert clock.update(1_004_000, 2_004_500) is None
    assert clock.update(900_000, 2_004_600) is None
    assert clock.offset_us == -1_000_500
    assert clock.update(1_008_000, 2_018_000) == -1_010_000
