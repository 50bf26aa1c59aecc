"""The app's end of a simulated vehicle that runs in a process of its own."""

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
from dart_flight.sim.pipe import FaultLine, Horn, Ready, SimulatorDied, SimulatorSpec, Truth, WorldOutput

_LAST_WORDS_S = 0.2  # less than the deadman waits for an event loop


class SimulatorError(FlightError):
    """The simulated vehicle did not start, or died."""


class SimulatorProcess:
    """A simulated vehicle in a process and session of its own, which outlive Ctrl-C and the app.

    Args:
        spec: what to simulate.
        on_truth: takes every truth record, on a thread of its own.
    """

    ready_timeout_s = 20.0
    what = "the simulated vehicle"

    def __init__(self, spec: SimulatorSpec, on_truth: Callable[[TruthSample | TruthContact], None]) -> None:
        self._on_truth = on_truth
        self._told = threading.Event()
        self._log = spec.log
        self.ready: Ready | None = None
        self._cause: str | None = None
        self._decoder = msgspec.json.Decoder(WorldOutput)
        # What goes wrong over there belongs beside what it says, not into the app's terminal.
        with open(spec.log or os.devnull, "ab") as errors:
            first = msgspec.json.encode(spec)
            self.process = ChildProcess("dart_flight.sim.simulator", first, self._take, errors)

    @property
    def died(self) -> bool:
        """Whether the vehicle is gone: it said so, or its process has ended."""
        return self._cause is not None or self.process.poll() is not None

    @property
    def cause(self) -> str:
        """What died, in words, once `died`."""
        if self._cause is None:
            self.process.listener.join(_LAST_WORDS_S)  # it may have said why, and not have been read yet
        if self._cause is not None:
            return self._cause
        code = self.process.poll()
        how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else "has ended"
        return f"the process of {self.what} {how}"

    @property
    def port(self) -> int:
        """UDP port that the autopilot sends to, where it chose that itself."""
        assert self.ready is not None
        assert self.ready.port is not None
        return self.ready.port

    @property
    def mocap_url(self) -> str | None:
        """URL of the emulated motion capture, or None without one."""
        return self.ready.mocap_url if self.ready is not None else None

    @property
    def version(self) -> str | None:
        """The autopilot's version, where it told."""
        return self.ready.version if self.ready is not None else None

    def wait_ready(self) -> None:
        """Block until the autopilot sends.

        Raises:
            SimulatorError: it does not in time; says why where that is known.
        """
        self._told.wait(self.ready_timeout_s)
        if self.ready is None:
            where = f", see {self._log}" if self._log else ""
            raise SimulatorError((self._cause or f"{self.what} did not start") + where)

    def send_horn(self, pulse_us: float) -> None:
        """Tell the plant where the mock servo's horn is."""
        self.process.send(msgspec.json.encode(Horn(pulse_us)))

    def send_line(self, line: bytes) -> bool:
        """Send an encoded line, from any thread, without blocking."""
        return self.process.send(line)

    def send_fault(self, fault: Fault) -> None:
        """A fault begins over there."""
        self.process.send(msgspec.json.encode(FaultLine(fault)))

    def close(self, timeout_s: float = 30.0) -> None:
        """Let go of the vehicle: it flies on to its failsafe if it is in the air, then the process ends."""
        self.process.end(timeout_s)

    def _take(self, line: bytes) -> None:
        if not line:
            self._told.set()  # it has ended, and there is nothing to wait for
        with contextlib.suppress(msgspec.DecodeError):
            item = self._decoder.decode(line)
            if isinstance(item, Ready):
                self.ready = item
                self._told.set()
            elif isinstance(item, SimulatorDied):
                self._cause = item.cause
                self._told.set()
            elif isinstance(item, Truth):
                record = item.state or item.contact
                if record is not None:
                    self._on_truth(record)


class Px4SimulatorProcess(SimulatorProcess):
    """Plant and a real PX4, which belongs to the process and ends with it."""

    ready_timeout_s = 60.0
    what = "the plant under PX4"

    def close(self, timeout_s: float = 30.0) -> None:
        """As for every world; should the process have been killed, PX4's session goes with it."""
        super().close(timeout_s)
        killed = self.process.returncode < 0  # in every other case it has ended PX4 itself
        if killed and self.ready is not None and self.ready.pid is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.ready.pid, signal.SIGKILL)


class HitlProcess(SimulatorProcess):
    """The plant that feeds a flight controller."""

    ready_timeout_s = 60.0
    what = "the plant at the flight controller"


def fly_simulated(
    record: FlightRecord,
    spec: SimulatorSpec,
    make_app: Callable[[SimulatorProcess], FlightApp],
    process: type[SimulatorProcess] = SimulatorProcess,
) -> SimulatorProcess:
    """Start a world, fly in it, end it; closes the record's log.

    Args:
        record: of the flight; takes the world's truth as well.
        spec: of the world, whose text log goes into the flight's folder.
        make_app: makes the app once the world is ready.
        process: what the world runs in.

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
