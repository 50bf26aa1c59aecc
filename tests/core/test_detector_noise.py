"""The impact detector in noise: learned noise, thresholds and detection floor."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec
import pytest

from dart_flight.base.records import ContactEnd, DetectionFloor, ForceEstimate, ImpactOnset, ImpactPeak, Mode
from dart_flight.config.vehicle import Coefficients, Material
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
from tests.core.conftest import known, of_kind
from tests.core.pulses import VEHICLE, half_sine

Forces = list[tuple[float, float]]
LEARNING_SAMPLES = 750  # 3 s, as in a climb, during which no contact is expected


class FixedThreshold(ImpactDetector):
    """A detector whose thresholds ignore the learned noise."""

    def thresholds_n(self) -> tuple[float, float, float, float]:
        return (self._threshold_n,) * 4

    def _noise_hides_release(self, release: float) -> bool:
        return False


def noisy(seconds: float, sigma_n: float, seed: int = 1, tone_hz: float | None = None) -> Forces:
    """Return white noise, or a tone with the same root mean square and a wandering phase."""
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
    forces: Forces, watching: bool = True, noise_n: float = 3.0, kind: type[ImpactDetector] = ImpactDetector
) -> tuple[ImpactDetector, list[Any]]:
    detector, state = kind(VEHICLE), FlightState()
    events: list[Any] = []
    for i, (fx, fy) in enumerate(forces):
        t = 1_000_000 + 4000 * i
        estimate = ForceEstimate(t, (fx, fy, 0.0), False, noise_n=noise_n)
        events += detector.update(estimate, t, state, ExpectedContact(watching and i > LEARNING_SAMPLES))
    return detector, events


def onsets(events: list[Any]) -> list[ImpactOnset]:
    return of_kind(ImpactOnset, events)


def with_pulse(forces: Forces, at_s: float, peak: float, duration_s: float) -> Forces:
    pulse = half_sine(peak, round(duration_s / 0.004))
    first = round(at_s / 0.004)
    out = list(forces)
    for i, push in enumerate(pulse):
        x, y = out[first + i]
        out[first + i] = (x + 0.8 * push, y - 0.6 * push)
    return out


@pytest.mark.parametrize("tone_hz", [None, 50.0, 83.3, 120.0, 200.0])
def test_noise_gives_no_impact_and_the_papers_first_hit_is_detected(tone_hz: float | None) -> None:
    # A flexible hit with a 15.4 N peak, in noise of 3.9 N per sample.
    forces = noisy(60.0, 3.9, tone_hz=tone_hz)
    assert onsets(run(forces)[1]) == []
    found = onsets(run(with_pulse(forces, 30.0, 15.4, 0.15))[1])
    assert len(found) == 1
    assert 31.0 <= found[0].t_us * 1e-6 <= 31.15
    assert 30.94 <= found[0].first_us * 1e-6 <= 31.1


def test_noise_gives_false_impacts_with_fixed_thresholds() -> None:
    assert len(onsets(run(noisy(20.0, 3.9), noise_n=0.26, kind=FixedThreshold)[1])) > 3


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("duration_s", [0.032, 0.06, 0.1, 0.18])
def test_a_pulse_just_above_the_detection_floor_is_detected(duration_s: float, seed: int) -> None:
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


@pytest.mark.parametrize("seed", range(4))
def test_a_long_contact_in_strong_noise_is_detected_by_the_long_mean(seed: int) -> None:
    """The threshold of the mean over the short window is higher than this contact's peak."""
    forces = noisy(12.0, 10.0, seed)
    quiet, _ = run(forces[: round(9.0 / 0.004)], noise_n=10.0)
    weakest_n = quiet.detection_floor_n(0.18)
    _, events = run(with_pulse(forces, 9.0, 1.1 * weakest_n, 0.18), noise_n=10.0)
    assert 1.1 * weakest_n < quiet.thresholds_n()[2]
    (onset,) = onsets(events)
    assert 10.0 <= onset.t_us * 1e-6 <= 10.22
    assert 9.96 <= onset.first_us * 1e-6 <= 10.1


def floors(detector: ImpactDetector, material: str | None) -> dict[Mode, float]:
    """Return the detection floors that are reported when a contact with a material is expected, newton."""
    for t_us, normal in ((20_000_000, None), (20_004_000, (1.0, 0.0))):
        estimate = ForceEstimate(t_us, (0.0, 0.0, 0.0), False, noise_n=3.9)
        events = detector.update(estimate, t_us, FlightState(), ExpectedContact(False, normal, material))
    (floor,) = of_kind(DetectionFloor, events)
    assert floor.rigid_n is not None
    return {Mode.RIGID: floor.rigid_n, Mode.FLEXIBLE: known(floor.flexible_n)}


