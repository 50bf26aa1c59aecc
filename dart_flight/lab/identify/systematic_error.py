"""Widening of intervals by the systematic errors of one kind of recording, which more data do not reduce.

If a vehicle turns during the contact, its guards slide faster or slower than its centre. In the law the
vehicle is a point, so the friction depends on the velocity of the centre. Flights at one speed do not
determine the lever arm from the centre to the sliding guard (docs/results/real_data.md). The intervals of the
coefficients therefore include the possible effect of the rotation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact

# Largest change of the guards' sliding speed, relative to the edge's speed at the largest turn rate
# (docs/results/flight_identification.md).
_OF_TURNING = 0.75
_MAX = 0.8
_K_OF_TURNING = 0.03  # rotation loads one guard more than the other, which lowers k by up to 6 %
_TURNS = 0.1  # ratio from which the rotation is reported


def widen_intervals(
    found: dict[str, Estimate | None], hits: Sequence[MeasuredImpact]
) -> tuple[dict[str, Estimate | None], list[str]]:
    """Widen the intervals of one mode's coefficients by the systematic errors of the recordings of its hits.

    Return notes, too.
    """
    shares = {name: max(hit.trial.allowance.get(name, 0.0) for hit in hits) for name in found}
    notes = []
    rate_rad_s = share = 0.0  # largest turn rate; largest ratio of guard speed to speed along the wall
    for hit in hits:
        trial = hit.trial
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
            f"the vehicle turned at up to {math.degrees(rate_rad_s):.0f} deg/s in these contacts, so the "
            f"guards slid up to {100.0 * slides:.0f} % slower or faster than the vehicle's centre; the "
            "contact law ignores rotation, so the interval of mu is widened"
        )
    return {name: _widened(e, shares[name]) for name, e in found.items()}, notes


def _widened(estimate: Estimate | None, share: float) -> Estimate | None:
    if estimate is None:
        return None
    more = share * abs(estimate.value)
    return Estimate(estimate.value, max(estimate.low - more, 0.0), estimate.high + more)
