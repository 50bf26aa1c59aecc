"""Fits of a pulse to the readings of a contact, and of its friction."""

from __future__ import annotations

import math
import random
import statistics

import pytest

from dart_flight.base.records import Mode
from dart_flight.core.sense.pulse import PulsePrior, TickReading, _binned, fit_friction, fit_normal
from tests.core.conftest import known
from tests.core.pulses import MASS, VEHICLE, true_pulse


def readings_of(
    pulse: list[tuple[float, float]], phase_s: float, noise_n: float, full_n: float, lag_s: float
) -> list[TickReading]:
    """Return tick means of a filtered, saturated pulse until some ticks after its peak."""
    rng = random.Random(3)
    top = max(range(len(pulse)), key=lambda i: pulse[i][0])
    keep = math.exp(-1e-5 / lag_s)
    n = t = 0.0
    fine = []
    for i in range(-4000, min(len(pulse), top + 1500)):
        true_forces = pulse[i] if i >= 0 else (0.0, 0.0)
        n, t = true_forces[0] + (n - true_forces[0]) * keep, true_forces[1] + (t - true_forces[1]) * keep
        fine.append((min(n, full_n), t))
    out = []
    first = round(phase_s * 1e5)
    for begin in range(first, len(fine) - 400, 400):
        part = fine[begin : begin + 400]
        a = (begin - 4000) * 1e-5 - lag_s
        normal = sum(p[0] for p in part) / 400 + rng.gauss(0.0, noise_n)
        tangential = sum(p[1] for p in part) / 400 + rng.gauss(0.0, noise_n)
        out.append(TickReading(a, a + 0.004, normal, tangential, any(p[0] >= full_n for p in part)))
    return out


@pytest.mark.parametrize("phase_s", [0.0, 0.001, 0.0035])
@pytest.mark.parametrize(("mode", "push_n"), [(Mode.RIGID, 0.0), (Mode.FLEXIBLE, 7.0), (Mode.FLEXIBLE, -2.0)])
def test_the_fit_compensates_tick_averaging_and_filter_lag(mode: Mode, push_n: float, phase_s: float) -> None:
    c = VEHICLE.materials["acrylic"].coefficients(mode)
    pulse = true_pulse(c.k, c.f, 1.0, push_n, 0.5, c.mu)
    readings = readings_of(pulse, phase_s, 1e-4, 1e9, 0.00073)
    # A first guess that is 20 % off in stiffness.
    prior = PulsePrior(math.sqrt(1.2 * c.k / MASS), 0.5 * c.f / MASS, c.mu / MASS)
    fit = known(fit_normal(readings, push_n, prior, 0.05, -0.003, 0.00073))
    top = max(n for n, _ in pulse)
    assert fit.peak_n == pytest.approx(top, rel=0.004)
    assert fit.peak_s == pytest.approx(max(range(len(pulse)), key=lambda i: pulse[i][0]) * 1e-5, abs=8e-4)
    for guess in (0.1, 1.5, 20.0):  # times the true friction
        friction = fit_friction(readings, fit, 0.0, MASS, guess * c.mu / MASS, 0.05)
        assert friction == pytest.approx(min(t for _, t in pulse), rel=0.03)
    # Before the peak, the newest friction is the largest.
    early = [r for r in readings if r.b < 0.6 * fit.peak_s]
    so_far = fit_friction(early, fit, 0.0, MASS, c.mu / MASS, 0.05)
    assert so_far == pytest.approx(min(t for _, t in pulse[: round(early[-1].b * 1e5)]), rel=0.1)


def test_tick_averaging_lowers_a_rigid_peak_by_a_known_share() -> None:
    """Compare the largest tick mean with the true peak of a 46 ms contact at every sampling phase."""
    c = VEHICLE.materials["concrete"].rigid
    pulse = true_pulse(c.k, c.f, 0.99, 0.0, 0.0, 0.0)
    top = max(n for n, _ in pulse)
    losses = []
    for phase in range(8):
        readings = readings_of(pulse, phase * 0.0005, 0.0, 1e9, 0.00073)
        losses.append(1.0 - max(r.normal for r in readings) / top)
    omega = math.sqrt(c.k / MASS)
    averaging = (omega * 0.004) ** 2 / 24.0
    assert min(losses) == pytest.approx(averaging, rel=0.6)
    # At the worst phase, the peak lies between two ticks: four times the loss.
    assert max(losses) == pytest.approx(4.0 * averaging, rel=0.35)


