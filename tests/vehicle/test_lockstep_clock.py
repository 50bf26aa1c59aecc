"""The clock of an autopilot that runs on a simulator's time."""

from __future__ import annotations

from dart_flight.vehicle.clock import LockstepClock


def test_clock_follows_stamps_at_any_pace() -> None:
    clock = LockstepClock(3.0)
    assert clock.to_autopilot(1234) == 1234  # no stamp yet
    for i in range(1000):
        clock.update(i * 12_000, 5_000_000 + i * 4_000)
    newest = 5_000_000 + 999 * 4_000
    assert clock.to_autopilot(newest) == 999 * 12_000
    assert clock.to_autopilot(newest + 2_000) == 999 * 12_000 + 6_000
    assert clock.offset_us == 999 * 12_000 - newest


def test_clock_stops_when_the_simulator_stops() -> None:
    clock = LockstepClock(1.0)
    clock.update(1_000_000, 2_000_000)
    assert clock.to_autopilot(2_030_000) == 1_030_000
    assert clock.to_autopilot(4_000_000) == 1_050_000  # rather than two seconds later
    clock.update(1_004_000, 4_000_000)
    assert clock.to_autopilot(4_000_000) == 1_004_000


def test_clock_reports_only_noticeable_changes_and_ignores_old_stamps() -> None:
    clock = LockstepClock()
    assert clock.update(1_000_000, 2_000_000) == -1_000_000
    assert clock.update(1_004_000, 2_004_500) is None
    assert clock.update(900_000, 2_004_600) is None
    assert clock.offset_us == -1_000_500
    assert clock.update(1_008_000, 2_018_000) == -1_010_000
