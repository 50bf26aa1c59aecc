"""The fast world: core, lock and simulated vehicle in one process and one thread, in simulated time.

The same decisions as everywhere else, as fast as the machine goes, the same for the same seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.flight.core import FlightCore
from dart_flight.lock.drivers import Driver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.drivers.px4 import Px4Driver
from dart_flight.lock.session import LockSession
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    CommandResult,
    FlightMode,
    ImuSample,
    Input,
    LockCommand,
    LockPermission,
    LockState,
    Note,
    OdometrySample,
    Output,
    SetPoint,
    SetPointSent,
    StatusSample,
    StatusText,
    Tick,
    VehicleAction,
    VehicleCommand,
)
from dart_flight.sim.cascade import TrajectorySetPoint
from dart_flight.sim.vehicle import SimulatedVehicle

Observer = Callable[[Input | Output | Note, int], None]

_LINK_DELAY_US = 1000  # median of MAVSDK's callback over UDP, measured on a laptop
_HALF_RATE = 2  # ticks: attitude, odometry, actuator outputs at 125 Hz
_TRUTH_EVERY = 2
_STATUS_EVERY = 50  # 5 Hz, and at once when something changes
_HOST_EVERY = 5  # ticks of 4 ms: lock polled and host time reported at 50 Hz
_REPEAT_US = 50_000  # MAVSDK repeats the last set-point at 20 Hz
_NAN3 = (math.nan, math.nan, math.nan)


class FastFlight:
    """One simulated flight.

    Args:
        mission: what to fly.
        seed: of every sensor's noise.
        driver: `mock` or `px4`; the real servo controllers have no place in simulated time.
        faults: of the mock servo.
        observe: sees every input with its number, every output and note with the number of its input.
    """

    def __init__(
        self,
        mission: Mission,
        seed: int,
        driver: LockDriver = LockDriver.MOCK,
        faults: MockFaults | None = None,
        observe: Observer | None = None,
    ) -> None:
        self.mission = mission
        self.core = FlightCore(mission)
        self.vehicle = SimulatedVehicle(mission, seed, driver)
        self.autopilot = self.vehicle.autopilot
        self.autopilot.say = self._on_text
        self._observe = observe or (lambda item, number: None)
        self._number = 0
        self._ticks = 0
        self._status: tuple[object, ...] = ()
        self._texts: list[tuple[str, str]] = []
        self._last_setpoint: SetPoint | None = None
        self._repeated_us = 0
        self._lock_states: list[LockState] = []
        self.mock: MockDriver | None = None
        lock = mission.vehicle.lock
        hardware: Driver
        if driver is LockDriver.PX4:
            hardware = Px4Driver(lock, self.autopilot.set_actuator)
        else:
            hardware = self.mock = MockDriver(lock, lambda: self.autopilot.time_us, faults=faults)
        self.lock = LockSession(lock, hardware, lambda: self.autopilot.time_us, self._lock_states.append)

    def run(self, limit_s: float = 180.0) -> None:
        """Fly until the core says that it is over, or for `limit_s` seconds of simulated time."""
        self._take(ClockOffset(self._host_us, 0))
        self.lock.start()
        while self.core.end is None and self.autopilot.now_s < limit_s:
            self.tick()

    @property
    def _host_us(self) -> int:
        return self.autopilot.time_us + _LINK_DELAY_US

    def tick(self) -> None:
        """4 ms: the vehicle, its telemetry, the lock."""
        if self.mock is not None:
            self.vehicle.set_horn(self.mock.horn_pulse_us(self.autopilot.time_us))
        self.vehicle.advance()
        self._ticks += 1
        self._truth()
        if self._ticks % _HOST_EVERY == 0:
            self.lock.poll()
            self._take(Tick(self._host_us))
        while self._lock_states:
            self._take(self._lock_states.pop(0))
        self._telemetry()
        self._repeat()

    def _truth(self) -> None:
        plant = self.autopilot.plant
        if self._ticks % _TRUTH_EVERY == 0:
            self._observe(plant.truth(), self._number)
        while plant.finished:
            self._observe(plant.finished.pop(0), self._number)

    def _telemetry(self) -> None:
        a, t_us, received = self.autopilot, self.autopilot.time_us, self._host_us
        e = a.estimator
        if self._ticks % _HALF_RATE == 0:
            # Stamped in milliseconds, as the MAVLink message is.
            self._take(AttitudeSample(t_us // 1000 * 1000, received, e.q))
            if e.ok:
                self._take(OdometrySample(t_us, received, e.position, e.velocity))
            self._take(ActuatorSample(t_us, received, a.motors))
        self._take(ImuSample(a.imu.t_us, received, a.imu.specific_force_frd, a.imu.rate_frd))
        status = (a.armed, a.mode, a.landed, e.ok)
        if status != self._status or self._ticks % _STATUS_EVERY == 0:
            self._status = status
            volts = a.vehicle.simulation.battery_v
            self._take(StatusSample(t_us, received, *status, volts, a.battery_remaining))
        while self._texts:
            severity, text = self._texts.pop(0)
            self._take(StatusText(t_us, received, severity, text))

    def _on_text(self, severity: str, text: str) -> None:
        self._texts.append((severity, text))

    # -- the core and what it wants --

    def take(self, item: Input) -> None:
        """Give the core an input from outside: an operator's request, a fault's sample."""
        self._take(item)

    def _take(self, item: Input) -> None:
        number = self._number
        self._number += 1
        self._observe(item, number)
        for output in self.core.step(item):
            self._observe(output, number)
            self._carry_out(output, number)

    def _carry_out(self, output: Output, number: int) -> None:
        if isinstance(output, SetPoint):
            self._last_setpoint = output
            self._send(output)
            if output.recovery:
                sent = self._host_us
                latency = sent - output.trigger_received_us
                self._observe(SetPointSent(output.t_us, sent, latency), number)
        elif isinstance(output, VehicleCommand):
            self._perform(output.action)
        elif isinstance(output, LockCommand):
            self.lock.command(output.mode)
        elif isinstance(output, LockPermission):
            self.lock.permit(output.permitted)
        elif output.topic == "/out/silence":
            self._last_setpoint = None

    def _send(self, setpoint: SetPoint) -> None:
        self._repeated_us = self.autopilot.time_us
        self.autopilot.set_trajectory(
            TrajectorySetPoint(
                setpoint.position_ned,
                setpoint.velocity_ned or _NAN3,
                setpoint.acceleration_ned or _NAN3,
                setpoint.yaw_ned_rad,
            )
        )

    def _repeat(self) -> None:
        if self._last_setpoint is not None and self.autopilot.time_us - self._repeated_us >= _REPEAT_US:
            self._send(self._last_setpoint)

    def _perform(self, action: VehicleAction) -> None:
        a = self.autopilot
        if action is VehicleAction.ARM:
            ok = a.arm()
        elif action is VehicleAction.DISARM:
            ok = a.disarm()
        else:
            modes = {
                VehicleAction.OFFBOARD: FlightMode.OFFBOARD,
                VehicleAction.HOLD: FlightMode.HOLD,
                VehicleAction.LAND: FlightMode.LAND,
            }
            ok = a.set_mode(modes[action])
            if action is not VehicleAction.OFFBOARD:
                self._last_setpoint = None
        self._take(CommandResult(a.time_us, action.value, ok, "" if ok else "denied"))
