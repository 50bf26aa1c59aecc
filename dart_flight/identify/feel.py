"""What a PX4 log felt: the flight core's own estimator and detector on any multirotor's ULog.

A log holds no mass. Everything is computed as specific force, per kilogram, with the thresholds of the
configured vehicle in the same form, so that there is one operating point for all vehicles; newtons come
out where a mass is given. Specific thrust is fitted from the log itself: the curve of `thrust_curve` with
mass one, and its error on stretches that the fit has not seen. The samples made from the log go through
`core.sense.Senses`, the same code as in flight.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import ThrustSource, VehicleConfig
from dart_flight.core.sense.detector import Expected, ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.state import FlightState
from dart_flight.geometry import GRAVITY_M_S2, MissionFrame, Quaternion, advance_attitude
from dart_flight.identify.thrust_curve import Points, Track, ground_of, quiet_points, said_of, track_of
from dart_flight.recording.ulog import ULogFile, columns, open_ulog
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    OdometrySample,
)

Array = NDArray[np.float64]

TOPICS = (
    "sensor_combined",
    "vehicle_attitude",
    "vehicle_local_position",
    "actuator_motors",
    "actuator_outputs",
    "vehicle_land_detected",
    "battery_status",
)
# Topic -> rate in Hz from which on nothing is lost by it; below it is named.
WANTED_HZ = {
    "sensor_combined": 190.0,
    "vehicle_attitude": 15.0,
    "vehicle_local_position": 9.0,
    "actuator": 50.0,
}
_LEAST_IMU_HZ = 90.0  # below it a rigid contact is four samples
_LEAST_WINDOWS = 8
_FOLDS = 4  # held-out parts
_BLOCK = 5  # windows that are held out together, 2.5 s
_RISEN_M = 0.3  # above the ground: taken off
_TAKEOFF_S = 5.0  # ... where the height is not known
_TOUCHDOWN_S = 3.0  # an impact this long before PX4 says landed is the ground
_MOTOR_PERIOD_S = 0.01  # commands between the logged ones, on a straight line
_MOST_DRAG_PER_S = 1.0
_FAST_M_S = 99.0
_TRIAL_BEFORE_S, _TRIAL_AFTER_S = 0.5, 0.4
_PROFILE = (
    "SDLOG_PROFILE 17, the default (bit 0) with high rate (bit 4): motors and attitude as fast as they are "
    "computed"
)


class SpecificThrust(msgspec.Struct):
    """Thrust over mass at full command and the curve's factor.

    `held_out_percent` is the error of the thrust on stretches that were not used for the fit.
    """

    full_m_s2: float
    model_factor: float
    battery_exponent: float
    reference_v: float | None
    windows: int
    held_out_percent: float
    said: str


class Felt(msgspec.Struct):
    """One impact.

    Attributes:
        t_s: since the log's beginning, first contact.
        acceleration_m_s2: peak of the normal force over mass.
        force_n: peak of the normal force; None without a mass.
        direction_deg: where the force points, clockwise from north.
        clipped: the accelerometer was at full scale: a lower bound.
        kind: `impact`, or `touch-down` where PX4 says landed shortly after.
        speed_m_s: horizontal, before it.
        height_m: above where the log begins, by PX4's estimate; None where it has none.
    """

    t_s: float
    acceleration_m_s2: float
    force_n: float | None
    direction_deg: float
    clipped: bool
    kind: str
    speed_m_s: float
    height_m: float | None


class FeltFlight(msgspec.Struct):
    """What one log felt; newtons are None without a mass."""

    log: str
    px4_version: str | None
    begin_s: float  # of the log, on the autopilot's clock
    duration_s: float
    flight_s: float
    noise_n: float | None
    noise_m_s2: float  # of one sample and axis, median over the flight
    noise_short_m_s2: float  # of the means over the detector's two windows
    noise_long_m_s2: float
    threshold_n: float | None
    threshold_m_s2: float  # lowest in force, median over the flight
    floor_rigid_m_s2: float  # peaks from which on contacts are found for certain
    floor_flexible_m_s2: float
    drag_per_s: float
    thrust: SpecificThrust | None
    impacts: list[Felt]
    unknown: list[str]
    series: FeltSeries | None = None  # not in JSON


class FeltSeries(msgspec.Struct):
    """Force over mass in flight, north, east and down, and the threshold; for the report and for trials."""

    time_s: Array
    force_m_s2: Array  # (n, 3)
    threshold_m_s2: Array
    position_s: Array
    position_ned: Array  # (m, 3)


# --- thrust ------------------------------------------------------------------------------------------------


def fit_specific_thrust(track: Track, vehicle: VehicleConfig) -> SpecificThrust | str:
    """Specific thrust over the motor commands, from the quiet stretches of a flight.

    Returns:
        The curve, or why there is none.
    """
    lag = vehicle.thrust.motor_lag_s
    points = quiet_points(track, 1.0, lag)
    said = "slow flight"
    if len(points.force) < _LEAST_WINDOWS:
        slow, points = points, quiet_points(track, 1.0, lag, _FAST_M_S)
        said = "flight at any speed: what speed does to the propellers is in the residual"
        if len(points.force) < _LEAST_WINDOWS:
            return (
                f"{len(points.force)} quiet half seconds, at least {_LEAST_WINDOWS} are needed; rejected: "
                f"{said_of(slow.rejected) or 'none'}"
            )
    known = bool(np.isfinite(points.volts).all())
    reference = float(points.volts.mean()) if known else None
    # Without or with the voltage, with the configured factor or a fitted one: what predicts best.
    choices: list[Callable[[Points], Curve]] = []
    for by_volts in (False, True) if known else (False,):
        for fitted in (False, True):
            choices.append(_fitter(vehicle.thrust.model_factor, fitted, by_volts, reference or 1.0))
    scored = [(_held_out(points, fit), fit) for fit in choices]
    error, best = min(scored, key=lambda s: s[0])
    curve = best(points)
    return SpecificThrust(
        full_m_s2=curve.full * points.motors,
        model_factor=curve.factor,
        battery_exponent=curve.exponent,
        reference_v=reference,
        windows=len(points.force),
        held_out_percent=100.0 * error,
        said=said,
    )


class Curve(msgspec.Struct):
    """full (factor u^2 + (1 - factor) u) (volts / reference) ** exponent, summed over the motors."""

    full: float
    factor: float
    exponent: float
    reference: float

    def of(self, p: Points) -> Array:
        """Specific thrust at some points."""
        shape = self.factor * p.square + (1.0 - self.factor) * p.linear
        by_volts = (p.volts / self.reference) ** self.exponent if self.exponent else 1.0
        return np.asarray(self.full * shape * by_volts)


def _fitter(factor: float, fitted: bool, by_volts: bool, reference: float) -> Callable[[Points], Curve]:
    def fit(p: Points) -> Curve:
        a = factor
        if fitted:
            solution, _, rank, _ = np.linalg.lstsq(
                np.stack([p.square, p.linear], axis=1), p.force, rcond=None
            )
            total = float(solution.sum())
            a = float(np.clip(solution[0] / total, 0.0, 1.0)) if rank == 2 and total > 0.0 else factor
        shape = a * p.square + (1.0 - a) * p.linear
        exponent = 0.0
        if by_volts and float(p.volts.std()) > 1e-6:
            x = np.log(p.volts / reference)
            y = np.log(np.maximum(p.force, 1e-3) / np.maximum(shape, 1e-6))
            exponent = float(np.clip(np.polyfit(x, y, 1)[0], 0.0, 3.0))
            shape = shape * (p.volts / reference) ** exponent
        # The median: a bump that no test has seen is one window.
        return Curve(float(np.median(p.force / np.maximum(shape, 1e-6))), a, exponent, reference)

    return fit


def _held_out(points: Points, fit: Callable[[Points], Curve]) -> float:
    """Error of predictions of held-out stretches, root mean square, of the mean thrust."""
    part = (np.arange(len(points.force)) // _BLOCK) % min(_FOLDS, max(2, len(points.force) // _BLOCK))
    squares = []
    for fold in np.unique(part):
        train, test = _some(points, part != fold), _some(points, part == fold)
        if len(train.force):
            squares.append((fit(train).of(test) - test.force) ** 2)
    return float(np.sqrt(np.concatenate(squares).mean()) / points.force.mean())


def _some(p: Points, chosen: NDArray[np.bool_]) -> Points:
    return Points(
        p.square[chosen],
        p.linear[chosen],
        p.force[chosen],
        p.volts[chosen],
        p.start_s[chosen],
        p.motors,
        p.rejected,
    )


def fit_drag(log: ULogFile, flying: list[tuple[float, float]]) -> float:
    """Drag in 1/s: horizontal specific force across the thrust against the velocity; wind is not known.

    Half-second means over the whole flight, robust; 0 where the flight is too slow to tell.
    """
    imu, attitude = log.first("sensor_combined"), log.first("vehicle_attitude")
    position = log.first("vehicle_local_position")
    if imu is None or attitude is None or position is None:
        return 0.0
    t = np.asarray(imu["timestamp"], dtype=float) * 1e-6
    f = columns(imu, "accelerometer_m_s2", 3)
    stamps = np.asarray(attitude["timestamp"], dtype=float) * 1e-6
    q = columns(attitude, "q", 4)
    at = np.asarray(position["timestamp"], dtype=float) * 1e-6
    velocity = np.stack([np.asarray(position[n], dtype=float) for n in ("vx", "vy")], axis=1)
    pairs = []
    for begin, end in flying:
        for start in np.arange(begin, end - 0.5, 0.5):
            inside = slice(*np.searchsorted(t, (start, start + 0.5)))
            near, moving = np.searchsorted(stamps, start + 0.25), np.searchsorted(at, start + 0.25)
            if inside.stop - inside.start < 10 or near >= len(stamps) or moving >= len(at):
                continue
            fx, fy = f[inside, 0].mean(), f[inside, 1].mean()
            w, x, y, z = q[near]
            north = (1.0 - 2.0 * (y * y + z * z)) * fx + 2.0 * (x * y - w * z) * fy
            east = 2.0 * (x * y + w * z) * fx + (1.0 - 2.0 * (x * x + z * z)) * fy
            vn, ve = velocity[moving]
            speed = math.hypot(vn, ve)
            if math.isfinite(speed) and speed > 1.0:
                pairs.append((-(north * vn + east * ve) / speed, speed))
    if len(pairs) < _LEAST_WINDOWS:
        return 0.0
    table = np.array(pairs)
    return float(np.clip(np.median(table[:, 0] / table[:, 1]), 0.0, _MOST_DRAG_PER_S))


# --- samples -----------------------------------------------------------------------------------------------

Sample = ImuSample | AttitudeSample | OdometrySample | ActuatorSample


def samples_of(log: ULogFile, track: Track, curve: SpecificThrust | None) -> Iterator[Sample]:
    """The log as the core takes it, in the order of the stamps.

    Attitude comes at the IMU's rate: the logged one, carried on by the gyro. Commands are collective, already
    through the curve, on a straight line between the logged ones.
    """
    imu, attitude = log.first("sensor_combined"), log.first("vehicle_attitude")
    assert imu is not None
    assert attitude is not None
    stamps = np.asarray(imu["timestamp"]).astype(np.int64)
    f, rate = columns(imu, "accelerometer_m_s2", 3), columns(imu, "gyro_rad", 3)
    attitude_us, q = np.asarray(attitude["timestamp"]).astype(np.int64), columns(attitude, "q", 4)
    others: list[tuple[int, Sample]] = [*_odometry(log), *_collective(track, curve)]
    others.sort(key=lambda pair: pair[0])
    now: Quaternion | None = None
    behind, last, place = 0, int(stamps[0]), 0
    for i, t in enumerate(stamps.tolist()):
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
            if math.isfinite(w + x + y + z):
                now = advance_attitude((w, x, y, z), turning, (t - int(attitude_us[behind])) * 1e-6)
            behind += 1
        last = t
        if now is not None:
            yield AttitudeSample(t, t, now)
        if np.isfinite(f[i]).all():
            yield ImuSample(t, t, (float(f[i, 0]), float(f[i, 1]), float(f[i, 2])), turning)


def _odometry(log: ULogFile) -> Iterator[tuple[int, Sample]]:
    position = log.first("vehicle_local_position")
    if position is None:
        return
    names = ("x", "y", "z", "vx", "vy", "vz")
    table = np.stack([np.asarray(position[n], dtype=float) for n in names], axis=1)
    for t, row in zip(
        np.asarray(position["timestamp"]).astype(np.int64).tolist(), table.tolist(), strict=True
    ):
        if all(math.isfinite(v) for v in row):
            yield t, OdometrySample(t, t, (row[0], row[1], row[2]), (row[3], row[4], row[5]))


def _collective(track: Track, curve: SpecificThrust | None) -> Iterator[tuple[int, Sample]]:
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
        yield stamp, ActuatorSample(stamp, stamp, (value, value, value, value), stamp_is_estimated=False)


def vehicle_for(
    vehicle: VehicleConfig, log: ULogFile, curve: SpecificThrust | None, drag: float
) -> VehicleConfig:
    """The configured vehicle with this one's thrust and drag; mass and thresholds stay."""
    replace, mass = msgspec.structs.replace, vehicle.airframe.mass_kg
    full = curve.full_m_s2 * mass / 4.0 if curve else 2.0 * mass * GRAVITY_M_S2 / 4.0
    imu = log.first("sensor_combined") or {}
    tick = vehicle.imu.tick_s
    if "accelerometer_integral_dt" in imu:
        tick = float(np.median(imu["accelerometer_integral_dt"])) * 1e-6 or tick
    return replace(
        vehicle,
        airframe=replace(vehicle.airframe, drag_per_s=(drag, drag, 0.0)),
        thrust=replace(vehicle.thrust, full_n=full, model_factor=0.0),
        imu=replace(vehicle.imu, tick_s=tick),
        estimation=replace(
            vehicle.estimation,
            arm_vibration=None,
            thrust_source=ThrustSource.ACTUATOR,
            battery=replace(vehicle.estimation.battery, exponent=0.0),
        ),
    )


