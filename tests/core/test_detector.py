"""Onset, peak and end of a contact, from forces sample by sample; test_detector_noise adds noise."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from dart_flight.base.records import ContactEnd, DetectionFloor, ForceEstimate, ImpactOnset, ImpactPeak
from dart_flight.core.sense.detector import (
    _FAR_SIGMA,
    _INTO_WALL,
    _LONGEST_CONTACT_S,
    _MAX_SMOOTH,
    _PEAK_DROP_SHARE,
    _SHORT_SIGMA,
    _SMOOTH_SHARE,
    ExpectedContact,
    ImpactDetector,
    _top_of,
    confirmed_force,
)
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import of_kind
from tests.core.pulses import VEHICLE, half_sine, true_pulse, with_estimation

THRESHOLD_N = VEHICLE.detection.force_threshold_n


def detector_events(
    forces: list[tuple[float, float]],
    noise_n: float = 0.26,
    normal: tuple[float, float] | None = None,
    push: tuple[float, float] = (0.0, 0.0),
) -> list[object]:
    """Return the events of a detector for forces every 4 ms."""
    detector = ImpactDetector(with_estimation(imu_noise_m_s2=0.2))  # the noise is already learned
    expected = ExpectedContact(True, normal, "wood" if normal else None)
    state = FlightState()
    events: list[object] = []
    for i, (fx, fy) in enumerate(forces):
        t = 1_000_000 + 4000 * i
        estimate = ForceEstimate(t, (fx, fy, 0.0), False, noise_n=noise_n, push_mission=push)
        found = detector.update(estimate, t, state, expected)
        events += [e for e in found if not isinstance(e, DetectionFloor)]
    return events


def test_planned_and_unplanned_hits_are_distinguished() -> None:
    pulse = [(0.0, 0.0)] * 20 + [(-f, 0.2 * f) for f in half_sine(30.0, 12)] + [(0.0, 0.0)] * 20
    events = detector_events(pulse, normal=(-1.0, 0.0))
    assert of_kind(ImpactOnset, events)[0].planned
    assert of_kind(ImpactPeak, events)[0].normal == (-1.0, 0.0)
    events = detector_events(pulse, normal=(1.0, 0.0))  # from behind
    assert not of_kind(ImpactOnset, events)[0].planned
    peak = of_kind(ImpactPeak, events)[0]
    assert math.degrees(math.atan2(peak.normal[1], -peak.normal[0])) == pytest.approx(
        math.degrees(math.atan(0.2)), abs=1.0
    )


@pytest.mark.parametrize("angle", [0.5, 2.0, -0.9])
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_peak_forces_do_not_depend_on_the_wall_angle(angle: float, direction: float) -> None:
    """The friction comes from the fit; the thrust pushes into the wall and along it."""
    co, so = math.cos(angle), math.sin(angle)

    def rotated(x: float, y: float) -> tuple[float, float]:
        return x * co - y * so, x * so + y * co

    pulse = true_pulse(750.0, 8.5, 1.0, 0.0, -direction, 5.0)
    ticks = [pulse[i : i + 400] for i in range(0, len(pulse) - 400, 400)]
    hit = [(-sum(n for n, _ in one) / 400, direction * 0.3 * sum(n for n, _ in one) / 400) for one in ticks]
    forces, push = [(0.0, 0.0)] * 20 + hit + [(0.0, 0.0)] * 20, (1.5, 0.8 * direction)
    peaks = []
    for samples, normal, lean in (
        (forces, (-1.0, 0.0), push),
        ([rotated(*force) for force in forces], rotated(-1.0, 0.0), rotated(*push)),
    ):
        (peak,) = of_kind(ImpactPeak, detector_events(samples, normal=normal, push=lean))
        assert peak.normal == pytest.approx(normal)
        peaks.append(peak)
    straight, oblique = peaks
    assert oblique.fitted is straight.fitted is True
    assert oblique.normal_force_n == pytest.approx(straight.normal_force_n)
    assert oblique.tangential_force_n == pytest.approx(straight.tangential_force_n)
    assert straight.tangential_force_n * direction > 1.0


@pytest.mark.parametrize(("bump_n", "peak_n"), [(2.5, 30.0), (3.0, 3.0)])
def test_the_peak_is_awaited_until_the_wall_pushes_if_friction_comes_first(
    bump_n: float, peak_n: float
) -> None:
    """The wall must push with half the threshold; a smaller force can drop before the real contact."""
    foot = [(-0.5 * bump_n, 8.0), (-bump_n, 9.0), (-bump_n, 9.0), (-0.5 * bump_n, 9.0), (-0.1, 9.0)]
    pulse = [(-f, 6.0) for f in half_sine(30.0, 12)]
    events = detector_events([(0.0, 0.0)] * 20 + foot + pulse + [(0.0, 0.0)] * 60, 0.01, (-1.0, 0.0))
    first = of_kind(ImpactPeak, events)[0]
    assert first.normal_force_n == pytest.approx(peak_n, rel=0.1)


@pytest.mark.parametrize(("share", "past"), [(0.9, False), (1.15, True)])
def test_a_dip_of_a_share_of_the_threshold_ends_a_weak_peak(share: float, past: bool) -> None:
    flat, dip_n = [(-8.0, 0.0)] * 6, share * _PEAK_DROP_SHARE * THRESHOLD_N
    events = detector_events([(0.0, 0.0)] * 20 + flat + [(dip_n - 8.0, 0.0)] + flat, 0.01, (-1.0, 0.0))
    assert bool(of_kind(ImpactPeak, events)) is past


def test_an_endless_contact_is_ended_after_a_while() -> None:
    (end, *_) = of_kind(ContactEnd, detector_events([(0.0, 0.0)] * 20 + [(-20.0, 0.0)] * 200))
    assert end.t_us - end.first_us == round(1e6 * _LONGEST_CONTACT_S)


@pytest.mark.parametrize(("share", "planned"), [(0.9, True), (1.2, False)])
def test_a_force_slightly_into_the_wall_can_be_the_planned_hit(share: float, planned: bool) -> None:
    """Friction comes first, with noise on top."""
    into_n = share * _INTO_WALL * 10.0
    events = detector_events([(0.0, 0.0)] * 20 + [(into_n, 10.0)] * 3, 0.001, (-1.0, 0.0))
    assert [e.planned for e in of_kind(ImpactOnset, events)] == [planned]


@pytest.mark.parametrize(("normal", "first"), [(None, (6.0, -3.0)), ((-1.0, 0.0), (0.5, -10.0))])
def test_a_contact_without_its_expected_wall_has_the_direction_of_its_impulse(
    normal: tuple[float, float] | None, first: tuple[float, float]
) -> None:
    """The first samples, of friction, do not give the direction, nor does the expected wall."""
    pulse = [(f, 0.2 * f) for f in half_sine(30.0, 12)[1:]]
    events = detector_events([(0.0, 0.0)] * 20 + [first] * 2 + pulse + [(0.0, 0.0)] * 60, 0.01, normal)
    (onset,) = of_kind(ImpactOnset, events)
    (peak,) = of_kind(ImpactPeak, events)
    assert onset.planned is (normal is not None)
    assert math.degrees(math.atan2(peak.normal[1], peak.normal[0])) == pytest.approx(0.0, abs=12.0)
    assert peak.normal_force_n == pytest.approx(30.0, rel=0.15)


@pytest.mark.parametrize(("share", "mean"), [(0.99, (6.0, 1.5)), (1.01, (4.0, 2.0))])
def test_three_samples_confirm_an_impact_if_two_are_too_noisy(
    share: float, mean: tuple[float, float]
) -> None:
    noise_n = share * THRESHOLD_N / _FAR_SIGMA
    assert confirmed_force(6.0, 0.0, ((6.0, 3.0), (0.0, 3.0)), noise_n, VEHICLE.detection) == mean


@pytest.mark.parametrize(("noise", "samples"), [(1.0, 1), (2.0, 4), (9.0, _MAX_SMOOTH)])
def test_samples_are_averaged_until_their_noise_is_a_small_share_of_the_peak(
    noise: float, samples: int
) -> None:
    """The noise of one sample is given as a multiple of this share."""
    detector = ImpactDetector(VEHICLE)
    detector._noise = noise * _SMOOTH_SHARE * 10.0  # the count is used inside of the peak detector only
    assert detector._smoothing(10.0) == samples


def test_short_windows_need_a_higher_noise_multiple_than_long_ones() -> None:
    detector, sigma = ImpactDetector(VEHICLE), VEHICLE.detection.noise_sigma
    for window in detector._windows:  # learned in flight, but not to exact values
        window.noise_n = 2.0
    short_n, long_n = 2.0 * (sigma + _SHORT_SIGMA), 2.0 * sigma
    assert detector.thresholds_n() == pytest.approx((short_n, short_n, long_n, long_n))


def test_the_peak_fit_uses_only_samples_above_seven_tenths_of_the_largest() -> None:
    """Fewer than four samples give no least-squares parabola, so the largest sample is used."""
    for heights in ((1.0, 6.9, 10.0, 8.0, 7.1, 6.9, 5.0), (9.0, 9.0, 6.9, 10.0, 6.9, 9.0, 9.0)):
        sharp = [(4000 * i, height) for i, height in enumerate(heights)]
        top_us = 4000 * heights.index(10.0)
        assert _top_of(sharp) == (10.0, top_us)
        assert _top_of([(28_000 - t, height) for t, height in reversed(sharp)]) == (10.0, 28_000 - top_us)


@pytest.mark.parametrize("seed", range(8))
def test_the_peak_is_that_of_the_parabola_through_four_samples_on_either_side(seed: int) -> None:
    rng = random.Random(seed)
    middle, stamps = rng.randrange(6, 12), [4000 * i + rng.randrange(0, 2000) for i in range(18)]
    pulse = [(t, 10.0 - 0.05 * abs(i - middle) + rng.uniform(-0.02, 0.02)) for i, t in enumerate(stamps)]
    near = pulse[middle - 4 : middle + 5]
    a, b, c = np.polyfit([(t - stamps[middle]) * 1e-3 for t, _ in near], [height for _, height in near], 2)
    height, t_us = _top_of(pulse)
    assert height == pytest.approx(c - b * b / (4.0 * a))
    assert t_us == pytest.approx(stamps[middle] - 500.0 * b / a, abs=1.0)


def test_wind_is_no_contact_but_a_lean_on_a_wall_is() -> None:
    rise = [(4.0 * 0.5 * (1.0 - math.cos(math.pi * min(1.0, i / 125))), 0.0) for i in range(1000)]
    assert detector_events(rise) == []
    lean = [(9.0 * 0.5 * (1.0 - math.cos(math.pi * min(1.0, i / 250))), 0.0) for i in range(1000)]
    assert len(of_kind(ImpactOnset, detector_events(lean))) == 1


def test_one_noisy_sample_is_no_impact() -> None:
    quiet = [(0.0, 0.0)] * 50
    assert detector_events([*quiet, (5.9, 0.0), *quiet]) == []
    assert len(of_kind(ImpactOnset, detector_events([*quiet, (5.9, 0.0), (5.7, 0.0), *quiet]))) == 1


def test_the_wait_for_a_peak_is_bounded() -> None:
    forever = [(0.0, 0.0)] * 20 + [(0.5 * i, 0.0) for i in range(200)]
    events = detector_events(forever)
    onset = of_kind(ImpactOnset, events)[0]
    peak = of_kind(ImpactPeak, events)[0]
    assert peak.detected_us - onset.first_us <= VEHICLE.detection.peak_wait_s * 1e6 + 4000


@pytest.mark.parametrize("lost", [(), (1,), (3,), (4,)])
@pytest.mark.parametrize("skew", [-1.0, 1.0])
def test_a_lost_sample_does_not_shift_the_parabola_of_a_peak(lost: tuple[int, ...], skew: float) -> None:
    """With a sample missing, the stamps are not symmetric about their mean."""
    top_us = 9300
    samples = [(4000 * i, 10.0 - 0.01 * (4.0 * i - 9.3) ** 2) for i in range(6) if i not in lost]
    if skew < 0.0:
        top_us, samples = 40_000 - top_us, [(40_000 - t, height) for t, height in reversed(samples)]
    height, t_us = _top_of(samples)
    assert height == pytest.approx(10.0)
    assert abs(t_us - top_us) <= 1


@pytest.mark.parametrize("first_us", [4000, 8000])
def test_the_peak_of_a_parabola_is_found_between_its_samples(first_us: int) -> None:
    """Four samples, the largest of them the second or the first."""
    pulse = [(t, 10.0 - 0.02 * ((t - 9300) * 1e-3) ** 2) for t in range(first_us, first_us + 16_000, 4000)]
    height, t_us = _top_of(pulse)
    assert height == pytest.approx(10.0)
    assert abs(t_us - 9300) <= 1
