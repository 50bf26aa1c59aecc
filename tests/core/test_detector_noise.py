"""The detector in noise: what it learns, what it then needs, what it keeps."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from dart_flight.base.records import ContactEnd, DetectionFloor, ForceEstimate, ImpactOnset, ImpactPeak
from dart_flight.core.sense.detector import (
    _MARGIN_SIGMA,
    ExpectedContact,
    ImpactDetector,
    _mean_prior,
    _onset_of_mean,
    _Sample,
)
from dart_flight.core.sense.pulse import PulsePrior
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.window import WindowMean, half_sine_share
from tests.core.test_force_estimate import VEHICLE, half_sine

Forces = list[tuple[float, float]]
LEARNT = 750  # samples, 3 s: as long as a climb, in which nothing is watched for


class FixedThreshold(ImpactDetector):
    """A detector whose threshold noise does not lift."""

    def thresholds_n(self) -> tuple[float, float, float, float]:
        return (self._threshold_n,) * 4

    def _noise_hides_release(self, release: float) -> bool:
        return False


def noisy(seconds: float, sigma_n: float, seed: int = 1, tone_hz: float | None = None) -> Forces:
    """White noise, or a tone with the same root mean square and a phase that wanders."""
    rng = random.Random(seed)
    phase, out = rng.uniform(0.0, math.tau), []
    for _ in range(round(seconds / 0.004)):
        if tone_hz is None:
            out.append((rng.gauss(0.0, sigma_n), rng.gauss(0.0, sigma_n)))
        else:
            phase += math.tau * tone_hz * 0.004 + rng.gauss(0.0, 0.05)
            top = math.sqrt(2.0) * sigma_n
            out.append((top * math.sin(phase), top * math.sin(phase + 1.0)))
    return out


def run(
    forces: Forces,
    watching: bool = True,
    noise_n: float = 3.0,
    kind: type[ImpactDetector] = ImpactDetector,
) -> tuple[ImpactDetector, list[Any]]:
    detector, state = kind(VEHICLE), FlightState()
    events: list[Any] = []
    for i, (fx, fy) in enumerate(forces):
        t = 1_000_000 + 4000 * i
        estimate = ForceEstimate(t, (fx, fy, 0.0), False, noise_n=noise_n)
        events += detector.update(estimate, t, state, ExpectedContact(watching and i > LEARNT))
    return detector, events


def onsets(events: list[Any]) -> list[ImpactOnset]:
    return [e for e in events if isinstance(e, ImpactOnset)]


def with_pulse(forces: Forces, at_s: float, peak: float, duration_s: float) -> Forces:
    pulse = half_sine(peak, round(duration_s / 0.004))
    first = round(at_s / 0.004)
    out = list(forces)
    for i, push in enumerate(pulse):
        x, y = out[first + i]
        out[first + i] = (x + 0.8 * push, y - 0.6 * push)
    return out


@pytest.mark.parametrize("tone_hz", [None, 50.0, 83.3, 120.0, 200.0])
def test_noise_alone_is_no_impact_and_the_papers_first_hit_is_found(tone_hz: float | None) -> None:
    # 15.4 N peak, flexible, where one sample is off by 3.9 N.
    forces = noisy(60.0, 3.9, tone_hz=tone_hz)
    assert onsets(run(forces)[1]) == []
    found = onsets(run(with_pulse(forces, 30.0, 15.4, 0.15))[1])
    assert len(found) == 1
    assert 31.0 <= found[0].t_us * 1e-6 <= 31.15
    assert 30.94 <= found[0].first_us * 1e-6 <= 31.1


def test_without_it_noise_makes_impacts() -> None:
    assert len(onsets(run(noisy(20.0, 3.9), noise_n=0.26, kind=FixedThreshold)[1])) > 3


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("duration_s", [0.032, 0.06, 0.1, 0.18])
def test_a_pulse_at_the_stated_floor_is_found(duration_s: float, seed: int) -> None:
    forces = noisy(12.0, 3.9, seed)
    detector, _ = run(forces[: round(8.0 / 0.004)])
    floor = detector.detection_floor_n(duration_s)
    short, long = detector.noise_n
    at_most = (
        6.0 * short / half_sine_share(8, duration_s, 0.004),
        6.0 * long / half_sine_share(25, duration_s, 0.004),
    )
    assert floor <= 1.001 * max(*at_most, 5.6)
    found = onsets(run(with_pulse(forces, 9.0, 1.25 * floor, duration_s))[1])
    assert [9.99 <= e.t_us * 1e-6 <= 10.0 + duration_s + 0.04 for e in found] == [True]


def test_where_it_is_quiet_the_longer_means_are_not_asked_and_promise_nothing() -> None:
    """The threshold is the configured one for all; one sample and two are held against it."""
    detector, _ = run(noisy(8.0, 0.26), noise_n=0.26)
    least, tick_s = VEHICLE.detection.force_threshold_n, VEHICLE.imu.tick_s
    assert detector.thresholds_n() == (least,) * 4
    for duration_s in (0.02, 0.06, 0.3):
        asked = [
            (least + _MARGIN_SIGMA * window.noise_n) / half_sine_share(i + 1, duration_s, tick_s)
            for i, window in enumerate(detector._windows[:2])
        ]
        assert detector.detection_floor_n(duration_s) == pytest.approx(min(asked))


@pytest.mark.parametrize("seed", range(4))
def test_no_threshold_is_under_the_configured_one_whatever_is_learnt(seed: int) -> None:
    rng = random.Random(seed)
    detector, state = ImpactDetector(VEHICLE), FlightState()
    size = 1.0
    for i in range(6000):
        if i % 500 == 0:
            size = rng.choice((0.0, 0.1, 1.0, 4.0, 20.0, 100.0))
        force = (rng.gauss(0.0, size), rng.gauss(0.0, size), 0.0)
        t = 1_000_000 + 4000 * i + rng.randrange(0, 2000)
        detector.update(
            ForceEstimate(t, force, False, noise_n=size), t, state, ExpectedContact(i % 1000 < 600)
        )
        assert min(detector.thresholds_n()) >= VEHICLE.detection.force_threshold_n
        assert detector.detection_floor_n(0.05) >= VEHICLE.detection.force_threshold_n


@pytest.mark.parametrize("sigma_n", [0.0, 0.3, 3.9])
def test_without_force_there_is_no_event(sigma_n: float) -> None:
    assert run(noisy(20.0, sigma_n), noise_n=max(sigma_n, 0.01))[1] == []


@pytest.mark.parametrize("seed", range(4))
def test_events_come_in_order_and_once(seed: int) -> None:
    forces = noisy(40.0, 3.9, seed)
    for at in (8.0, 16.0, 24.0, 32.0):
        forces = with_pulse(forces, at, 40.0, 0.06 if at < 20.0 else 0.15)
    events = [e for e in run(forces)[1] if not isinstance(e, DetectionFloor)]
    kinds = [type(e) for e in events]
    assert kinds == [ImpactOnset, ImpactPeak, ContactEnd] * 4
    for onset, peak, end in zip(events[::3], events[1::3], events[2::3], strict=True):
        assert onset.first_us <= onset.t_us <= peak.detected_us <= end.t_us + 20_000
        assert peak.normal_force_n == pytest.approx(40.0, rel=0.4)


@pytest.mark.parametrize("samples", [3, 4, 6])
def test_the_end_of_a_contact_is_its_own_however_short_it_is(samples: int) -> None:
    """Its force is gone by the time that its peak is known."""
    pulse: Forces = [(f, 0.0) for f in half_sine(40.0, samples)]
    _, events = run(([(0.0, 0.0)] * 1000 + pulse) * 3 + [(0.0, 0.0)] * 100, noise_n=0.26)
    impacts, ends = onsets(events), [e for e in events if isinstance(e, ContactEnd)]
    assert len(impacts) == len(ends) == 3
    for onset, end in zip(impacts, ends, strict=True):
        assert end.first_us == onset.first_us
        assert 0 <= end.t_us - onset.t_us < 60_000


def turning(seconds: float, top_n: float, hz: float) -> Forces:
    """A tone whose axes differ by a quarter of a turn: of the same size in every sample."""
    angles = [math.tau * hz * 0.004 * i for i in range(round(seconds / 0.004))]
    return [(top_n * math.cos(a), top_n * math.sin(a)) for a in angles]


@pytest.mark.parametrize("hz", [50.0, 83.3, 123.0])
def test_a_tone_that_turns_about_does_not_blind_it_after_the_first_impact(hz: float) -> None:
    forces = turning(14.0, 5.4, hz)
    ats = (8.0, 9.0, 10.0, 11.0)
    for at in ats:
        forces = with_pulse(forces, at, 40.0, 0.06)
    _, events = run(forces, noise_n=3.9)
    assert [round(e.t_us * 1e-6 - 1.0, 1) for e in onsets(events)] == list(ats)
    ends = [e.t_us * 1e-6 - 1.0 for e in events if isinstance(e, ContactEnd)]
    assert all(0.0 <= end - at - 0.06 < 0.05 for at, end in zip(ats, ends, strict=True))


@pytest.mark.parametrize("top_n", [4.0, 5.4, 7.0])
def test_noise_does_not_drive_the_baseline_away(top_n: float) -> None:
    # Many samples are over the threshold, on one side more than on the other as soon as the baseline is off.
    rng = random.Random(3)
    forces = [(x + rng.gauss(0.0, 1.5), y + rng.gauss(0.0, 1.5)) for x, y in turning(20.0, top_n, 61.0)]
    detector, _ = run(forces, noise_n=3.9)
    assert math.hypot(*detector.slow_force.value) < 0.5


def test_a_quiet_vehicle_is_not_slower_for_it() -> None:
    forces = with_pulse(noisy(20.0, 0.26), 10.0, 15.4, 0.15)
    with_it, without = run(forces, noise_n=0.26)[1], run(forces, noise_n=0.26, kind=FixedThreshold)[1]
    assert with_it == without
    assert len(onsets(with_it)) == 1


def test_the_window_forgets_no_rounding_and_learns_no_constant_force() -> None:
    window = WindowMean(0.032, 1.0, 8)
    rng = random.Random(2)
    kept: list[float] = []
    for i in range(20_000):
        x = 50.0 + rng.gauss(0.0, 1.0)
        kept = [*kept, x][-8:]
        window.add(4000 * i, x, 0.0)
        window.learn(0.004)
    assert window.mean[0] == pytest.approx(sum(kept) / 8, abs=1e-9)
    # One of two axes is noisy: per component 1 / sqrt(2) of its deviation over sqrt(8).
    assert window.noise_n == pytest.approx(1.0 / math.sqrt(16.0), rel=0.4)


def test_the_newest_ten_means_teach_nothing_yet_and_what_was_assumed_counts_for_five() -> None:
    """A contact's foot may be in them."""
    window = WindowMean(0.0, 1.0, 1)
    for i in range(11):
        window.add(4000 * i, 0.0, 0.0)
        window.learn(0.004)
    assert window.noise_n == 1.0
    window.learn(0.004)
    assert window.noise_n == pytest.approx(math.sqrt(5.0 / 6.0))