def test_no_pulse_is_fitted_to_readings_without_one() -> None:
    c = VEHICLE.materials["wood"].rigid
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, 0.2)
    readings = readings_of(true_pulse(c.k, c.f, 1.0, 0.0, 0.0, 0.0), 0.002, 0.0, 1e9, 0.00073)
    begun = [r for r in readings if r.b > -0.003]

    def fits(some: list[TickReading]) -> bool:
        return fit_normal(some, 0.0, prior, 0.26, -0.003, 0.00073) is not None

    assert fits(readings)
    assert not fits(begun[:2])
    assert fits(begun[:3])
    assert not fits([])
    assert not fits([r._replace(normal=-abs(r.normal)) for r in readings])
    assert not fits([r._replace(normal=0.0) for r in readings])
    # A force that alternates from tick to tick is no pulse.
    assert not fits([r._replace(normal=40.0 * (i % 2)) for i, r in enumerate(begun)])


@pytest.mark.parametrize("noise_n", [0.26, 1000.0])
def test_no_pulse_is_fitted_above_all_its_clipped_readings(noise_n: float) -> None:
    """The first step leads above all readings, and then none of them limits the pulse.

    In low noise, the next step of the fit fails. In high noise, the fit has settled by then.
    """
    forces = [0.0] * 5 + [17.0, 70.0, 68.0]
    begins = [-0.0247 + 0.004 * i for i in range(len(forces))]
    readings = [TickReading(a, a + 0.004, n, 0.0, n > 0.0) for a, n in zip(begins, forces, strict=True)]
    assert fit_normal(readings, 0.0, PulsePrior(65.0, 5.8, 0.2), noise_n, -0.003, 0.00073) is None


@pytest.mark.parametrize(
    ("noise_share", "misfit_share", "fits"),
    [(0.01, 0.15, True), (0.01, 0.26, False), (0.1, 0.26, True), (0.1, 0.36, False)],
)
def test_no_friction_is_fitted_to_readings_that_alternate(
    noise_share: float, misfit_share: float, fits: bool
) -> None:
    """The limit of the misfit is a fifth of the peak, or three standard deviations of the noise."""
    c = VEHICLE.materials["acrylic"].rigid
    pulse = true_pulse(c.k, c.f, 1.0, 0.0, 0.5, c.mu)
    peak = min(t for _, t in pulse)
    clean = readings_of(pulse, 0.002, 0.0, 1e9, 0.00073)
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, c.mu / MASS)
    normal = known(fit_normal(clean, 0.0, prior, 0.05, -0.003, 0.00073))
    readings = [
        r._replace(tangential=r.tangential + misfit_share * peak * (-1) ** i) for i, r in enumerate(clean)
    ]
    found = fit_friction(readings, normal, 0.0, MASS, prior.kappa, noise_share * abs(peak))
    assert (found is not None) is fits
    inside = [r for r in clean if r.b > normal.start_s]
    assert fit_friction(inside[:2], normal, 0.0, MASS, prior.kappa, 0.05) is None
    assert fit_friction(inside[:3], normal, 0.0, MASS, prior.kappa, 0.05) is not None


@pytest.mark.parametrize(("sigma", "damped"), [(0.0, 50.0), (30.0, 40.0), (49.9, 5.0), (80.0, 5.0)])
def test_the_half_period_of_a_contact_is_bounded_if_damping_prevents_an_oscillation(
    sigma: float, damped: float
) -> None:
    """At least a tenth of the undamped frequency is assumed."""
    assert PulsePrior(50.0, sigma, 1.0).half_period_s == pytest.approx(math.pi / damped)


