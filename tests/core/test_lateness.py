"""Age of samples at their receipt, from stamps, times of receipt and round trips."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest

from dart_flight.base.records import ImuSample, RoundTrip
from dart_flight.core.guard.stream_watch import _DRIFT, _SHARE, _SHARE_US, _STEP_MAX_US, TelemetryDelay
from dart_flight.core.pace import Pace
from tests.core.conftest import HandFedCore

AHEAD_US = 300_000_000  # offset of the autopilot's clock


def feed(
    delay: TelemetryDelay,
    seconds: float,
    delay_s: Callable[[float], float],
    *,
    from_s: float = 0.0,
    round_trips: bool = True,
    drift: float = 0.0,
) -> bool:
    """Feed IMU samples and round trips with this delay each way; return whether they ever were late."""
    was_late = False
    for i in range(round(seconds / 0.004)):
        now_s = from_s + 0.004 * i
        autopilot_us = AHEAD_US + round(1e6 * now_s * (1.0 + drift))
        way_s = delay_s(now_s)
        if round_trips and i % 25 == 0:
            here_us = round(1e6 * now_s)
            delay.add_round_trip(
                RoundTrip(here_us + round(1e6 * way_s), here_us - round(1e6 * way_s), autopilot_us)
            )
        delay.add_sample(autopilot_us, round(1e6 * (now_s + way_s)))
        was_late = was_late or delay.late
    return was_late


def test_no_delay_is_known_without_a_round_trip() -> None:
    delay = TelemetryDelay(0.075)
    assert not feed(delay, 2.0, lambda t: 1.0, round_trips=False)
    assert delay.age_us == 0.0


def test_a_constant_delay_is_measured_by_round_trips() -> None:
    delay = TelemetryDelay(0.075)
    assert not feed(delay, 2.0, lambda t: 0.05)
    assert abs(delay.age_us - 50e3) < 1.0
    delay = TelemetryDelay(0.075)
    assert feed(delay, 0.3, lambda t: 1.0)
    assert delay.describe() == "telemetry arrives 1000 ms after sampling, limit 75 ms, round trip 2000 ms"


def test_a_later_delay_is_detected_without_further_round_trips() -> None:
    delay = TelemetryDelay(0.075)
    assert not feed(delay, 60.0, lambda t: 0.003)
    assert feed(delay, 0.3, lambda t: 0.1, from_s=60.0, round_trips=False)
    assert delay.describe() == "telemetry arrives 100 ms after sampling, limit 75 ms"


def test_a_lasting_delay_keeps_counting_as_late() -> None:
    """The clock offset adapts within seconds, but the best round trip is kept for longer."""
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.003)
    feed(delay, 120.0, lambda t: 2.4, from_s=1.0)
    assert delay.late
    feed(delay, 3.0, lambda t: 0.003, from_s=121.0)
    assert not delay.late


@pytest.mark.rest
def test_clock_drift_is_no_delay() -> None:
    for drift in (1e-4, -1e-4):
        delay = TelemetryDelay(0.075)
        rng = random.Random(1)
        assert not feed(delay, 1800.0, lambda t, c=rng: 0.002 + 0.02 * c.random(), drift=drift)  # type: ignore[misc]


def test_a_burst_after_a_pause_is_no_delay() -> None:
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.003)
    assert not feed(delay, 0.4, lambda t: 0.003 + 1.4 - t, from_s=1.0, round_trips=False)
    assert not feed(delay, 1.0, lambda t: 0.003, from_s=1.4)


@pytest.mark.parametrize("pause_s", [0.3, 0.8])
def test_the_words_name_the_late_samples_and_a_pause_of_the_program(pause_s: float) -> None:
    """The program pauses again and again, and reads the samples of each pause at once after it."""
    delay, now_s = TelemetryDelay(0.075), 1.0
    feed(delay, 1.0, lambda t: 0.003)
    while not delay.late:
        end_s = now_s + pause_s
        feed(delay, pause_s, lambda t, e=end_s: e - t, from_s=now_s, round_trips=False)  # type: ignore[misc]
        # Samples taken just before the round trip may seem to arrive before they were taken.
        feed(delay, 0.06, lambda t: -0.014, from_s=end_s, round_trips=False)
        now_s = end_s + 0.06
    assert delay.age_us < 75_000
    read_ms = round(1e3 * pause_s)
    assert delay.describe(has_paused=True) == (
        f"this program reads telemetry {read_ms} ms after sampling, limit 75 ms"
    )
    assert delay.describe() == f"telemetry arrives {read_ms} ms after sampling, limit 75 ms"
    feed(delay, 30.0, lambda t: 0.003, from_s=now_s, round_trips=False)
    feed(delay, 0.3, lambda t: 0.1, from_s=now_s + 30.0, round_trips=False)
    assert delay.describe() == "telemetry arrives 100 ms after sampling, limit 75 ms"


def test_jitter_counts_as_a_delay_if_too_many_samples_are_late() -> None:
    rng = random.Random(1)
    assert not feed(TelemetryDelay(0.075), 60.0, lambda t: 0.075 * rng.random())
    assert feed(TelemetryDelay(0.075), 5.0, lambda t: 0.15 * rng.random())


@pytest.mark.parametrize("every_ms", [4, 20, 100])
def test_samples_count_as_late_after_a_share_of_the_last_second(every_ms: int) -> None:
    """The share of late samples approaches one exponentially; one sample counts for a limited time."""
    each = min(1000 * every_ms, _STEP_MAX_US) / _SHARE_US
    samples = math.ceil(math.log(1.0 - _SHARE) / math.log(1.0 - each))
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.0)
    count = 0
    while not delay.late:
        count += 1
        now_us = 996_000 + 1000 * every_ms * count
        delay.add_sample(AHEAD_US + now_us - 80_000, now_us)
    assert count == pytest.approx(samples, abs=1)


@pytest.mark.parametrize(("more_ms", "used"), [(0, True), (2, False)])
def test_a_slow_round_trip_is_used_once_clock_drift_may_exceed_its_error(more_ms: int, used: bool) -> None:
    """The drift of 100 s is added to the previous round trip's error of 1 ms."""
    way_ms = round(_DRIFT * 100e3) + more_ms
    delay = TelemetryDelay(0.075)
    delay.add_round_trip(RoundTrip(1_000, -1_000, AHEAD_US))
    later_us, way_us = 100_001_000, 1000 * way_ms
    autopilot_us = AHEAD_US + later_us - way_us + 5_000
    delay.add_round_trip(RoundTrip(later_us, later_us - 2 * way_us, autopilot_us))
    delay.add_sample(AHEAD_US, 10_000)
    assert delay.age_us == (1000.0 * way_ms - 5_000.0 if used else 10_000.0)


