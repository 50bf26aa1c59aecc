"""The fast world: core, lock and simulated vehicle in one process and one thread, in simulated time.

The same decisions as everywhere else, as fast as the machine goes, the same for the same seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.core.flight_core import FlightCore
from dart_flight.lock.drivers import Driver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.drivers.px4 import Px4Driver
from dart_flight.lock.session import LockSession
from dart_flight.samples import (
    ActuatorSample,
    AttitudeSample,
    ClockOffset,
    CommandResult,
    EstimatorSample,
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
from dart_flight.sim.faults.impairment import Impairment, LossyLink
from dart_flight.sim.faults.kinds import Fault, Place, Trigger, VehicleFault, impairment_of, mock_faults_of
from dart_flight.sim.vehicle import SimulatedVehicle

Observer = Callable[[Input | Output | Note, int], None]

Telemetry = (
    ImuSample | AttitudeSample | OdometrySample | ActuatorSample | StatusSample | EstimatorSample | StatusText
)

# The host reads its own clock; and a message takes 1 ms, the median of MAVSDK's callback over UDP.
_HOST_OFFSET_US = 7_001_000
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
        fault: what goes wrong, and when.
    """

    def __init__(
        self,
        mission: Mission,
        seed: int,
        driver: LockDriver = LockDriver.MOCK,
        faults: MockFaults | None = None,
        observe: Observer | None = None,
        fault: Fault | None = None,
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
        self._resets = -1
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
        self.faulted = None if fault is None else FaultedFlight(self, fault, seed)

    def run(self, limit_s: float = 180.0) -> None:
        """Fly until the core says that it is over, or for `limit_s` seconds of simulated time."""
        self._take(ClockOffset(self.host_us, 0))
        self.lock.start()
        while self.core.end is None and self.autopilot.now_s < limit_s and not self._orphaned:
            self.tick()

    def run_out(self, limit_s: float = 60.0) -> None:
        """Let the vehicle fly on by itself until it has landed, for `limit_s` more seconds at most.

        In a pilot's hands it only has to hold still: three seconds of that are enough.
        """
        until_s = self.autopilot.now_s + limit_s
        while self.autopilot.armed and self.autopilot.now_s < until_s:
            self.tick()
            if self.autopilot.mode is FlightMode.MANUAL:
                until_s = min(until_s, self.autopilot.now_s + 3.0)

    @property
    def _orphaned(self) -> bool:
        return self.faulted is not None and self.faulted.app_dead and not self.autopilot.armed

    @property
    def host_us(self) -> int:
        """The host's monotonic time as the app would read it, microseconds."""
        # Of its own: the autopilot's clock may jump.
        return round(self.autopilot.now_s * 1e6) + _HOST_OFFSET_US

    def tick(self) -> None:
        """4 ms: the vehicle, its telemetry, the lock."""
        if self.faulted is not None:
            self.faulted.tick()
        if self.mock is not None:
            self.vehicle.set_horn(self.mock.horn_pulse_us(self.autopilot.time_us))
        self.vehicle.advance()
        self._ticks += 1
        self._truth()
        if self.faulted is not None and self.faulted.app_silent:
            self._repeat()  # MAVSDK's own thread goes on
            return
        if self._ticks % _HOST_EVERY == 0:
            self.lock.poll()
            self._take(Tick(self.host_us))
        while self._lock_states:
            self._take(self._lock_states.pop(0))
        self._telemetry()
        if self.faulted is not None:
            for item in self.faulted.arrived():
                self._take(item)
        self._repeat()

    def _truth(self) -> None:
        plant = self.autopilot.plant
        if self._ticks % _TRUTH_EVERY == 0:
            self._observe(plant.truth(), self._number)
        while plant.finished:
            self._observe(plant.finished.pop(0), self._number)

    def _telemetry(self) -> None:
        a, t_us, received = self.autopilot, self.autopilot.time_us, self.host_us
        e = a.estimator
        if self._ticks % _HALF_RATE == 0:
            # Stamped in milliseconds, as the MAVLink message is.
            self._receive(AttitudeSample(t_us // 1000 * 1000, received, e.q))
            if e.ok:
                self._receive(OdometrySample(t_us, received, e.position, e.velocity))
            self._receive(ActuatorSample(t_us, received, a.motors))
        self._receive(ImuSample(a.imu.t_us, received, a.imu.specific_force_frd, a.imu.rate_frd))
        if e.resets != self._resets:
            self._resets = e.resets
            self._receive(EstimatorSample(t_us, received, e.resets))
        status = (a.armed, a.mode, a.landed, e.ok)
        if status != self._status or self._ticks % _STATUS_EVERY == 0:
            self._status = status
            volts = a.vehicle.simulation.battery_v
            self._receive(StatusSample(t_us, received, *status, volts, a.battery_remaining))
        while self._texts:
            severity, text = self._texts.pop(0)
            self._receive(StatusText(t_us, received, severity, text))

    def _receive(self, item: Telemetry) -> None:
        if self.faulted is None:
            self._take(item)
        else:
            self.faulted.send_in(item)

    def _on_text(self, severity: str, text: str) -> None:
        self._texts.append((severity, text))

    # -- the core and what it wants --

    def forget_setpoint(self) -> None:
        """MAVSDK has gone with the process: nothing repeats the last set-point."""
        self._last_setpoint = None

    def take(self, item: Input) -> None:
        """Give the core an input from outside: an operator's request, a fault's sample."""
        self._take(item)

    def _take(self, item: Input) -> None:
        number = self._number
        self._number += 1
        self._observe(item, number)
        if self.faulted is not None:
            self.faulted.sees(item)
        for output in self.core.step(item):
            self._observe(output, number)
            if self.faulted is not None:
                self.faulted.sees(output)
            self._carry_out(output, number)

    def _carry_out(self, output: Output, number: int) -> None:
        if isinstance(output, SetPoint):
            self._last_setpoint = output
            self._transmit(output)
            if output.recovery:
                sent = self.host_us
                latency = sent - output.trigger_received_us
                self._observe(SetPointSent(output.t_us, sent, latency), number)
        elif isinstance(output, VehicleCommand):
            self._transmit(output.action)
        elif isinstance(output, LockCommand):
            self.lock.command(output.mode)
        elif isinstance(output, LockPermission):
            self.lock.permit(output.permitted)
        elif output.topic == "/out/silence":
            self._last_setpoint = None

    def _send(self, setpoint: SetPoint) -> None:
        self.autopilot.set_trajectory(
            TrajectorySetPoint(
                setpoint.position_ned,
                setpoint.velocity_ned or _NAN3,
                setpoint.acceleration_ned or _NAN3,
                setpoint.yaw_ned_rad,
            )
        )

    def _repeat(self) -> None:
        if self._last_setpoint is not None and self.host_us - self._repeated_us >= _REPEAT_US:
            self._transmit(self._last_setpoint)

    def _transmit(self, order: SetPoint | VehicleAction) -> None:
        """To the autopilot, over the link where that is faulty."""
        self._repeated_us = self.host_us
        if self.faulted is not None:
            self.faulted.send_out(order)
        else:
            self.deliver(order)

    def deliver(self, order: SetPoint | VehicleAction) -> None:
        """A set-point or an action arrives at the autopilot."""
        if isinstance(order, SetPoint):
            self._send(order)
        else:
            self._perform(order)

    def _perform(self, action: VehicleAction) -> None:
        a = self.autopilot
        if action is VehicleAction.ARM:
            ok = a.arm()
        elif action in (VehicleAction.DISARM, VehicleAction.KILL):
            ok = a.disarm(force=action is VehicleAction.KILL)
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


class FaultedFlight:
    """One fault in one fast flight: when it begins, and what it does between app and vehicle.

    A hang leaves MAVSDK repeating the last set-point until the deadman ends the process.
    """

    def __init__(self, flight: FastFlight, fault: Fault, seed: int) -> None:
        self._flight, self.fault = flight, fault
        self._trigger = Trigger(fault)
        self.began_us: int | None = None  # host time
        self._in: LossyLink[Telemetry] = LossyLink(seed)
        self._out: LossyLink[SetPoint | VehicleAction] = LossyLink(seed + 1)
        self._vehicle: VehicleFault | None = None
        self._ended = False

    @property
    def app_silent(self) -> bool:
        """The app has stopped doing anything."""
        stops = self.fault.kind.place is Place.APP and self.fault.name != "disk-full"
        return self.began_us is not None and stops

    @property
    def app_dead(self) -> bool:
        """The deadman has ended it, or whoever killed it."""
        if not self.app_silent or self.began_us is None:
            return False
        starve_s = 0.0 if self.fault.name == "sigkill" else self._flight.mission.vehicle.guard.deadman_s
        return self._flight.host_us - self.began_us >= starve_s * 1e6

    def sees(self, record: Input | Output) -> None:
        """Take a record of the flight, to know the phase."""
        self._trigger.sees(record)

    def tick(self) -> None:
        """Once per tick: begin when it is time, go on while it lasts."""
        flight = self._flight
        if self.began_us is None:
            if not self._trigger.due(flight.autopilot.time_us):
                return
            self.began_us = flight.host_us
            self._begin()
        if self._vehicle is not None:
            self._vehicle.tick()
        lasts_s = self.fault.value if self.fault.name == "link-loss" and self.fault.value > 0.0 else None
        if lasts_s is not None and not self._ended and flight.host_us - self.began_us > lasts_s * 1e6:
            self._ended = True
            self._in.impairment = self._out.impairment = Impairment()
        if (self.app_dead or self.fault.name == "sigstop") and self.app_silent:
            flight.forget_setpoint()
        for order in self._out.pop(flight.autopilot.now_s):
            flight.deliver(order)

    def _begin(self) -> None:
        flight, fault, place = self._flight, self.fault, self.fault.kind.place
        if place is Place.LINK:
            self._in.impairment = self._out.impairment = impairment_of(fault)
        elif place is Place.LOCK:
            if flight.mock is not None:
                flight.mock.inject(mock_faults_of(fault))
        elif place is not Place.APP:
            self._vehicle = VehicleFault(flight.vehicle, fault)

    def send_in(self, item: Telemetry) -> None:
        """A sample on its way to the app."""
        dropped = self.began_us is not None and self.fault.name == "imu-dropout"
        if not (dropped and isinstance(item, ImuSample)):
            self._in.push(self._flight.autopilot.now_s, item)

    def arrived(self) -> list[Telemetry]:
        """What reaches the app now, with the time at which it does."""
        received = self._flight.host_us
        return [
            msgspec.structs.replace(item, received_us=received)
            for item in self._in.pop(self._flight.autopilot.now_s)
        ]

    def send_out(self, order: SetPoint | VehicleAction) -> None:
        """A set-point or an action on its way to the autopilot."""
        self._out.push(self._flight.autopilot.now_s, order)
        for one in self._out.pop(self._flight.autopilot.now_s):
            self._flight.deliver(one)
