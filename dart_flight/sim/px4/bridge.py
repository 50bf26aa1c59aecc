"""The plant as PX4's external simulator: HIL messages over TCP, in lockstep.

PX4 connects as a TCP client. It receives one HIL_SENSOR per tick and answers with one HIL_ACTUATOR_CONTROLS.
PX4's clock is the `time_usec` of HIL_SENSOR. `HilLink` implements this exchange. `Px4Vehicle` contains the
plant, its sensors and the lock's servo. `sim/px4/launch.py` starts and stops PX4.
"""

from __future__ import annotations

import contextlib
import math
import random
import socket
import struct
import time
from typing import Any, Protocol

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.errors import FlightError
from dart_flight.base.geometry import Quaternion, Vec3, add, scale
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import LockDriver, Motor, VehicleConfig
from dart_flight.lock.drivers.px4_output import actuator_pulse_us
from dart_flight.sim.embedded_autopilot import TICK_US
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import make_plant
from dart_flight.sim.sensors import (
    ATTITUDE_NOISE_RAD,
    GPS_QUALITIES,
    POSE_NOISE_M,
    Barometer,
    GpsFix,
    GpsReceiver,
    ImuSensor,
    Magnetometer,
    PoseSensor,
)
from dart_flight.sim.simulated_vehicle import LockServo
from dart_flight.sim.wind import Wind

_PX4_G_M_S2 = 9.80665  # PX4's CONSTANTS_ONE_G, which differs from our gravity

# PX4 stores the simulated accelerometer as 16-bit counts of 1/2048 g without saturation, so a larger reading
# changes its sign. PX4 truncates the fraction and counts only +32767 as clipped, hence the 0.4.
ACCELEROMETER_LIMIT_M_S2 = 32767.4 / 2048.0 * _PX4_G_M_S2
GYRO_LIMIT_RAD_S = math.radians(2000.0 * 32767.0 / 32768.0)

# PX4's home position near Zurich, with the magnetic field of PX4's world model there.
HOME_LAT_DEG, HOME_LON_DEG, HOME_ALTITUDE_M = 47.397742, 8.545594, 488.0
HOME_FIELD_GAUSS: Vec3 = (0.21475, 0.00797, 0.42817)
_EARTH_RADIUS_M = 6371000.0  # PX4's projection uses the same sphere

_STEPS_PER_TICK = TICK_US // 1000
_SLOW_EVERY = 5  # ticks: magnetometer and barometer at 50 Hz
_ACCELEROMETER, _GYRO, _MAGNETOMETER, _BAROMETER = 0x007, 0x038, 0x1C0, 0x1A00
ARMED = 128
_BOOT_WAIT_S = 0.004  # timeout per tick until PX4's first answer; PX4 does not answer while it boots
_ANSWER_WAIT_S = 5.0


class Px4LostError(FlightError):
    """PX4 has closed the connection or does not answer."""


class Controls(msgspec.Struct, frozen=True):
    """One HIL_ACTUATOR_CONTROLS: motor values 0 to 1, others -1 to 1; all are zero while PX4 is disarmed."""

    time_us: int
    armed: bool
    values: tuple[float, ...]


class SensorLink(Protocol):
    """Link that carries the plant's measurements to PX4, with or without lockstep."""

    @property
    def controls(self) -> Controls:
        """The last outputs received from PX4."""

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        """Send one tick's messages; return PX4's outputs for the next tick."""


class HilLink:
    """The simulator's end of PX4's TCP connection; methods raise Px4LostError if the connection is gone."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._pack = mavlink.MAVLink(None, srcSystem=1, srcComponent=200)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self.controls = Controls(0, False, (0.0,) * 16)
        self.locked = False  # whether PX4 has begun to answer

    def send(self, *messages: Any) -> None:
        """Send messages with a single write."""
        data = b""
        for message in messages:
            data += message.pack(self._pack)
            self._pack.seq = (self._pack.seq + 1) % 256
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise Px4LostError(f"PX4 closed the simulator connection ({error.strerror})") from None

    def exchange(self, sensor: Any, *others: Any) -> Controls:
        """Send one tick's messages and wait for PX4's answer; raise Px4LostError after 5 s.

        Before PX4's first answer, the wait is short, and the outputs of a disarmed vehicle are returned.
        """
        # PX4 stamps poses and fixes with its clock, which the later HIL_SENSOR advances.
        self.send(*others, sensor)
        begun_s = time.monotonic()
        while not self._receive_answer(sensor.time_usec, begun_s + self._patience_s):
            if time.monotonic() < begun_s + self._patience_s:
                continue
            if self.locked:
                raise Px4LostError(f"PX4 has not answered for {_ANSWER_WAIT_S:g} s")
            break
        return self.controls

    @property
    def _patience_s(self) -> float:
        """Longest wait for an answer; PX4's first answer also extends the wait in progress."""
        return _ANSWER_WAIT_S if self.locked else _BOOT_WAIT_S

    def _receive_answer(self, time_us: int, deadline: float) -> bool:
        self._socket.settimeout(max(1e-4, deadline - time.monotonic()))
        try:
            data = self._socket.recv(65536)
        except TimeoutError:
            return False
        except OSError as error:
            raise Px4LostError(f"PX4 closed the simulator connection ({error.strerror})") from None
        if not data:
            raise Px4LostError("PX4 closed the simulator connection")
        answered = False
        with contextlib.suppress(mavlink.MAVError, struct.error):
            for message in self._parser.parse_buffer(data) or []:
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    armed = bool(message.mode & ARMED)
                    self.controls = Controls(message.time_usec, armed, tuple(message.controls))
                    self.locked = True
                    answered = answered or message.time_usec >= time_us
        return answered

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()


