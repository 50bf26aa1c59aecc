"""The world of the embedded autopilot: plant, autopilot and MAVLink, with or without lockstep.

If the app ends (closed pipe), the vehicle continues until its failsafe has acted. The world's text log
contains the vehicle's reports. The process ends when the vehicle has landed, but at the latest 30 s after the
app has ended. If a pilot flies with the sticks, this limit is 3 s.
"""

from __future__ import annotations

from typing import IO

from dart_flight.base.errors import FlightError
from dart_flight.base.records import FlightMode
from dart_flight.sim.draws import draw_world
from dart_flight.sim.faults.fault_table import Fault, FaultSite, VehicleFault, make_impairment
from dart_flight.sim.faults.impairment import Impairment
from dart_flight.sim.faults.twin import make_second_vehicle
from dart_flight.sim.lockstep import Lockstep
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.pipe import (
    LineWriter,
    Ready,
    SimulatorDied,
    SimulatorSpec,
)
from dart_flight.sim.plant import Plant
from dart_flight.sim.pose_feed import EmulatedMotionCapture
from dart_flight.sim.served_world import WorldLog, serve
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

_ORPHAN_S = 28.0  # longest flight after the app's end, so that the process ends within 30 s
_PILOT_S = 3.0  # the same limit in a pilot's mode, in which the vehicle only holds its position


class EmbeddedSimulator:
    """The simulated vehicle with the embedded autopilot, connected to the app's pipe and sockets."""

    def __init__(self, spec: SimulatorSpec) -> None:
        self._spec = spec
        true = draw_world(spec.mission, spec.seed, spec.spreads).mission
        self._vehicle = SimulatedVehicle(true, spec.seed, true.vehicle.lock_driver)
        self.set_horn = self._vehicle.set_horn
        self._autopilot = self._vehicle.autopilot
        self._endpoint = MavlinkEndpoint(self._autopilot, tuple(spec.ports))
        self._log = WorldLog(spec.log)
        self._to_link = self._autopilot.send_text
        self._autopilot.send_text = self._report
        self._fault: VehicleFault | None = None
        self._link_back_s: float | None = None
        self._twin: tuple[SimulatedVehicle, MavlinkEndpoint] | None = None
        self._mocap: EmulatedMotionCapture | None = None
        if spec.mocap is not None:
            self._autopilot.use_external_poses()
            self._mocap = EmulatedMotionCapture(spec.mocap, spec.mission, self._autopilot.plant)

    def run(self, commands: IO[bytes], truth: IO[bytes]) -> None:
        writer = LineWriter(truth)
        writer.put(Ready(self._autopilot.time_us, mocap_url=self._mocap.url if self._mocap else None))
        lockstep = None
        if self._spec.lockstep:
            lockstep = Lockstep(
                self._endpoint,
                answers_at_rest=True,
                waits_at_first=True,
                log=lambda text: self._log.write(self._autopilot.now_s, text),
            )
        try:
            serve(self, writer, commands, self._spec.speed, lockstep, self._endpoint.sockets)
        except FlightError as error:
            self._report("critical", str(error))
            writer.put(SimulatorDied(str(error)))
            writer.finish()
        self._report("info", "simulated vehicle stops")
        if self._mocap is not None:
            self._mocap.close()
        self._endpoint.close()

    @property
    def time_us(self) -> int:
        return self._autopilot.time_us

    def _report(self, severity: str, text: str) -> None:
        self._to_link(severity, text)
        self._log.write(self._autopilot.now_s, f"{severity}: {text}")

    def advance(self) -> Plant:
        if self._fault is not None:
            self._fault.tick()
        if self._link_back_s is not None and self._autopilot.now_s >= self._link_back_s:
            self._endpoint.impair(Impairment())
            self._link_back_s = None
        self._vehicle.advance()
        self._endpoint.exchange()
        if self._twin is not None:
            twin, endpoint = self._twin
            twin.advance()
            endpoint.exchange()
        return self._autopilot.plant

    def begin_fault(self, fault: Fault) -> None:
        self._report("warning", f"fault {fault.name} {fault.value:g}")
        if self._mocap is not None and fault.kind.site is FaultSite.MOCAP:
            self._mocap.feed.begin_fault(fault, self._autopilot.now_s)
        elif fault.kind.site is not FaultSite.LINK:
            self._fault = VehicleFault(self._vehicle, fault)
        elif fault.name == "imu-dropout":
            self._endpoint.stop_imu()
        elif fault.name == "second-vehicle":
            spec = self._spec
            twin = make_second_vehicle(spec.mission, spec.seed, fault.value, self._autopilot.time_us)
            self._twin = (twin, MavlinkEndpoint(twin.autopilot, tuple(spec.ports)))
        else:
            self._endpoint.impair(make_impairment(fault))
            if fault.name == "link-loss" and fault.value > 0.0:
                self._link_back_s = self._autopilot.now_s + fault.value

    def publish_pose(self) -> int | None:
        if self._mocap is None:
            return None
        return self._mocap.publish(self._autopilot.now_s, self._autopilot.pose)

    def is_over(self, alone_s: float) -> bool:
        """Return whether the failsafe has landed the vehicle, or the time limit has passed."""
        if not alone_s and self._autopilot.armed:
            self._report("warning", "app disconnected; the vehicle continues until its failsafe acts")
        most_s = _PILOT_S if self._autopilot.mode is FlightMode.MANUAL else _ORPHAN_S
        return not self._autopilot.armed or alone_s > most_s
