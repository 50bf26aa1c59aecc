"""The simulated vehicle in a process of its own: plant, embedded autopilot, MAVLink, real time.

Started by `dry-run` with its end of a pipe: commands come on standard input, truth goes to standard output,
one JSON object a line. When the app dies (end of input) the vehicle flies on to its failsafe, which goes to
its text log, and the process ends once it has landed, 30 s later at the latest.
"""

from __future__ import annotations

import contextlib
import gc
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import IO

import msgspec

from dart_flight.config.document import Document
from dart_flight.config.mission import parse_mission
from dart_flight.config.vehicle import LockDriver, VehicleConfig
from dart_flight.samples import TruthContact, TruthSample
from dart_flight.sim.autopilot import TICK_S
from dart_flight.sim.faults import Fault, Place, VehicleFault, impairment_of
from dart_flight.sim.impairment import Impairment
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.vehicle import SimulatedVehicle

_TRUTH_EVERY = 2  # ticks
_ORPHAN_S = 28.0  # after the app's death; with start and end it stays within 30 s
_LATE_S = 0.25  # a stall longer than this is not caught up with: the world pauses instead


class WorldSpec(msgspec.Struct):
    """What the process is told on its first line of input."""

    mission: str
    vehicle: str  # configuration as JSON: what the app has, whatever file it came from
    seed: int
    ports: list[int]
    driver: LockDriver
    log: str | None = None


class Horn(msgspec.Struct, tag="horn"):
    """The mock servo's modelled horn, as a pulse in microseconds."""

    pulse_us: float


class Ping(msgspec.Struct, tag="ping"):
    """Nothing; a line that keeps the pipe alive."""


class FaultLine(msgspec.Struct, tag="fault"):
    """A fault that begins now."""

    fault: Fault


WorldInput = Horn | Ping | FaultLine


class Ready(msgspec.Struct, tag="ready"):
    """The autopilot sends from now on."""

    time_us: int


class Truth(msgspec.Struct, tag="truth"):
    """A truth record on its way to the app."""

    state: TruthSample | None = None
    contact: TruthContact | None = None


WorldOutput = Ready | Truth


def run_in_real_time(step: Callable[[], None], until: Callable[[], bool]) -> None:
    """Call `step` every 4 ms until `until` says so; after a long stall the world pauses rather than races."""
    due = time.monotonic()
    while not until():
        step()
        due += TICK_S
        now = time.monotonic()
        if due > now:
            time.sleep(due - now)
        elif now - due > _LATE_S:
            due = now


class _Writer:
    """Lines to a pipe from a thread of their own: a hung reader must not stop the flight."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._lines: deque[bytes] = deque(maxlen=5000)
        self._wake = threading.Event()
        threading.Thread(target=self._run, daemon=True, name="truth").start()

    def put(self, item: WorldOutput) -> None:
        self._lines.append(msgspec.json.encode(item))
        self._wake.set()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            with contextlib.suppress(OSError, ValueError):  # the reader is gone
                while self._lines:
                    self._stream.write(self._lines.popleft() + b"\n")
                self._stream.flush()


class _Reader:
    """Lines from the app; `closed` once the app is gone."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.items: deque[WorldInput] = deque()
        self.closed = False
        threading.Thread(target=self._run, daemon=True, name="commands").start()

    def _run(self) -> None:
        decoder = msgspec.json.Decoder(WorldInput)
        for line in self._stream:
            with contextlib.suppress(msgspec.DecodeError):
                self.items.append(decoder.decode(line))
        self.closed = True


class VehicleProcess:
    """The simulated vehicle between its pipe and its sockets."""

    def __init__(self, spec: WorldSpec, commands: IO[bytes], truth: IO[bytes]) -> None:
        vehicle = msgspec.json.decode(spec.vehicle, type=VehicleConfig)
        mission = parse_mission(Document.load(spec.mission), vehicle)
        self._vehicle = SimulatedVehicle(mission, spec.seed, spec.driver)
        self._autopilot = self._vehicle.autopilot
        self._endpoint = MavlinkEndpoint(self._autopilot, tuple(spec.ports))
        self._log: IO[str] | None = None
        if spec.log is not None:
            self._log = open(spec.log, "a", encoding="utf-8", buffering=1)  # noqa: SIM115
        self._to_link = self._autopilot.say
        self._autopilot.say = self._say
        self._writer, self._reader = _Writer(truth), _Reader(commands)
        self._ticks = 0
        self._orphan_since_s: float | None = None
        self._over = False
        self._fault: VehicleFault | None = None
        self._link_back_s: float | None = None

    def run(self) -> None:
        """Fly in real time until the app is gone and the vehicle is down."""
        self._writer.put(Ready(self._autopilot.time_us))
        # What has been loaded by now stays: the collector need not walk it in flight.
        gc.freeze()
        run_in_real_time(self._step, lambda: self._over)
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
        elif not self._autopilot.armed or now - self._orphan_since_s > _ORPHAN_S:
            self._over = True


def main() -> int:
    """Body of the process; returns its exit status."""
    # The app's terminal must not take the vehicle down: Ctrl-C is the app's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = msgspec.json.decode(sys.stdin.buffer.readline(), type=WorldSpec)
    VehicleProcess(spec, sys.stdin.buffer, sys.stdout.buffer).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
