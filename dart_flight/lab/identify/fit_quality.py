"""Assessment of the law: does the law reproduce the fitted recordings, and predict held-out hits?

A fit is poor if the law misses the recordings by more than their noise or scatter. Some trials are fitted
without their samples, for example drops that only an accelerometer recorded. The law must then reproduce the
peak force and the outgoing speed of each hit.

Predictions of held-out hits are compared with two baselines that need no law. The first baseline assumes that
the outgoing speed is a constant fraction of the incoming speed. The second baseline assumes that the peak
force is proportional to the incoming speed. If the law does not predict held-out hits better than the
baselines, the law's coefficients are useless, even if the law fits well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.estimates import Errors, Estimate, FitQuality, HeldOut
from dart_flight.lab.identify.impact_fit import ImpactFit
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem, median
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.trials import Trial

_NOISES = 3.0  # maximum ratio of a good fit's residual to the recording's noise
_SHARE = 0.06  # allowed residual over the contact's amplitude, due to filters and the law's simplicity
_CONTACT_S = 0.1  # maximum time from the contact's start to the turn, and from the turn to its end
# Limits of median errors: twice the scatter of repeated real drops (docs/results/real_data.md).
_MOST = (0.25, 0.1)  # peak force, outgoing speed
_SAME_SPEED = 0.12  # maximum relative difference between hits that count as hits at one speed
_MIN_HITS = 3
_EARNED = 0.1  # minimum relative improvement over a baseline that counts as significant
CONSTANT_RESTITUTION, FORCE_PROPORTIONAL = "constant-restitution", "force-proportional"


def assess_fit(
    coefficients: Mapping[str, Mapping[str, Estimate | None]],
    whole: LawProblem,
    residuals: Mapping[str, float],
    expected: Mapping[str, float],
) -> FitQuality:
    """Assess fitted coefficients against the recordings that were used for the fit.

    Args:
        whole: hits that were fitted as a whole, without their samples.
        residuals: quantity -> residual of the fitted samples.
        expected: quantity -> largest residual of a good fit; quantities without an entry are not assessed.
    """
    off, most = dict(residuals), dict(expected)
    for mode, own in whole.by_mode().items():
        errors = own.errors_of(coefficients[mode])
        for name, error, limit in zip(("peak", "speed out"), errors, _MOST, strict=True):
            if error is not None:
                off[f"{mode} {name}"], most[f"{mode} {name}"] = error, limit
    compared = {name: value for name, value in off.items() if name in most}
    sentences = [
        f"poor fit: the residual of {name} is {value:.3g}, {value / most[name]:.1f} times the limit of "
        f"{most[name]:.3g}; check --drop, --mode and the units, and use trials of one wall"
        for name, value in compared.items()
        if not value <= most[name]
    ]
    return FitQuality(not sentences if compared else None, most, sentences)


def expected_residuals(trials: Sequence[Trial], hits: Sequence[MeasuredImpact]) -> dict[str, float]:
    """Return the largest residuals of a good fit of these trials, by quantity.

    Each limit is the larger of two values: three times the noise of the recordings, and a small fraction of
    the quantity's change in the contact (for positions, the penetration).
    """
    noise: dict[str, list[float]] = {}
    size: dict[str, list[float]] = {}
    for trial, hit in zip(trials, hits, strict=True):
        if hit.turn is None:
            continue  # only an accelerometer: assess it as a whole hit
        for name, series in trial.series.items():
            near = np.abs(series.time_s - hit.turn.turn_s) <= _CONTACT_S
            if not near.any():
                continue
            values = series.value[near]
            change = abs(hit.turn.deepest_m) if name == "normal_m" else float(np.ptp(values))
            noise.setdefault(name, []).append(noise_of(series.value))
            size.setdefault(name, []).append(change)
    return {name: max(_NOISES * _rms(noise[name]), _SHARE * _rms(size[name])) for name in noise}


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


# --- held-out hits ---------------------------------------------------------------------------------------


def speed_groups(speed: Array) -> NDArray[np.intp]:
    """Return a group number for each hit; a gap of more than 12 % between speeds starts a new group."""
    order = np.argsort(speed)
    groups = np.zeros(speed.size, dtype=np.intp)
    number = 0
    for before, now in itertools.pairwise(order):
        if speed[now] > speed[before] * (1.0 + _SAME_SPEED):
            number += 1
        groups[now] = number
    return groups


def hold_out(problem: LawProblem) -> HeldOut:
    """Predict the hits at each speed from a fit to the hits at other speeds, and return the errors.

    The hits are of one mode. If all hits have the same speed, each hit is predicted from the other hits.
    """
    mode, n = problem.hits[0].trial.mode, len(problem.hits)
    if n < _MIN_HITS:
        sentence = f"{mode}: {n} hit{'s' if n > 1 else ''}, too few to assess predictions"
        return HeldOut(mode, "trial", 0, None, {}, Errors(None, None), False, sentence)
    groups = speed_groups(problem.speed_in)
    by_speed = bool(groups.max() > 0)
    folds = groups if by_speed else np.arange(n)
    enough = all(problem.only(folds != fold).is_enough for fold in np.unique(folds))
    law = _errors(problem, folds, _by_law) if enough else None
    ratios = _errors(problem, folds, _in_proportion)
    earned, sentence = False, "these trials determine only restitution and tangential ratio"
    if law is not None:
        earned, sentence = _compare(law, ratios, "held-out speeds" if by_speed else "held-out hits")
    return HeldOut(
        mode=mode,
        held_out="speed" if by_speed else "trial",
        hits=n,
        law=law,
        baselines={
            CONSTANT_RESTITUTION: Errors(None, ratios.outgoing_speed),
            FORCE_PROPORTIONAL: Errors(ratios.peak_force, None),
        },
        scatter=_scatter(problem, groups),
        earned=earned,
        sentence=f"{mode}: {sentence}",
    )


def _errors(
    problem: LawProblem,
    folds: NDArray[np.intp],
    predict: Callable[[LawProblem, LawProblem], tuple[Array, Array]],
) -> Errors:
    """Return the errors on held-out hits.

    Args:
        folds: fold of each hit. The hits of a fold are predicted from the other hits.
        predict: called with the known hits and the held-out hits; returns the peaks and outgoing speeds of
            the held-out hits.
    """
    peak, out = np.empty(folds.size), np.empty(folds.size)
    for fold in np.unique(folds):
        held = folds == fold
        peak[held], out[held] = predict(problem.only(~held), problem.only(held))
    return problem.errors(peak, out)


def _by_law(known: LawProblem, held: LawProblem) -> tuple[Array, Array]:
    fit = ImpactFit(known)
    k, f = np.exp(fit.solve(fit.start))
    predicted = held.predict(k, f)
    return predicted.peak_normal_force_n, predicted.normal_out_m_s


def _in_proportion(known: LawProblem, held: LawProblem) -> tuple[Array, Array]:
    """Predict peak and outgoing speed: the incoming speed times the median of the known ratios.

    If no known hit has a ratio, the prediction is NaN.
    """
    ratios = (median(values / known.speed_in) for values in (known.peak, known.speed_out))
    peak, out = ((math.nan if ratio is None else ratio) * held.speed_in for ratio in ratios)
    return peak, out


def _scatter(problem: LawProblem, groups: NDArray[np.intp]) -> Errors:
    """Predict each hit by the median of all hits at its speed, and return the errors.

    A law that depends only on the speed can hardly have smaller errors.
    """
    peak, out = np.full(groups.size, math.nan), np.full(groups.size, math.nan)
    for group in np.unique(groups):
        members = groups == group
        if members.sum() >= 3:
            repeats = problem.only(members)
            peak[members], out[members] = _in_proportion(repeats, repeats)
    return problem.errors(peak, out)


def _compare(law: Errors, ratios: Errors, words: str) -> tuple[bool, str]:
    """Return whether the law has smaller errors than the baselines in every quantity, with a sentence."""
    named = zip(("peak force", "outgoing speed"), (FORCE_PROPORTIONAL, CONSTANT_RESTITUTION), strict=True)
    judged = [
        (name, mine, base)
        for name, mine, base in zip(named, law, ratios, strict=True)
        if mine is not None and base is not None
    ]
    earned = bool(judged) and all(mine < (1.0 - _EARNED) * base for _, mine, base in judged)
    shown = ", ".join(
        f"{what} to {100.0 * mine:.1f} % ({baseline}: {100.0 * base:.1f} %)"
        for (what, baseline), mine, base in judged
    )
    better = "better than both baselines" if earned else "no better than the baselines"
    return earned, f"the law predicts {words} {better}: {shown}"
