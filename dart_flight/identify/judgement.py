"""From a fit to what can be said: which coefficients the data tell, how well, and which fits are bad."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.identify.estimates import Estimate, SetAside
from dart_flight.identify.intervals import Deviation, deviations
from dart_flight.identify.sample_fit import HIGHEST_F, HIGHEST_K, LOWEST_F, LOWEST_K, PUSHES, SampleFit
from dart_flight.identify.trials import noise_of

# Rates of change this small in the model make a coefficient unknown rather than zero.
_WIDEST_LOG = math.log(10.0)
# Residuals in contact over the noise of the same channel in free flight: beyond it the law does not fit.
BAD_FIT = 4.0
_LEAST_JUDGED = 4  # samples in contact


class SampleTrial(NamedTuple):
    """What a fit of samples says of one trial; see `TrialFit`."""

    onset_s: float
    normal_m_s: float
    tangential_m_s: float | None
    samples_in_contact: int
    push_m_s2: tuple[float, float]
    force_delay_s: float | None
    misfit: float | None
    worst_channel: str
    set_aside: SetAside


class SampleResult(NamedTuple):
    """What a fit of samples says; see `Identification`.

    Attributes:
        bad: modes whose law does not fit the samples of a contact.
    """

    coefficients: dict[str, dict[str, Estimate | None]]
    plane_m: Estimate
    residuals: dict[str, float]
    trials: list[SampleTrial]
    vertical_side: int | None
    bad: set[str]
    notes: list[str]


def conclude(fit: SampleFit, theta: Array) -> SampleResult:
    """Coefficients with intervals, what became of each trial, and what a reader should know."""
    deviation = deviations(fit, theta)
    notes: list[str] = []
    trials = _trials(fit, theta)
    bad = set()
    for trial, judged in zip(fit.trials, trials, strict=True):
        if judged.misfit is not None and judged.misfit > BAD_FIT:
            bad.add(trial.mode)
            notes.append(
                f"{trial.name}: bad fit: in contact {judged.worst_channel} is off by {judged.misfit:.1f} "
                "times its noise in free flight"
            )
        aside = judged.set_aside
        if aside.contact:
            notes.append(f"{trial.name}: {aside.contact} of {aside.in_contact} samples in contact set aside")
    coefficients: dict[str, dict[str, Estimate | None]] = {}
    side: int | None = None
    for mode in fit.parameters.modes:
        members = [i for i, trial in enumerate(fit.trials) if trial.mode == mode]
        found = _stiffness(fit, theta, deviation, mode, notes)
        found["mu"] = _friction(fit, theta, deviation.half, members)
        found["nu"], up = _vertical(fit, theta, deviation.half, members)
        side = up if up is not None else side
        allowed = {n: max(fit.trials[i].allowance.get(n, 0.0) for i in members) for n in found}
        coefficients[mode] = {n: _widened(e, allowed[n]) for n, e in found.items()}
    half = float(deviation.half[0])
    plane = Estimate(float(theta[0]), float(theta[0]) - half, float(theta[0]) + half)
    return SampleResult(coefficients, plane, _residuals(fit, theta), trials, side, bad, notes)


def _stiffness(
    fit: SampleFit, theta: Array, deviation: Deviation, mode: str, notes: list[str]
) -> dict[str, Estimate | None]:
    at = fit.parameters.of_mode(mode)
    found: dict[str, Estimate | None] = {}
    for name, lowest, highest in (("k", LOWEST_K, HIGHEST_K), ("f", LOWEST_F, HIGHEST_F)):
        half, value = float(deviation.half[at[name]]), float(theta[at[name]])
        found[name] = None
        if value < math.log(lowest) + 1e-3 or value > math.log(highest) - 1e-3:
            notes.append(f"{mode}: {name} is at a bound of the search ({math.exp(value):.3g}) and not known")
        elif half >= _WIDEST_LOG:
            notes.append(f"{mode}: {name} cannot be told from these trials")
        else:
            found[name] = Estimate(*(math.exp(v) for v in (value, value - half, value + half)))
    return found


def _widened(estimate: Estimate | None, share: float) -> Estimate | None:
    """The interval with a share of the value added at both ends."""
    if estimate is None:
        return None
    more = share * abs(estimate.value)
    return Estimate(estimate.value, max(estimate.low - more, 0.0), estimate.high + more)


def _friction(fit: SampleFit, theta: Array, deviation: Array, members: list[int]) -> Estimate | None:
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["mu"]
    moving = False
    change = 0.0  # exponent of the slowing per s/m of mu: how strongly mu acts at all
    for i in members:
        own = fit.parameters.own[i]
        if "vy" in own:
            moving |= abs(theta[own["vy"]]) > max(5.0 * float(deviation[own["vy"]]), 0.02)
            _, end, contact = fit.span(theta, i)
            change = max(change, float(contact.impulse(end)) / fit.mass_kg)
    value, half = float(theta[at]), float(deviation[at])
    if not moving or (half > value and half * change > 0.3):
        return None
    return Estimate(value, max(value - half, 0.0), value + half)


def _vertical(
    fit: SampleFit, theta: Array, deviation: Array, members: list[int]
) -> tuple[Estimate | None, int | None]:
    """Nu by its size, and the side on which the force acts."""
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["nu"]
    if not any("z0" in fit.parameters.own[i] for i in members):
        return None, None
    value, half = abs(float(theta[at])), float(deviation[at])
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
        if inside.sum() < _LEAST_JUDGED or free.sum() < _LEAST_JUDGED:
            continue
        noise = max(float(np.sqrt(np.mean(error[free] ** 2))), noise_of(window.series[name]), 1e-9)
        ratio = float(np.sqrt(np.mean(error[inside] ** 2))) / noise
        if worst is None or ratio > worst:
            worst, channel = ratio, name
    return worst, channel


def _trials(fit: SampleFit, theta: Array) -> list[SampleTrial]:
    fits = []
    for i, window in enumerate(fit.windows):
        own = fit.parameters.own[i]
        along = float(theta[own["vy"]]) if "vy" in own else None
        onset, speed = float(theta[own["onset"]]), -float(theta[own["speed"]])
        push = [float(theta[own[f"n_{when}"]]) if "n_after" in own else 0.0 for when in PUSHES]
        inside = sum(int(c.sum()) for c in window.contact.values())
        gone = {name: window.counts[name] == 0.0 for name in window.series}
        aside = SetAside(
            sum(int((gone[n] & ~window.contact[n]).sum()) for n in gone),
            sum(int((gone[n] & window.contact[n]).sum()) for n in gone),
            inside,
        )
        misfit, channel = _misfit(fit, theta, i)
        delay = float(theta[own["delay"]]) if "delay" in own else None
        fits.append(
            SampleTrial(
                onset,
                speed,
                along,
                fit.in_contact(theta, i),
                (push[0], push[1]),
                delay,
                misfit,
                channel,
                aside,
            )
        )
    return fits
