"""The solver and its intervals: against the closed form for a mean, and on impacts with scatter."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dart_flight.base.summary import Z95, student_t
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.impact_fit import ImpactFit, fit_impacts
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.solver import (
    HIGHEST_F,
    HIGHEST_K,
    LOWEST_F,
    LOWEST_K,
    LawFit,
    stiffness_and_damping,
)
from dart_flight.lab.identify.trials import Trial

pytest.importorskip("scipy")

K, F, MASS_KG, G = 40_000.0, 80.0, 0.241, 9.80665


class Mean(LawFit):
    """An estimate of the mean of numbers with a known standard deviation."""

    robust_from = 1.5
    losses = ("linear",)
    bounds = np.array([-1e6]), np.array([1e6])

    def __init__(self, numbers: Array, sd: float, groups: int) -> None:
        self.numbers, self.sd, self.groups = numbers, sd, groups

    def residuals(self, theta: Array) -> Array:
        return np.asarray((theta[0] - self.numbers) / self.sd)

    def reweight(self, theta: Array) -> None:
        pass

    def resampling_groups(self) -> list[NDArray[np.intp]]:
        return np.array_split(np.arange(self.numbers.size), self.groups)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=30), st.floats(0.1, 3.0))
def test_the_interval_of_a_mean_uses_the_wider_standard_deviation(numbers: list[float], sd: float) -> None:
    values = np.array(numbers)
    n = values.size
    problem = Mean(values, sd, n)
    theta = problem.solve(np.array([0.0]))
    assert theta[0] == pytest.approx(values.mean(), abs=1e-6)
    expected, sample = (
        Z95 * sd / math.sqrt(n),
        student_t(n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n),
    )
    (half,) = problem.half_widths()
    if sample > 1.31 * expected:
        assert half == pytest.approx(sample, rel=1e-4)
    elif sample < 1.29 * expected:
        assert half == pytest.approx(expected, rel=1e-6)


def test_a_single_resampling_group_uses_the_known_standard_deviation() -> None:
    problem = Mean(np.array([0.0, 9.0, 20.0]), 0.5, 1)
    problem.solve(np.array([0.0]))
    (half,) = problem.half_widths()
    assert half == pytest.approx(Z95 * 0.5 / math.sqrt(3.0))


@given(st.floats(1.0, 15.0), st.floats(-8.0, 10.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_an_undetermined_coefficient_is_unknown(
    log_k: float, log_f: float, wide_k: float, wide_f: float
) -> None:
    found, notes = stiffness_and_damping(np.array([log_k, log_f]), np.array([wide_k, wide_f]), 1.1)
    limits = {"k": (LOWEST_K, HIGHEST_K), "f": (LOWEST_F, HIGHEST_F)}
    for name, log, wide in (("k", log_k, wide_k), ("f", log_f, wide_f)):
        low, high = limits[name]
        estimate = found[name]
        if estimate is None:
            assert wide >= 1.1 or not 1.01 * low < math.exp(log) < 0.99 * high
        else:
            assert estimate.low <= estimate.value <= estimate.high
            assert estimate.value == pytest.approx(math.exp(log))
            assert wide < 1.1
    assert len(notes) == sum(estimate is None for estimate in found.values())


def scattered_drops(n: int, sds: tuple[float, float, float], seed: int) -> LawProblem:
    """Return drops by the law whose outgoing speed, peak and duration have random errors."""
    random = np.random.default_rng((seed, n))
    trial = Trial("drop", {}, "rigid", -G)
    speeds = np.resize([3.1, 4.4, 5.4], n) * (1.0 + 0.02 * random.standard_normal(n))
    problem = LawProblem([MeasuredImpact(trial, v, 0.0, 0.05, 10) for v in speeds], MASS_KG, Onset.LCP)
    true = problem.predict(K, F)
    off = random.standard_normal((3, n)) * np.array(sds)[:, None]
    out = np.maximum(true.normal_out_m_s + speeds * off[0], 0.0)
    peak, contact = true.peak_normal_force_n * np.exp(off[1]), true.contact_time_s * np.exp(off[2])
    rows = zip(speeds.tolist(), out.tolist(), peak.tolist(), contact.tolist(), strict=True)
    return problem.of(
        [
            MeasuredImpact(trial, v, 0.0, 0.05, 10, normal_out_m_s=out, peak_force_n=peak, contact_s=contact)
            for v, out, peak, contact in rows
        ]
    )


@pytest.mark.parametrize("n", [pytest.param(3, marks=pytest.mark.rest), 6])
@pytest.mark.parametrize(
    "sds",
    [
        pytest.param((0.04, 0.08, 0.1), id="as expected", marks=pytest.mark.rest),
        pytest.param((0.055, 0.19, 0.2), id="as real drops"),
    ],
)
def test_intervals_of_whole_impacts_cover_the_truth(n: int, sds: tuple[float, float, float]) -> None:
    covered = []
    for seed in range(25):
        found, _ = fit_impacts(scattered_drops(n, sds, seed))
        for name, true in (("k", K), ("f", F)):
            estimate = found[name]
            covered.append(estimate is None or estimate.low <= true <= estimate.high)
    assert np.mean(covered) > 0.88


def test_the_reweighted_problem_has_the_robust_solution() -> None:
    for seed in range(5):
        fit = ImpactFit(scattered_drops(6, (0.06, 0.25, 0.2), seed))
        fit.losses = ("huber",)
        robust = fit.solve(np.log([30_000.0, 60.0]))
        fit.reweight(robust)
        score = fit.jacobian(robust).T @ fit.residuals(robust)
        assert score == pytest.approx(0.0, abs=1e-3)
        half = fit.half_widths()
        fit.losses = ImpactFit.losses
        assert (np.abs(fit.solve(fit.start) - robust) < 0.02 * half).all()
