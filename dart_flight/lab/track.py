"""The measurements of one flight as arrays in local NED, from a flight log or PX4's log, for calibration."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    FlightMode,
    ImuSample,
    LandedState,
    OdometrySample,
    StatusSample,
)
from dart_flight.config.document import InputError
from dart_flight.lab.flight_arrays import Array, turned
from dart_flight.lab.ulog import (
    MotorCommands,
    ULogFile,
    battery,
    columns,
    motor_commands,
    open_ulog,
    refuse_other_vehicles,
    seconds,
)
from dart_flight.recording.reader import Log, MissingDataError, read_log

_TOPICS = (
    "sensor_combined",
    "vehicle_attitude",
    "actuator_motors",
    "actuator_outputs",
    "vehicle_local_position",
    "battery_status",
    "vehicle_land_detected",
    "vehicle_status",
)
_NONE, _NO_ROWS, _NO_FOURS = np.empty(0), np.empty((0, 3)), np.empty((0, 4))
NO_MOTORS = MotorCommands(_NONE, _NO_FOURS, "")


class Track(msgspec.Struct):
    """Measurements of one flight; stamps are the autopilot's time in seconds. Missing measurements are empty.

    Attributes:
        source: name of the file, for messages.
        imu_s: stamps of the IMU, (n,).
        specific_force, rate: specific force (m/s2) and angular rate (rad/s) in FRD, (n, 3).
        motor_s, motors: stamps (m,), and motor commands (m, motors) from 0 to 1.
        attitude_s, q: stamps (a,) and attitudes, FRD to NED, (a, 4).
        position_s: stamps of PX4's estimate, (k,).
        position, velocity: estimates in m and m/s, (k, 3), NaN where PX4 had no estimate.
        voltage_s, voltage: stamps (v,) and battery voltage, V, (v,).
        ground: start and end of each interval on the ground, s.
        notes: remarks on the source and on omitted data.
    """

    source: str
    imu_s: Array
    specific_force: Array
    rate: Array
    motor_s: Array
    motors: Array
    attitude_s: Array = _NONE
    q: Array = _NO_FOURS
    position_s: Array = _NONE
    position: Array = _NO_ROWS
    velocity: Array = _NO_ROWS
    voltage_s: Array = _NONE
    voltage: Array = _NONE
    ground: list[tuple[float, float]] = msgspec.field(default_factory=list)
    notes: tuple[str, ...] = ()

    def to_ned(self, body: Array) -> Array:
        """Rotate vectors (n, 3) at the IMU's stamps from FRD to NED by the interpolated attitude."""
        # A quaternion and its negative are the same attitude, so choose the sign closer to the neighbour.
        signs = np.where(np.sum(self.q[1:] * self.q[:-1], axis=1) < 0.0, -1.0, 1.0)
        continuous = self.q * np.cumprod([1.0, *signs])[:, None]
        q = np.stack([np.interp(self.imu_s, self.attitude_s, part) for part in continuous.T], axis=1)
        return turned(q / np.linalg.norm(q, axis=1, keepdims=True), body)


def read_calibration_series(path: str | Path) -> Track:
    """Read one flight with its motor commands from a flight log (`.mcap`) or a PX4 ULog (`.ulg`)."""
    if Path(path).suffix.lower() != ".ulg":
        return _own_track(read_log(path))
    log = open_ulog(path, _TOPICS)
    refuse_other_vehicles(log)
    if log.first("sensor_combined") is None:
        raise InputError("the log has no sensor_combined", source=log.source)
    return calibration_series_of(log, motor_commands(log))


def _own_track(log: Log) -> Track:
    kinds = (ImuSample, ActuatorSample, AttitudeSample, OdometrySample, StatusSample)
    imu, sent, attitude, moved, status = (log[kind.topic] for kind in kinds)
    if not len(imu) or not len(sent):
        raise MissingDataError("the log has no IMU samples or no motor commands", source=log.source)
    # PX4's land detector may report a touch-down half a second late, so omit the whole landing.
    landing = status["flight_mode"] == FlightMode.LAND
    known = np.isfinite(status["battery_v"])
    return Track(
        source=log.source,
        imu_s=imu["t_us"] * 1e-6,
        specific_force=imu["specific_force_frd"],
        rate=imu["rate_frd"],
        motor_s=sent["t_us"] * 1e-6,
        motors=sent["motors"],
        attitude_s=attitude["t_us"] * 1e-6,
        q=attitude["q_frd_to_ned"],
        position_s=moved["t_us"] * 1e-6,
        position=moved["position_ned"],
        velocity=moved["velocity_ned"],
        voltage_s=status["t_us"][known] * 1e-6,
        voltage=status["battery_v"][known],
        ground=_intervals(status["t_us"] * 1e-6, landing | (status["landed"] == LandedState.ON_GROUND)),
    )


def calibration_series_of(log: ULogFile, motors: MotorCommands = NO_MOTORS) -> Track:
    """Return the measurements of an open ULog. `motors` are the motor commands read from the same log."""
    imu, attitude = log.first("sensor_combined"), log.first("vehicle_attitude")
    moved, volts = log.first("vehicle_local_position"), battery(log)
    notes = [motors.description, volts.problem]
    if log.first("vehicle_land_detected") is None:
        notes.append("no vehicle_land_detected: time on the ground is unknown")
    track = Track(
        source=log.source,
        imu_s=_NONE,
        specific_force=_NO_ROWS,
        rate=_NO_ROWS,
        motor_s=motors.time_s,
        motors=motors.values,
        voltage_s=volts.time_s,
        voltage=volts.volts,
        ground=_ground(log),
        notes=tuple(note for note in notes if note),
    )
    if imu is not None:
        track.imu_s = seconds(imu)
        track.specific_force, track.rate = columns(imu, "accelerometer_m_s2", 3), columns(imu, "gyro_rad", 3)
    if attitude is not None:
        q = columns(attitude, "q", 4)
        known = np.isfinite(q).all(axis=1)
        track.attitude_s, track.q = seconds(attitude)[known], q[known]
    if moved is not None:
        table = np.stack(
            [np.asarray(moved[n], dtype=float) for n in ("x", "y", "z", "vx", "vy", "vz")], axis=1
        )
        track.position_s, track.position, track.velocity = seconds(moved), table[:, :3], table[:, 3:]
    return track


def _ground(log: ULogFile) -> list[tuple[float, float]]:
    """Return the intervals in which PX4 reports a landed vehicle, `maybe_landed` or `ground_contact`."""
    landed = log.first("vehicle_land_detected")
    if landed is None:
        return []
    states = [landed[n] for n in ("landed", "maybe_landed", "ground_contact") if n in landed]
    return _intervals(seconds(landed), np.any(states, axis=0))


def _intervals(times: Array, holds: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return an interval (begin, end) in s for each sample at which `holds` is True.

    Each interval ends at the next sample; the interval of the last sample ends at infinity.
    """
    ends = np.append(times, np.inf)[1:]
    return list(zip(times[holds].tolist(), ends[holds].tolist(), strict=True))