# --- the flight --------------------------------------------------------------------------------------------


def feel(path: str | Path, vehicle: VehicleConfig, mass_kg: float | None = None) -> FeltFlight:
    """What a log felt.

    Args:
        path: a ULog of PX4 1.9 or later.
        vehicle: thresholds and what else the estimator wants; its mass is that of its thresholds.
        mass_kg: of the vehicle that flew; None where it is not known.

    Raises:
        InputError: the file cannot be read, or lacks IMU or attitude.
    """
    return feel_log(open_ulog(path, TOPICS), vehicle, mass_kg)


Listener = Callable[[tuple[ForceEstimate, bool]], object]


def feel_log(
    log: ULogFile,
    vehicle: VehicleConfig,
    mass_kg: float | None = None,
    listen: Callable[[VehicleConfig, list[tuple[float, float]]], Listener] | None = None,
) -> FeltFlight:
    """As `feel`, of an opened log.

    `listen` is told the vehicle that the estimator has and the flights; what it returns takes every estimate
    and whether it was in the air.
    """
    unknown = _missing(log)
    try:
        track = track_of(log)
        fitted = fit_specific_thrust(track, vehicle)
    except InputError as error:
        if log.first("sensor_combined") is None:
            raise
        track, fitted = _without_motors(log), error.message
    unknown += [f"thrust: {fitted}; hover is assumed"] if isinstance(fitted, str) else []
    unknown += track.notes[1:]
    curve = None if isinstance(fitted, str) else fitted
    flying = flights_of(log, track)
    drag = fit_drag(log, flying)
    if not drag:
        unknown.append("drag: too slow a flight to tell it")
    unknown.append("wind, and the accelerometer's bias where the vehicle does not hover")
    if mass_kg is None:
        unknown.append("mass: forces are in m/s2, with --mass also in newton")
    made = vehicle_for(vehicle, log, curve, drag)
    pass_ = Pass(made, flying, listen(made, flying) if listen is not None else None)
    for sample in samples_of(log, track, curve):
        pass_.take(sample)
    return pass_.felt(log, track, curve, drag, mass_kg, unknown)


