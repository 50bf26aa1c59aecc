"""Fast world: core, lock and simulated vehicle in one process and one thread, in simulated time.

The fast world makes the same decisions as the other worlds, as fast as the computer allows. A seed
always gives the same flight. `dry-run --fast`, campaigns and scripts use this world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from dart_flight.base.records import (
    ClockOffset,
    CommandResult,
    FlightMode,
    Input,
    LockState,
    OperatorRequest,
    Phase,
    Record,
    Request,
    RoundTrip,
    Setpoint,
    StatusText,
    Tick,
    VehicleAction,
    World,
)
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.core.flight_core import FlightCore
from dart_flight.lock.drivers import DRIVERS, ActuatorLink, driver_names, make_driver
from dart_flight.lock.drivers.mock import MockDriver, MockFaults
from dart_flight.lock.lock_session import LockSession
from dart_flight.recording.reader import IN_MEMORY
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fault_injection import FlightWithFault, Order, TimeRequest
from dart_flight.run.flight_record import FlightRecord, LogPlace, Onlooker
from dart_flight.run.planner_process import PlanItem, Planner, kinds_of_requests
from dart_flight.run.shell import Observe, Shell
from dart_flight.run.timing import InProcessTime, RealTime
from dart_flight.sim.cascade import TrajectorySetpoint
from dart_flight.sim.draws import DrawnWorld, draw_world
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from dart_flight.sim.telemetry_sender import TelemetrySender
from dart_flight.vehicle.clock import SimulatedTime

if TYPE_CHECKING:
    from dart_flight.run.fast_poses import FastPoses

# The host's clock minus the autopilot's clock, plus 1 ms for the median delay of a MAVSDK callback over UDP.
_HOST_OFFSET_US: Final = 7_001_000
_TRUTH_EVERY: Final = 2
_HOST_EVERY: Final = 5  # ticks of 4 ms between polls of the lock and reports of the host time (50 Hz)
_TIMESYNC_EVERY: Final = 25  # ticks between measurements of the round trip, as in the app
_REPEAT_US: Final = 50_000  # period at which MAVSDK repeats the last setpoint
_LONGEST_S: Final = 180.0  # longest duration of a flight, excluding the mission's holds
_NAN3 = (math.nan, math.nan, math.nan)
FLIGHT_MODES: Final = {
    VehicleAction.OFFBOARD: FlightMode.OFFBOARD,
    VehicleAction.LAND: FlightMode.LAND,
}


class _FastClock(SimulatedTime):
    """The autopilot's clock and the host's clock of a fast flight."""

    def __init__(self, flight: FastFlight) -> None:
        super().__init__()
        self._flight = flight

    def host_us(self) -> int:
        return self._flight.host_us

    def to_autopilot(self, host_time_us: int) -> int:
        """Return the autopilot's current time; `host_time_us` is ignored."""
        return self._flight.autopilot.time_us


class _PlannerAtOnce:
    """A planner that plans while simulated time stands still; its answers wait until they are due."""

    def __init__(self, planner: Planner, time: RealTime) -> None:
        self._planner, self._time = planner, time

    def send(self, item: PlanItem) -> None:
        answer = self._planner.take(item)
        if answer is not None:
            self._time.hold_answer(answer)


