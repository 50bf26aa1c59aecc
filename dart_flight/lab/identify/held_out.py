"""How well the law predicts hits that it has not seen, against two baselines that need no law.

Baselines: the speed out is a constant share of the speed in; the peak force is proportional to the speed in.
A law that does not predict held-out hits better than these has not earned its coefficients, however well it
fits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Errors, HeldOut
from dart_flight.lab.identify.hit_fit import HitFit, HitTable, median, predict
from dart_flight.lab.identify.measured_impacts import MeasuredImpact

_SAME_SPEED = 0.12  # hits whose speeds differ by less are repeats of one
_MIN_HITS = 3
# A difference of errors below this share of them is chance with so few hits.
_EARNED = 0.1
CONSTANT_RESTITUTION, FORCE_PROPORTIONAL = "constant-restitution", "force-proportional"


def speed_groups(speed: Array) -> NDArray[np.intp]:
    """Group number per hit: a new one wherever the next higher speed is more than 12 % away."""
    order = np.argsort(speed)
    groups = np.zeros(speed.size, dtype=np.intp)
    number = 0
    for before, now in itertools.pairwise(order):
        if speed[now] > speed[before] * (1.0 + _SAME_SPEED):
            number += 1
        groups[now] = number
    return groups


def hold_out(hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset) -> HeldOut:
    """Leave out each speed in turn (each hit where there is one speed only), fit to the rest, predict it.

    Args:
        hits: of one mode.
        mass_kg, onset: as `identify`.
    """
    mode, n = hits[0].mode, len(hits)
    if n < _MIN_HITS:
        said = f"{mode}: {n} hit{'s' if n > 1 else ''} cannot tell how well others are predicted"
        return HeldOut(mode, "trial", 0, None, {}, Errors(None, None), False, said)

    def by_law(rest: HitTable, held: HitTable) -> tuple[Array, Array]:
        k, f = np.exp(HitFit(rest, mass_kg, onset).solve())
        said = predict(k, f, held, mass_kg, onset)
        return said.peak_normal_force_n, said.normal_out_m_s

    table = HitTable.of(hits)
    groups = speed_groups(table.speed_in)
    by_speed = bool(groups.max() > 0)
    folds = groups if by_speed else np.arange(n)
    enough = all(table.only(folds != fold).is_enough for fold in np.unique(folds))
    law = _errors(table, folds, by_law) if enough else None
    ratios = _errors(table, folds, _in_proportion)
    earned, said = False, "restitution and tangential ratio are what these trials tell"
    if law is not None:
        earned, said = _judge(law, ratios, "held-out speeds" if by_speed else "held-out hits")
    return HeldOut(
        mode=mode,
        held_out="speed" if by_speed else "trial",
        hits=n,
        law=law,
        baselines={
            CONSTANT_RESTITUTION: Errors(None, ratios.outgoing_speed),
            FORCE_PROPORTIONAL: Errors(ratios.peak_force, None),
        },
        scatter=_scatter(table, groups),
        earned=earned,
        sentence=f"{mode}: {said}",
    )


def _errors(
    table: HitTable, folds: NDArray[np.intp], by: Callable[[HitTable, HitTable], tuple[Array, Array]]
) -> Errors:
    """Errors of a prediction (known hits, asked for -> peak, speed out) of each fold from all others."""
    peak, out = np.empty(folds.size), np.empty(folds.size)
    for fold in np.unique(folds):
        peak[folds == fold], out[folds == fold] = by(table.only(folds != fold), table.only(folds == fold))
    return table.errors(peak, out)


def _in_proportion(known: HitTable, asked: HitTable) -> tuple[Array, Array]:
    """Peak and speed out by the median ratios to the speed in of the known hits; NaN where none has it."""
    ratios = (median(values / known.speed_in) for values in (known.peak, known.speed_out))
    peak, out = ((math.nan if ratio is None else ratio) * asked.speed_in for ratio in ratios)
    return peak, out


def _scatter(table: HitTable, groups: NDArray[np.intp]) -> Errors:
    """How far repeats at one speed lie from their own median: no law does better than this."""
    peak, out = np.full(groups.size, math.nan), np.full(groups.size, math.nan)
    for group in np.unique(groups):
        members = groups == group
        if members.sum() >= 3:
            repeats = table.only(members)
            peak[members], out[members] = _in_proportion(repeats, repeats)
    return table.errors(peak, out)


def _judge(law: Errors, ratios: Errors, words: str) -> tuple[bool, str]:
    """Whether the law is better in everything that could be judged, and this in words."""
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
