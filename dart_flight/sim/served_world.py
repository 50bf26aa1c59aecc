"""The process of a simulated world: it serves the app over a pipe, limits the pace, and ends after the app.

The app's commands arrive on standard input. The truth goes to standard output, one JSON object per line.
"""

from __future__ import annotations

import gc
import itertools
import math
import time
from collections.abc import Iterator, Sequence
from typing import IO, Protocol

from dart_flight.sim.embedded_autopilot import TICK_S, TICK_US
from dart_flight.sim.faults.fault_table import Fault
from dart_flight.sim.lockstep import Lockstep
from dart_flight.sim.pipe import (
    FaultLine,
    HornPosition,
    LineReader,
    LineWriter,
    Stepped,
    Truth,
)
from dart_flight.sim.plant import Plant

_TRUTH_EVERY = 2  # ticks between two records of the truth
STALL_S = 0.25  # after a longer stall, the world pauses instead of catching up


class Pacer:
    """Limiter of a world's pace; after a long stall the world pauses and does not catch up."""

    def __init__(self) -> None:
        self._due_s = time.monotonic()

    def wait(self, period_s: float) -> None:
        """Wait until this tick is due. The next tick is due `period_s` later, or immediately if that is 0."""
        now_s = time.monotonic()
        if self._due_s > now_s:
            time.sleep(self._due_s - now_s)
        elif now_s - self._due_s > STALL_S:
            self._due_s = now_s
        self._due_s += period_s


def ticks_in_real_time(period_s: float = TICK_S) -> Iterator[int]:
    """Yield the number of each tick (0, 1, ...) when it is due."""
    pace = Pacer()
    for tick in itertools.count():
        pace.wait(period_s)
        yield tick


class ServedWorld(Protocol):
    """Interface of a world that `serve` connects to the app; the world may have any autopilot."""

    @property
    def time_us(self) -> int:
        """The autopilot's time."""

    def set_horn(self, pulse_us: float) -> None:
        """Set the position of the mock servo's horn."""

    def begin_fault(self, fault: Fault) -> None:
        """Begin a fault."""

    def advance(self) -> Plant:
        """Advance by one tick; return the plant."""
        ...

    def publish_pose(self) -> int | None:
        """Send a pose if it is due.

        Return the number of the sent frame. The result is None if no pose is due, or if no program listens.
        """

    def is_over(self, alone_s: float) -> bool:
        """Return whether the world may end now, `alone_s` seconds after the app has ended."""
        ...


def speed_limit(speed: float, lockstep: Lockstep | None, *, connected: bool) -> float:
    """Return the current limit of the real-time factor.

    A world in lockstep may be faster than real time only while it waits for the app. Before the app's first
    report, or while PX4 has an open request, the world does not wait, and telemetry could run ahead.
    """
    held = lockstep is None or (connected and lockstep.limits_pace)
    return speed if held else min(speed, 1.0)


def serve(
    world: ServedWorld,
    writer: LineWriter,
    commands: IO[bytes],
    speed: float,
    lockstep: Lockstep | None = None,
    wake: Sequence[int] = (),
) -> int:
    """Process the app's lines and send the truth until app and world have ended; return the number of ticks.

    Args:
        speed: highest real-time factor.
        lockstep: decides whether time may advance; if None, time does not wait for the app.
        wake: descriptors of the world that become readable when data has arrived.

    Raises:
        FlightError: the app does not answer, or the network fails.
    """
    reader, gone_s = LineReader(commands), math.inf

    def process_lines() -> bool:
        """Return whether the app is still connected."""
        reader.clear()
        while reader.items:
            item = reader.items.popleft()
            if isinstance(item, HornPosition):
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
            lockstep.wait(world.time_us + TICK_US, (reader.wake, *wake), process_lines)
        process_lines()
        # Send the pose after the telemetry of the same time, so that the order is always the same.
        frame = world.publish_pose()
        if frame is not None and lockstep is not None and not reader.closed:
            lockstep.publish("pose", frame)
            lockstep.wait(world.time_us + TICK_US, (reader.wake, *wake), process_lines)
        pace.wait(TICK_S / speed_limit(speed, lockstep, connected=not reader.closed))
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
    """The process has received SIGTERM."""


def raise_terminated(_signum: int, _frame: object) -> None:
    """Raise an exception at SIGTERM, for a world that must clean up."""
    raise TerminatedError


class WorldLog:
    """The world's text log, with simulated times in seconds; without a path nothing is written."""

    def __init__(self, path: str | None) -> None:
        self._file = None if path is None else open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115

    def write(self, now_s: float, text: str) -> None:
        if self._file is not None:
            self._file.write(f"{now_s:9.3f} s  {text}\n")
