"""Campaign: three choices of the next hits of a trial series, compared in the same vehicles.

The package has equal steps of speed only. Hits at the two ends of the range of speeds, and a D-optimal choice
over speed, angle and mode, exist only here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median

import numpy as np

from dart_flight.base.records import Mode
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.identify.next_hits import (
    FITTED,
    ModeFit,
    NextHit,
    NextHitLimits,
    fastest_m_s,
    information_of,
    next_hits,
    predict_hit,
)
from tools.campaigns.results import grouped, markdown
from tools.campaigns.series import SeriesOutcome, fly_series

_SLIDINGS = (0.0, 0.2, 0.4, 0.6)  # velocity along the wall, relative to the normal velocity
_OF_TWO_LEVELS = 0.4
_SPEEDS = 13


def _two_levels(fits: Mapping[Mode, ModeFit], limits: NextHitLimits, count: int) -> list[NextHit]:
    hits = []
    for i, (mode, fit) in enumerate(fits.items()):
        top = fastest_m_s(fit, limits, _OF_TWO_LEVELS)
        number = count // len(fits) + (i < count % len(fits))
        if top is not None:
            speeds = np.resize([limits.slowest_m_s, top], number).tolist()
            hits += [predict_hit(fit, limits, mode, -v, _OF_TWO_LEVELS * v) for v in speeds]
    return sorted(hits, key=lambda hit: hit.highest_n)


def _d_optimal(fits: Mapping[Mode, ModeFit], limits: NextHitLimits, count: int) -> list[NextHit]:
    """Choose one hit after the other, each with the largest gain of information over all modes."""
    information, options = {}, []
    for mode, fit in fits.items():
        information[mode] = np.diag((np.array([fit.k.half, fit.f.half, fit.mu.half]) / 1.96) ** -2.0)
        for sliding in _SLIDINGS:
            top = fastest_m_s(fit, limits, sliding)
            if top is not None:
                speeds = np.linspace(limits.slowest_m_s, top, _SPEEDS).tolist()
                options += [
                    (mode, v, sliding * v, information_of(fit, limits, -v, sliding * v)) for v in speeds
                ]
    hits = []
    for _ in range(count if options else 0):
        gains = [
            np.linalg.slogdet(information[mode] + more)[1] - np.linalg.slogdet(information[mode])[1]
            for mode, _, _, more in options
        ]
        mode, speed, along, more = options[int(np.argmax(gains))]
        information[mode] += more
        hits.append(predict_hit(fits[mode], limits, mode, -speed, along))
    return sorted(hits, key=lambda hit: hit.highest_n)


_DESIGNS = {"equal_steps": next_hits, "two_levels": _two_levels, "d_optimal": _d_optimal}


def fly_series_of(point: Point, seed: int) -> SeriesOutcome:
    """Fly a series whose hits one of the three designs chooses."""
    return fly_series(point, seed, _DESIGNS[point.case["design"]])


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a line a design: hits, and error and half width of the interval of each coefficient, in %."""
    table = []
    for (design,), series in grouped(rows, "design").items():
        cells = [design.replace("_", " "), str(len(series)), f"{median(one.hits for one in series):g}"]
        for name in FITTED:
            found = [c for one in series for key, c in one.coefficients.items() if key.split()[1] == name]
            off = median(abs(value / truth - 1.0) for value, *_, truth in found)
            half = median(0.5 * math.log(high / low) for _, low, high, *_ in found)
            cells.append(f"{100.0 * off:.1f}, {100.0 * half:.1f}")
        peaks = [one.peak_rms for one in series if one.peak_rms is not None]
        table.append(
            [*cells, f"{max(one.highest_share for one in series):.2f}", f"{100.0 * median(peaks):.1f}"]
        )
    return markdown(("design", "series", "hits", *FITTED, "peak / limit", "peak, %"), table)