def _missing(log: ULogFile) -> list[str]:
    """Topics that are not there or too slow, in words.

    Raises:
        InputError: without IMU or attitude nothing can be felt.
    """
    for name in ("sensor_combined", "vehicle_attitude"):
        if log.first(name) is None:
            raise InputError(f"has no {name}: nothing can be felt", source=log.source)
    rate = log.rate_hz("sensor_combined") or 0.0
    if rate < _LEAST_IMU_HZ:
        raise InputError(
            f"sensor_combined at {rate:.0f} Hz: a rigid contact of 50 ms needs {_LEAST_IMU_HZ:.0f}; log with "
            f"{_PROFILE}",
            source=log.source,
        )
    out, slow = [], False
    for name, wanted in WANTED_HZ.items():
        topics = ("actuator_motors", "actuator_outputs") if name == "actuator" else (name,)
        rates = [r for topic in topics if (r := log.rate_hz(topic)) is not None]
        if not rates:
            out.append(f"no {' or '.join(topics)}")
            slow = True
        elif max(rates) < wanted:
            out.append(f"{' or '.join(topics)} at {max(rates):.0f} Hz, {wanted:.0f} would do")
            slow = True
    if log.first("vehicle_land_detected") is None:
        out.append("no vehicle_land_detected: the whole log counts as flight")
    if log.gaps_s > 0.0:
        out.append(f"{log.gaps_s:.2f} s that the logger lost")
    return out + [f"what would help: {_PROFILE}"] * slow


