"""Assessment of a fit: whether the law with the fitted coefficients reproduces the recordings.

A fit is poor if the law misses the recordings by more than their noise or scatter. Some trials are fitted
without their samples, for example drops that only an accelerometer recorded. The law must then reproduce the
peak force and the outgoing speed of each hit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from dart_flight.lab.identify.estimates import Estimate, FitQuality
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.trials import Trial

_NOISES = 3.0  # residual of a good fit over the recording's noise
_SHARE = 0.06  # residual relative to the contact's amplitude, for filters and for simplifications of the law
_CONTACT_S = 0.1  # interval on either side of the turn that contains the contact
# Medians over whole hits: twice the scatter of repeated real drops (docs/results/real_data.md).
_MOST = (0.25, 0.1)  # peak force, outgoing speed


def assess_fit(
    coefficients: Mapping[str, Mapping[str, Estimate | None]],
    whole: LawProblem,
    residuals: Mapping[str, float],
    expected: Mapping[str, float],
) -> FitQuality:
    """Assess coefficients against the recordings to which the coefficients were fitted.

    Args:
        whole: hits that were fitted as a whole, without their samples.
        residuals: quantity -> residual of the fitted samples.
        expected: quantity -> largest residual of a good fit; quantities without one are skipped.
    """
    off, most = dict(residuals), dict(expected)
    for mode, own in whole.by_mode().items():
        errors = own.errors_of(coefficients[mode])
        for name, error, limit in zip(("peak", "speed out"), errors, _MOST, strict=True):
            if error is not None:
                off[f"{mode} {name}"], most[f"{mode} {name}"] = error, limit
    compared = {name: value for name, value in off.items() if name in most}
    sentences = [
        f"poor fit: the residual of {name} is {value:.3g}; a good fit has at most {most[name]:.3g}, "
        f"which is {value / most[name]:.1f} times less; check --drop, --mode and the units, and use "
        "trials of one wall"
        for name, value in compared.items()
        if not value <= most[name]
    ]
    return FitQuality(not sentences if compared else None, most, sentences)


def expected_residuals(trials: Sequence[Trial], hits: Sequence[MeasuredImpact]) -> dict[str, float]:
    """Return the largest residuals of a good fit of these trials, by quantity.

    Each is three times the noise of the recordings, or a small fraction of the quantity's change in the
    contact (such as the penetration), whichever is larger.
    """
    noise: dict[str, list[float]] = {}
    size: dict[str, list[float]] = {}
    for trial, hit in zip(trials, hits, strict=True):
        if hit.turn is None:
            continue  # accelerometer only, assessed as a whole hit
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