class FastFlight:
    """One simulated flight. A lock driver that does not work in simulated time is replaced by `mock`.

    Args:
        seed: seed of the sensor noise.
        observe: receives each input and the input's number. Then it receives each output and note (such as
            `SetpointSent`) that the input causes, with the same number.
        world: simulated world with random differences from the mission (`sim.draws`) and with the faults of
            the mock servo, or None for no differences.
    """

    def __init__(
        self,
        mission: Mission,
        seed: int,
        observe: Observe | None = None,
        fault: Fault | None = None,
        world: DrawnWorld | None = None,
    ) -> None:
        self.mission = mission
        if world is None:
            world = DrawnWorld(mission, None, {})
        true, driver = world.mission, mission.vehicle.lock_driver or LockDriver.MOCK
        if not DRIVERS[driver].simulated:
            driver = LockDriver.MOCK
        self.vehicle = SimulatedVehicle(true, seed, driver)
        self.autopilot = self.vehicle.autopilot
        self.autopilot.send_text = self._on_text
        self.deadman_s = mission.vehicle.guard.deadman_s
        self._observe = observe
        self.core = FlightCore(mission)
        # Latency of the simulated computer, independent of this computer's speed.
        plan_us = round(true.vehicle.simulation.replan_latency_s * 1e6)
        # Without a fault, the shell calls the observer directly, which saves time for every record.
        notice = self._observe_record if fault is not None else observe or (lambda record, number: None)
        self._clock = _FastClock(self)
        self.shell = Shell(self.core, self, notice, InProcessTime(self._clock, plan_us))
        self.shell.planners = {
            kind: _PlannerAtOnce(Planner(mission, kind), self.shell.time)
            for kind in kinds_of_requests(mission)
        }
        self._ticks = 0
        self._connected = False  # the app, too, accepts telemetry only after the first answer to a request
        self._sender = TelemetrySender(self.vehicle)
        self._twin_sender: TelemetrySender | None = None
        self._texts: list[tuple[str, str]] = []
        self._last_setpoint: Setpoint | None = None
        self._repeated_us = 0
        self._lock_states: list[LockState] = []
        operator_s = true.vehicle.simulation.operator_s
        self._operator_us = None if operator_s is None else round(operator_s * 1e6)
        self._continue_us: int | None = None
        self.mock: MockDriver | None = None
        self.lock: LockSession | None = None
        if mission.vehicle.lock is not None:
            self.shell.lock = self.lock = self._make_lock(mission.vehicle.lock, driver, world.lock_faults)
        self.poses: FastPoses | None = None
        if mission.vehicle.mocap.url is not None:
            self.shell.poses = self.poses = self._make_poses()
        self.faulted = None if fault is None else FlightWithFault(self, fault, seed)

    def _make_poses(self) -> FastPoses:
        from dart_flight.run.fast_poses import FastPoses  # noqa: PLC0415  (MAVSDK takes long to load)

        return FastPoses(self.mission, self.autopilot, self._clock, self._arrive)

    def _make_lock(self, lock: LockConfig, driver: LockDriver, faults: MockFaults | None) -> LockSession:
        def clock_us() -> int:
            return self.autopilot.time_us

        actuator = self.autopilot.set_actuator
        hardware = make_driver(
            lock, driver, clock_us=clock_us, link=ActuatorLink(actuator, None), faults=faults, gpio=False
        )
        self.mock = hardware if isinstance(hardware, MockDriver) else None
        return LockSession(lock, hardware, clock_us, self._lock_states.append)

    def run(self) -> None:
        """Fly until the core ends the flight, or until the time limit.

        Without the limit, a simulated flight that never ends would block a campaign.
        """
        limit_s = time_limit_s(self.mission)
        self.step(ClockOffset(self.host_us, 0))
        if self.lock is not None:
            self.lock.start()
        while self.core.end is None and self.autopilot.now_s < limit_s and not self._orphaned:
            self.tick()
        silent = self.faulted is not None and self.faulted.app_silent
        if self.core.end is None and not (self._orphaned or silent):
            message = f"the simulated flight did not end within {limit_s:.0f} s of simulated time"
            self.step(OperatorRequest(self.host_us, Request.WORLD_DIED, message))

    @property
    def _orphaned(self) -> bool:
        return self.faulted is not None and self.faulted.app_dead and not self.autopilot.armed

    @property
    def host_us(self) -> int:
        """Host's monotonic time as the app would read it."""
        # The host's clock must not follow the autopilot's clock, which may jump.
        return round(self.autopilot.now_s * 1e6) + _HOST_OFFSET_US

    def tick(self) -> None:
        """Advance vehicle, telemetry and lock by 4 ms."""
        if self.faulted is not None:
            self.faulted.tick()
        if self.mock is not None:
            self.vehicle.set_horn(self.mock.horn_pulse_us(self.autopilot.time_us))
        self.vehicle.advance()
        self._ticks += 1
        self._truth()
        if self._ticks % _TIMESYNC_EVERY == 1:
            self._request_time()
        if self.faulted is not None and self.faulted.app_silent:
            self._repeat()  # MAVSDK's thread keeps running when the app hangs
            return
        if self._ticks % _HOST_EVERY == 0:
            if self.lock is not None:
                self.lock.poll()
            self.step(Tick(self.host_us))
        while self._lock_states:
            self.step(self._lock_states.pop(0))
        for answer in self.shell.due_answers():
            self.step(answer)
        if self._continue_us is not None and self._continue_us <= self.host_us:
            self._continue_us = None
            self.step(OperatorRequest(self.host_us, Request.CONTINUE))
        self._telemetry()
        if self.poses is not None:
            self.poses.tick()
        if self.faulted is not None:
            for item in self.faulted.arrived():
                self._arrive(item)
        self._repeat()

    def _truth(self) -> None:
        plant = self.autopilot.plant
        if self._ticks % _TRUTH_EVERY == 0:
            self.shell.note(plant.truth())
        while plant.finished:
            self.shell.note(plant.finished.pop(0))

    def _telemetry(self) -> None:
        for item in self._sender.samples(self._ticks, self.host_us):
            self._receive(item)
        if self.faulted is not None and self.faulted.twin is not None:
            if self._twin_sender is None:
                self._twin_sender = TelemetrySender(self.faulted.twin, begins=False)
            for item in self._twin_sender.samples(self._ticks, self.host_us):
                self._receive(item)
        while self._texts:
            severity, text = self._texts.pop(0)
            self._receive(StatusText(self.autopilot.time_us, self.host_us, severity, text))

    def _receive(self, item: Input) -> None:
        if self.faulted is None:
            self._arrive(item)
        else:
            self.faulted.send_in(item)

    def _arrive(self, item: Input) -> None:
        self._connected = self._connected or type(item) is RoundTrip
        if self._connected:
            self.shell.step(item)

    def _request_time(self) -> None:
        if self.faulted is None:
            self.deliver(TimeRequest(self.host_us))
        else:
            self.faulted.send_out(TimeRequest(self.host_us))

    def _on_text(self, severity: str, text: str) -> None:
        self._texts.append((severity, text))

    # -- inputs and commands of the core (`shell.Transport`) --

    def step(self, item: Input) -> None:
        """Step the core with an input, which a sensor, the operator or a fault has caused."""
        self.shell.step(item)

    def _observe_record(self, record: Record, number: int) -> None:
        if self._observe is not None:
            self._observe(record, number)
        if self.faulted is not None:
            self.faulted.observe(record)

    def send(self, setpoint: Setpoint) -> None:
        """Send a setpoint to the autopilot, and repeat it periodically like MAVSDK."""
        self._last_setpoint = setpoint
        self._transmit(setpoint)

    def act(self, action: VehicleAction) -> None:
        self._transmit(action)

    def enter(self, phase: Phase) -> None:
        # The simulated operator ends every pause.
        waits = phase is Phase.PAUSE and self._operator_us is not None
        self._continue_us = self.host_us + (self._operator_us or 0) if waits else None

    def fall_silent(self) -> None:
        """Stop repeating the last setpoint; also called when a fault has ended the simulated app."""
        self._last_setpoint = None

    def finish(self) -> None:
        """Do nothing: `run` ends when the core has ended the mission."""

    def _repeat(self) -> None:
        if self._last_setpoint is not None and self.host_us - self._repeated_us >= _REPEAT_US:
            self._transmit(self._last_setpoint)

    def _transmit(self, order: Setpoint | VehicleAction) -> None:
        """Send an order to the autopilot, through the faulty link if a fault affects the link."""
        self._repeated_us = self.host_us
        if self.faulted is not None:
            self.faulted.send_out(order)
        else:
            self.deliver(order)

    def deliver(self, order: Order) -> None:
        if isinstance(order, Setpoint):
            self.autopilot.set_trajectory(
                TrajectorySetpoint(
                    order.position_ned,
                    order.velocity_ned or _NAN3,
                    order.acceleration_ned or _NAN3,
                    order.yaw_ned_rad,
                )
            )
        elif isinstance(order, TimeRequest):
            self._receive(RoundTrip(self.host_us, order.sent_us, self.autopilot.time_us))
        else:
            self._perform(order)

    def _perform(self, action: VehicleAction) -> None:
        a = self.autopilot
        if action is VehicleAction.ARM:
            ok = a.arm()
        elif action in (VehicleAction.DISARM, VehicleAction.KILL):
            ok = a.disarm(force=action is VehicleAction.KILL)
        else:
            ok = a.set_mode(FLIGHT_MODES[action])
            if action is not VehicleAction.OFFBOARD:
                self._last_setpoint = None
        self.step(CommandResult(a.time_us, action.value, ok, "" if ok else "denied"))


