"""Additional arrays of a recorded flight in the mission frame: attitude, setpoints, tracking, power, lock.

Times count in seconds as in `FlightArrays`. If the log lacks a signal, the array has length 0.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EscSample,
    ForceEstimate,
    LockPhase,
    LockState,
    Mode,
    Setpoint,
    StatusSample,
    TruthSample,
)
from dart_flight.config.mission import Mission
from dart_flight.core.sense.thrust_model import ThrustModel
from dart_flight.lab.flight_arrays import Array, FlightArrays, turned

V = TypeVar("V")
# Axes of the body in FRD.
_FORWARD_LEFT_UP = np.array([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)])


class Angles(NamedTuple):
    """Attitude in the mission frame, radians; arrays (n,).

    Attributes:
        time_s: times, s.
        yaw: counter-clockwise from the mission's x axis, unwrapped.
        pitch: positive with the nose up.
        roll: positive with the left side up.
    """

    time_s: Array
    yaw: Array
    pitch: Array
    roll: Array


class SetpointSeries(NamedTuple):
    """The sent setpoints; each is valid until the next.

    Attributes:
        time_s: times of sending, s, (n,).
        position, velocity: m and m/s, (n, 3); the velocity is NaN if none was sent.
        recovery: whether the setpoint is the response to an impact, (n,).
    """

    time_s: Array
    position: Array
    velocity: Array
    recovery: Array


class Power(NamedTuple):
    """Thrust and battery.

    Attributes:
        time_s, thrust_n: total thrust from the core's model (`core/sense/thrust_model.py`), arrays (n,).
        motor_time_s, lowest, highest: smallest and largest command to a motor, 0 to 1, arrays (m,).
        battery_time_s, battery_v: battery voltage, arrays (k,).
    """

    time_s: Array
    thrust_n: Array
    motor_time_s: Array
    lowest: Array
    highest: Array
    battery_time_s: Array
    battery_v: Array


def angles(course: FlightArrays, *, true: bool = False) -> Angles:
    """Return the estimated or true attitude, from the body's forward and left axes."""
    samples = course.topic_in_ned(TruthSample if true else AttitudeSample)
    q = samples["q_frd_to_ned"]
    forward, left, up = (course.from_ned(turned(q, axis)) for axis in _FORWARD_LEFT_UP)
    return Angles(
        samples.t_s,
        np.unwrap(np.arctan2(forward[:, 1], forward[:, 0])),
        np.arcsin(np.clip(forward[:, 2], -1.0, 1.0)),
        np.arctan2(left[:, 2], up[:, 2]),
    )


def setpoint_series(course: FlightArrays) -> SetpointSeries:
    sent = course.topic_in_ned(Setpoint)
    position, velocity = (
        course.places_from_ned(sent["position_ned"], sent.t_s),
        course.from_ned(sent["velocity_ned"]),
    )
    return SetpointSeries(sent.t_s, position, velocity, sent["recovery"])


def in_force(times: Array, at_s: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For each of `at_s`, return the index of the latest of `times` until then, and whether one exists."""
    index = np.searchsorted(times, at_s, side="right") - 1
    return np.maximum(index, 0), index >= 0


def tracking(course: FlightArrays) -> tuple[Array, Array, Array]:
    """Return the differences between the estimate and the active setpoint at each odometry sample.

    Returns:
        Times in s, and the magnitudes of the differences in position (m) and in velocity (m/s), arrays (n,).
            The velocity difference is NaN if the setpoint had no velocity.
    """
    motion, sent = course.estimated, setpoint_series(course)
    if not sent.time_s.size or not motion.time_s.size:
        return np.empty(0), np.empty(0), np.empty(0)
    index, known = in_force(sent.time_s, motion.time_s)
    away = np.linalg.norm(motion.position - sent.position[index], axis=1)
    slip = np.linalg.norm(motion.velocity - sent.velocity[index], axis=1)
    return motion.time_s[known], away[known], slip[known]


def power(course: FlightArrays, mission: Mission) -> Power:
    model = ThrustModel(mission.vehicle)
    thrust: list[tuple[float, float]] = []
    for record in course.records:
        if isinstance(record, ActuatorSample):
            model.add_commands(record)
        elif isinstance(record, EscSample):
            model.update_esc(record)
        elif isinstance(record, StatusSample):
            model.update_voltage(record.battery_v)
        elif isinstance(record, ForceEstimate):
            n = model.mean_over_tick(record.t_us)
            if model.source is not None:
                thrust.append((course.time_of(record.t_us), n))
    times, values = np.array(thrust, dtype=float).reshape(-1, 2).T
    sent, status = course.topic(ActuatorSample), course.topic(StatusSample)
    known = np.isfinite(status["battery_v"])
    return Power(
        times,
        values,
        sent.t_s,
        sent["motors"].min(axis=1, initial=1.0),
        sent["motors"].max(axis=1, initial=0.0),
        status.t_s[known],
        status["battery_v"][known],
    )


def stretches(moments: list[tuple[float, V]], end: float) -> list[tuple[float, float, V]]:
    """Return (begin, end, value) of (begin, value); a value ends when the next begins, the last at `end`."""
    stops = [t for t, _ in moments[1:]] + [end] if moments else []
    return [(t, stop, value) for (t, value), stop in zip(moments, stops, strict=True)]


def lock_stretches(course: FlightArrays, end_s: float) -> list[tuple[float, float, str]]:
    """Return (begin, end, state) of the lock: rigid, flexible, travelling, fault or unknown."""

    def name(state: LockState) -> str:
        known = state.mode.value if state.mode else "unknown"
        return known if state.phase is LockPhase.SETTLED else state.phase.value

    return stretches([(course.time_of(s.t_us), name(s)) for s in course.all(LockState)], end_s)


def lock_mode(course: FlightArrays, t_us: int) -> Mode | None:
    """Return the mode in which the lock was settled at a time, or None."""
    before = [s for s in course.all(LockState) if s.t_us <= t_us]
    return before[-1].mode if before and before[-1].phase is LockPhase.SETTLED else None