def with_motors(mission: Mission, motors: tuple[Motor, ...]) -> Mission:
    airframe = msgspec.structs.replace(mission.vehicle.airframe, listed=motors, arm_x_m=None, arm_y_m=None)
    return msgspec.structs.replace(
        mission, vehicle=msgspec.structs.replace(mission.vehicle, airframe=airframe)
    )


class Px4Vehicle:
    """Plant, sensors and lock servo behind a HIL link.

    Args:
        mission: the mission, whose vehicle has the motors from PX4's parameters.
        seed: seed of every sensor's noise.
        sends_poses: whether the poses of the simulated motion capture go to PX4 over this link.

    Attributes:
        pose: pose that motion capture reports at this tick.
    """

    def __init__(
        self,
        mission: Mission,
        seed: int,
        link: SensorLink,
        position_from: PositionSource = PositionSource.MOCAP,
        sends_poses: bool = True,
    ) -> None:
        self.vehicle, self._link, self._sends_poses = mission.vehicle, link, sends_poses
        self.pose: tuple[float, Vec3, Quaternion] | None = None
        self.plant = make_plant(mission, seed)
        noise = GaussianNoise(random.Random(seed))
        self._imu = ImuSensor(self.vehicle, noise)
        self._pose = PoseSensor(self.vehicle, noise) if position_from is PositionSource.MOCAP else None
        self._gps = GpsReceiver(GPS_QUALITIES[position_from], noise) if self._pose is None else None
        self._barometer = Barometer(noise, HOME_ALTITUDE_M)
        self._magnetometer = Magnetometer(noise, HOME_FIELD_GAUSS)
        self._wind = Wind(self.vehicle.simulation, seed, TICK_US * 1e-6)
        lock = self.vehicle.lock
        self._servo = None if lock is None else LockServo(self.plant, lock.servo)
        self._lock_by_px4 = lock if lock is not None and lock.driver is LockDriver.PX4 else None
        self._motors, self._servo_channel = len(self.plant.motors), servo_channel(self.vehicle)
        self._ticks = self._slow_tick = 0
        self.clipped = 0  # ticks with a saturated accelerometer axis
        self._unreported: list[tuple[Vec3, Vec3]] = []  # specific force and rate of each unsent tick
        self._others: list[Any] = []
        self._last_sensor: Any = None

    @property
    def time_us(self) -> int:
        """PX4's clock."""
        return round(self.plant.time_s * 1e6)

    @property
    def armed(self) -> bool:
        return self._link.controls.armed

    def set_horn(self, pulse_us: float) -> None:
        if self._servo is not None:
            self._servo.set_horn(pulse_us)

    def step(self, report: bool = True) -> None:
        """Advance the plant by one tick of 4 ms with PX4's last outputs, then send the measurements to PX4.

        If `report` is false, nothing is sent, and the next IMU sample is a mean that includes this tick.
        """
        controls = self._link.controls
        m = controls.values
        if self._lock_by_px4 is not None and self._servo is not None:
            # A disarmed PX4 sets all simulated outputs to zero, which is not a servo command.
            pulse = actuator_pulse_us(self._lock_by_px4, m[self._servo_channel]) if controls.armed else None
            self._servo.track_pulse(self.time_us, pulse)
        self._wind.step(self.plant)
        specific_force = self.plant.advance(m[: self._motors], _STEPS_PER_TICK)
        self._ticks += 1
        if self._pose is not None:
            pose = self.pose = self._pose.measure(self.plant)
            if pose is not None and self._sends_poses:
                self._others.append(odometry_message(self.time_us, pose[1], pose[2], self.vehicle))
        if self._gps is not None:
            fix = self._gps.measure(self.plant)
            if fix is not None:
                self._others.append(gps_message(self.time_us, fix, self._gps))
        self._measure_imu(specific_force, any(m[: self._motors]))
        if report:
            others, self._others = self._others, []
            self._last_sensor = self._sensor_message()
            self._link.exchange(self._last_sensor, *others)

    def stand_still(self) -> None:
        """Stop the plant for one tick and repeat the last IMU sample, because PX4 needs a steady stream."""
        self._link.exchange(self._last_sensor)

    def _measure_imu(self, specific_force_frd: Vec3, motors_turn: bool) -> None:
        f, w = self._imu.measure(specific_force_frd, self.plant.rate, motors_turn)
        self.clipped += any(abs(axis) >= self.vehicle.imu.full_scale_m_s2 for axis in f)
        self._unreported.append((f, w))

    def _sensor_message(self) -> Any:
        f, w = self._unreported.pop()
        if self._unreported:
            count = len(self._unreported) + 1
            for early_f, early_w in self._unreported:
                f, w = add(f, early_f), add(w, early_w)
            f, w = scale(f, 1.0 / count), scale(w, 1.0 / count)
            self._unreported.clear()
        ax, ay, az = (accelerometer_output(axis, self.vehicle.imu.full_scale_m_s2) for axis in f)
        gx, gy, gz = (max(-GYRO_LIMIT_RAD_S, min(GYRO_LIMIT_RAD_S, axis)) for axis in w)
        fields = _ACCELEROMETER | _GYRO
        field, pressure, altitude = (0.0, 0.0, 0.0), 0.0, 0.0
        if self._ticks - self._slow_tick >= _SLOW_EVERY:
            self._slow_tick = self._ticks
            fields |= _MAGNETOMETER | _BAROMETER
            field = self._magnetometer.measure(self.plant)
            pressure, altitude = self._barometer.measure(self.plant)
        return mavlink.MAVLink_hil_sensor_message(
            self.time_us, ax, ay, az, gx, gy, gz, *field, pressure, 0.0, altitude, 25.0, fields, 0
        )


