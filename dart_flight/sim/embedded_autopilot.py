"""The embedded autopilot: a small imitation of PX4 on the plant, without I/O and without a clock.

One `step` is a tick of 4 ms: plant, sensors, estimator, modes and failsafes, control. `run.fast` runs the
autopilot in the process of the flight core. `sim.embedded_simulator` runs the autopilot in a separate
process, which communicates over MAVLink.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Final

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2, Quaternion, Vec3, distance2, rotate, yaw_ned_of
from dart_flight.base.records import FlightMode, LandedState, SystemStatus
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource, Value, vehicle_parameters
from dart_flight.config.rotors import rotor_parameters
from dart_flight.config.vehicle import Px4Parameters, VehicleConfig
from dart_flight.lock.drivers.px4_output import PREARM_ALWAYS, actuator_pulse_us, required_parameters
from dart_flight.planning.positioning import simulated_source
from dart_flight.sim.cascade import Cascade, TrajectorySetpoint
from dart_flight.sim.delayed_filter import DelayedFilter
from dart_flight.sim.estimator import Estimator
from dart_flight.sim.gps_filter import GpsWeights
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant, make_plant
from dart_flight.sim.sensors import GPS_QUALITIES, GpsReceiver, ImuSensor, PoseSensor

TICK_S: Final = 0.004
TICK_US: Final = 4000
_STEPS_PER_TICK: Final = 4
_POSITION_EVERY: Final = 2  # ticks; PX4's position controller runs with its estimator, at about 125 Hz
_FAILSAFE_HOLD_S: Final = 5.0
_IDLE: Final = 0.05
_KILL_DISARM_S: Final = 5.0  # PX4's COM_KILL_DISARM
_OFFBOARD_PROOF_S: Final = 0.5  # offboard mode is accepted only with a setpoint younger than this


class ImuReading:
    """The IMU sample of one tick, as reported."""

    __slots__ = ("rate_frd", "specific_force_frd", "t_us")

    def __init__(self, t_us: int, specific_force_frd: Vec3, rate_frd: Vec3) -> None:
        self.t_us, self.specific_force_frd, self.rate_frd = t_us, specific_force_frd, rate_frd


class Autopilot:
    """The simulated vehicle's autopilot: arming, modes, failsafes and control.

    Args:
        send_text: receives (severity, text) of every STATUSTEXT.
    """

    def __init__(
        self,
        plant: Plant,
        seed: int,
        send_text: Callable[[str, str], None] | None = None,
        position_from: PositionSource = PositionSource.MOCAP,
    ) -> None:
        self.plant = plant
        self.vehicle: VehicleConfig = plant.vehicle
        noise = GaussianNoise(random.Random(seed))
        self.imu_sensor = ImuSensor(self.vehicle, noise)
        self.pose_sensor = PoseSensor(self.vehicle, noise)
        self.gps: GpsReceiver | None = None
        if position_from is not PositionSource.MOCAP:
            self.gps = GpsReceiver(GPS_QUALITIES[position_from], noise)
        self.estimator = Estimator()
        self.pose_filter: Estimator | DelayedFilter = self.estimator  # fuses IMU and poses into `estimator`
        self.parameters = default_parameters(self.vehicle, position_from)
        v = self.vehicle
        self.cascade = Cascade(self.parameters, v.hover_thrust_fraction(), v.thrust, v.airframe.motors)
        self._stopped, self._idle = ((u,) * len(v.airframe.motors) for u in (0.0, _IDLE))
        self.send_text = send_text or (lambda severity, text: None)
        self.armed = False
        self.mode = FlightMode.HOLD
        self.landed = LandedState.ON_GROUND
        self.motors: tuple[float, ...] = self._stopped
        self._killed_at_s: float | None = None
        self.actuator_set: list[float] = [math.nan] * 6
        self.pose: tuple[float, Vec3, Quaternion] | None = None  # pose from motion capture at this tick
        self.fuses_own_pose = True  # False if poses arrive by `fuse_external_pose`
        self.imu = ImuReading(0, (0.0, 0.0, -GRAVITY_M_S2), (0.0, 0.0, 0.0))
        self.failsafe: str | None = None
        self.imu_stuck = False  # fault: the reported IMU sample repeats; the estimator gets true samples
        self.battery_left: float | None = None
        self._offboard: TrajectorySetpoint | None = None
        self._offboard_at_s = -math.inf
        self._hold: TrajectorySetpoint = TrajectorySetpoint()
        self._failsafe_since_s: float | None = None
        self._quiet_since_s = 0.0
        self._tick = 0
        # PX4 runs for a while before a client connects, and its clock differs from the host's.
        plant.time_offset_us = 7_000_000

    # -- telemetry --

    @property
    def now_s(self) -> float:
        return self.plant.time_s

    @property
    def time_us(self) -> int:
        """The autopilot's clock."""
        return round(self.plant.time_s * 1e6) + self.plant.time_offset_us

    @property
    def system_status(self) -> SystemStatus:
        if self._killed_at_s is not None:
            return SystemStatus.FLIGHT_TERMINATION
        if not self.armed:
            return SystemStatus.STANDBY
        return SystemStatus.CRITICAL if self.failsafe else SystemStatus.ACTIVE

    @property
    def battery_remaining(self) -> float:
        """The remaining charge, 0 to 1; a full battery lasts 15 minutes."""
        if self.battery_left is not None:
            return self.battery_left
        return max(0.0, 1.0 - self.plant.time_s / 900.0)

    # -- MAVLink commands --

    def arm(self, force: bool = False) -> bool:
        """Like PX4, arm if the estimator is ready and the mode permits a take-off; return whether armed."""
        if self.armed:
            return True
        if self._killed_at_s is not None:
            self.send_text("critical", "Arming denied: kill switch engaged")
            return False
        if not self.estimator.ok:
            self.send_text("critical", "Arming denied: no local position")
            return False
        if self.mode in (FlightMode.LAND, FlightMode.RETURN) and not force:
            self.send_text("critical", "Arming denied: switch to another mode first")
            return False
        self.armed = True
        self.failsafe = None
        self.cascade.reset()
        self._hold_here()
        self.send_text("info", "Armed by external command")
        return True

    def disarm(self, force: bool = False) -> bool:
        """Disarm on the ground, or anywhere if forced; return whether the vehicle is disarmed."""
        if self.armed and self.landed is not LandedState.ON_GROUND and not force:
            self.send_text("critical", "Disarming denied: not landed")
            return False
        if self.armed:
            self.armed = False
            self.send_text("info", "Disarmed")
        return True

    def kill(self) -> None:
        """Stop the motors like the pilot's kill switch; disarm 5 s later, like PX4."""
        self._killed_at_s = self.now_s

    def set_mode(self, mode: FlightMode) -> bool:
        """Change the mode; return whether it was accepted. Offboard mode needs fresh setpoints."""
        if mode is FlightMode.OFFBOARD and self.now_s - self._offboard_at_s > _OFFBOARD_PROOF_S:
            self.send_text("critical", "Switching to offboard is not possible: no setpoints")
            return False
        if mode is not self.mode:
            self.mode = mode
            self._failsafe_since_s = None
            self.failsafe = None
            self._hold_here()
        return True

    def take_off(self, altitude_m: float | None = None) -> bool:
        """Climb to the take-off altitude and hold, like PX4's take-off mode; return the acknowledgement."""
        if not self.armed:
            return True  # PX4 acknowledges a take-off while disarmed but does nothing
        self.set_mode(FlightMode.TAKEOFF)
        climb = altitude_m if altitude_m is not None else self.parameters["MIS_TAKEOFF_ALT"]
        p = self.estimator.position
        self._hold.position = (p[0], p[1], p[2] - climb)
        return True

    def set_trajectory(self, setpoint: TrajectorySetpoint) -> None:
        self._offboard = setpoint
        self._offboard_at_s = self.now_s

    def use_external_poses(self) -> None:
        """Ignore the simulated motion capture, and fuse the poses passed to `fuse_external_pose` instead."""
        self.fuses_own_pose = False
        self.assume_pose_delay(1e-3 * float(self.parameters["EKF2_EV_DELAY"]))

    def assume_pose_delay(self, delay_s: float) -> None:
        """Assume that every subsequent pose is `delay_s` old on arrival, like PX4 with EKF2_EV_DELAY."""
        self.pose_filter = DelayedFilter(self.estimator, self.now_s, delay_s)

    def fuse_external_pose(self, position_ned: Vec3, q_frd_to_ned: Quaternion | None) -> None:
        """Fuse an external pose; before `use_external_poses`, do nothing."""
        if not self.fuses_own_pose:
            self.pose_filter.correct(self.now_s, position_ned, q_frd_to_ned)

    def set_actuator(self, index: int, value: float) -> None:
        """Set a peripheral output, -1 to 1 (DO_SET_ACTUATOR); the output moves only while armed."""
        if 1 <= index <= 6:
            self.actuator_set[index - 1] = value

    def lock_pulse_us(self) -> float | None:
        """Return the pulse of the lock's output, or None without a lock or while the output is disarmed."""
        lock = self.vehicle.lock
        if lock is None:
            return None
        value = self.actuator_set[lock.px4.actuator_index - 1]
        moves = self.armed or round(self.parameters["COM_PREARM_MODE"]) == PREARM_ALWAYS
        if math.isnan(value) or not moves:
            return None
        return actuator_pulse_us(lock, value)

    # -- one tick --

    def step(self) -> None:
        """Advance by one tick of 4 ms."""
        specific_force = self.plant.advance(self.motors, _STEPS_PER_TICK)
        measured, rate = self.imu_sensor.measure(specific_force, self.plant.rate, any(self.motors))
        if self.imu_stuck:
            self.imu = ImuReading(self.time_us, self.imu.specific_force_frd, self.imu.rate_frd)
        else:
            self.imu = ImuReading(self.time_us, measured, rate)
        self.pose_filter.predict(self.now_s, measured, rate, TICK_S)
        pose = self.pose = self.pose_sensor.measure(self.plant)
        if self.gps is not None:
            self._correct_by_gps(self.gps, pose)
        elif pose is not None and self.fuses_own_pose:
            self.pose_filter.correct(*pose)
        self._tick += 1
        self._detect_landing()
        if self._killed_at_s is not None and self.now_s - self._killed_at_s > _KILL_DISARM_S:
            self.disarm(force=True)
        if not self.armed or self._killed_at_s is not None:
            self.motors = self._stopped
            return
        self._check_offboard()
        setpoint = self._setpoint()
        if self._is_resting(setpoint):
            self.cascade.reset()
            self.motors = self._idle
            return
        e = self.estimator
        if self._tick % _POSITION_EVERY == 0:
            self.cascade.update_position(
                setpoint, e.position, e.velocity, yaw_ned_of(e.q), TICK_S * _POSITION_EVERY
            )
        self.motors = self.cascade.update_attitude(e.q, e.rate, TICK_S)

    def _correct_by_gps(self, receiver: GpsReceiver, pose: tuple[float, Vec3, Quaternion] | None) -> None:
        """Correct position and velocity with the GPS fix, and the attitude with the simulated pose."""
        if pose is not None:
            self.estimator.correct_attitude(pose[0], pose[2])
        fix = receiver.measure(self.plant)
        if fix is not None:
            weights = GpsWeights(
                float(self.parameters["EKF2_GPS_P_NOISE"]),
                float(self.parameters["EKF2_GPS_V_NOISE"]),
                rotate(self.plant.q, self.imu_sensor.bias),
            )
            self.estimator.correct_gps(fix.t_s, fix.position_ned, fix.velocity_ned, weights)

    def _setpoint(self) -> TrajectorySetpoint:
        if self.mode is FlightMode.OFFBOARD and self._offboard is not None:
            return self._offboard
        if self.mode is FlightMode.LAND:
            p = self._hold.position
            down = self.parameters["MPC_LAND_SPEED"]
            return TrajectorySetpoint((p[0], p[1], math.nan), (math.nan, math.nan, down), yaw=self._hold.yaw)
        if self.mode is FlightMode.TAKEOFF:
            e = self.estimator
            if abs(e.position[2] - self._hold.position[2]) < 0.1 and abs(e.velocity[2]) < 0.2:
                self.send_text("info", "Takeoff finished")
                target = self._hold.position
                self.mode = FlightMode.HOLD
                self._hold_here()
                self._hold.position = target
        return self._hold

    def _hold_here(self) -> None:
        """Hold the heading, and the position where the vehicle would stop; land at the current position."""
        e = self.estimator
        # PX4 brakes before it holds; with the gains 0.95 1/s and 1.8 1/s, braking takes about 0.5 s. Its
        # landing returns to the position at which it began (measured on v1.18).
        brakes = self.armed and self.landed is not LandedState.ON_GROUND and self.mode is not FlightMode.LAND
        ahead = 0.5 if brakes else 0.0
        self._hold = TrajectorySetpoint(
            (
                e.position[0] + ahead * e.velocity[0],
                e.position[1] + ahead * e.velocity[1],
                e.position[2],
            ),
            yaw=yaw_ned_of(e.q),
        )

    def _is_resting(self, setpoint: TrajectorySetpoint) -> bool:
        """Return whether the vehicle is on the ground and the setpoint does not demand a climb."""
        if self.landed is not LandedState.ON_GROUND:
            return False
        wants_up = setpoint.position[2] < self.estimator.position[2] - 0.05 or setpoint.velocity[2] < -0.05
        return not wants_up

    def _check_offboard(self) -> None:
        now = self.now_s
        lost = now - self._offboard_at_s > self.parameters["COM_OF_LOSS_T"]
        if self.mode is FlightMode.OFFBOARD and lost:
            self.send_text("critical", "Failsafe: offboard lost, holding")
            self.set_mode(FlightMode.HOLD)
            self.failsafe = "offboard lost"
            self._failsafe_since_s = now
        elif self._failsafe_since_s is not None and now - self._failsafe_since_s > _FAILSAFE_HOLD_S:
            self.send_text("critical", "Failsafe: offboard lost, landing")
            self.set_mode(FlightMode.LAND)
            self.failsafe = "offboard lost"
            self._failsafe_since_s = None

    def _detect_landing(self) -> None:
        still = abs(self.plant.velocity[2]) < 0.15 and distance2(self.plant.velocity, (0.0, 0.0)) < 0.2
        if not (self.plant.on_ground and still):
            self._quiet_since_s = self.now_s
        quiet = self.now_s - self._quiet_since_s
        if self.landed is LandedState.ON_GROUND:
            if self.armed and not self.plant.on_ground:
                self.landed = LandedState.IN_AIR
        elif quiet > 0.5:
            self.landed = LandedState.ON_GROUND
            self.send_text("info", "Landing detected")
        disarm_after = self.parameters["COM_DISARM_LAND"]
        if (
            self.armed
            and self.landed is LandedState.ON_GROUND
            and self.mode is FlightMode.LAND
            and disarm_after > 0.0
            and quiet > disarm_after
        ):
            self.disarm()