@pytest.mark.parametrize("period_s", [0.004, 0.01])
@pytest.mark.parametrize("length_s", [0.0, 0.032, 0.1])
@pytest.mark.parametrize("duration_s", [0.03, 0.06, 0.15, 0.3])
def test_the_share_of_a_half_sine_is_its_largest_mean_wherever_samples_fall(
    duration_s: float, length_s: float, period_s: float
) -> None:
    def largest(beside: float) -> float:
        window, best = WindowMean(length_s, 1.0, 1), 0.0
        for i in range(round(0.9 / period_s)):
            at_s = i * period_s - 0.4 - beside * period_s
            push = math.sin(math.pi * at_s / duration_s) if 0.0 < at_s < duration_s else 0.0
            window.add(round(i * period_s * 1e6) + 1, push, 0.0)
            best = max(best, window.mean[0])
        return best

    share = half_sine_share(max(1, math.ceil(length_s / period_s - 1e-9)), duration_s, period_s)
    worst = min(largest(0.05 * i) for i in range(20))
    assert share <= worst + 1e-9
    assert worst <= 1.02 * share


@pytest.mark.parametrize("begins", [0, 1, 2, 9, 20])
def test_where_only_a_mean_shows_a_pulse_it_begins_with_its_first_sample(begins: int) -> None:
    """Along the force: 2 N from then on, a little noise around nothing before."""
    forces = [2.0 if i >= begins else 0.3 * (-1) ** i for i in range(32)]
    samples = [
        _Sample(1000 + 4000 * i, 4000, -0.6 * f, 0.8 * f, (0.0, 0.0), False) for i, f in enumerate(forces)
    ]
    assert _onset_of_mean(samples, (-0.6, 0.8)) == samples[begins].t_us


def test_a_half_sine_between_two_samples_may_not_be_seen() -> None:
    assert half_sine_share(1, 0.01, 0.01) == 0.0


def test_of_a_wall_that_is_in_no_plan_the_middle_of_the_materials_is_expected() -> None:
    """By ratio: a stiffness is as likely half as double. Where there are no materials, something at all."""
    stiff, soft = PulsePrior(80.0, 9.0, 2.0), PulsePrior(20.0, 1.0, 0.5)
    assert _mean_prior([soft]) == pytest.approx(soft)
    assert _mean_prior([stiff, soft]) == pytest.approx((40.0, 3.0, 1.0))
    assert min(_mean_prior([])) > 0.0
    # Of one that does not hold on at all: a millionth, so that there is a ratio.
    assert _mean_prior([stiff, soft._replace(kappa=0.0)]).kappa == pytest.approx(math.sqrt(2.0 * 1e-6))