@pytest.mark.parametrize(
    ("share", "stiffness", "error"),
    [(0.6, 1.0, 0.04), (0.75, 1.0, 0.04), (0.9, 1.0, 0.04), (0.9, 1.25, 0.01), (0.9, 1.6, 0.01)],
)
def test_a_clipped_pulse_is_reconstructed(share: float, stiffness: float, error: float) -> None:
    """The bounds, also those after the first that the model satisfies, correct a prior that is too stiff."""
    c = VEHICLE.materials["wood"].rigid
    pulse = true_pulse(c.k, c.f, 3.0, 0.0, 0.0, 0.0)
    top = max(n for n, _ in pulse)
    readings = readings_of(pulse, 0.002, 0.2, share * top, 0.00073)
    for i in range(1, len(readings) - 1):  # like the detector, neighbours of a clipped tick are bounds
        bound = any(r.normal >= 0.99 * share * top for r in readings[i - 1 : i + 2])
        readings[i] = readings[i]._replace(bound=readings[i].bound or bound)
    prior = PulsePrior(math.sqrt(stiffness * c.k / MASS), 0.5 * c.f / MASS, 0.2)
    fit = known(fit_normal(readings, 0.0, prior, 0.26, -0.003, 0.00073))
    assert fit.peak_n == pytest.approx(top, rel=error)
    assert max(r.normal for r in readings) < share * top + 1.0


@pytest.mark.parametrize("mode", list(Mode))
def test_pulse_misfit_and_peak_uncertainty_match_the_noise(mode: Mode) -> None:
    c, noise_n, rng = VEHICLE.materials["acrylic"].coefficients(mode), 1.5, random.Random(4)
    clean = readings_of(true_pulse(c.k, c.f, 1.0, 1.0, 0.0, 0.0), 0.002, 0.0, 1e9, 0.00073)
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, 0.2)
    fits = []
    for _ in range(40):
        readings = [r._replace(normal=r.normal + rng.gauss(0.0, noise_n)) for r in clean]
        fit = known(fit_normal(readings, 1.0, prior, noise_n, -0.003, 0.00073))
        fits.append(fit)
    assert 0.6 < statistics.mean(fit.misfit for fit in fits) < 1.3
    scatter = statistics.stdev(fit.peak_n for fit in fits)
    assert 0.8 * scatter < statistics.mean(fit.sigma_n for fit in fits) < 1.6 * scatter


@pytest.mark.parametrize("count", [10, 200])
def test_binned_readings_keep_the_sums_of_a_pulse(count: int) -> None:
    """No bin spans a gap, and a reading at full scale keeps its own bin."""
    rng, at, readings = random.Random(count), 0.0, list[TickReading]()
    for i in range(count):
        begin = at + (0.004 if i == 7 else 0.0)
        at = begin + rng.choice((0.002, 0.004))
        readings.append(TickReading(begin, at, rng.gauss(0.0, 1.0), rng.gauss(0.0, 1.0), i == 3))
    bins = _binned(readings)
    assert sum(n for _, n in bins) == count
    assert len(bins) <= max(10, 45)
    assert [r for r, _ in bins if r.bound] == [readings[3]]
    assert not [r for r, _ in bins if r.a < readings[6].b and r.b > readings[7].a]
    for moment in (lambda r: 1.0, lambda r: r.normal, lambda r: r.tangential):
        together, alone = (
            sum((r.b - r.a) * moment(r) for r in some) for some in ([r for r, _ in bins], readings)
        )
        assert together == pytest.approx(alone)


@pytest.mark.parametrize(("apart_s", "averaged"), [(0.0, True), (0.9e-6, True), (1.1e-6, False)])
def test_readings_less_than_a_microsecond_apart_are_neighbours(apart_s: float, averaged: bool) -> None:
    begins = [(0.004 + apart_s) * i for i in range(90)]
    readings = [TickReading(at, at + 0.004, 1.0, 0.0, False) for at in begins]
    assert (len(_binned(readings)) < 90) is averaged
