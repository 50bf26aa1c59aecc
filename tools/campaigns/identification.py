"""Campaign: coefficients identified from synthetic trials (docs/results/identification.md).

Drops are recorded at 1000 Hz with 0.5 mm noise, wall hits at 240 Hz with 1 mm. In every set the plane has an
error of 10 mm, speeds vary by 3 % and heights by 2 % (standard deviations), and sampling has a random phase.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.law import Onset
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.trials import Trial
from tests.doubles.synthetic_trials import MASS_KG, drop_trial, wall_trial
from tools.campaigns.results import NoResultError, grouped, markdown

_SPEEDS = {"3 hits at 1.0 m/s": (1.0, 1.0, 1.0)}
_FULL = "hits with track and height"


class Identified(msgspec.Struct, frozen=True):
    """Coefficients of one set by name: estimate, both ends of its 95 % interval, and true value."""

    coefficients: dict[str, tuple[float, float, float, float]]


def trials_of(c: Coefficients, kind: str, mode: str, random: np.random.Generator) -> list[Trial]:
    """Return one set of trials."""
    plane = random.normal(0.0, 0.01)
    if "drops" in kind:
        heights = 0.05 * (1.0 + 0.02 * random.standard_normal(3))
        return [drop_trial(c, h, random, noise_m=0.0005, plane_m=plane, mode=mode) for h in heights]
    speeds = np.array(_SPEEDS.get(kind, (0.5, 1.0, 1.5))) * (1.0 + 0.03 * random.standard_normal(3))
    full = kind == _FULL
    return [
        wall_trial(
            c, -v, random, noise_m=0.001, plane_m=plane, mode=mode,
            tangential_m_s=0.5 if full else None, with_vertical=full,
        )
        for v in speeds
    ]  # fmt: skip


def identify_set(point: Point, seed: int) -> Identified:
    """Identify one set.

    Raises:
        NoResultError: a coefficient is not determined.
    """
    kind, mode = point.case["trials"], point.case["mode"]
    surface = "concrete" if "drops" in kind else "acrylic"
    truth = point.mission.vehicle.materials[surface].coefficients(Mode(mode))
    trials = trials_of(truth, kind, mode, np.random.default_rng((1, seed - 1)))
    found = identify(trials, MASS_KG, Onset.LCP).coefficients[mode]
    identified = {}
    for name in ("k", "f", "mu", "nu") if kind == _FULL else ("k", "f"):
        estimate = found[name]
        if estimate is None:
            raise NoResultError(f"{name} is not determined")
        identified[name] = (estimate.value, estimate.low, estimate.high, float(getattr(truth, name)))
    return Identified(identified)


_HEADS = ("trials", "coefficient", "median error: rigid, flexible", "95 % interval holds", "half interval")


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every kind of trials and coefficient; pairs are for rigid and flexible arms."""
    table: dict[tuple[str, str], list[list[str]]] = {}
    for (trials, _), sets in grouped(rows, "trials", "mode").items():
        for name in sets[0].coefficients:
            value, low, high, true = np.array([one.coefficients[name] for one in sets]).T
            figures = (
                f"{np.median(np.abs(value / true - 1.0)):.2%}",
                f"{np.mean((low <= true) & (true <= high)):.0%}",
                f"{np.median(0.5 * (high - low) / true):.2%}",
            )
            table.setdefault((trials, name), [[], [], []])
            for cell, figure in zip(table[trials, name], figures, strict=True):
                cell.append(figure)
    return markdown(_HEADS, [[*key, *map(", ".join, cells)] for key, cells in table.items()])