def default_parameters(
    vehicle: VehicleConfig, position_from: PositionSource = PositionSource.MOCAP
) -> dict[str, Value]:
    """Return PX4 parameters from the configuration, and typical values for the other parameters.

    An int is an INT32 parameter of PX4, a float a REAL32 parameter.
    """
    parameters: dict[str, Value] = {
        field.encode_name: float(getattr(vehicle.px4, field.name))
        for field in msgspec.structs.fields(Px4Parameters)
    }
    parameters["MPC_THR_HOVER"] = vehicle.hover_thrust_fraction()
    parameters["THR_MDL_FAC"] = vehicle.thrust.square_share
    parameters |= rotor_parameters(vehicle.airframe.motors)
    parameters["SYS_AUTOSTART"] = 4001
    parameters["MAV_SYS_ID"] = 1
    # Include the GPS parameters that `check` reads, because clients request a missing parameter repeatedly.
    for source in (PositionSource.RTK, PositionSource.MOCAP, position_from):
        parameters |= {p.name: p.value for p in vehicle_parameters(source).values()}
    parameters |= vehicle.mocap.measured_parameters()
    # This autopilot's own failsafes: hold if offboard is lost, then land; no remote control.
    parameters |= {
        "COM_OBL_RC_ACT": 5,
        "COM_FAIL_ACT_T": _FAILSAFE_HOLD_S,
        "COM_RCL_EXCEPT": 4,
        "COM_LKDOWN_TKO": 3.0,
        "SYS_HITL": 0,
    }
    # Position of the IMU: forward, right, down.
    parameters |= {f"EKF2_IMU_POS_{axis}": p for axis, p in zip("XYZ", vehicle.imu.position_m, strict=True)}
    # The motors are the first PWM outputs, as in PX4's defaults.
    for k in range(1, len(vehicle.airframe.motors) + 1):
        parameters |= {f"PWM_MAIN_FUNC{k}": 100 + k, f"PWM_MAIN_MIN{k}": 1000, f"PWM_MAIN_MAX{k}": 2000}
    parameters["PWM_MAIN_TIM0"] = 400
    # The lock's servo is on the output that the configuration names.
    if vehicle.lock is not None:
        for required in required_parameters(vehicle.lock):
            parameters[required.name] = required.value
    return parameters


def make_autopilot(
    mission: Mission, seed: int, send_text: Callable[[str, str], None] | None = None
) -> Autopilot:
    """Return an autopilot on the ground below the mission's start."""
    return Autopilot(make_plant(mission, seed=seed), seed, send_text, simulated_source(mission))