def servo_channel(vehicle: VehicleConfig) -> int:
    """Return the servo's channel in HIL_ACTUATOR_CONTROLS, from 0; for a quadrotor 4, which is PWM_MAIN 5."""
    return len(vehicle.airframe.motors)


def accelerometer_output(specific_force_m_s2: float, full_scale_m_s2: float) -> float:
    """Return one axis of HIL_SENSOR, saturated at full scale.

    PX4's simulated driver reports clipping at 16 g. If the full scale is 16 g, the driver reports clipping of
    a saturated axis. If the full scale is smaller, the driver does not report clipping.
    """
    limit = ACCELEROMETER_LIMIT_M_S2
    if abs(specific_force_m_s2) >= full_scale_m_s2:
        limit = min(limit, full_scale_m_s2) if full_scale_m_s2 < 0.999 * limit else limit
        return math.copysign(limit, specific_force_m_s2)
    return max(-limit, min(limit, specific_force_m_s2))


def odometry_message(time_us: int, position_ned: Vec3, q: Quaternion, vehicle: Any) -> Any:
    """Return a motion-capture system's ODOMETRY: a pose in local NED without velocity."""
    nan = math.nan
    covariance = [nan] * 21
    covariance[0] = covariance[6] = covariance[11] = POSE_NOISE_M**2
    covariance[15] = covariance[18] = covariance[20] = ATTITUDE_NOISE_RAD**2
    return mavlink.MAVLink_odometry_message(
        time_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *position_ned,
        list(q),
        nan,
        nan,
        nan,
        nan,
        nan,
        nan,
        covariance,
        [nan] * 21,
        0,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,  # PX4's EKF fuses this type, but not the type for mocap
        100,
    )


def gps_message(time_us: int, fix: GpsFix, receiver: GpsReceiver) -> Any:
    """Return HIL_GPS, in the message's units: 1e-7 degrees, millimetres, centimetres per second."""
    latitude, longitude = geodetic(fix.position_ned)
    vn, ve, vd = fix.velocity_ned
    return mavlink.MAVLink_hil_gps_message(
        time_us,
        receiver.quality.fix_type,
        round(latitude * 1e7),
        round(longitude * 1e7),
        round((HOME_ALTITUDE_M - fix.position_ned[2]) * 1e3),
        round(receiver.quality.eph_m * 100.0),
        round(receiver.quality.epv_m * 100.0),
        round(math.hypot(vn, ve) * 100.0),
        round(vn * 100.0),
        round(ve * 100.0),
        round(vd * 100.0),
        65535,  # course unknown
        14,  # satellites
        0,
        0,
    )


def geodetic(position_ned: Vec3) -> tuple[float, float]:
    """Return latitude and longitude (degrees) of a point near PX4's home position."""
    latitude = HOME_LAT_DEG + math.degrees(position_ned[0] / _EARTH_RADIUS_M)
    shrink = math.cos(math.radians(HOME_LAT_DEG))
    return latitude, HOME_LON_DEG + math.degrees(position_ned[1] / (_EARTH_RADIUS_M * shrink))
