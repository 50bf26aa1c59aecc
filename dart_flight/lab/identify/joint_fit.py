"""The joint fit of the law to the samples of several trials, and the result of this fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, SetAside, TrialFit
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.sample_fit import PUSHES, SampleFit
from dart_flight.lab.identify.solver import descend, half_widths, stiffness_and_damping
from dart_flight.lab.identify.trials import Trial

_LOSSES = ("soft_l1", "linear", "linear")
_CURVED = 4.5  # standard deviations beyond which a curvature in free flight is not noise
_WIDEST_LOG = math.log(10.0)  # a coefficient with a wider interval than a factor of ten is unknown
BAD_FIT = 4.0  # residual in contact over the channel's noise in free flight; above it the law does not fit
_MIN_JUDGED = 4  # samples in contact


def solve(
    trials: Sequence[Trial],
    hits: Sequence[MeasuredImpact],
    mass_kg: float,
    onset: Onset,
    *,
    least: int = 0,
) -> tuple[SampleFit, Array, list[str]]:
    """Fit the samples with a robust loss, then by least squares with weights from the residuals.

    Args:
        trials: trials with positions.
        hits: hits of the trials, in the same order.
        least: required number of samples in contact. If any trial has fewer, the fit stops early.

    Returns:
        The fit, its parameters, and notes.
    """
    fit = SampleFit(trials, hits, mass_kg, onset)
    theta = descend(fit, fit.start(), _LOSSES)
    if any(fit.in_contact(theta, i) < least for i in range(len(fit.trials))):
        return fit, theta, []
    if not _is_curved(fit, theta):
        return fit, theta, []
    pushed = SampleFit(trials, hits, mass_kg, onset, pushed=True)
    pushed.sd = dict(fit.sd)
    start = np.zeros(pushed.parameters.size)
    shared = 1 + 4 * len(fit.parameters.modes)
    start[:shared] = theta[:shared]
    for old, new in zip(fit.parameters.own, pushed.parameters.own, strict=True):
        for name, j in old.items():
            start[new[name]] = theta[j]
    notes = ["free flight is not straight, so the fit includes accelerations before and after the contact"]
    return pushed, descend(pushed, start, _LOSSES), notes


def _is_curved(fit: SampleFit, theta: Array) -> bool:
    """Return whether free flight before or after any wall hit curves more than the noise explains."""
    for i, trial in enumerate(fit.trials):
        if trial.acceleration_m_s2 != 0.0:
            continue
        begin, end, _ = fit.span(theta, i)
        predicted = fit.predict(theta, i)
        for name in ("normal_m", "tangential_m", "vertical_m"):
            if name not in predicted:
                continue
            time, value = fit.windows[i].series[name]
            # Third differences estimate the noise independently of the curvature.
            sd = noise_of(fit.trials[i].series[name])
            for part in (time < begin, time > end):
                part &= (fit.windows[i].counts[name] > 0.0) & ~fit.windows[i].contact[name]
                if part.sum() < 8:
                    continue
                t = time[part] - time[part].mean()
                bend = np.stack((np.ones_like(t), t, 0.5 * t * t), axis=1)
                error = (value - predicted[name])[part]
                inverse = np.linalg.pinv(bend.T @ bend)
                curvature = float((inverse @ bend.T @ error)[2])
                if abs(curvature) > _CURVED * sd * math.sqrt(float(inverse[2, 2])):
                    return True
    return False


# --- result ---------------------------------------------------------------------------------------------


@dataclass
class SampleResult:
    """The result of a fit of samples, part of `Identification`; empty if all trials have too few samples.

    Attributes:
        trials: index of a trial among the trials given to `identify` -> fit of this trial.
        bad: modes in which the law does not fit the samples of a contact.
    """

    coefficients: dict[str, dict[str, Estimate | None]] = field(default_factory=dict)
    plane_m: Estimate | None = None
    residuals: dict[str, float] = field(default_factory=dict)
    trials: dict[int, TrialFit] = field(default_factory=dict)
    vertical_side: int | None = None
    bad: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


def conclude(fit: SampleFit, theta: Array, places: Sequence[int]) -> SampleResult:
    """Return coefficients with intervals, the result of each trial, and notes.

    `places` gives, for each fitted trial, its index among the trials given to `identify`.
    """
    halves = half_widths(fit, theta)
    plane_m = Estimate.about(float(theta[0]), float(halves[0]))
    result = SampleResult(plane_m=plane_m, residuals=_residuals(fit, theta))
    for i, (place, hit) in enumerate(zip(places, fit.hits, strict=True)):
        misfit, channel = _misfit(fit, theta, i)
        if misfit is not None and misfit > BAD_FIT:
            result.bad.add(hit.mode)
            result.notes.append(
                f"{hit.name}: in contact {channel} differs from the law by "
                f"{misfit:.1f} times its noise in free flight"
            )
        trial_fit = result.trials[place] = _trial_fit(fit, theta, i, hit)._replace(misfit=misfit)
        aside = trial_fit.set_aside
        if aside.contact:
            result.notes.append(
                f"{hit.name}: {aside.contact} of {aside.in_contact} samples in contact were set aside"
            )
    for mode in fit.parameters.modes:
        members = [i for i, trial in enumerate(fit.trials) if trial.mode == mode]
        at = [fit.parameters.mode_indices(mode)[name] for name in ("k", "f")]
        found, unknown = stiffness_and_damping(theta[at], halves[at], _WIDEST_LOG)
        result.notes += [f"{mode}: {note}" for note in unknown]
        found["mu"] = _friction(fit, theta, halves, members)
        found["nu"], side = _vertical(fit, theta, halves, members)
        result.vertical_side = side if side is not None else result.vertical_side
        result.coefficients[mode] = found
    return result


def _friction(fit: SampleFit, theta: Array, halves: Array, members: list[int]) -> Estimate | None:
    at = fit.parameters.mode_indices(fit.trials[members[0]].mode)["mu"]
    moving = False
    change = 0.0  # exponent of the deceleration per s/m of mu, the influence of mu
    for i in members:
        own = fit.parameters.own[i]
        if "vy" in own:
            moving |= abs(theta[own["vy"]]) > max(5.0 * float(halves[own["vy"]]), 0.02)
            _, end, contact = fit.span(theta, i)
            change = max(change, float(contact.impulse(end)) / fit.mass_kg)
    value, half = float(theta[at]), float(halves[at])
    if not moving or (half > value and half * change > 0.3):
        return None
    return Estimate.about(value, half, 0.0)


def _vertical(
    fit: SampleFit, theta: Array, halves: Array, members: list[int]
) -> tuple[Estimate | None, int | None]:
    """Return the magnitude of nu and the direction of the vertical force (`vertical_side`)."""
    at = fit.parameters.mode_indices(fit.trials[members[0]].mode)["nu"]
    if not any("z0" in fit.parameters.own[i] for i in members):
        return None, None
    value, half = abs(float(theta[at])), float(halves[at])
    if half > max(value, 1.0):
        return None, None
    side = None if half > value else 1 if theta[at] > 0.0 else -1
    return Estimate.about(value, half, 0.0), side


def _residuals(fit: SampleFit, theta: Array) -> dict[str, float]:
    errors: dict[str, list[Array]] = {}
    for i, window in enumerate(fit.windows):
        for name, error in fit.errors(theta, i).items():
            errors.setdefault(name, []).append(error[window.counts[name] > 0.0])
    return {name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for name, parts in errors.items()}


def _misfit(fit: SampleFit, theta: Array, i: int) -> tuple[float | None, str]:
    """Return the ratio of residual in contact to noise for the worst channel, and its name."""
    worst: float | None = None
    channel = ""
    window = fit.windows[i]
    for name, error in fit.errors(theta, i).items():
        inside = window.contact[name] & (window.counts[name] > 0.0)
        free = ~window.contact[name] & (window.counts[name] > 0.0)
        if inside.sum() < _MIN_JUDGED or free.sum() < _MIN_JUDGED:
            continue
        noise = max(float(np.sqrt(np.mean(error[free] ** 2))), noise_of(window.series[name]), 1e-9)
        ratio = float(np.sqrt(np.mean(error[inside] ** 2))) / noise
        if worst is None or ratio > worst:
            worst, channel = ratio, name
    return worst, channel


def _trial_fit(fit: SampleFit, theta: Array, i: int, hit: MeasuredImpact) -> TrialFit:
    own, window = fit.parameters.own[i], fit.windows[i]
    before, after = (float(theta[own[f"n_{when}"]]) if "n_after" in own else 0.0 for when in PUSHES)
    gone = {name: window.counts[name] == 0.0 for name in window.series}
    return TrialFit.from_hit(hit)._replace(
        used="samples",
        onset_s=float(theta[own["onset"]]),
        normal_m_s=-float(theta[own["speed"]]),
        tangential_m_s=float(theta[own["vy"]]) if "vy" in own else None,
        samples_in_contact=fit.in_contact(theta, i),
        push_m_s2=(before, after),
        force_delay_s=float(theta[own["delay"]]) if "delay" in own else None,
        set_aside=SetAside(
            sum(int((gone[n] & ~window.contact[n]).sum()) for n in gone),
            sum(int((gone[n] & window.contact[n]).sum()) for n in gone),
            sum(int(c.sum()) for c in window.contact.values()),
        ),
    )
