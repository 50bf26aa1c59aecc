"""Whether to believe a fit: what it gives back, beside what was recorded.

A fit is poor where the law with its coefficients does not give back what was recorded, by more than the
recordings' own noise or scatter. Where only hits as a whole are known, as of an accelerometer alone, their
peaks and speeds out are what has to be given back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Errors, Estimate, FitQuality
from dart_flight.lab.identify.hit_fit import HitTable, predict
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.recorded_impact import noise_of
from dart_flight.lab.identify.trials import Trial

# Over a whole recording residuals of good fits are the noise; what a filter in the recording and the law
# itself leave out is up to a few hundredths of the contact's own size (simulated vehicle's logs: below 0.01).
_NOISES = 3.0
_SHARE = 0.06
_CONTACT_S = 0.1  # to either side of the turn: the contact is in there
# Of whole hits, in the median: twice what repeats of real drops scatter (docs/results/real_data.md).
_MOST = Errors(peak_force=0.25, outgoing_speed=0.1)


def errors_of(
    coefficients: Mapping[str, Estimate | None], hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset
) -> Errors:
    """Return by how much coefficients miss their own hits; unknown without hits, k or f."""
    k, f = coefficients["k"], coefficients["f"]
    if k is None or f is None or not hits:
        return Errors(None, None)
    table = HitTable.of(hits)
    said = predict(k.value, f.value, table, mass_kg, onset)
    return table.errors(said.peak_normal_force_n, said.normal_out_m_s)


def assess_fit(
    coefficients: Mapping[str, Mapping[str, Estimate | None]],
    whole: Sequence[MeasuredImpact],
    residuals: Mapping[str, float],
    expected: Mapping[str, float],
    mass_kg: float,
    onset: Onset,
) -> FitQuality:
    """Judge coefficients by the recordings they are from.

    Args:
        coefficients: by mode.
        whole: hits whose samples were not fitted.
        residuals: by quantity, of the samples that were.
        expected: largest residuals of a good fit, by quantity.
        mass_kg, onset: as `identify`.
    """
    off, most = dict(residuals), dict(expected)
    for mode, found in coefficients.items():
        errors = errors_of(found, [hit for hit in whole if hit.mode == mode], mass_kg, onset)
        for name, error, limit in zip(("peak", "speed out"), errors, _MOST, strict=True):
            if error is not None and limit is not None:
                off[f"{mode} {name}"], most[f"{mode} {name}"] = error, limit
    return judge(off, most)


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


def expected_residuals(trials: Sequence[Trial], hits: Sequence[MeasuredImpact]) -> dict[str, float]:
    """The largest residuals that a good fit of these trials has, by quantity.

    Three times the noise of the recordings, or a small share of what the contact does to the quantity
    (penetration, peak force, change along the wall), whichever is more.
    """
    noise: dict[str, list[float]] = {}
    size: dict[str, list[float]] = {}
    for trial, hit in zip(trials, hits, strict=True):
        if hit.turn is None:
            continue  # an accelerometer alone: a whole hit
        for name, series in trial.series.items():
            near = np.abs(series.time_s - hit.turn.turn_s) <= _CONTACT_S
            if not near.any():
                continue
            values = series.value[near]
            change = abs(hit.turn.deepest_m) if name == "normal_m" else float(np.ptp(values))
            noise.setdefault(name, []).append(noise_of(series))
            size.setdefault(name, []).append(change)
    return {name: max(_NOISES * _rms(noise[name]), _SHARE * _rms(size[name])) for name in noise}


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))
