"""More of a recorded flight as arrays, in the mission frame: attitude, set-points, tracking, thrust, battery.

Times are seconds of the flight's `FlightArrays`; a signal that the log does not have is an array of length 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import MissionFrame, Quaternion, rotate
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EscSample,
    ForceEstimate,
    Record,
    SetPoint,
    StatusSample,
    TruthSample,
)
from dart_flight.config.mission import Mission
from dart_flight.core.sense.thrust import ThrustModel
from dart_flight.lab.flight_arrays import Array, FlightArrays


class Angles(NamedTuple):
    """Attitude in the mission frame, radians; arrays (n,).

    Attributes:
        time_s: of each.
        yaw: counter-clockwise from the mission's x axis, without jumps of a turn.
        pitch: nose up.
        roll: left side up.
    """

    time_s: Array
    yaw: Array
    pitch: Array
    roll: Array


class SetPoints(NamedTuple):
    """What was sent; each holds until the next.

    Attributes:
        time_s: (n,).
        position, velocity: (n, 3), the velocity NaN where none was sent.
        recovery: (n,), whether it answers an impact.
    """

    time_s: Array
    position: Array
    velocity: Array
    recovery: Array


class Tracking(NamedTuple):
    """Distance from the set-point in force, at each odometry sample; arrays (n,).

    Attributes:
        time_s: of each.
        position_m: of the position.
        velocity_m_s: of the velocity, NaN where the set-point had none.
    """

    time_s: Array
    position_m: Array
    velocity_m_s: Array


class Power(NamedTuple):
    """Thrust and battery.

    Attributes:
        time_s, thrust_n: total thrust by the core's model (`core/sense/thrust.py`), arrays (n,).
        motor_time_s, lowest, highest: least and largest command to a motor, 0 to 1, arrays (m,).
        battery_time_s, battery_v: arrays (k,).
    """

    time_s: Array
    thrust_n: Array
    motor_time_s: Array
    lowest: Array
    highest: Array
    battery_time_s: Array
    battery_v: Array


def angles(course: FlightArrays, *, true: bool = False) -> Angles:
    """The estimated attitude, or the simulated vehicle's."""
    frame = course.frame
    samples: Iterable[AttitudeSample | TruthSample] = (
        course.all(TruthSample) if true else course.all(AttitudeSample)
    )
    if frame is None:
        samples = ()
    rows = [(course.time_of(s.t_us), *_angles(frame, s.q_frd_to_ned)) for s in samples if frame]
    table = np.array(rows, dtype=float) if rows else np.empty((0, 4))
    return Angles(table[:, 0], np.unwrap(table[:, 1]), table[:, 2], table[:, 3])


def _angles(frame: MissionFrame, q: Quaternion) -> tuple[float, float, float]:
    """Yaw, pitch and roll of the body's forward and left axes seen in the mission frame."""
    fx, fy, fz = frame.vector_from_ned(rotate(q, (1.0, 0.0, 0.0)))
    left = frame.vector_from_ned(rotate(q, (0.0, -1.0, 0.0)))
    up = frame.vector_from_ned(rotate(q, (0.0, 0.0, -1.0)))
    return math.atan2(fy, fx), math.asin(max(-1.0, min(1.0, fz))), math.atan2(left[2], up[2])


def set_points(course: FlightArrays) -> SetPoints:
    """Every set-point that was sent."""
    frame = course.frame
    records = course.all(SetPoint) if frame is not None else []
    none = (math.nan, math.nan, math.nan)
    position, velocity = [], []
    for r in records:
        assert frame is not None
        position.append(frame.point_from_ned(r.position_ned))
        velocity.append(none if r.velocity_ned is None else frame.vector_from_ned(r.velocity_ned))
    return SetPoints(
        np.array([course.time_of(r.t_us) for r in records], dtype=float),
        np.array(position, dtype=float).reshape(-1, 3),
        np.array(velocity, dtype=float).reshape(-1, 3),
        np.array([r.recovery for r in records], dtype=bool),
    )


def in_force(times: Array, at_s: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Index of the last of `times` that is not after each of `at_s`, and whether there is one."""
    index = np.searchsorted(times, at_s, side="right") - 1
    return np.maximum(index, 0), index >= 0


def tracking(course: FlightArrays) -> Tracking:
    """How far the estimated position and velocity are from the set-point in force."""
    motion, sent = course.estimated, set_points(course)
    if not sent.time_s.size or not motion.time_s.size:
        return Tracking(np.empty(0), np.empty(0), np.empty(0))
    index, known = in_force(sent.time_s, motion.time_s)
    away = np.linalg.norm(motion.position - sent.position[index], axis=1)
    slip = np.linalg.norm(motion.velocity - sent.velocity[index], axis=1)
    return Tracking(motion.time_s[known], away[known], slip[known])


def power(course: FlightArrays, mission: Mission) -> Power:
    """Thrust as the core reckons it, the motors' commands, and the battery."""
    model = ThrustModel(mission.vehicle)
    thrust: list[tuple[float, float]] = []
    for record in course.records:
        _feed(model, record)
        if isinstance(record, ForceEstimate):
            n = model.mean_over_tick(record.t_us)
            if model.source is not None:
                thrust.append((course.time_of(record.t_us), n))
    motors = [(course.time_of(s.t_us), min(s.motors), max(s.motors)) for s in course.all(ActuatorSample)]
    battery = [
        (course.time_of(s.t_us), s.battery_v) for s in course.all(StatusSample) if s.battery_v is not None
    ]
    return Power(*_columns(thrust, 2), *_columns(motors, 3), *_columns(battery, 2))


def _feed(model: ThrustModel, record: Record) -> None:
    if isinstance(record, ActuatorSample):
        model.take_actuator(record)
    elif isinstance(record, EscSample):
        model.take_esc(record)
    elif isinstance(record, StatusSample):
        model.take_voltage(record.battery_v)


def _columns(rows: Sequence[tuple[float, ...]], count: int) -> Iterable[Array]:
    table = np.array(rows, dtype=float).reshape(-1, count)
    return (table[:, i] for i in range(count))
