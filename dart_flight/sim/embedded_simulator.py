"""The simulated vehicle as a separate process: plant, embedded autopilot and MAVLink, in lockstep or not.

Started by `dry-run` with its end of a pipe: commands come on standard input, truth goes to standard output,
one JSON object a line. When the app dies (end of input) the vehicle flies on to its failsafe, which goes to
its text log, and the process ends once it has landed, 30 s later at the latest; after 3 s in a pilot's hands.
"""

from __future__ import annotations

import gc
import itertools
import math
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from typing import IO, Protocol

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import FlightMode
from dart_flight.sim.draws import draw_world
from dart_flight.sim.embedded_autopilot import TICK_S, TICK_US
from dart_flight.sim.faults.fault_table import Fault, FaultSite, VehicleFault, impairment_of
from dart_flight.sim.faults.impairment import Impairment
from dart_flight.sim.faults.twin import make_second_vehicle
from dart_flight.sim.lockstep import Lockstep
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.pipe import (
    FULL_SPEED,
    FaultLine,
    Horn,
    LineReader,
    LineWriter,
    Ready,
    SimulatorDied,
    SimulatorSpec,
    Stepped,
    Truth,
)
from dart_flight.sim.plant import Plant
from dart_flight.sim.simulated_vehicle import SimulatedVehicle

_TRUTH_EVERY = 2  # ticks
_ORPHAN_S = 28.0  # after the app's death; with start and end it stays within 30 s
_PILOT_S = 3.0  # likewise in a pilot's hands, where it only has to hold still
STALL_S = 0.25  # a stall longer than this is not caught up with: the world pauses instead


class Pacer:
    """Limiter of a world's pace; after a long stall the world pauses and does not catch up."""

    def __init__(self) -> None:
        self._due_s = time.monotonic()

    def wait(self, period_s: float) -> None:
        """Wait until the next tick is due, a period after the last tick; do not wait for a period of 0."""
        now_s = time.monotonic()
        if self._due_s > now_s:
            time.sleep(self._due_s - now_s)
        elif now_s - self._due_s > STALL_S:
            self._due_s = now_s
        self._due_s += period_s


def ticks_in_real_time(period_s: float = TICK_S) -> Iterator[int]:
    """Yield numbers of ticks, one every period; with 4 ms a tick takes the time it simulates."""
    pace = Pacer()
    for tick in itertools.count():
        pace.wait(period_s)
        yield tick


class ServedWorld(Protocol):
    """What is served to the app, whichever autopilot flies in it."""

    @property
    def time_us(self) -> int:
        """The autopilot's time, microseconds."""

    def set_horn(self, pulse_us: float) -> None:
        """Where the mock servo's horn is."""

    def begin_fault(self, fault: Fault) -> None:
        """A fault begins."""

    def advance(self) -> Plant:
        """Go on by one tick; returns the plant."""
        ...

    def is_over(self, alone_s: float) -> bool:
        """Whether it may end, without the app for so long; 0: the app has gone this moment."""
        ...


def serve(
    world: ServedWorld,
    writer: LineWriter,
    commands: IO[bytes],
    speed: float,
    lockstep: Lockstep | None = None,
    wake: Sequence[int] = (),
) -> int:
    """Process the app's lines and send the truth, tick by tick, until app and world have ended.

    Args:
        world: the simulated world.
        writer: writer of the truth.
        commands: lines from the app.
        speed: highest number of simulated seconds per second.
        lockstep: decides whether time may advance; None: time does not wait for the app.
        wake: the world's descriptors that become readable when data has arrived.

    Returns:
        The number of ticks.

    Raises:
        FlightError: the app does not answer, or the network fails.
    """
    reader, gone_s = LineReader(commands), math.inf

    def take_lines() -> bool:
        """Process the app's lines; return whether the app is still connected."""
        reader.clear()
        while reader.items:
            item = reader.items.popleft()
            if isinstance(item, Horn):
                world.set_horn(item.pulse_us)
            elif isinstance(item, FaultLine):
                world.begin_fault(item.fault)
            elif isinstance(item, Stepped) and lockstep is not None:
                lockstep.update(item)
        return not reader.closed

    # Exempt the objects loaded so far from garbage collection in flight.
    gc.freeze()
    pace = Pacer()
    for tick in itertools.count():
        if lockstep is not None and not reader.closed:
            lockstep.wait(world.time_us + TICK_US, (reader.wake, *wake), take_lines)
        take_lines()
        # Run without a limit only while lockstep holds the world back.
        waits = lockstep is not None and lockstep.holds and not reader.closed
        pace.wait(TICK_S / (1.0 if speed == FULL_SPEED and not waits else speed))
        plant = world.advance()
        if tick % _TRUTH_EVERY == 0:
            writer.put(Truth(state=plant.truth()))
        while plant.finished:
            writer.put(Truth(contact=plant.finished.pop(0)))
        if reader.closed:
            now_s = time.monotonic()
            gone_s = min(gone_s, now_s)
            if world.is_over(now_s - gone_s):
                break
    return tick