def time_limit_s(mission: Mission) -> float:
    return _LONGEST_S + mission.goal.hold_s + sum(waypoint.hold_s for waypoint in mission.waypoints)


def simulated_driver(mission: Mission) -> LockDriver:
    """Return the lock driver, or `mock` without a lock; raise InputError for a driver without simulation."""
    driver = mission.vehicle.lock_driver or LockDriver.MOCK
    if not DRIVERS[driver].simulated:
        others = driver_names(lambda entry: entry.simulated)
        raise InputError(f"the {driver.value} lock driver cannot be simulated; choose {others}")
    return driver


def fly_fast(
    mission: Mission,
    seed: int,
    log_dir: Path | None,
    progress: Onlooker | None = None,
    lock_faults: MockFaults | None = None,
    fault: Fault | None = None,
    spreads: Mapping[str, float] | None = None,
    keep_record: Callable[[FlightRecord], None] | None = None,
) -> Verdict:
    """Fly in process and in simulated time, and return the verdict.

    Args:
        log_dir: parent folder of the flight's folder, or None for no log on disk (campaigns).
        lock_faults: faults of the mock servo from the start of the flight, or None for faults drawn with the
            seed.
        keep_record: callback for the complete record; without `log_dir` the record's log is in memory.

    Raises:
        InputError: the log cannot be written, or the lock driver does not work in simulated time.
    """
    simulated_driver(mission)  # raises if the driver cannot be simulated
    world = draw_world(mission, seed, spreads or {})
    if lock_faults is not None:
        world = world._replace(lock_faults=lock_faults)
    keep_in: LogPlace = IN_MEMORY if log_dir is None and keep_record is not None else log_dir
    record = FlightRecord(mission, World.FAST, seed, keep_in, world.drawn)
    if progress is not None:
        record.onlookers.append(progress)
        record.notice = progress
    flight = FastFlight(mission, seed, observe=record, fault=fault, world=world)
    flight.run()
    record.close()
    if keep_record is not None:
        keep_record(record)
    return record.build()
