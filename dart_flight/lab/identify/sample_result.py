"""The choice of the trials whose samples are fitted, and the result of this fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Estimate, SetAside, TrialFit
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.sample_fit import PUSHES, FittedImpact, SampleFit
from dart_flight.lab.identify.solver import stiffness_and_damping

_MIN_IN_CONTACT = 4
_SLOW_SAMPLING_S = 0.006
_WIDEST_LOG = math.log(10.0)  # a coefficient is unknown if its interval is wider than a factor of 10
_BAD_FIT = 4.0  # the law does not fit if residual in contact / noise in free flight exceeds this ratio
_MIN_JUDGED = 4  # minimum number of samples, both in contact and in free flight, for reporting a misfit


@dataclass
class SampleResult:
    """The part of `Identification` that the fit of samples gives; empty if all trials have too few samples.

    Attributes:
        bad: modes in which the law does not fit the samples of a contact.
    """

    coefficients: dict[str, dict[str, Estimate | None]] = field(default_factory=dict)
    plane_m: Estimate | None = None
    residuals: dict[str, float] = field(default_factory=dict)
    trials: dict[MeasuredImpact, TrialFit] = field(default_factory=dict)
    vertical_side: int | None = None
    bad: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


def fit_samples(problem: LawProblem) -> SampleResult:
    """Fit the samples of the hits that have enough position samples in contact."""
    chosen = [hit for hit in problem.hits if hit.turn is not None and hit.trial.position_measured]
    few: dict[MeasuredImpact, int] = {}
    for hit in chosen:
        # With slow sampling, count in the measured interval, which is widened to whole samples. With fast
        # sampling this interval begins too late, so count in the fitted contact (`_with_few_samples`).
        if float(np.median(np.diff(hit.trial.normal.time_s))) > _SLOW_SAMPLING_S:
            n = max(hit.trial.samples_between(hit.begin_s, hit.end_s) - 2, 0)
            if n < _MIN_IN_CONTACT:
                few[hit] = n
    result = SampleResult()
    while chosen := [hit for hit in chosen if hit not in few]:
        fit = _solve(problem.of(chosen))
        if not (less := _with_few_samples(fit)):
            result = _conclude(fit)
            break
        few |= less
    result.notes += [
        f"{hit.trial.name}: {n} sample{'' if n == 1 else 's'} in contact, at least "
        f"{_MIN_IN_CONTACT} are needed for stiffness: only the trial's speeds are used"
        for hit, n in few.items()
    ]
    return result


def _with_few_samples(fit: SampleFit) -> dict[MeasuredImpact, int]:
    counts = {fitted.hit: fitted.in_contact(fit.theta) for fitted in fit.hits}
    return {hit: n for hit, n in counts.items() if n < _MIN_IN_CONTACT}


def _solve(problem: LawProblem) -> SampleFit:
    """Fit without the controller's accelerations; if free flight is curved, fit again with them."""
    fit = SampleFit(problem)
    theta = fit.solve(fit.start())
    if _with_few_samples(fit) or not any(fitted.is_curved(theta) for fitted in fit.hits):
        return fit
    pushed = SampleFit(problem, pushed=True)
    pushed.sd = fit.sd
    start = np.zeros(pushed.size)
    for old, new in zip(fit.hits, pushed.hits, strict=True):
        for name, j in old.at.items():
            start[new.at[name]] = theta[j]
    pushed.solve(start)
    return pushed