def _without_motors(log: ULogFile) -> Track:
    imu = log.first("sensor_combined")
    assert imu is not None
    empty = np.empty(0)
    return Track(
        source=log.source,
        imu_s=np.asarray(imu["timestamp"], dtype=float) * 1e-6,
        specific_force=columns(imu, "accelerometer_m_s2", 3),
        rate=columns(imu, "gyro_rad", 3),
        motor_s=empty,
        motors=np.empty((0, 4)),
        velocity_s=empty,
        velocity=np.empty((0, 3)),
        voltage_s=empty,
        voltage=empty,
        ground=ground_of(log),
    )


def flights_of(log: ULogFile, track: Track) -> list[tuple[float, float]]:
    """From, to in seconds: in the air, from 0.3 m up to what PX4 calls landed."""
    begin, end = float(track.imu_s[0]), float(track.imu_s[-1])
    landed = log.first("vehicle_land_detected")
    if landed is None:
        return [(begin, end)]
    stamps = np.asarray(landed["timestamp"], dtype=float) * 1e-6
    air: list[list[float]] = []
    for t, state, until in zip(stamps, landed["landed"], [*stamps[1:], end], strict=True):
        if state:
            continue
        if air and air[-1][1] == t:
            air[-1][1] = float(until)
        else:
            air.append([float(t), float(until)])
    # What is in the air when the log begins has taken off before.
    taken_off = [(a if a <= begin + 0.1 else _off_the_ground(log, a, b), b) for a, b in air]
    return [(a, b) for a, b in taken_off if b > a]


