"""The messages between the application and a simulated vehicle in a separate process, one JSON line each.

The first line on the vehicle's standard input is a `SimulatorSpec`; `WorldInput`s follow. Its standard output
carries `WorldOutput`s. Every world in a separate process uses these messages, whichever autopilot it has.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import threading
from collections import deque
from typing import IO

import msgspec

from dart_flight.base.records import TruthContact, TruthSample
from dart_flight.config.mission import Mission
from dart_flight.config.packages import missing_package
from dart_flight.config.parameter_file import Parameter, PositionSource
from dart_flight.config.vehicle import Motor
from dart_flight.sim.faults.fault_table import Fault

FULL_SPEED = 1e6  # real-time factor that no computer reaches


class Px4SimulatorSpec(msgspec.Struct):
    """The settings of a real PX4 that flies the plant.

    Attributes:
        directory: folder that contains PX4's bin/px4 and etc/.
        folder: folder of the flight; PX4 works in a subfolder.
        parameters: PX4 parameters to set before the flight, by name.
        position_from: source of the position, motion capture (indoors, no GPS) or a GPS receiver.
    """

    directory: str
    folder: str
    parameters: dict[str, Parameter]
    position_from: PositionSource = PositionSource.MOCAP


class HitlSpec(msgspec.Struct):
    """The settings of a flight controller in hardware-in-the-loop mode.

    Attributes:
        url: URL of the flight controller's port, `serial:///dev/ttyACM0:921600` or UDP.
        motors: motors in the flight controller's parameters, or None for the motors of the configuration.
        position_from: source of PX4's position, simulated motion capture or a simulated GPS receiver.
    """

    url: str
    motors: tuple[Motor, ...] | None = None
    position_from: PositionSource = PositionSource.MOCAP


class SimulatorSpec(msgspec.Struct):
    """The specification of a simulated flight, the first line of the process's input."""

    mission: Mission  # the application's mission
    seed: int
    ports: list[int]  # remote UDP ports of the embedded autopilot
    log: str | None = None
    px4: Px4SimulatorSpec | None = None
    hitl: HitlSpec | None = None
    spreads: dict[str, float] = msgspec.field(default_factory=dict)  # deviations from the mission (`draws`)
    speed: float = 1.0  # highest real-time factor
    lockstep: bool = False  # whether simulated time waits for the application (`sim.lockstep`)
    mocap: str | None = None  # kind of the emulated motion capture that provides the autopilot's position


class HornPosition(msgspec.Struct, tag="horn"):
    """The position of the mock servo's simulated horn, as a pulse in microseconds."""

    pulse_us: float


class Ping(msgspec.Struct, tag="ping"):
    """An empty message that keeps the pipe alive."""


class FaultLine(msgspec.Struct, tag="fault"):
    """A fault that begins now."""

    fault: Fault


class Stepped(msgspec.Struct, tag="stepped"):
    """The progress of the application, sent whenever it has no work left (`sim.lockstep`).

    Attributes:
        streams: newest stamp that the core has processed on each telemetry stream, microseconds. The stream
            of poses has the number of the newest frame instead of a stamp.
        sent: values of the last message of each kind that was passed to MAVSDK; an unused value is None.
            `setpoint` has position, velocity and acceleration; `pose` has the position of a forwarded pose,
            local NED.
        commands: number of requests to the autopilot without a result.
        plan_due_us: due time of the planner's answer, or None without an open request.
        batch_us: duration of a batch of samples that the core processes together. The world does not wait
            within a batch.
        flies: whether the application still sends messages. If not, the world continues alone.
    """

    streams: dict[str, int]
    sent: dict[str, tuple[float | None, ...]] = msgspec.field(default_factory=dict)
    commands: int = 0
    plan_due_us: int | None = None
    batch_us: int = 0
    flies: bool = True


WorldInput = HornPosition | Ping | FaultLine | Stepped


class Ready(msgspec.Struct, tag="ready"):
    """The first message of a simulated vehicle: the autopilot now sends telemetry.

    `port` is the UDP port of the telemetry, if the autopilot has chosen this port. `mocap_url` is the URL of
    an emulated motion-capture server, if there is one.
    """

    time_us: int
    port: int | None = None
    version: str | None = None
    pid: int | None = None  # process id of the autopilot, if it has its own process
    mocap_url: str | None = None


class Truth(msgspec.Struct, tag="truth"):
    """A record for the application: the simulated vehicle's true state, or a true contact."""

    state: TruthSample | None = None
    contact: TruthContact | None = None


class SimulatorDied(msgspec.Struct, tag="died"):
    """The simulated vehicle cannot continue; the process ends after this message."""

    cause: str


WorldOutput = Ready | Truth | SimulatorDied


class LineWriter:
    """A writer of lines to a pipe in its own thread, so that a hung reader does not stop the flight."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._lines: deque[bytes] = deque(maxlen=5000)
        self._wake = threading.Event()
        self._idle = threading.Event()
        threading.Thread(target=self._run, daemon=True, name="truth").start()

    def put(self, item: WorldOutput) -> None:
        """Queue a line; never blocks."""
        self._idle.clear()
        self._lines.append(msgspec.json.encode(item))
        self._wake.set()

    def finish(self, timeout_s: float = 1.0) -> None:
        """Wait until all queued lines have been written, or until the timeout."""
        if self._lines:
            self._idle.wait(timeout_s)

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            with contextlib.suppress(OSError, ValueError):  # the reader has closed the pipe
                while self._lines:
                    self._stream.write(self._lines[0] + b"\n")
                    self._lines.popleft()
                self._stream.flush()
            self._idle.set()


class LineReader:
    """A reader of lines from the application, in its own thread.

    Attributes:
        items: received items that have not been processed.
        closed: whether the application has closed the pipe.
        wake: descriptor that becomes readable when an item arrives, and stays readable until `clear`.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.items: deque[WorldInput] = deque()
        self.closed = False
        self.wake = os.eventfd(0, os.EFD_NONBLOCK)
        threading.Thread(target=self._run, daemon=True, name="commands").start()

    def clear(self) -> None:
        """Reset `wake`; call this before reading `items`, so that no item is missed."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.wake)

    def _run(self) -> None:
        decoder = msgspec.json.Decoder(WorldInput)
        for line in self._stream:
            with contextlib.suppress(msgspec.DecodeError):
                self.items.append(decoder.decode(line))
            os.eventfd_write(self.wake, 1)
        self.closed = True
        os.eventfd_write(self.wake, 1)


def has_mavlink() -> bool:
    """Return whether the package that the simulated vehicle's process needs is installed."""
    return importlib.util.find_spec("pymavlink") is not None


def require_mavlink() -> None:
    """Raise InputError if a package for the simulated vehicle's process is missing."""
    if not has_mavlink():
        raise missing_package("simulation needs pymavlink", "sim")