class TerminatedError(Exception):
    """The process was told to end (SIGTERM)."""


def raise_terminated(_signum: int, _frame: object) -> None:
    """Handler of SIGTERM for a world that has something to put away first."""
    raise TerminatedError


class WorldLog:
    """The world's text log: times in its own seconds; nothing where the app wants none."""

    def __init__(self, path: str | None) -> None:
        self._file = None if path is None else open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115

    def write(self, now_s: float, text: str) -> None:
        """Add a line."""
        if self._file is not None:
            self._file.write(f"{now_s:9.3f} s  {text}\n")


class EmbeddedSimulator:
    """The simulated vehicle with the embedded autopilot, between the app's pipe and its sockets."""

    def __init__(self, spec: SimulatorSpec) -> None:
        self._spec = spec
        true = draw_world(spec.mission, spec.seed, spec.spreads).mission
        self._vehicle = SimulatedVehicle(true, spec.seed, true.vehicle.lock_driver)
        self.set_horn = self._vehicle.set_horn
        self._autopilot = self._vehicle.autopilot
        self._endpoint = MavlinkEndpoint(self._autopilot, tuple(spec.ports))
        self._log = WorldLog(spec.log)
        self._to_link = self._autopilot.say
        self._autopilot.say = self._say
        self._fault: VehicleFault | None = None
        self._link_back_s: float | None = None
        self._twin: tuple[SimulatedVehicle, MavlinkEndpoint] | None = None

    def run(self, commands: IO[bytes], truth: IO[bytes]) -> None:
        """Fly at the wanted pace until the app is gone and the vehicle is down."""
        writer = LineWriter(truth)
        writer.put(Ready(self._autopilot.time_us))
        lockstep = None
        if self._spec.lockstep:
            lockstep = Lockstep(self._endpoint, answers_at_rest=True, waits_at_first=True)
        try:
            serve(self, writer, commands, self._spec.speed, lockstep, self._endpoint.sockets)
        except FlightError as error:
            self._say("critical", str(error))
            writer.put(SimulatorDied(str(error)))
            writer.finish()
        self._say("info", "simulated vehicle stops")
        self._endpoint.close()

    @property
    def time_us(self) -> int:
        """As `ServedWorld`."""
        return self._autopilot.time_us

    def _say(self, severity: str, text: str) -> None:
        self._to_link(severity, text)
        self._log.write(self._autopilot.now_s, f"{severity}: {text}")

    def advance(self) -> Plant:
        """As `ServedWorld`."""
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
        """As `ServedWorld`."""
        self._say("warning", f"fault {fault.name} {fault.value:g}")
        if fault.kind.place is not FaultSite.LINK:
            self._fault = VehicleFault(self._vehicle, fault)
        elif fault.name == "imu-dropout":
            self._endpoint.stop_imu()
        elif fault.name == "second-vehicle":
            spec = self._spec
            twin = make_second_vehicle(spec.mission, spec.seed, fault.value, self._autopilot.time_us)
            self._twin = (twin, MavlinkEndpoint(twin.autopilot, tuple(spec.ports)))
        else:
            self._endpoint.impair(impairment_of(fault))
            if fault.name == "link-loss" and fault.value > 0.0:
                self._link_back_s = self._autopilot.now_s + fault.value

    def is_over(self, alone_s: float) -> bool:
        """As `ServedWorld`: it flies on to its failsafe, and ends when it has landed."""
        if not alone_s and self._autopilot.armed:
            self._say("warning", "app disconnected; continuing to the failsafe")
        most_s = _PILOT_S if self._autopilot.mode is FlightMode.MANUAL else _ORPHAN_S
        return not self._autopilot.armed or alone_s > most_s


def main() -> int:
    """Body of the process; returns its exit status."""
    # The app's terminal must not take the vehicle down: Ctrl-C is the app's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = msgspec.json.decode(sys.stdin.buffer.readline(), type=SimulatorSpec)
    if spec.px4 is not None:
        from dart_flight.sim.px4.px4_simulator import Px4Simulator  # noqa: PLC0415  (only where PX4 flies)

        return Px4Simulator(spec, spec.px4).run(sys.stdin.buffer, sys.stdout.buffer)
    if spec.hitl is not None:
        from dart_flight.sim.px4.hitl_simulator import HitlSimulator  # noqa: PLC0415  (needs a serial port)

        return HitlSimulator(spec, spec.hitl).run(sys.stdin.buffer, sys.stdout.buffer)
    EmbeddedSimulator(spec).run(sys.stdin.buffer, sys.stdout.buffer)
    return 0


if __name__ == "__main__":
    # Not sys.exit: the interpreter aborts where a thread still waits in stdin for the app's next line.
    os._exit(main())