@pytest.mark.parametrize("mode", list(Mode))
def test_the_detection_floor_of_an_unknown_material_is_within_those_of_the_known(mode: Mode) -> None:
    """In noise, a flexible contact lasts longer and is detected at a lower force."""
    detector = run(noisy(8.0, 3.9))[0]
    known = [floors(detector, material)[mode] for material in VEHICLE.materials]
    assert min(known) < floors(detector, None)[mode] < max(known)


@pytest.mark.parametrize(("forces", "samples"), [((40.0, 44.0, 20.0), 3), ((40.0, 20.0, 4.0), 3)])
def test_the_peak_is_reported_at_the_third_sample_of_a_contact_at_the_earliest(
    forces: tuple[float, ...], samples: int
) -> None:
    """An earlier drop may be noise, or the end of the pulse before its peak was seen."""
    quiet = [(0.0, 0.0)] * (LEARNING_SAMPLES + 10)
    for count in range(1, len(forces) + 1):
        _, events = run([*quiet, *((-f, 0.0) for f in forces[:count])], noise_n=0.05)
        assert len(onsets(events)) == 1
        assert len(of_kind(ImpactPeak, events)) == (count >= samples)


def test_the_detection_floor_without_materials_is_that_of_a_firm_contact() -> None:
    """A contact with a natural frequency of 50 rad/s and a decay of 4 per second."""
    mass = VEHICLE.airframe.mass_kg
    firm = Coefficients(2500.0 * mass, 8.0 * mass, 0.1, 0.0)
    material = msgspec.structs.replace(VEHICLE.materials["wood"], rigid=firm, flexible=firm)

    def floors_with(materials: dict[str, Material]) -> list[float]:
        vehicle = msgspec.structs.replace(VEHICLE, materials=materials)
        return list(floors(ImpactDetector(vehicle), None).values())

    assert floors_with({}) == pytest.approx(floors_with({"firm": material}), rel=1e-9)


def test_the_long_windows_do_not_lower_the_detection_floor_in_low_noise() -> None:
    """All windows have the configured threshold; only those of one and two samples are relevant."""
    detector, _ = run(noisy(8.0, 0.26), noise_n=0.26)
    least, tick_s = VEHICLE.detection.force_threshold_n, VEHICLE.imu.tick_s
    assert detector.thresholds_n() == (least,) * 4
    for duration_s in (0.02, 0.06, 0.3):
        needed_n = [  # no public name gives the noise of the short windows
            (least + _MARGIN_SIGMA * window.noise_n) / half_sine_share(i + 1, duration_s, tick_s)
            for i, window in enumerate(detector._windows[:2])
        ]
        assert detector.detection_floor_n(duration_s) == pytest.approx(min(needed_n))


@pytest.mark.parametrize("seed", range(4))
def test_no_learned_threshold_falls_below_the_configured_one(seed: int) -> None:
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
def test_noise_without_a_contact_gives_no_event(sigma_n: float) -> None:
    assert run(noisy(20.0, sigma_n), noise_n=max(sigma_n, 0.01))[1] == []


@pytest.mark.parametrize("seed", range(4))
def test_events_come_once_and_in_order(seed: int) -> None:
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
def test_even_a_short_contact_has_its_own_end(samples: int) -> None:
    """The force has ended before the peak is detected."""
    pulse: Forces = [(f, 0.0) for f in half_sine(40.0, samples)]
    _, events = run(([(0.0, 0.0)] * 1000 + pulse) * 3 + [(0.0, 0.0)] * 100, noise_n=0.26)
    impacts, ends = onsets(events), of_kind(ContactEnd, events)
    assert len(impacts) == len(ends) == 3
    for onset, end in zip(impacts, ends, strict=True):
        assert end.first_us == onset.first_us
        assert 0 <= end.t_us - onset.t_us < 60_000


def rotating_tone(seconds: float, top_n: float, hz: float) -> Forces:
    """Return a tone with its axes in quadrature, so that every sample has the same magnitude."""
    angles = [math.tau * hz * 0.004 * i for i in range(round(seconds / 0.004))]
    return [(top_n * math.cos(a), top_n * math.sin(a)) for a in angles]


@pytest.mark.parametrize("hz", [50.0, 83.3, 123.0])
def test_a_rotating_vibration_does_not_hide_later_impacts(hz: float) -> None:
    forces = rotating_tone(14.0, 5.4, hz)
    ats = (8.0, 9.0, 10.0, 11.0)
    for at in ats:
        forces = with_pulse(forces, at, 40.0, 0.06)
    _, events = run(forces, noise_n=3.9)
    assert [round(e.t_us * 1e-6 - 1.0, 1) for e in onsets(events)] == list(ats)
    ends = [e.t_us * 1e-6 - 1.0 for e in events if isinstance(e, ContactEnd)]
    assert all(0.0 <= end - at - 0.06 < 0.05 for at, end in zip(ats, ends, strict=True))


