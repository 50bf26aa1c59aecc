"""The app's side of a simulated vehicle that runs in its own process, for the worlds over MAVSDK."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Callable

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.processes import ChildProcess
from dart_flight.base.records import TruthContact, TruthSample
from dart_flight.config.document import utf8_path
from dart_flight.run.app import FlightApp
from dart_flight.run.flight_record import FlightRecord
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.pipe import (
    FaultLine,
    HornPosition,
    Ready,
    SimulatorDied,
    SimulatorSpec,
    Truth,
    WorldOutput,
)

_LAST_WORDS_S = 0.2  # wait this long for the world's last message, but less than the deadman's timeout


class SimulatorError(FlightError):
    """The simulated vehicle did not start, or died."""


class SimulatorProcess:
    """Simulated vehicle in its own process; Ctrl-C and the end of the app do not interrupt its flight.

    `on_truth` is called on a separate thread.
    """

    ready_timeout_s = 20.0
    what = "the simulated vehicle"

    def __init__(self, spec: SimulatorSpec, on_truth: Callable[[TruthSample | TruthContact], None]) -> None:
        self._on_truth = on_truth
        self._reported = threading.Event()
        self._log = spec.log
        self.ready: Ready | None = None
        self._cause: str | None = None
        self._decoder = msgspec.json.Decoder(WorldOutput)
        # Errors of the process go into its text log, not to the app's terminal.
        with open(spec.log or os.devnull, "ab") as errors:
            first = msgspec.json.encode(spec)
            self.process = ChildProcess("dart_flight.sim.simulator", first, self._receive, errors)

    @property
    def died(self) -> bool:
        """Whether the world has reported its end, or its process has ended."""
        return self._cause is not None or self.process.poll() is not None

    @property
    def cause(self) -> str:
        """The reason why the world has ended; valid only if `died` is True."""
        if self._cause is None:
            self.process.listener.join(_LAST_WORDS_S)  # wait, because the pipe may still contain the cause
        if self._cause is not None:
            return self._cause
        code = self.process.poll()
        how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else "has ended"
        return f"the process of {self.what} {how}"

    @property
    def port(self) -> int:
        """UDP port that the autopilot has chosen for its telemetry."""
        assert self.ready is not None
        assert self.ready.port is not None
        return self.ready.port

    @property
    def mocap_url(self) -> str | None:
        return self.ready.mocap_url if self.ready is not None else None

    @property
    def version(self) -> str | None:
        return self.ready.version if self.ready is not None else None

    def wait_ready(self) -> None:
        """Block until the autopilot sends telemetry; raise SimulatorError, with the cause if it is known."""
        self._reported.wait(self.ready_timeout_s)
        if self.ready is None:
            where = f", see {self._log}" if self._log else ""
            raise SimulatorError((self._cause or f"{self.what} did not start") + where)

    def send_horn(self, pulse_us: float) -> None:
        self.process.send(msgspec.json.encode(HornPosition(pulse_us)))

    def send_line(self, line: bytes) -> bool:
        """Send an encoded line to the simulated vehicle, from any thread, without blocking."""
        return self.process.send(line)

    def send_fault(self, fault: Fault) -> None:
        self.process.send(msgspec.json.encode(FaultLine(fault)))

    def close(self, timeout_s: float = 30.0) -> None:
        """End the process. If the vehicle is in the air, it first continues until its failsafe has acted."""
        self.process.end(timeout_s)

    def _receive(self, line: bytes) -> None:
        if not line:
            self._reported.set()  # the process has ended
        with contextlib.suppress(msgspec.DecodeError):
            item = self._decoder.decode(line)
            if isinstance(item, Ready):
                self.ready = item
                self._reported.set()
            elif isinstance(item, SimulatorDied):
                self._cause = item.cause
                self._reported.set()
            elif isinstance(item, Truth):
                record = item.state or item.contact
                if record is not None:
                    self._on_truth(record)


class Px4SimulatorProcess(SimulatorProcess):
    """The process of a plant that a real PX4 flies. PX4 ends together with this process."""

    ready_timeout_s = 60.0
    what = "the plant under PX4"

    def close(self, timeout_s: float = 30.0) -> None:
        """End the process. If the process had to be killed, also kill PX4's session."""
        super().close(timeout_s)
        killed = self.process.returncode < 0  # a process that ended by itself has also ended PX4
        if killed and self.ready is not None and self.ready.pid is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.ready.pid, signal.SIGKILL)


class HitlProcess(SimulatorProcess):
    """The process of a plant that sends simulated sensor data to a flight controller."""

    ready_timeout_s = 60.0
    what = "the simulated vehicle connected to the flight controller"


def fly_simulated(
    record: FlightRecord,
    spec: SimulatorSpec,
    make_app: Callable[[SimulatorProcess], FlightApp],
    process: type[SimulatorProcess] = SimulatorProcess,
) -> SimulatorProcess:
    """Start a world, fly in this world, end the world and close the log; return the world.

    Args:
        record: receives the truth of the world.
        spec: specification of the world, whose text log goes into the flight's folder.
        make_app: makes the app once the world is ready.

    Raises:
        InputError: the name of the flight's folder is not UTF-8.
        SimulatorError, VehicleError: the simulated vehicle did not start or did not answer.
    """
    try:
        spec.log = utf8_path((record.folder / "autopilot.log").resolve())
        world = process(spec, record.truth)
        try:
            world.wait_ready()
            app = make_app(world)
            record.notice = app.show
            asyncio.run(app.run())
        finally:
            world.close()
    finally:
        record.close()
    return world