def test_the_shortest_of_three_round_trips_counts_without_comparable_clocks() -> None:
    delay, ages_us = TelemetryDelay(0.075), []
    for took_us in (10_000, 400_000, 400_000, 400_000):
        delay.add_round_trip(RoundTrip(took_us, 0, None))
        delay.add_sample(0, 0)
        ages_us.append(delay.age_us)
    assert ages_us == [5_000.0, 5_000.0, 5_000.0, 200_000.0]


def test_a_clock_jump_restarts_the_comparison() -> None:
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.003)
    for i in range(250):
        now_us = 1_000_000 + 4000 * i
        delay.add_sample(now_us, now_us)  # 300 s back
        if i % 25 == 20:
            delay.add_round_trip(RoundTrip(now_us + 3000, now_us - 3000, now_us))
    assert delay.age_us == 0.0
    assert not delay.late


@pytest.mark.parametrize("back_ms", [4, 40])
def test_any_round_trip_restarts_the_comparison_after_a_clock_jump(back_ms: int) -> None:
    """Even a round trip that is slower than those before it restarts the comparison."""
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.003)
    way_us = 1000 * back_ms
    delay.add_round_trip(RoundTrip(1_000_000 + way_us, 1_000_000 - way_us, 1_000_000))  # 300 s back
    delay.add_sample(1_000_000, 1_000_000)
    assert delay.age_us == 0.0


def test_a_slower_round_trip_does_not_replace_a_faster_one() -> None:
    """With 40 ms out and 0 ms back, half of the round trip would count as a delay."""
    delay = TelemetryDelay(0.075)
    feed(delay, 1.0, lambda t: 0.003)
    delay.add_round_trip(RoundTrip(1_000_000, 960_000, AHEAD_US + 1_000_000))
    delay.add_sample(AHEAD_US + 1_000_000, 1_003_000)
    assert delay.age_us == pytest.approx(3000.0, abs=1.0)


def test_only_round_trips_count_if_the_autopilots_clock_rate_differs() -> None:
    delay = TelemetryDelay(0.075)
    for i in range(1000):
        now_us = 4000 * i
        if i % 25 == 0:
            slow_us = 400_000 if i == 500 else 10_000  # one hiccup
            delay.add_round_trip(RoundTrip(now_us, now_us - slow_us, None))
        delay.add_sample(now_us // 2, now_us)
        assert not delay.late
    for i in range(1000, 1200):
        now_us = 4000 * i
        if i % 25 == 0:
            delay.add_round_trip(RoundTrip(now_us, now_us - 400_000, None))
        delay.add_sample(now_us // 2, now_us)
    assert delay.late


def test_a_late_backlog_near_a_wall_is_stepped_in_batches() -> None:
    """MAVSDK's thread hands the samples over and keeps reading; the queue discards old samples."""
    c = HandFedCore()
    c.fly_to_wood()
    paces = [c.core.pace]
    c.feed(RoundTrip(c.t_us, c.t_us - 1_000_000, c.t_us))
    for i in range(80):
        c.feed(ImuSample(c.t_us + 4000 * i, c.t_us + 4000 * i, (0.0, 0.0, -9.81 + 1e-4 * i), (0.0, 0.0, 0.0)))
    assert [*paces, c.core.pace] == [Pace.IMMEDIATE, Pace.BATCHED]
