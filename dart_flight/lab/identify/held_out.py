"""Which law predicts hits that it has not seen, against two baselines that need no law.

Baselines: the speed out is a constant share of the speed in; the peak force is proportional to the speed in.
A law that does not predict held-out hits better than these has not earned its parameters, however well it
fits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.hits import Hit
from dart_flight.lab.identify.law_fit import HitTable, best_fit, fit_law, predict
from dart_flight.lab.identify.laws import ContactLaw

_SAME_SPEED = 0.12  # hits whose speeds differ by less are repeats of one
_LEAST_HITS = 3
# A difference of errors below this share of them is chance with so few hits.
_EARNED = 0.1
CONSTANT_RESTITUTION, FORCE_PROPORTIONAL = "constant-restitution", "force-proportional"


class Errors(NamedTuple):
    """Median size of the error on held-out hits; None where it cannot be judged.

    Attributes:
        peak_force: as a share of the measured peak.
        outgoing_speed: as a share of the speed in.
    """

    peak_force: float | None
    outgoing_speed: float | None


class HeldOut(NamedTuple):
    """The comparison of one mode.

    Attributes:
        mode: of the hits.
        held_out: `speed` where all hits of one speed (or height) are left out together, else `trial`.
        hits: how many were predicted.
        laws: errors by law.
        baselines: errors by baseline; each predicts one of the two.
        scatter: of repeats at one speed, the same measure; None without repeats.
        best: the law with the smallest errors; None where there are too few hits.
        better_by: how much smaller its errors are than the baselines', as a share; negative is worse.
        earned: whether it predicts better than the baselines in everything that could be judged.
        sentence: this in words.
    """

    mode: str
    held_out: str
    hits: int
    laws: dict[str, Errors]
    baselines: dict[str, Errors]
    scatter: Errors
    best: str | None
    better_by: Errors
    earned: bool
    sentence: str


def speed_groups(speed: Array) -> Array:
    """Group number per hit: a new one wherever the next higher speed is more than 12 % away."""
    order = np.argsort(speed)
    groups = np.zeros(speed.size, dtype=int)
    number = 0
    for before, now in itertools.pairwise(order):
        if speed[now] > speed[before] * (1.0 + _SAME_SPEED):
            number += 1
        groups[now] = number
    return groups


def compare(laws: Sequence[ContactLaw], hits: Sequence[Hit], mass_kg: float) -> HeldOut:
    """Leave out each speed in turn (each hit where there is one speed only), fit to the rest, predict it.

    Args:
        laws: candidates, the reference first.
        hits: of one mode.
        mass_kg: of the vehicle.
    """
    mode = hits[0].mode
    table = HitTable.of(hits)
    n = len(hits)
    groups = speed_groups(table.speed_in)
    by_speed = groups.max() > 0
    folds = groups.astype(float) if by_speed else np.arange(n, dtype=float)
    kept = np.array([folds != fold for fold in range(int(folds.max()) + 1)], dtype=float)
    usable = np.array([fold.sum() > 0 for fold in kept])
    none = Errors(None, None)
    if n < _LEAST_HITS or not usable.any():
        said = f"{mode}: {n} hit{'s' if n > 1 else ''} cannot tell which law predicts others"
        return HeldOut(mode, "trial", 0, {}, {}, none, None, none, False, said)

    found: dict[str, Errors] = {}
    for law in laws:
        few = min((HitTable(*(v[k > 0.0] for v in table)).equations for k in kept), default=0)
        if few < len(law.parameters) or not table.shows_size:
            continue
        start = best_fit(law, table, mass_kg).values[0]
        values = fit_law(law, table, mass_kg, kept, start).values
        outcome = predict(law, values, table, mass_kg)
        rows = folds.astype(int), np.arange(n)
        found[law.name] = _errors(table, outcome.peak_force_n[rows], outcome.normal_out_m_s[rows])
    baselines = _baselines(table, folds)
    scatter = _scatter(table, groups)
    best, better = _best(found, baselines)
    shown = [v for v in better if v is not None]
    earned = bool(shown) and all(v > _EARNED for v in shown)
    words = "held-out speeds" if by_speed else "held-out hits"
    return HeldOut(
        mode, "speed" if by_speed else "trial", n, found, baselines, scatter, best, better, earned,
        _sentence(mode, words, best, found, baselines, better, earned),
    )  # fmt: skip


def _median(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def _errors(table: HitTable, peak: Array, out: Array) -> Errors:
    return Errors(
        _median(np.abs(peak / table.peak - 1.0)), _median(np.abs(out - table.speed_out) / table.speed_in)
    )


def _baselines(table: HitTable, folds: Array) -> dict[str, Errors]:
    peak, out = np.full(folds.size, math.nan), np.full(folds.size, math.nan)
    for fold in np.unique(folds):
        rest, held = folds != fold, folds == fold
        peak[held], out[held] = _in_proportion(table, rest, held)
    errors = _errors(table, peak, out)
    return {
        CONSTANT_RESTITUTION: Errors(None, errors.outgoing_speed),
        FORCE_PROPORTIONAL: Errors(errors.peak_force, None),
    }


def _in_proportion(table: HitTable, known: Array, asked: Array) -> tuple[Array, Array]:
    """Peak and speed out of the hits asked for, by the median ratios to the speed in of those known; NaN
    where none of them has it."""
    ratios = (_median((values / table.speed_in)[known]) for values in (table.peak, table.speed_out))
    peak, out = ((math.nan if ratio is None else ratio) * table.speed_in[asked] for ratio in ratios)
    return peak, out


def _scatter(table: HitTable, groups: Array) -> Errors:
    """How far repeats at one speed lie from their own median: no law does better than this."""
    peak, out = np.full(groups.size, math.nan), np.full(groups.size, math.nan)
    for group in np.unique(groups):
        members = groups == group
        if members.sum() >= 3:
            peak[members], out[members] = _in_proportion(table, members, members)
    return _errors(table, peak, out)


def _best(found: dict[str, Errors], baselines: dict[str, Errors]) -> tuple[str | None, Errors]:
    reference = Errors(
        baselines[FORCE_PROPORTIONAL].peak_force, baselines[CONSTANT_RESTITUTION].outgoing_speed
    )

    def gains(errors: Errors) -> Errors:
        return Errors(
            *(
                None if mine is None or base is None else (base - mine) / max(base, 1e-9)
                for mine, base in zip(errors, reference, strict=True)
            )
        )

    best: str | None = None
    most = -math.inf
    for name, errors in found.items():
        known = [g for g in gains(errors) if g is not None]
        # The reference is asked first: another law has to be better than it by more than chance.
        total = min(known) if known else -math.inf  # as good as where it is worst
        if total > most + (_EARNED if best is not None else 0.0):
            best, most = name, total
    return best, gains(found[best]) if best is not None else Errors(None, None)


def _share(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def _sentence(
    mode: str, words: str, best: str | None, found: dict[str, Errors], baselines: dict[str, Errors],
    better: Errors, earned: bool,
) -> str:  # fmt: skip
    if best is None:
        return (
            f"{mode}: no law could be compared; restitution and tangential ratio are what these trials tell"
        )
    parts = []
    for name, what, base in (
        ("peak_force", "peak force", FORCE_PROPORTIONAL),
        ("outgoing_speed", "outgoing speed", CONSTANT_RESTITUTION),
    ):
        mine, other = getattr(found[best], name), getattr(baselines[base], name)
        if mine is not None and other is not None:
            parts.append(f"{what} to {_share(mine)} ({base}: {_share(other)})")
    said = ", ".join(parts)
    if earned:
        gain = ", ".join(
            f"{what} by {_share(value)}"
            for what, value in (("peak force", better.peak_force), ("outgoing speed", better.outgoing_speed))
            if value is not None
        )
        return f"{mode}: law {best} predicts {words} better than both baselines ({gain} of the error): {said}"
    return f"{mode}: no law predicts {words} better than the baselines; nearest is {best}: {said}"