def _off_the_ground(log: ULogFile, begin: float, end: float) -> float:
    """When a flight has risen a little: PX4's land detector says "in the air" at the first thrust."""
    position = log.first("vehicle_local_position")
    if position is None:
        return begin + _TAKEOFF_S
    t = np.asarray(position["timestamp"], dtype=float) * 1e-6
    inside = (t >= begin) & (t <= end)
    height = -np.asarray(position["z"], dtype=float)[inside]
    if not len(height):
        return begin + _TAKEOFF_S
    risen = np.flatnonzero(height > height[0] + _RISEN_M)
    return float(t[inside][risen[0]]) if len(risen) else end


class Pass:
    """Estimator and detector over one log.

    Args:
        vehicle: as `vehicle_for` has it.
        flying: stretches in which an impact is one, seconds.
        listener: takes every estimate, with whether it was in the air.
    """

    def __init__(
        self,
        vehicle: VehicleConfig,
        flying: list[tuple[float, float]],
        listener: Listener | None = None,
    ) -> None:
        self._mass, self._flying, self._listener = vehicle.airframe.mass_kg, flying, listener
        self.estimator, self.detector = ForceEstimator(vehicle), ImpactDetector(vehicle)
        self.state = FlightState()
        self.state.anchor(MissionFrame())
        self._place = 0
        self.rows: list[tuple[float, float, float, float, float]] = []  # time, north, east, down, threshold
        self._noise: list[tuple[float, float, float, float, float]] = []
        self.onsets: list[ImpactOnset] = []
        self.peaks: list[ImpactPeak] = []

    def in_the_air(self, t_s: float) -> bool:
        """Whether this is within one of the flights; moments do not go back."""
        while self._place < len(self._flying) and self._flying[self._place][1] < t_s:
            self._place += 1
        return self._place < len(self._flying) and self._flying[self._place][0] <= t_s

    def take(self, sample: Sample) -> None:
        """The next sample of the log."""
        if isinstance(sample, AttitudeSample):
            if self.state.take_attitude(sample):
                self.estimator.take_attitude(sample)
        elif isinstance(sample, OdometrySample):
            self.state.take_odometry(sample)
        elif isinstance(sample, ActuatorSample):
            self.estimator.thrust.take_actuator(sample)
        elif self.state.take_imu(sample):
            self._feel(sample)

    def _feel(self, sample: ImuSample) -> None:
        detector, flying = self.detector, self.in_the_air(sample.t_us * 1e-6)
        # What is learnt on the ground says nothing of the flight.
        estimate = self.estimator.estimate(sample, self.state, detector.in_contact or not flying)
        if estimate is None:
            return
        if self._listener is not None:
            self._listener((estimate, flying))
        for event in detector.update(estimate, sample.t_us, self.state, Expected(flying)):
            if isinstance(event, ImpactOnset):
                self.onsets.append(event)
            elif isinstance(event, ImpactPeak):
                self.peaks.append(event)
        if flying:
            self._keep(estimate)

    def _keep(self, estimate: ForceEstimate) -> None:
        fx, fy, fz = estimate.force_mission
        m, thresholds = self._mass, self.detector.thresholds_n()
        # The mission frame here is north, west, up.
        self.rows.append((estimate.t_us * 1e-6, fx / m, -fy / m, -fz / m, min(thresholds) / m))
        if len(self.rows) % 50 == 0:
            short, long = self.detector.noise_n
            self._noise.append(
                (
                    self.estimator.hover.noise_m_s2,
                    short / m,
                    long / m,
                    self.detector.floor_n(0.05) / m,
                    self.detector.floor_n(0.15) / m,
                )
            )

    def felt(
        self,
        log: ULogFile,
        track: Track,
        curve: SpecificThrust | None,
        drag: float,
        mass_kg: float | None,
        unknown: list[str],
    ) -> FeltFlight:
        """The result."""
        begin = float(track.imu_s[0])
        table = np.array(self.rows).reshape(-1, 5)
        noise = (
            np.median(np.array(self._noise).reshape(-1, 5), axis=0) if self._noise else np.full(5, math.nan)
        )
        threshold = float(np.median(table[:, 4])) if len(table) else math.nan
        position = log.first("vehicle_local_position")
        where = np.empty((0, 3)), np.empty(0)
        if position is not None:
            where = (
                np.stack([np.asarray(position[n], dtype=float) for n in ("x", "y", "z")], axis=1),
                np.asarray(position["timestamp"], dtype=float) * 1e-6 - begin,
            )
        return FeltFlight(
            log=log.source,
            px4_version=".".join(str(v) for v in log.version) if log.version else None,
            begin_s=begin,
            duration_s=float(track.imu_s[-1]) - begin,
            flight_s=sum(b - a for a, b in self._flying),
            noise_n=None if mass_kg is None else mass_kg * float(noise[0]),
            noise_m_s2=float(noise[0]),
            noise_short_m_s2=float(noise[1]),
            noise_long_m_s2=float(noise[2]),
            threshold_n=None if mass_kg is None else mass_kg * threshold,
            threshold_m_s2=threshold,
            floor_rigid_m_s2=float(noise[3]),
            floor_flexible_m_s2=float(noise[4]),
            drag_per_s=drag,
            thrust=curve,
            impacts=[self._impact(o, begin, track.ground, where, mass_kg) for o in self.onsets],
            unknown=unknown,
            series=FeltSeries(table[:, 0] - begin, table[:, 1:4], table[:, 4], where[1], where[0]),
        )

    def _impact(
        self,
        onset: ImpactOnset,
        begin: float,
        ground: list[tuple[float, float]],
        where: tuple[Array, Array],
        mass_kg: float | None,
    ) -> Felt:
        peak = next((p for p in self.peaks if p.detected_us >= onset.t_us), None)
        fx, fy = onset.force_mission[:2] if peak is None else peak.normal
        size = math.hypot(fx, fy) if peak is None else peak.normal_force_n
        t = onset.first_us * 1e-6
        down_m = where[0][:, 2]
        height = float(down_m[0] - np.interp(t - begin, where[1], down_m)) if len(down_m) else math.nan
        down = any(a - _TOUCHDOWN_S <= t <= b for a, b in ground)
        return Felt(
            t_s=t - begin,
            acceleration_m_s2=size / self._mass,
            force_n=None if mass_kg is None else size / self._mass * mass_kg,
            direction_deg=math.degrees(math.atan2(-fy, fx)) % 360.0,
            clipped=peak is not None and peak.clipped,
            kind="touch-down" if down else "impact",
            speed_m_s=math.hypot(onset.velocity_mission[0], onset.velocity_mission[1]),
            height_m=height if math.isfinite(height) else None,
        )


