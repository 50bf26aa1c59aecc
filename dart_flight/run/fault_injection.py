"""Injection of one fault into a flight of the fast world, or into the link of that flight."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import msgspec

from dart_flight.base.records import (
    ImuSample,
    Input,
    Record,
    Setpoint,
    VehicleAction,
)
from dart_flight.config.mission import Mission
from dart_flight.lock.drivers.mock import MockDriver
from dart_flight.sim.embedded_autopilot import Autopilot
from dart_flight.sim.faults.fault_table import (
    Fault,
    FaultSite,
    Trigger,
    VehicleFault,
    make_impairment,
    make_mock_faults,
)
from dart_flight.sim.faults.impairment import Impairment, LossyLink
from dart_flight.sim.faults.twin import make_second_vehicle
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

if TYPE_CHECKING:
    from dart_flight.run.fast_poses import FastPoses


class TimeRequest(NamedTuple):
    """TIMESYNC request to the autopilot; `sent_us` is the host time."""

    sent_us: int


Order = Setpoint | VehicleAction | TimeRequest


class FaultyFlight(Protocol):
    """The members of a flight that the injected fault uses."""

    mission: Mission
    vehicle: SimulatedVehicle
    autopilot: Autopilot
    mock: MockDriver | None
    poses: FastPoses | None
    deadman_s: float

    @property
    def host_us(self) -> int: ...

    def fall_silent(self) -> None:
        """Stop repeating the last setpoint."""

    def deliver(self, order: Order) -> None:
        """Deliver an order to the autopilot."""


class FlightWithFault:
    """Injector of a fault into a flight of the fast world; it also models the link between app and vehicle.

    As in a flight over MAVSDK, the last setpoint of a hung app is repeated until the deadman kills the app.
    """

    def __init__(self, flight: FaultyFlight, fault: Fault, seed: int) -> None:
        self._flight, self.fault = flight, fault
        self._trigger = Trigger(fault)
        self.began_us: int | None = None  # host time
        self._in: LossyLink[Input] = LossyLink(seed)
        self._out: LossyLink[Order] = LossyLink(seed + 1)
        self._vehicle: VehicleFault | None = None
        self._seed = seed
        self.twin: SimulatedVehicle | None = None  # second vehicle on the link; None until it sends
        self._ended = False

    @property
    def app_silent(self) -> bool:
        """Whether the app has stopped working."""
        stops = self.fault.kind.site is FaultSite.APP and self.fault.name != "disk-full"
        return self.began_us is not None and stops

    @property
    def app_dead(self) -> bool:
        """Whether the deadman or another process has killed the app."""
        if not self.app_silent or self.began_us is None:
            return False
        starve_s = 0.0 if self.fault.name == "sigkill" else self._flight.deadman_s
        return self._flight.host_us - self.began_us >= starve_s * 1e6

    def observe(self, record: Record) -> None:
        self._trigger.process(record)

    def tick(self) -> None:
        """Begin the fault when it is due; afterwards update its effects."""
        flight = self._flight
        if self.began_us is None:
            if not self._trigger.is_due(flight.autopilot.time_us):
                return
            self.began_us = flight.host_us
            self._begin()
        if self._vehicle is not None:
            self._vehicle.tick()
        if self.twin is not None:
            self.twin.advance()
        lasts_s = self.fault.value if self.fault.name == "link-loss" and self.fault.value > 0.0 else None
        if lasts_s is not None and not self._ended and flight.host_us - self.began_us > lasts_s * 1e6:
            self._ended = True
            self._in.impairment = self._out.impairment = Impairment()
        if (self.app_dead or self.fault.name == "sigstop") and self.app_silent:
            flight.fall_silent()
        for order in self._out.pop(flight.autopilot.now_s):
            flight.deliver(order)

    def _begin(self) -> None:
        flight, fault, place = self._flight, self.fault, self.fault.kind.site
        if fault.name == "second-vehicle":
            self.twin = make_second_vehicle(flight.mission, self._seed, fault.value, flight.autopilot.time_us)
        if place is FaultSite.LINK:
            self._in.impairment = self._out.impairment = make_impairment(fault)
        elif place is FaultSite.LOCK:
            if flight.mock is not None:
                flight.mock.inject(make_mock_faults(fault))
        elif place is FaultSite.MOCAP:
            if flight.poses is not None:
                flight.poses.begin_fault(fault)
        elif place is not FaultSite.APP:
            self._vehicle = VehicleFault(flight.vehicle, fault)

    def send_in(self, item: Input) -> None:
        """Put a sample on the link to the app."""
        dropped = self.began_us is not None and self.fault.name == "imu-dropout"
        if not (dropped and isinstance(item, ImuSample)):
            self._in.push(self._flight.autopilot.now_s, item)

    def arrived(self) -> list[Input]:
        """Return the samples that reach the app now, with `received_us` set to the current time."""
        received = self._flight.host_us
        return [
            msgspec.structs.replace(item, received_us=received)
            for item in self._in.pop(self._flight.autopilot.now_s)
        ]

    def send_out(self, order: Order) -> None:
        """Put an order on the link to the autopilot."""
        self._out.push(self._flight.autopilot.now_s, order)
        for one in self._out.pop(self._flight.autopilot.now_s):
            self._flight.deliver(one)
