"""Whether a fit can be believed: its residuals against what the recordings themselves lead to expect."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dart_flight.identify.trials import Trial, find_impact, noise_of

# Residuals of good fits are the noise; what a filter in the recording and the law itself leave out is up to a
# few hundredths of the contact's own size (flight logs of the simulated vehicle: below 0.01).
_NOISES = 3.0
_SHARE = 0.06
_CONTACT_S = 0.1  # to either side of the turn: the contact is in there


class FitJudgement(NamedTuple):
    """A fit, judged.

    Attributes:
        good: no residual is larger than expected.
        expected: quantity -> largest root mean square residual of a good fit, in its own unit.
        says: a sentence per quantity that is not good; what to look at.
    """

    good: bool
    expected: dict[str, float]
    says: list[str]


def judge_fit(residuals: Mapping[str, float], expected: Mapping[str, float]) -> FitJudgement:
    """Compare residuals with those that a good fit has.

    Args:
        residuals: quantity -> root mean square, in its own unit.
        expected: likewise, the largest that is good (`expected_residuals`); a quantity without one is good.
    """
    says = [
        f"poor fit: the residual of {name} is {residual:.3g}, {residual / expected[name]:.1f} times the "
        f"{expected[name]:.3g} of a good one; wall hits or drops (--drop), one wall, the right mode, units?"
        for name, residual in residuals.items()
        if name in expected and residual > expected[name]
    ]
    return FitJudgement(not says, dict(expected), says)


def expected_residuals(trials: Sequence[Trial]) -> dict[str, float]:
    """The largest residuals that a good fit of these trials has, by quantity.

    Three times the noise of the recordings, or a small share of what the contact does to the quantity
    (penetration, peak force, change along the wall), whichever is more.
    """
    noise: dict[str, list[float]] = {}
    size: dict[str, list[float]] = {}
    for trial in trials:
        if "normal_m" not in trial.series:
            continue  # an accelerometer alone: judged with its law (`judgement`)
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