# --- trials ------------------------------------------------------------------------------------------------


def write_trials(flight: FeltFlight, folder: Path) -> list[Path]:
    """Every impact of a flight as a CSV trial for `identify`, in the collision frame of its own force.

    The plane of first touch is taken where the vehicle was at the onset. Without a mass there is no force
    column.
    """
    series, written = flight.series, []
    if series is None:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    mass = flight.threshold_n / flight.threshold_m_s2 if flight.threshold_n is not None else None
    for number, impact in enumerate((i for i in flight.impacts if i.kind == "impact"), 1):
        heading = math.radians(impact.direction_deg)
        normal = np.array([math.cos(heading), math.sin(heading)])
        tangent = np.array([-normal[1], normal[0]])
        time = series.time_s - impact.t_s
        near = (time > -_TRIAL_BEFORE_S) & (time < _TRIAL_AFTER_S)
        if not near.any() or len(series.position_s) < 2:
            continue
        at = series.time_s[near]
        place = np.stack(
            [np.interp(at, series.position_s, series.position_ned[:, k]) for k in range(3)], axis=1
        )
        touch = [np.interp(impact.t_s, series.position_s, series.position_ned[:, k]) for k in range(3)]
        moved = place - np.array(touch)
        rows = {
            "time_s": time[near],
            "normal_m": moved[:, :2] @ normal,
            "tangential_m": moved[:, :2] @ tangent,
            "vertical_m": -place[:, 2],
        }
        if mass is not None:
            force = mass * series.force_m_s2[near, :2]
            rows["normal_force_n"], rows["tangential_force_n"] = force @ normal, force @ tangent
        path = folder / f"{Path(flight.log).stem}_impact{number}.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(rows)
            writer.writerows(zip(*([f"{v:.6f}" for v in column] for column in rows.values()), strict=True))
        written.append(path)
    return written
