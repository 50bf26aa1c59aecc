"""From trials to the parameters that fit their samples best."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dart_flight.config.packages import missing_package
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.sample_fit import SampleFit
from dart_flight.lab.identify.trials import Trial
from dart_flight.lab.identify.windows import AFTER_S, BEFORE_S

_DEAD = 1e-6  # in any unit: a recording that changes by less is not one
_CURVED = 4.5  # deviations of a curvature in free flight that is not noise


def least_squares(residuals: Callable[[Array], Array], start: Array, **how: Any) -> Any:
    """SciPy's function of this name.

    Raises:
        InputError: SciPy is missing.
    """
    try:
        from scipy.optimize import least_squares as of_scipy  # noqa: PLC0415
    except ImportError:
        raise missing_package("needs SciPy", "identify") from None
    return of_scipy(residuals, start, **how)


def solve(
    trials: Sequence[Trial],
    felt: Sequence[tuple[float, float]],
    mass_kg: float,
    onset: Onset,
    *,
    may_curve: bool = True,
    least: int = 0,
) -> tuple[SampleFit, Array, list[str]]:
    """Robust descent, then least squares with the weights that the residuals ask for.

    Args:
        trials: with positions.
        felt: begin and end of each contact as the recording itself shows it.
        mass_kg, onset: as `identify`.
        may_curve: whether accelerations in free flight may be estimated.
        least: samples in contact that every trial needs; with fewer the fit stops early.

    Returns:
        The fit, its parameters, and notes.

    Raises:
        InputError: SciPy is missing, or a trial cannot be used.
    """
    notes: list[str] = []

    def descend(fit: SampleFit, theta: Array, losses: Sequence[str]) -> Array:
        low, high = fit.bounds()
        for turn, loss in enumerate(losses, 1):
            result = least_squares(
                fit.residuals, np.clip(theta, low, high), jac=fit.jacobian, bounds=(low, high),
                x_scale="jac", loss=loss, f_scale=2.0, max_nfev=80,
            )  # fmt: skip
            theta = result.x
            if turn < len(losses):
                _refine(fit, theta)
        return theta

    fit = SampleFit(trials, mass_kg, onset, False, felt)
    theta = descend(fit, fit.start(), ("soft_l1", "linear", "linear"))
    if any(fit.in_contact(theta, i) < least for i in range(len(fit.trials))):
        return fit, theta, notes
    if may_curve and _is_curved(fit, theta):
        notes.append("free flight is not straight: accelerations before and after the contact are estimated")
        pushed = SampleFit(trials, mass_kg, onset, True, felt)
        pushed.sd = dict(fit.sd)
        start = np.zeros(pushed.parameters.size)
        start[: 1 + 4 * len(fit.parameters.modes)] = theta[: 1 + 4 * len(fit.parameters.modes)]
        for old, new in zip(fit.parameters.own, pushed.parameters.own, strict=True):
            for name, j in old.items():
                start[new[name]] = theta[j]
        fit, theta = pushed, descend(pushed, start, ("soft_l1", "linear", "linear"))
    return fit, theta, notes


def _is_curved(fit: SampleFit, theta: Array) -> bool:
    """Whether the residuals of any wall hit bend, before or after the contact, more than noise does."""
    for i, trial in enumerate(fit.trials):
        if trial.acceleration_m_s2 != 0.0:
            continue
        begin, end, _ = fit.span(theta, i)
        predicted = fit.predict(theta, i)
        for name in ("normal_m", "tangential_m", "vertical_m"):
            if name not in predicted:
                continue
            time, value = fit.windows[i].series[name]
            # From third differences: what bends does not add to it, as it would to the residuals.
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


def without_derived(trials: Sequence[Trial]) -> tuple[list[Trial], list[str]]:
    """Leave out what is no measurement: velocities differenced from the positions, dead channels.

    The former would count twice; the latter seem to have no noise at all and would count for everything.
    """
    kept, notes = [], []
    for trial in trials:
        series = dict(trial.series)
        for name in [n for n, (_, value) in series.items() if not value.size or float(np.ptp(value)) < _DEAD]:
            if name != "normal_m":
                del series[name]
                notes.append(f"{trial.name}: {name} never changes and was not used")
        for axis in ("normal", "tangential"):
            position, velocity = series.get(f"{axis}_m"), series.get(f"{axis}_m_s")
            if position is None or velocity is None or position.time_s.size < 20:
                continue
            slope = np.gradient(position.value, position.time_s)
            own = velocity.value - np.interp(velocity.time_s, position.time_s, slope)
            noise = np.std(np.diff(slope, 2)) / math.sqrt(6.0)
            if np.median(np.abs(own)) < 0.2 * noise:
                del series[f"{axis}_m_s"]
                notes.append(f"{trial.name}: {axis}_m_s is the derivative of {axis}_m and was not used")
        kept.append(replace(trial, series=series))
    return kept, notes


def _refine(fit: SampleFit, theta: Array) -> None:
    """Windows about the contact that was found, then weights from the residuals."""
    for i, trial in enumerate(fit.trials):
        begin, end, contact = fit.span(theta, i)
        if trial.acceleration_m_s2 < 0.0:
            g = -trial.acceleration_m_s2
            before = min(0.85 * -contact.normal_m_s / g, BEFORE_S)
            after = min(1.5 * max(float(contact.normal(end - begin)[1]), 0.0) / g, BEFORE_S)
        else:
            before, after = BEFORE_S, AFTER_S
        begin, end = min(begin, fit.felt[i][0]), max(end, fit.felt[i][1])
        fit.cut(i, begin - before, end + after)
    fit.weigh(theta)
