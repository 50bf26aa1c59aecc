"""The simulated vehicle in a process of its own: plant, embedded autopilot, MAVLink, at a pace.

Started by `dry-run` with its end of a pipe: commands come on standard input, truth goes to standard output,
one JSON object a line. When the app dies (end of input) the vehicle flies on to its failsafe, which goes to
its text log, and the process ends once it has landed, 30 s later at the latest; after 3 s in a pilot's hands.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import IO

import msgspec

from dart_flight.base.records import FlightMode
from dart_flight.config.document import Document
from dart_flight.config.mission import parse_mission
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.sim.autopilot import TICK_S
from dart_flight.sim.draws import draw_world
from dart_flight.sim.faults.impairment import Impairment
from dart_flight.sim.faults.kinds import Fault, Place, VehicleFault, impairment_of
from dart_flight.sim.faults.twin import second_vehicle
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.pipe import FaultLine, Horn, LineReader, LineWriter, Ready, Truth, WorldSpec
from dart_flight.sim.vehicle import SimulatedVehicle

_TRUTH_EVERY = 2  # ticks
_ORPHAN_S = 28.0  # after the app's death; with start and end it stays within 30 s
_PILOT_S = 3.0  # likewise in a pilot's hands, where it only has to hold still
_LATE_S = 0.25  # a stall longer than this is not caught up with: the world pauses instead


def run_in_real_time(step: Callable[[], None], until: Callable[[], bool], period_s: float = TICK_S) -> None:
    """Call `step` every period until `until` says so; after a long stall the world pauses rather than races.

    With a period of 4 ms a tick takes the time it simulates; a shorter one is a world at higher speed.
    """
    due = time.monotonic()
    while not until():
        step()
        due += period_s
        now = time.monotonic()
        if due > now:
            time.sleep(due - now)
        elif now - due > _LATE_S:
            due = now


class VehicleProcess:
    """The simulated vehicle between its pipe and its sockets."""

    def __init__(self, spec: WorldSpec, commands: IO[bytes], truth: IO[bytes]) -> None:
        vehicle = msgspec.json.decode(spec.vehicle, type=VehicleConfig)
        mission = parse_mission(Document.load(spec.mission), vehicle)
        true = draw_world(mission, spec.seed, spec.spreads).mission
        self._vehicle = SimulatedVehicle(true, spec.seed, spec.driver)
        self._autopilot = self._vehicle.autopilot
        self._endpoint = MavlinkEndpoint(self._autopilot, tuple(spec.ports))
        self._log: IO[str] | None = None
        if spec.log is not None:
            self._log = open(spec.log, "a", encoding="utf-8", buffering=1)  # noqa: SIM115
        self._to_link = self._autopilot.say
        self._autopilot.say = self._say
        self._writer, self._reader = LineWriter(truth), LineReader(commands)
        self._period_s = TICK_S / spec.speed
        self._ticks = 0
        self._orphan_since_s: float | None = None
        self._over = False
        self._fault: VehicleFault | None = None
        self._link_back_s: float | None = None
        self._mission, self._seed, self._ports = mission, spec.seed, tuple(spec.ports)
        self._twin: tuple[SimulatedVehicle, MavlinkEndpoint] | None = None

    def run(self) -> None:
        """Fly at the wanted pace until the app is gone and the vehicle is down."""
        self._writer.put(Ready(self._autopilot.time_us))
        # What has been loaded by now stays: the collector need not walk it in flight.
        gc.freeze()
        run_in_real_time(self._step, lambda: self._over, self._period_s)
        self._say("info", "simulated vehicle stops")
        self._endpoint.close()

    def _say(self, severity: str, text: str) -> None:
        self._to_link(severity, text)
        if self._log is not None:
            self._log.write(f"{self._autopilot.now_s:9.3f} s {severity}: {text}\n")

    def _step(self) -> None:
        while self._reader.items:
            item = self._reader.items.popleft()
            if isinstance(item, Horn):
                self._vehicle.set_horn(item.pulse_us)
            elif isinstance(item, FaultLine):
                self._break(item.fault)
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
        plant = self._autopilot.plant
        if self._ticks % _TRUTH_EVERY == 0:
            self._writer.put(Truth(state=plant.truth()))
        while plant.finished:
            self._writer.put(Truth(contact=plant.finished.pop(0)))
        self._ticks += 1
        if self._reader.closed:
            self._fly_on_alone()

    def _break(self, fault: Fault) -> None:
        self._say("warning", f"fault {fault.name} {fault.value:g}")
        if fault.kind.place is not Place.LINK:
            self._fault = VehicleFault(self._vehicle, fault)
        elif fault.name == "imu-dropout":
            self._endpoint.stop_imu()
        elif fault.name == "second-vehicle":
            twin = second_vehicle(self._mission, self._seed, fault.value, self._autopilot.time_us)
            self._twin = (twin, MavlinkEndpoint(twin.autopilot, self._ports))
        else:
            self._endpoint.impair(impairment_of(fault))
            if fault.name == "link-loss" and fault.value > 0.0:
                self._link_back_s = self._autopilot.now_s + fault.value

    def _fly_on_alone(self) -> None:
        """The app is gone: fly on to the failsafe, end when landed."""
        now = self._autopilot.now_s
        if self._orphan_since_s is None:
            self._orphan_since_s = now
            if self._autopilot.armed:
                self._say("warning", "the app is gone, flying on to the failsafe")
            return
        most_s = _PILOT_S if self._autopilot.mode is FlightMode.MANUAL else _ORPHAN_S
        if not self._autopilot.armed or now - self._orphan_since_s > most_s:
            self._over = True


def main() -> int:
    """Body of the process; returns its exit status."""
    # The app's terminal must not take the vehicle down: Ctrl-C is the app's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = msgspec.json.decode(sys.stdin.buffer.readline(), type=WorldSpec)
    if spec.px4 is not None:
        from dart_flight.sim.px4.process import Px4Process  # noqa: PLC0415  (only where PX4 flies)

        return Px4Process(spec, spec.px4, sys.stdin.buffer, sys.stdout.buffer).run()
    VehicleProcess(spec, sys.stdin.buffer, sys.stdout.buffer).run()
    return 0


if __name__ == "__main__":
    # Not sys.exit: the interpreter aborts where a thread still waits in stdin for the app's next line.
    os._exit(main())
