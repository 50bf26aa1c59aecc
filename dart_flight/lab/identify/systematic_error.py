"""What recordings of a kind are off by, however many there are: by that the intervals are widened.

A vehicle that turns while it touches slides at its guards faster or slower than at its centre. The law is a
point's, its friction goes with the centre's velocity, and flights of one speed cannot tell a lever
(docs/results/real_data.md); so the coefficient is said with what turning may make of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.trials import Trial

# Of what turning at its largest rate makes the vehicle's edge slide, over the centre's velocity: by so much
# the guards slide otherwise, at most (docs/results/flight_identification.md).
_OF_TURNING = 0.75
_MAX = 0.8
_K_OF_TURNING = 0.03  # turning presses one guard deeper than the other: k is lower there, by up to 6 %
_TURNS = 0.1  # from this share on it is said


def widen_intervals(
    found: dict[str, Estimate | None], trials: Sequence[Trial], hits: Sequence[MeasuredImpact]
) -> tuple[dict[str, Estimate | None], list[str]]:
    """Coefficients with intervals as wide as recordings of this kind ask for, and what a reader should know.

    Args:
        found: k, f, mu, nu of one mode.
        trials: they are from.
        hits: of these trials, in their order.
    """
    shares = {name: max(trial.allowance.get(name, 0.0) for trial in trials) for name in found}
    notes = []
    rate_rad_s = share = 0.0  # largest turn rate; largest speed of the guards by it over that along the wall
    for trial, hit in zip(trials, hits, strict=True):
        if trial.flown is not None and trial.turn_rad_s is not None and hit.tangential_in_m_s:
            sliding = trial.turn_rad_s * trial.flown.config.airframe.contact_distance_m
            rate_rad_s = max(rate_rad_s, trial.turn_rad_s)
            share = max(share, sliding / abs(hit.tangential_in_m_s))
    mu = found["mu"]
    if share > _TURNS:
        slides = min(_OF_TURNING * share, _MAX)
        shares["k"] += _K_OF_TURNING
        if mu is not None:
            found = found | {"mu": Estimate(mu.value, mu.low / (1.0 + slides), mu.high / (1.0 - slides))}
        notes.append(
            f"the vehicle turned by up to {math.degrees(rate_rad_s):.0f} deg/s in these contacts, and "
            "the law is a point's, which does not turn: where it touched it slid up to "
            f"{100.0 * slides:.0f} % slower or faster than its centre; mu is off by that, see its interval"
        )
    return {name: _widened(e, shares[name]) for name, e in found.items()}, notes


def _widened(estimate: Estimate | None, share: float) -> Estimate | None:
    """The interval with a share of the value added at both ends."""
    if estimate is None:
        return None
    more = share * abs(estimate.value)
    return Estimate(estimate.value, max(estimate.low - more, 0.0), estimate.high + more)