@pytest.mark.parametrize("sigma_n", [0.26, 1.5, 3.9])
def test_a_vehicle_that_stays_at_a_wall_has_one_impact(sigma_n: float) -> None:
    """The force must have been below the release level before it counts as another impact."""
    forces = [
        (x + 24.0 * (i >= 2000), y - 18.0 * (i >= 2000)) for i, (x, y) in enumerate(noisy(12.0, sigma_n))
    ]
    _, events = run(forces, noise_n=sigma_n)
    assert [round(e.t_us * 1e-6 - 1.0, 1) for e in onsets(events)] == [8.0]


@pytest.mark.parametrize("top_n", [4.0, 5.4, 7.0])
def test_noise_does_not_shift_the_baseline(top_n: float) -> None:
    # Many samples exceed the threshold, and more of them on one side as soon as the baseline drifts.
    rng = random.Random(3)
    forces = [(x + rng.gauss(0.0, 1.5), y + rng.gauss(0.0, 1.5)) for x, y in rotating_tone(20.0, top_n, 61.0)]
    detector, _ = run(forces, noise_n=3.9)
    assert math.hypot(*detector.slow_force.value) < 0.5


def test_learned_noise_does_not_delay_detection_on_a_quiet_vehicle() -> None:
    forces = with_pulse(noisy(20.0, 0.26), 10.0, 15.4, 0.15)
    with_it, without = run(forces, noise_n=0.26)[1], run(forces, noise_n=0.26, kind=FixedThreshold)[1]
    assert with_it == without
    assert len(onsets(with_it)) == 1


def test_a_window_mean_stays_exact_and_its_noise_ignores_a_constant_force() -> None:
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


def test_the_newest_ten_means_are_not_learned_and_the_prior_counts_as_five() -> None:
    """They may contain the start of a contact."""
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
def test_half_sine_share_is_the_largest_mean_at_the_worst_sampling_phase(
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
def test_the_onset_found_by_a_mean_is_the_pulses_first_sample(begins: int) -> None:
    """Along the force there are 2 N from the onset on, and small noise around zero before."""
    forces = [2.0 if i >= begins else 0.3 * (-1) ** i for i in range(32)]
    samples = [
        _Sample(1000 + 4000 * i, 4000, -0.6 * f, 0.8 * f, (0.0, 0.0), False) for i, f in enumerate(forces)
    ]
    assert _onset_of_mean(samples, (-0.6, 0.8)) == samples[begins].t_us


def test_a_half_sine_between_two_samples_has_no_guaranteed_share() -> None:
    assert half_sine_share(1, 0.01, 0.01) == 0.0


def test_no_peak_is_certainly_detected_if_the_pulse_may_fall_between_two_samples() -> None:
    detector, _ = run(noisy(8.0, 0.26), noise_n=0.26)
    assert detector.detection_floor_n(VEHICLE.imu.tick_s) == math.inf
    # If it is a quarter longer than a tick, one sample reaches at least this share of the peak.
    share = math.cos(0.5 * math.pi / 1.25)
    noise_n = detector._windows[0].noise_n  # no public name gives the noise of the short windows
    sample_n = VEHICLE.detection.force_threshold_n + _MARGIN_SIGMA * noise_n
    assert detector.detection_floor_n(1.25 * VEHICLE.imu.tick_s) == pytest.approx(sample_n / share)


@pytest.mark.parametrize(
    ("sigma_n", "peak_n", "duration_s", "window"),
    [(0.26, 40.0, 0.06, 0), (3.9, 15.4, 0.15, 2), (7.0, 11.0, 0.3, 3)],
)
def test_the_crossed_threshold_is_that_of_the_detecting_window(
    sigma_n: float, peak_n: float, duration_s: float, window: int
) -> None:
    """In low noise, one or two samples cross the configured threshold."""
    forces = with_pulse(noisy(12.0, sigma_n), 10.0, peak_n, duration_s)
    detector, events = run(forces[: round((10.05 + duration_s) / 0.004)], noise_n=sigma_n)
    assert len(onsets(events)) == 1
    assert detector.crossed_threshold_n == detector.thresholds_n()[window]
    assert (detector.crossed_threshold_n > VEHICLE.detection.force_threshold_n) is (window > 0)


def test_an_unplanned_wall_gets_the_geometric_mean_of_the_materials() -> None:
    """Half and double the stiffness are equally likely; without materials, the prior is positive."""
    stiff, soft = PulsePrior(80.0, 9.0, 2.0), PulsePrior(20.0, 1.0, 0.5)
    assert _mean_prior([soft]) == pytest.approx(soft)
    assert _mean_prior([stiff, soft]) == pytest.approx((40.0, 3.0, 1.0))
    assert min(_mean_prior([])) > 0.0
    # A kappa of zero counts as one millionth, so that the mean is defined.
    assert _mean_prior([stiff, soft._replace(kappa=0.0)]).kappa == pytest.approx(math.sqrt(2.0 * 1e-6))