def _conclude(fit: SampleFit) -> SampleResult:
    """Return coefficients with intervals, the result of each trial, and notes."""
    theta, halves = fit.theta, fit.half_widths()
    result = SampleResult(plane_m=Estimate.about(float(theta[0]), float(halves[0])))
    if fit.pushed:
        result.notes.append(
            "free flight is not straight, so the fit includes accelerations before and after the contact"
        )
    kept: dict[str, list[Array]] = {}
    for fitted in fit.hits:
        errors, trial = fitted.errors(theta), fitted.trial
        for name, error in errors.items():
            kept.setdefault(name, []).append(error[fitted.window[name].counts > 0.0])
        misfit, channel = _misfit(fitted, errors)
        if misfit is not None and misfit > _BAD_FIT:
            result.bad.add(trial.mode)
            result.notes.append(
                f"{trial.name}: in contact {channel} differs from the law by "
                f"{misfit:.1f} times its noise in free flight"
            )
        trial_fit = result.trials[fitted.hit] = _trial_fit(fitted, theta, misfit)
        aside = trial_fit.set_aside
        if aside.contact:
            result.notes.append(
                f"{trial.name}: {aside.contact} of {aside.in_contact} samples in contact were excluded"
            )
    result.residuals = {
        name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for name, parts in kept.items()
    }
    for mode, at in fit.modes.items():
        k_and_f = [at["k"], at["f"]]
        found, unknown = stiffness_and_damping(theta[k_and_f], halves[k_and_f], _WIDEST_LOG)
        result.notes += [f"{mode}: {note}" for note in unknown]
        found["mu"] = _friction(fit, halves, mode)
        found["nu"], side = _vertical(fit, halves, mode)
        result.vertical_side = side if side is not None else result.vertical_side
        result.coefficients[mode] = found
    return result


def _friction(fit: SampleFit, halves: Array, mode: str) -> Estimate | None:
    theta, moving = fit.theta, False
    change = 0.0  # largest impulse / mass, m/s; friction slows the vehicle by exp(-mu * change)
    for fitted in fit.of_mode(mode):
        if "vy" in fitted.at:
            j = fitted.at["vy"]
            moving |= abs(theta[j]) > max(5.0 * float(halves[j]), 0.02)
            _, end, contact = fitted.span(theta)
            change = max(change, float(contact.impulse(end)) / fit.problem.mass_kg)
    at = fit.modes[mode]["mu"]
    value, half = float(theta[at]), float(halves[at])
    if not moving or (half > value and half * change > 0.3):
        return None
    return Estimate.about(value, half, 0.0)


def _vertical(fit: SampleFit, halves: Array, mode: str) -> tuple[Estimate | None, int | None]:
    """Return the magnitude of nu and the direction of the vertical force (`vertical_side`)."""
    at = fit.modes[mode]["nu"]
    value, half = abs(float(fit.theta[at])), float(halves[at])
    if not any("z0" in fitted.at for fitted in fit.of_mode(mode)) or half > max(value, 1.0):
        return None, None
    side = None if half > value else 1 if fit.theta[at] > 0.0 else -1
    return Estimate.about(value, half, 0.0), side


def _misfit(fitted: FittedImpact, errors: dict[str, Array]) -> tuple[float | None, str]:
    """Return the ratio of residual in contact to noise for the worst channel, and the channel's name."""
    worst: float | None = None
    channel = ""
    for name, error in errors.items():
        _, value, counts, contact = fitted.window[name]
        inside, free = contact & (counts > 0.0), ~contact & (counts > 0.0)
        if inside.sum() < _MIN_JUDGED or free.sum() < _MIN_JUDGED:
            continue
        noise = max(float(np.sqrt(np.mean(error[free] ** 2))), noise_of(value), 1e-9)
        ratio = float(np.sqrt(np.mean(error[inside] ** 2))) / noise
        if worst is None or ratio > worst:
            worst, channel = ratio, name
    return worst, channel


def _trial_fit(fitted: FittedImpact, theta: Array, misfit: float | None) -> TrialFit:
    at, channels = fitted.at, fitted.window.values()
    before, after = (float(theta[at[f"n_{when}"]]) if "n_after" in at else 0.0 for when in PUSHES)
    return TrialFit.from_hit(fitted.hit)._replace(
        used="samples",
        onset_s=float(theta[at["onset"]]),
        normal_m_s=-float(theta[at["speed"]]),
        tangential_m_s=float(theta[at["vy"]]) if "vy" in at else None,
        samples_in_contact=fitted.in_contact(theta),
        push_m_s2=(before, after),
        force_delay_s=float(theta[at["delay"]]) if "delay" in at else None,
        misfit=misfit,
        set_aside=SetAside(
            sum(int(((c.counts == 0.0) & ~c.contact).sum()) for c in channels),
            sum(int(((c.counts == 0.0) & c.contact).sum()) for c in channels),
            sum(int(c.contact.sum()) for c in channels),
        ),
    )
