"""The samples of a ULog as inputs of the flight core, and the vehicle configuration for these samples."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2, Quaternion, advance_attitude
from dart_flight.base.records import ActuatorSample, AttitudeSample, ImuSample, OdometrySample
from dart_flight.config.vehicle import Thrust, ThrustSource, VehicleConfig
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.inspect.specific_thrust import SpecificThrust
from dart_flight.lab.track import Track
from dart_flight.lab.ulog import ULogFile

_MOTOR_PERIOD_S = 0.01  # interpolation step between logged commands

Sample = ImuSample | AttitudeSample | OdometrySample | ActuatorSample


def samples_of(track: Track, curve: SpecificThrust | None, motors: int) -> Iterator[Sample]:
    """Yield the samples of a log in the order of their stamps.

    The gyro propagates the logged attitude, so that every IMU sample has an attitude sample. Every motor gets
    the collective command, which is converted by the curve and interpolated between logged values.
    """
    stamps, attitude_us = _us(track.imu_s), _us(track.attitude_s)
    f, rate, q = track.specific_force, track.rate, track.q
    others: list[tuple[int, Sample]] = [*_odometry(track), *_collective(track, curve, motors)]
    others.sort(key=lambda pair: pair[0])
    now: Quaternion | None = None
    behind, last, place = 0, stamps[0], 0
    for i, t in enumerate(stamps):
        if t <= last and i:
            continue
        while place < len(others) and others[place][0] <= t:
            yield others[place][1]
            place += 1
        turning = (float(rate[i, 0]), float(rate[i, 1]), float(rate[i, 2]))
        if now is not None:
            now = advance_attitude(now, turning, (t - last) * 1e-6)
        while behind < len(attitude_us) and attitude_us[behind] <= t:
            w, x, y, z = (float(v) for v in q[behind])
            now = advance_attitude((w, x, y, z), turning, (t - attitude_us[behind]) * 1e-6)
            behind += 1
        last = t
        if now is not None:
            yield AttitudeSample(t, t, now)
        if np.isfinite(f[i]).all():
            yield ImuSample(t, t, (float(f[i, 0]), float(f[i, 1]), float(f[i, 2])), turning)


def _us(time_s: Array) -> list[int]:
    stamps: list[int] = np.rint(time_s * 1e6).astype(np.int64).tolist()
    return stamps


def _odometry(track: Track) -> Iterator[tuple[int, Sample]]:
    known = np.isfinite(track.position).all(axis=1) & np.isfinite(track.velocity).all(axis=1)
    rows = (track.position[known].tolist(), track.velocity[known].tolist())
    for t, place, velocity in zip(_us(track.position_s[known]), *rows, strict=True):
        yield t, OdometrySample(t, t, tuple(place), tuple(velocity))


def _collective(track: Track, curve: SpecificThrust | None, motors: int) -> Iterator[tuple[int, Sample]]:
    if curve is None or len(track.motor_s) < 2:
        return
    u = track.motors
    share = (curve.model_factor * u * u + (1.0 - curve.model_factor) * u).mean(axis=1)
    fine = np.arange(track.motor_s[0], track.motor_s[-1], _MOTOR_PERIOD_S)
    values = np.interp(fine, track.motor_s, share)
    if curve.reference_v is not None and curve.battery_exponent:
        volts = np.interp(fine, track.voltage_s, track.voltage)
        values = values * (volts / curve.reference_v) ** curve.battery_exponent
    for t, value in zip(fine.tolist(), values.tolist(), strict=True):
        stamp = round(t * 1e6)
        yield stamp, ActuatorSample(stamp, stamp, (value,) * motors, stamp_is_estimated=False)


def vehicle_for(
    vehicle: VehicleConfig, log: ULogFile, curve: SpecificThrust | None, drag: float
) -> VehicleConfig:
    """Return the configured vehicle with the thrust, drag and IMU interval of the log."""
    replace, mass = msgspec.structs.replace, vehicle.airframe.mass_kg
    all_n = mass * (curve.full_m_s2 if curve else 2.0 * GRAVITY_M_S2)
    imu = log.first("sensor_combined") or {}
    tick = vehicle.imu.tick_s
    if "accelerometer_integral_dt" in imu:
        interval = np.asarray(imu["accelerometer_integral_dt"])
        # PX4 versions before 1.7 logged seconds.
        tick = float(np.median(interval)) * (1.0 if interval.dtype.kind == "f" else 1e-6) or tick
    return replace(
        vehicle,
        airframe=replace(vehicle.airframe, drag_per_s=(drag, drag, 0.0)),
        thrust=Thrust(vehicle.thrust.motor_lag_s, all_n / len(vehicle.airframe.motors), 0.0),
        imu=replace(vehicle.imu, tick_s=tick),
        estimation=replace(
            vehicle.estimation,
            arm_vibration=None,
            thrust_source=ThrustSource.ACTUATOR,
            battery=replace(vehicle.estimation.battery, exponent=0.0),
        ),
    )
