"""The search for the impact in a recording of any length, and the rejection of unusable recordings.

An `InputError` names the trial and the reason.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.trials import Trial

_LONGEST_STEP_S = 0.03  # maximum sampling interval; the shortest contacts last 0.05 s
_FASTEST_M_S = 15.0
_DEEPEST_M = 0.4
_SLOWEST_M_S = 0.05
_TURN_M_S2 = 1.2  # minimum mean acceleration of an impact's turn
_NEAREST_M = 0.08  # maximum distance of an impact's turning point in front of the assumed plane


class TrialImpact(NamedTuple):
    """The approximate impact in a recording, from which a fit starts.

    Attributes:
        turn_s: time at which the normal velocity changes its sign.
        approach_m_s: normal velocity before the turn (negative).
        rebound_m_s: normal velocity after the turn.
        deepest_m: normal position at the turn.
        noise_m: standard deviation of the position samples.
    """

    turn_s: float
    approach_m_s: float
    rebound_m_s: float
    deepest_m: float
    noise_m: float


def refuse_unusable(trial: Trial) -> None:
    for name, series in trial.series.items():
        if series.time_s.size > 1 and not (np.diff(series.time_s) > 0.0).all():
            raise InputError("time does not increase", source=trial.name, key=(name,))
        if not (np.isfinite(series.time_s).all() and np.isfinite(series.value).all()):
            raise InputError("some values are not numbers", source=trial.name, key=(name,))
    if "normal_m" not in trial.series:
        return
    time = trial.normal.time_s
    if time.size < 12:
        raise InputError(f"{time.size} samples are too few for an impact", source=trial.name)
    step = float(np.median(np.diff(time)))
    if step > _LONGEST_STEP_S:
        raise InputError(
            f"the samples are {1e3 * step:.0f} ms apart, but a contact of 50 to 180 ms needs a sample every "
            f"{1e3 * _LONGEST_STEP_S:.0f} ms or less; is time_s in seconds?",
            source=trial.name,
            key=("time_s",),
        )


def _slopes(time: Array, value: Array, half_s: float) -> Array:
    """Return the slope of the straight line through the samples within `half_s` of each sample."""
    first = np.searchsorted(time, time - half_s)
    last = np.searchsorted(time, time + half_s, side="right")
    t, x = time - time.mean(), value - value.mean()
    sums = [np.concatenate(([0.0], np.cumsum(v))) for v in (np.ones_like(t), t, x, t * t, t * x)]
    n, st, sx, stt, stx = (s[last] - s[first] for s in sums)
    spread = stt - st * st / n
    return np.where(spread > 0.0, (stx - st * sx / n) / np.where(spread > 0.0, spread, 1.0), 0.0)


def find_impact(trial: Trial) -> TrialImpact:
    """Find the first strong turn from approach to departure.

    An implausible position or speed, as with a wrong unit, is rejected.
    """
    refuse_unusable(trial)
    time, value = trial.normal
    step = float(np.median(np.diff(time)))
    speed = _slopes(time, value, max(0.012, 2.5 * step))
    candidates = np.flatnonzero((speed[:-1] < 0.0) & (speed[1:] >= 0.0)) + 1
    found: list[TrialImpact] = []
    reach = 0.12  # time before and after a turn in which approach and rebound speed are searched, s
    for i in candidates:
        at = float(time[i])
        before = (time >= at - reach) & (time < at)
        after = (time > at) & (time <= at + reach)
        if before.sum() < 3 or after.sum() < 3:
            continue
        turn = TrialImpact(
            at, float(speed[before].min()), float(speed[after].max()), float(value[i]), noise_of(value)
        )
        quick = (turn.rebound_m_s - turn.approach_m_s) / (2.0 * reach) >= _TURN_M_S2
        if quick and turn.approach_m_s < -_SLOWEST_M_S and turn.rebound_m_s > 0.0:
            found.append(turn)
    if not found:
        raise InputError(
            "no impact found: the motion never reverses quickly from approach to departure", source=trial.name
        )
    strongest = max(turn.rebound_m_s - turn.approach_m_s for turn in found)
    # The first strong turn is the impact; later ones are bounces. Noise may split a turn into several.
    begun = next(t for t in found if t.rebound_m_s - t.approach_m_s >= 0.6 * strongest)
    same = [t for t in found if abs(t.turn_s - begun.turn_s) < 0.04]
    impact = min(same, key=lambda t: t.deepest_m)
    if trial.acceleration_m_s2 == 0.0:
        impact = impact._replace(approach_m_s=_line_slope(time, value, impact))
    if -impact.approach_m_s > _FASTEST_M_S:
        raise InputError(
            f"approach at {-impact.approach_m_s:.0f} m/s: are positions in metres and times in seconds?",
            source=trial.name,
        )
    if impact.deepest_m < -_DEEPEST_M:
        raise InputError(
            f"the motion reverses {-impact.deepest_m:.2f} m behind the plane of first touch, "
            f"limit {_DEEPEST_M:g} m",
            source=trial.name,
        )
    if impact.deepest_m > _NEAREST_M:
        raise InputError(
            f"the motion reverses {impact.deepest_m:.2f} m before the plane of first touch; if normal_m is "
            "the distance of the vehicle's centre from the wall, give --contact-distance",
            source=trial.name,
        )
    return impact


def _line_slope(time: Array, value: Array, impact: TrialImpact) -> float:
    """Return the approach velocity as the median slope (Theil and Sen).

    The median is robust if at most a third of the samples are outliers.
    """
    straight = (time > impact.turn_s - 0.25) & (time < impact.turn_s - 0.07)
    t, x = time[straight][-200:], value[straight][-200:]
    apart = t[None, :] - t[:, None] > 0.03
    if apart.sum() < 10:
        return impact.approach_m_s
    slope = float(np.median(((x[None, :] - x[:, None])[apart]) / ((t[None, :] - t[:, None])[apart])))
    return min(slope, -_SLOWEST_M_S)


def deviation_of(errors: Array) -> float:
    """Return the standard deviation, estimated robustly from the median absolute error."""
    return max(1.4826 * float(np.median(np.abs(errors))), 1e-9)


def noise_of(value: Array) -> float:
    """Return the standard deviation of the white noise in samples; third differences remove the motion."""
    if value.size < 8:
        return 1e-3
    third = np.diff(value, 3)
    return max(deviation_of(third - np.median(third)) / math.sqrt(20.0), 1e-7)


def free_spans_s(
    acceleration_m_s2: float, speed_in_m_s: float, speed_out_m_s: float, longest_s: tuple[float, float]
) -> tuple[float, float]:
    """Return the duration of free flight before and after a contact, at most `longest_s` each.

    In a drop, free flight begins with the release; after the rebound it ends with the next contact.
    """
    if acceleration_m_s2 >= 0.0:
        return longest_s
    fall_s = 0.85 * speed_in_m_s / -acceleration_m_s2
    rise_s = 1.5 * max(speed_out_m_s, 0.0) / -acceleration_m_s2
    return min(fall_s, longest_s[0]), min(rise_s, longest_s[1])
