"""From a fit to what can be said: which coefficients the data tell, how well, and whether to believe it.

A fit is poor where the law with its coefficients does not give back what was recorded, by more than the
recordings' own noise or scatter. Of a fit of samples that is asked twice. In the contact of one trial: is it
poor there, the mode's coefficients are taken from its hits as a whole, unless it gives their peaks and speeds
all the same. And at the end, over all trials, by `assess_fit`. Where only hits as a whole are known, as of an
accelerometer alone, their peaks and speeds out are what has to be given back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification, SetAside, TrialFit
from dart_flight.lab.identify.intervals import half_widths
from dart_flight.lab.identify.measured_impacts import MeasuredImpact, measure_impact
from dart_flight.lab.identify.recorded_impact import find_impact, noise_of
from dart_flight.lab.identify.sample_fit import HIGHEST_F, HIGHEST_K, LOWEST_F, LOWEST_K, PUSHES, SampleFit
from dart_flight.lab.identify.trials import Trial
from dart_flight.lab.identify.whole_fit import HitTable, predict

# Rates of change this small in the model make a coefficient unknown rather than zero.
_WIDEST_LOG = math.log(10.0)
# In contact, over the noise of the same channel in free flight: beyond it the law is poor for this trial.
BAD_FIT = 4.0
_MIN_JUDGED = 4  # samples in contact
# Over a whole recording residuals of good fits are the noise; what a filter in the recording and the law
# itself leave out is up to a few hundredths of the contact's own size (simulated vehicle's logs: below 0.01).
_NOISES = 3.0
_SHARE = 0.06
_CONTACT_S = 0.1  # to either side of the turn: the contact is in there
# Of whole hits, in the median: twice what repeats of real drops scatter (docs/results/real_data.md).
_PEAK_SHARE, _SPEED_SHARE = 0.25, 0.1


class SampleResult(NamedTuple):
    """What a fit of samples says; see `Identification`.

    Attributes:
        bad: modes whose law does not fit the samples of a contact.
    """

    coefficients: dict[str, dict[str, Estimate | None]]
    plane_m: Estimate
    residuals: dict[str, float]
    trials: list[TrialFit]
    vertical_side: int | None
    bad: set[str]
    notes: list[str]


def conclude(fit: SampleFit, theta: Array, hits: Sequence[MeasuredImpact]) -> SampleResult:
    """Coefficients with intervals, what became of each trial, and what a reader should know.

    Args:
        fit, theta: the fit and its parameters.
        hits: of its trials as a whole, in their order.
    """
    halves = half_widths(fit, theta)
    notes: list[str] = []
    trials = []
    bad = set()
    for i, hit in enumerate(hits):
        misfit, channel = _misfit(fit, theta, i)
        if misfit is not None and misfit > BAD_FIT:
            bad.add(hit.mode)
            notes.append(
                f"{hit.name}: in contact {channel} differs from the law by "
                f"{misfit:.1f} times its noise in free flight"
            )
        one = _trial_fit(fit, theta, i, hit)._replace(misfit=misfit)
        aside = one.set_aside
        if aside.contact:
            notes.append(f"{hit.name}: {aside.contact} of {aside.in_contact} samples in contact set aside")
        trials.append(one)
    coefficients: dict[str, dict[str, Estimate | None]] = {}
    side: int | None = None
    for mode in fit.parameters.modes:
        members = [i for i, trial in enumerate(fit.trials) if trial.mode == mode]
        found = _stiffness(fit, theta, halves, mode, notes)
        found["mu"] = _friction(fit, theta, halves, members)
        found["nu"], up = _vertical(fit, theta, halves, members)
        side = up if up is not None else side
        coefficients[mode] = found
    half = float(halves[0])
    plane = Estimate(float(theta[0]), float(theta[0]) - half, float(theta[0]) + half)
    return SampleResult(coefficients, plane, _residuals(fit, theta), trials, side, bad, notes)


def _stiffness(
    fit: SampleFit, theta: Array, halves: Array, mode: str, notes: list[str]
) -> dict[str, Estimate | None]:
    at = fit.parameters.of_mode(mode)
    found: dict[str, Estimate | None] = {}
    for name, lowest, highest in (("k", LOWEST_K, HIGHEST_K), ("f", LOWEST_F, HIGHEST_F)):
        half, value = float(halves[at[name]]), float(theta[at[name]])
        found[name] = None
        if value < math.log(lowest) + 1e-3 or value > math.log(highest) - 1e-3:
            notes.append(f"{mode}: {name} is at a bound of the search ({math.exp(value):.3g}) and not known")
        elif half >= _WIDEST_LOG:
            notes.append(f"{mode}: {name} cannot be told from these trials")
        else:
            found[name] = Estimate(*(math.exp(v) for v in (value, value - half, value + half)))
    return found


def _friction(fit: SampleFit, theta: Array, halves: Array, members: list[int]) -> Estimate | None:
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["mu"]
    moving = False
    change = 0.0  # exponent of the slowing per s/m of mu: how strongly mu acts at all
    for i in members:
        own = fit.parameters.own[i]
        if "vy" in own:
            moving |= abs(theta[own["vy"]]) > max(5.0 * float(halves[own["vy"]]), 0.02)
            _, end, contact = fit.span(theta, i)
            change = max(change, float(contact.impulse(end)) / fit.mass_kg)
    value, half = float(theta[at]), float(halves[at])
    if not moving or (half > value and half * change > 0.3):
        return None
    return Estimate(value, max(value - half, 0.0), value + half)


def _vertical(
    fit: SampleFit, theta: Array, halves: Array, members: list[int]
) -> tuple[Estimate | None, int | None]:
    """Nu by its size, and the side on which the force acts."""
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["nu"]
    if not any("z0" in fit.parameters.own[i] for i in members):
        return None, None
    value, half = abs(float(theta[at])), float(halves[at])
    if half > max(value, 1.0):
        return None, None
    side = None if half > value else 1 if theta[at] > 0.0 else -1
    return Estimate(value, max(value - half, 0.0), value + half), side


def _residuals(fit: SampleFit, theta: Array) -> dict[str, float]:
    errors: dict[str, list[Array]] = {}
    for i, window in enumerate(fit.windows):
        for name, error in fit.errors(theta, i).items():
            errors.setdefault(name, []).append(error[window.counts[name] > 0.0])
    return {name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for name, parts in errors.items()}


def _misfit(fit: SampleFit, theta: Array, i: int) -> tuple[float | None, str]:
    """The largest ratio over channels of residual in contact to noise, and its channel."""
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
    return whole_trial(hit)._replace(
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


def whole_trial(hit: MeasuredImpact) -> TrialFit:
    """What is said of a trial whose samples are not fitted."""
    return TrialFit(
        name=hit.name,
        mode=hit.mode,
        onset_s=hit.begin_s,
        normal_m_s=-hit.normal_in_m_s,
        tangential_m_s=hit.tangential_in_m_s,
        samples_in_contact=hit.samples_in_contact,
        push_m_s2=(0.0, 0.0),
        used="whole",
        normal_out_m_s=hit.normal_out_m_s,
        tangential_out_m_s=hit.tangential_out_m_s,
        peak_force_n=hit.peak_force_n,
        force_delay_s=None,
        misfit=None,
        set_aside=SetAside(0, 0, hit.samples_in_contact),
    )


# --- whether to believe it ----------------------------------------------------------------------------------


class FitQuality(NamedTuple):
    """A fit, judged.

    Attributes:
        good: nothing is further off than expected; None where there is nothing to judge by.
        expected: quantity -> the most that a good fit is off, in its own unit.
        says: a sentence per quantity that is not good; what to look at.
    """

    good: bool | None
    expected: dict[str, float]
    says: list[str]


def assess_fit(found: Identification, trials: Sequence[Trial], mass_kg: float, onset: Onset) -> FitQuality:
    """Judge coefficients by the recordings they are from.

    Args:
        found: what `identify` made of the trials.
        trials: as it had them, likewise `mass_kg` and `onset`.
    """
    off, expected = dict(found.residuals), expected_residuals(trials)
    whole = {trial.name for trial in found.trials if trial.used == "whole"}
    for mode, coefficients in found.coefficients.items():
        own = [t for t in trials if t.mode == mode and t.name in whole]
        if not own or not found.is_known(mode):
            continue
        peak, out = errors_of_hits(coefficients, [measure_impact(t, mass_kg) for t in own], mass_kg, onset)
        for name, error, most in (("peak", peak, _PEAK_SHARE), ("speed out", out, _SPEED_SHARE)):
            if error is not None:
                off[f"{mode} {name}"], expected[f"{mode} {name}"] = error, most
    return judge(off, expected)


def judge(off: Mapping[str, float], expected: Mapping[str, float]) -> FitQuality:
    """Compare what is off with what a good fit is off by; a quantity without an expectation is not judged."""
    judged = {name: value for name, value in off.items() if name in expected}
    says = [
        f"poor fit: the residual of {name} is {value:.3g}, {value / expected[name]:.1f} times the "
        f"{expected[name]:.3g} of a good one; wall hits or drops (--drop), one wall, the right mode, units?"
        for name, value in judged.items()
        if not value <= expected[name]
    ]
    return FitQuality(not says if judged else None, dict(expected), says)


def errors_of_hits(
    coefficients: Mapping[str, Estimate | None], hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset
) -> tuple[float | None, float | None]:
    """By how much coefficients miss their own hits, in the median: share of the peak, and of the speed in.

    None where no hit tells it, or k or f is not known.
    """
    k, f = coefficients["k"], coefficients["f"]
    if k is None or f is None:
        return None, None
    table = HitTable.of(hits)
    said = predict(k.value, f.value, table, mass_kg, onset)
    peak = np.abs(said.peak_normal_force_n / table.peak - 1.0)
    out = np.abs(said.normal_out_m_s - table.speed_out) / table.speed_in
    peak, out = (values[np.isfinite(values)] for values in (peak, out))
    return (float(np.median(peak)) if peak.size else None, float(np.median(out)) if out.size else None)


def expected_residuals(trials: Sequence[Trial]) -> dict[str, float]:
    """The largest residuals that a good fit of these trials has, by quantity.

    Three times the noise of the recordings, or a small share of what the contact does to the quantity
    (penetration, peak force, change along the wall), whichever is more.
    """
    noise: dict[str, list[float]] = {}
    size: dict[str, list[float]] = {}
    for trial in trials:
        if "normal_m" not in trial.series:
            continue  # an accelerometer alone: a whole hit
        impact = find_impact(trial)
        for name, series in trial.series.items():
            near = np.abs(series.time_s - impact.turn_s) <= _CONTACT_S
            if not near.any():
                continue
            values = series.value[near]
            change = abs(impact.deepest_m) if name == "normal_m" else float(np.ptp(values))
            noise.setdefault(name, []).append(noise_of(series))
            size.setdefault(name, []).append(change)
    return {name: max(_NOISES * _rms(noise[name]), _SHARE * _rms(size[name])) for name in noise}


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))
