"""Measurement of hits as a whole, without a contact law: incoming and outgoing speed, peak and duration.

A law must predict these quantities. Restitution and tangential ratio follow from them. Some recordings give
no other data: motion capture at 100 Hz records too few samples of the contact, and an accelerometer in a drop
records no positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.document import InputError
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.recorded_impact import (
    TrialImpact,
    deviation_of,
    find_impact,
    free_spans_s,
    noise_of,
)
from dart_flight.lab.identify.trials import Series, Trial

_WINDOW_S = 0.2  # duration of free flight that is used before the contact, and after it
_GUARD_S = 0.03  # time before and after the turn that is excluded until the contact's extent is known
_BEND_SD_M_S2 = 3.0  # standard deviation of a controller's acceleration before and after a wall hit
_DEVIATES = 4.0  # number of standard deviations beyond which a position is not in free flight
_MIN = 6  # minimum number of samples in contact for measuring duration and depth
_RINGS = 0.3  # ratio of undershoot to peak beyond which the sensor or frame rings
_DOMINATED = 0.5  # ratio of undershoot to peak beyond which the reading is useless; a wall only pushes
_BRIDGED_S = 0.015  # maximum pause within one contact, if one corner lands before the others
_DETECTED = 8.0  # number of standard deviations beyond which a force is a contact
_SHORTEST_FLIGHT_S = 0.04
_WEIGHTLESS_M_S2 = 5.0
_FALLS_S = 0.06  # minimum duration of free fall before a pulse


@dataclass(frozen=True, eq=False)
class MeasuredImpact:
    """One hit as measured; unknown values are None.

    Attributes:
        trial: the recording of the hit.
        normal_in_m_s: normal speed towards the wall at first touch, positive.
        begin_s, end_s: start and end of the contact in the recording, rounded outwards to samples.
        samples_in_contact: position samples in this interval.
        normal_out_m_s: normal speed away from the wall at the release.
        tangential_in_m_s, tangential_out_m_s: velocity along the wall before and after the contact.
        sd_in_m_s, sd_out_m_s, sd_tangential_m_s: standard deviations of these speeds.
        peak_force_n: largest measured normal force; None also if the sensor saturated.
        compression_m: largest displacement into the wall since first touch.
        notes: remarks for the reader, in sentences.
        turn: reversal from approach to departure in the recorded positions.
    """

    trial: Trial
    normal_in_m_s: float
    begin_s: float
    end_s: float
    samples_in_contact: int
    normal_out_m_s: float | None = None
    tangential_in_m_s: float | None = None
    tangential_out_m_s: float | None = None
    sd_in_m_s: float = 0.0
    sd_out_m_s: float = 0.0
    sd_tangential_m_s: float = 0.0
    peak_force_n: float | None = None
    contact_s: float | None = None
    compression_m: float | None = None
    notes: tuple[str, ...] = ()
    turn: TrialImpact | None = None


def measure_impact(trial: Trial, mass_kg: float) -> MeasuredImpact:
    """Measure the hit in a trial; a trial without `normal_m` must be a drop with `specific_force_m_s2`."""
    return _measure_motion(trial) if "normal_m" in trial.series else _measure_accelerometer(trial, mass_kg)


# --- positions ------------------------------------------------------------------------------------------


class _FreeFlightFit:
    """A parabola that is robustly fitted to the free flight before or after a contact.

    The fit is linear, so each reweighting has a closed solution and needs no solver.
    """

    def __init__(self, time: Array, value: Array, about_s: float, bend: float, bend_sd: float) -> None:
        self.about_s = about_s
        t = time - about_s
        design = np.stack((np.ones_like(t), t, 0.5 * t * t), axis=1)
        weight = np.ones_like(t)
        scale = 1e-6
        for _ in range(6):
            information = design.T @ (weight[:, None] * design) / scale**2
            information[2, 2] += 1.0 / bend_sd**2
            right = design.T @ (weight * value) / scale**2
            right[2] += bend / bend_sd**2
            self.line = np.linalg.solve(information, right)
            error = np.abs(value - design @ self.line)
            scale = max(deviation_of(error), 1e-6)
            weight = np.minimum(1.0, 2.0 * scale / np.maximum(error, 1e-12))
        self.noise = scale
        self.covariance = np.linalg.inv(information)

    def position(self, time: Array) -> Array:
        t = time - self.about_s
        result: Array = self.line[0] + t * (self.line[1] + 0.5 * t * self.line[2])
        return result

    def speed(self, time_s: float) -> tuple[float, float]:
        """Return the slope of the parabola at `time_s` and the standard deviation of this slope."""
        row = np.array([0.0, 1.0, time_s - self.about_s])
        return float(row @ self.line), math.sqrt(max(float(row @ self.covariance @ row), 0.0))


def _flights(
    series: Series, begin: float, end: float, spans: tuple[float, float], bend: float, bend_sd: float
) -> tuple[_FreeFlightFit, _FreeFlightFit] | None:
    time, value = series
    sides = []
    for chosen, about in (
        ((time >= begin - spans[0]) & (time < begin), begin),
        ((time > end) & (time <= end + spans[1]), end),
    ):
        if chosen.sum() < 4:
            return None
        sides.append(_FreeFlightFit(time[chosen], value[chosen], about, bend, bend_sd))
    return sides[0], sides[1]


def _measure_motion(trial: Trial) -> MeasuredImpact:
    impact = find_impact(trial)
    time, value = trial.normal
    step = float(np.median(np.diff(time)))
    falls = trial.acceleration_m_s2 < 0.0
    bend, bend_sd = (trial.acceleration_m_s2, 1e-3) if falls else (0.0, _BEND_SD_M_S2)
    spans = free_spans_s(
        trial.acceleration_m_s2, -impact.approach_m_s, impact.rebound_m_s, (_WINDOW_S, _WINDOW_S)
    )
    guard = max(_GUARD_S, 2.0 * step)
    begin, end = impact.turn_s - guard, impact.turn_s + guard
    for _ in range(3):
        flights = _flights(trial.normal, begin, end, spans, bend, bend_sd)
        if flights is None:
            raise InputError("too few samples around the impact", source=trial.name)
        begin, end = _extent(trial.normal, impact.turn_s, flights, impact.noise_m, step)
        before, after = flights
    speed_in, sd_in = before.speed(begin)
    speed_out, sd_out = after.speed(end)
    inside = (time > begin) & (time < end)
    count = int(inside.sum())
    enough = count >= _MIN
    along = _tangential_velocities(trial, begin, end)
    force = _measure_force(trial, begin, end)
    depth = float(before.position(np.array([begin]))[0] - value[inside].min()) if enough else None
    contact = end - begin - step if enough else None
    if force.contact_s is not None:
        contact = force.contact_s
    return MeasuredImpact(
        trial,
        max(-speed_in, 1e-3),
        begin,
        end,
        count,
        normal_out_m_s=max(speed_out, 0.0),
        tangential_in_m_s=along[0],
        tangential_out_m_s=along[1],
        sd_in_m_s=sd_in,
        sd_out_m_s=sd_out,
        sd_tangential_m_s=along[2],
        peak_force_n=force.peak_n,
        contact_s=contact,
        compression_m=depth if depth is not None and depth > 0.0 else None,
        notes=force.notes,
        turn=impact,
    )


def _extent(
    series: Series, turn_s: float, flights: tuple[_FreeFlightFit, _FreeFlightFit], noise_m: float, step: float
) -> tuple[float, float]:
    """Return the interval around the turn in which the positions deviate from free flight.

    The interval reaches at most 0.15 s before the turn and 0.15 s after it.
    """
    time, value = series
    at = int(np.searchsorted(time, turn_s))
    limits = []
    for flight, order in (
        (flights[0], range(min(at, time.size - 1), -1, -1)),
        (flights[1], range(at, time.size)),
    ):
        error = np.abs(value - flight.position(time))
        threshold = _DEVIATES * max(noise_m, flight.noise)
        limit = turn_s
        free = 0
        for i in order:
            if abs(time[i] - turn_s) > 0.15:
                break
            if error[i] > threshold:
                limit, free = float(time[i]), 0
            else:
                free += 1
                if free >= 3:  # one or two small errors may be a zero crossing inside the contact
                    break
        limits.append(limit)
    return min(limits[0], turn_s) - step, max(limits[1], turn_s) + step


def _tangential_velocities(
    trial: Trial, begin: float, end: float
) -> tuple[float | None, float | None, float]:
    """Return the velocities along the wall before and after contact, and the larger standard deviation."""
    for name, slope in (("tangential_m", True), ("tangential_m_s", False)):
        if name not in trial.series:
            continue
        bend_sd = _BEND_SD_M_S2 if slope else 0.1
        flights = _flights(trial.series[name], begin, end, (_WINDOW_S, _WINDOW_S), 0.0, bend_sd)
        if flights is None:
            continue
        if slope:
            (before, sd), (after, other) = flights[0].speed(begin), flights[1].speed(end)
            return before, after, max(sd, other)
        sides = [float(f.position(np.array([at]))[0]) for f, at in zip(flights, (begin, end), strict=True)]
        deviation = max(math.sqrt(float(f.covariance[0, 0])) for f in flights)
        return sides[0], sides[1], deviation
    return None, None, 0.0


# --- force ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ForcePulse:
    peak_n: float | None = None
    contact_s: float | None = None
    notes: tuple[str, ...] = ()


def _measure_force(trial: Trial, begin: float, end: float) -> _ForcePulse:
    """Return peak and duration of the measured normal force, around the contact from `begin` to `end`."""
    if "normal_force_n" not in trial.series:
        return _ForcePulse()
    time, value = trial.series["normal_force_n"]
    before = (time >= begin - 0.25) & (time < begin - 0.02)
    near = (time > begin - 0.05) & (time < end + 0.1)  # clocks may differ by some milliseconds
    if before.sum() < 4 or near.sum() < 3:
        return _ForcePulse(notes=(f"{trial.name}: too few samples of normal_force_n around the contact",))
    level = float(np.median(value[before]))
    noise = max(deviation_of(value[before] - level), 1e-6)
    return _pulse(trial.name, time[near], value[near] - level, noise, 4.0 * float(np.median(np.diff(time))))


def _pulse(name: str, time: Array, force: Array, noise: float, bridged_s: float) -> _ForcePulse:
    at = int(np.argmax(force))
    peak = float(force[at])
    if peak < _DETECTED * noise:
        return _ForcePulse(notes=(f"{name}: the force does not rise above its noise",))
    top = force >= peak - 1e-9 * abs(peak)
    clipped = bool((top[1:] & top[:-1]).any())
    rings = bool(force.min() < -_RINGS * peak)
    strong = np.flatnonzero(force > max(0.1 * peak, 4.0 * noise))
    gaps = np.diff(time[strong]) > max(bridged_s, 0.004)
    place = int(np.searchsorted(strong, at))
    lower = np.flatnonzero(gaps[:place])
    upper = np.flatnonzero(gaps[place:])
    first = strong[lower[-1] + 1] if lower.size else strong[0]
    last = strong[place + upper[0]] if upper.size else strong[-1]
    near = np.flatnonzero(force > 0.8 * peak)
    near = near[(near >= first) & (near <= last)]
    if near.size >= 6 and noise > 0.005 * peak:  # the maximum of noisy samples is biased
        t = time[near] - time[at]
        bend = np.polyfit(t, force[near], 2)
        if bend[0] < 0.0:
            peak = float(np.polyval(bend, -0.5 * bend[1] / bend[0]))
    notes = []
    if clipped:
        notes.append(f"{name}: the force is clipped at {peak:.3g} N; its peak is unknown")
    dominated = force.min() < -_DOMINATED * peak
    if dominated:
        notes.append(
            f"{name}: the force swings from {peak:.3g} N to {float(force.min()):.3g} N: the sensor mount "
            "resonates; the contact's peak and duration are unknown"
        )
    elif rings:
        notes.append(f"{name}: the force swings to the other sign: the sensor or the frame rings")
    return _ForcePulse(
        None if clipped or dominated else peak,
        None if rings or clipped else float(time[last] - time[first]) * 1.05,
        tuple(notes),
    )


# --- accelerometer --------------------------------------------------------------------------------------


def _measure_accelerometer(trial: Trial, mass_kg: float) -> MeasuredImpact:
    """Measure a drop from accelerometer readings along the normal.

    The readings show rest, fall, the pulse of the contact, flight, and the next pulse.
    """
    if trial.acceleration_m_s2 >= 0.0:
        raise InputError(
            "an accelerometer alone does not give the impact speed at a wall; record normal_m or normal_m_s, "
            "or use --drop",
            source=trial.name,
        )
    time, value = trial.series["specific_force_m_s2"]
    if time.size < 50:
        raise InputError(f"{time.size} samples are too few for an impact", source=trial.name)
    noise = noise_of(value)
    pulse_at = _find_pulse(time, value, noise, trial.name)
    level, noise = _weightless_level(time, value, pulse_at, noise, trial.name)
    reading, largest = value - level, float(value.max())
    notes = []
    if abs(level) > _WEIGHTLESS_M_S2:
        notes.append(f"{trial.name}: no free fall before the impact: the reading is {level:.1f} m/s², not 0")
    begin_at, end_at = _extent_of_pulse(
        time, reading, pulse_at, noise, max(_DETECTED * noise, 0.05 * largest)
    )
    inside = slice(max(begin_at - 1, 0), end_at + 2)
    pulse = _pulse(trial.name, time[inside], mass_kg * reading[inside], mass_kg * noise, _BRIDGED_S)
    speed, sd = _speed_of_fall(trial, _fall(time, reading, begin_at, noise), notes)
    out = _bounce(time, reading, end_at, max(_DETECTED * noise, 0.03 * largest))
    if out is not None and out > speed:
        notes.append(f"{trial.name}: the time until the next contact is too long for a rebound")
        out = None
    return MeasuredImpact(
        trial,
        speed,
        float(time[begin_at]),
        float(time[end_at]),
        end_at - begin_at + 1,
        normal_out_m_s=out,
        sd_in_m_s=sd,
        sd_out_m_s=0.005 * GRAVITY_M_S2,
        peak_force_n=pulse.peak_n,
        contact_s=pulse.contact_s,
        notes=(*notes, *pulse.notes),
    )


def _find_pulse(time: Array, value: Array, noise: float, name: str) -> int:
    """Return the index of the first sample of the contact's pulse.

    The pulse of a soft drop hardly exceeds 1 g, and the sensor also reads 1 g while the vehicle is held. The
    pulse must therefore follow free fall. If no pulse follows free fall, a pulse above 3 g is accepted.
    """
    largest = float(value.max())
    strong = np.flatnonzero(value > max(0.1 * largest, 15.0 * noise))
    for i in strong:
        before = value[(time > time[i] - _FALLS_S) & (time < time[i] - 0.005)]
        if before.size >= _MIN and abs(float(np.median(before))) < 0.5 * _WEIGHTLESS_M_S2:
            return int(i)
    if not strong.size or largest < max(20.0 * noise, 3.0 * GRAVITY_M_S2):
        raise InputError("no impact found: no pulse after free fall and none above 3 g", source=name)
    return int(strong[0])


def _weightless_level(
    time: Array, value: Array, pulse_at: int, noise: float, name: str
) -> tuple[float, float]:
    """Return the level and the noise of the readings in free fall; the ideal level is 0."""
    calm = (time > time[pulse_at] - 0.12) & (time < time[pulse_at] - 0.01)
    if calm.sum() < 8:
        raise InputError(
            "the recording begins too late: it contains no free fall before the impact", source=name
        )
    level = float(np.median(value[calm]))
    return level, max(noise, deviation_of(value[calm] - level))


def _extent_of_pulse(
    time: Array, reading: Array, pulse_at: int, noise: float, loud: float
) -> tuple[int, int]:
    """Return the first and last sample of the contact.

    If two corners touch one after the other, the force may be 0 between the two touches.
    """
    begin_at = end_at = pulse_at
    while begin_at > 0 and abs(reading[begin_at - 1]) > 4.0 * noise:
        begin_at -= 1
    for i in np.flatnonzero(np.abs(reading) > loud):
        if i <= pulse_at:
            continue
        if time[i] - time[end_at] > _BRIDGED_S:
            break
        end_at = int(i)
    return begin_at, end_at


def _speed_of_fall(trial: Trial, fall_s: float | None, notes: list[str]) -> tuple[float, float]:
    """Return the speed at the ground and its standard deviation, from the known height or the fall time."""
    height = trial.height_m
    if height is None and fall_s is None:
        raise InputError(
            "the speed of the fall is unknown: give --drop HEIGHT, or record the release", source=trial.name
        )
    if height is None:
        assert fall_s is not None
        return GRAVITY_M_S2 * fall_s, 0.01 * GRAVITY_M_S2
    speed = math.sqrt(2.0 * GRAVITY_M_S2 * height)
    if fall_s is not None and abs(GRAVITY_M_S2 * fall_s / speed - 1.0) > 0.2:
        notes.append(
            f"{trial.name}: falls for {fall_s:.3f} s; a drop from {height:g} m takes "
            f"{speed / GRAVITY_M_S2:.3f} s"
        )
    return speed, 0.01 * math.sqrt(GRAVITY_M_S2 * height)


def _smooth(value: Array, n: int) -> Array:
    total = np.cumsum(np.concatenate(([0.0], value)))
    half = max(n // 2, 1)
    i = np.arange(value.size)
    low, high = np.maximum(i - half, 0), np.minimum(i + half + 1, value.size)
    result: Array = (total[high] - total[low]) / (high - low)
    return result


def _fall(time: Array, reading: Array, begin_at: int, noise: float) -> float | None:
    """Return the duration of free fall before the contact; None if the release was not recorded."""
    step = float(np.median(np.diff(time[: begin_at + 1]))) if begin_at > 2 else 1e-3
    smooth = _smooth(reading[:begin_at], max(int(0.01 / step), 1))
    held = np.flatnonzero(smooth > 0.5 * GRAVITY_M_S2)
    held = held[time[held] < time[begin_at] - 0.05]
    if not held.size or smooth[max(held[-1] - int(0.05 / step), 0) : held[-1]].mean() < 0.6 * GRAVITY_M_S2:
        return None
    return float(time[begin_at] - time[held[-1]])


def _bounce(time: Array, reading: Array, end_at: int, threshold: float) -> float | None:
    """Return the rebound speed, from the time until the next contact; None if this time is unknown."""
    later = np.flatnonzero((np.abs(reading) > threshold) & (time > time[end_at] + _BRIDGED_S))
    if not later.size:
        return None
    duration = float(time[later[0]] - time[end_at])
    between = (time > time[end_at] + 0.3 * duration) & (time < time[later[0]] - 0.1 * duration)
    if duration < _SHORTEST_FLIGHT_S or between.sum() < 5:
        return None
    if abs(float(np.mean(reading[between]))) > _WEIGHTLESS_M_S2:
        return None
    return 0.5 * GRAVITY_M_S2 * duration
