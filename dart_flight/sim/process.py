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

from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.servo import ServoModel, mode_of
from dart_flight.samples import Mode, TruthContact, TruthSample
from dart_flight.sim.autopilot import TICK_S, Autopilot, make_autopilot
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint

_TRUTH_EVERY = 2  # ticks
_ORPHAN_S = 28.0  # after the app's death; with start and end it stays within 30 s
_LATE_S = 0.25  # a stall longer than this is not caught up with: the world pauses instead


class WorldSpec(msgspec.Struct):
    """What the process is told on its first line of input."""

    mission: str
    config: str | None
    seed: int
    ports: list[int]
    driver: LockDriver
    log: str | None = None


class Horn(msgspec.Struct, tag="horn"):
    """The mock servo's modelled horn, as a pulse in microseconds."""

    pulse_us: float


class Ping(msgspec.Struct, tag="ping"):
    """Nothing; a line that keeps the pipe alive."""


WorldInput = Horn | Ping


class Ready(msgspec.Struct, tag="ready"):
    """The autopilot sends from now on."""

    time_us: int


class Truth(msgspec.Struct, tag="truth"):
    """A truth record on its way to the app."""

    state: TruthSample | None = None
    contact: TruthContact | None = None


WorldOutput = Ready | Truth


class SimulatedVehicle:
    """Autopilot, MAVLink endpoint and lock of one simulated vehicle, stepped in ticks.

    Args:
        mission: walls and start.
        seed: of the sensors' noise.
        ports: remote UDP ports, one link each.
        driver: `px4` moves the servo by the autopilot's own output; with any other the horn is told.
    """

    def __init__(self, mission: Mission, seed: int, ports: tuple[int, ...], driver: LockDriver) -> None:
        self.autopilot: Autopilot = make_autopilot(mission, seed)
        self.endpoint = MavlinkEndpoint(self.autopilot, ports)
        self._servo_config = mission.vehicle.lock.servo
        self._index = mission.vehicle.lock.px4.actuator_index
        self._by_autopilot = driver is LockDriver.PX4
        resting = pulse_for(mission, mission.transit_mode)
        self._servo = ServoModel(self._servo_config, resting)

    def set_horn(self, pulse_us: float) -> None:
        """Where the mock servo's horn is."""
        self._apply(pulse_us)

    def step(self) -> None:
        """One tick: lock, plant and autopilot, MAVLink."""
        if self._by_autopilot:
            t_us = self.autopilot.time_us
            pulse = self.autopilot.actuator_pulse_us(self._index)
            if pulse is not None:
                self._servo.command(t_us, pulse)
            self._apply(self._servo.pulse_at(t_us))
        self.autopilot.step()
        self.endpoint.exchange()

    def _apply(self, pulse_us: float) -> None:
        # Between the ends no rod holds all four arms: not rigid means flexible.
        mode = mode_of(self._servo_config, pulse_us)
        self.autopilot.plant.set_mode(Mode.RIGID if mode is Mode.RIGID else Mode.FLEXIBLE)


def pulse_for(mission: Mission, mode: Mode) -> float:
    """Pulse of a mode's end stop, microseconds."""
    servo = mission.vehicle.lock.servo
    return servo.rigid_pulse_us if mode is Mode.RIGID else servo.flexible_pulse_us


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


def main() -> int:
    """Body of the process; returns its exit status."""
    # The app's terminal must not take the vehicle down: Ctrl-C is the app's business.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    spec = msgspec.json.decode(sys.stdin.buffer.readline(), type=WorldSpec)
    mission = load_mission(spec.mission, spec.config)
    vehicle = SimulatedVehicle(mission, spec.seed, tuple(spec.ports), spec.driver)
    autopilot, writer, reader = vehicle.autopilot, _Writer(sys.stdout.buffer), _Reader(sys.stdin.buffer)
    log = open(spec.log, "a", encoding="utf-8", buffering=1) if spec.log else None  # noqa: SIM115
    to_link = autopilot.say

    def say(severity: str, text: str) -> None:
        to_link(severity, text)
        if log is not None:
            log.write(f"{autopilot.now_s:9.3f} s {severity}: {text}\n")

    autopilot.say = say
    state = {"ticks": 0, "orphan_since": None, "over": False}

    def step() -> None:
        while reader.items:
            item = reader.items.popleft()
            if isinstance(item, Horn):
                vehicle.set_horn(item.pulse_us)
        vehicle.step()
        _report(autopilot, writer, int(state["ticks"] or 0))
        state["ticks"] = int(state["ticks"] or 0) + 1
        if reader.closed:
            _orphaned(autopilot, state, say)

    writer.put(Ready(autopilot.time_us))
    gc.freeze()
    run_in_real_time(step, lambda: bool(state["over"]))
    say("info", "simulated vehicle stops")
    vehicle.endpoint.close()
    return 0


def _report(autopilot: Autopilot, writer: _Writer, ticks: int) -> None:
    plant = autopilot.plant
    if ticks % _TRUTH_EVERY == 0:
        writer.put(Truth(state=plant.truth()))
    while plant.finished:
        writer.put(Truth(contact=plant.finished.pop(0)))


def _orphaned(autopilot: Autopilot, state: dict[str, int | float | bool | None], say: Callable[[str, str], None]) -> None:
    """The app is gone: fly on to the failsafe, end when landed."""
    since = state["orphan_since"]
    if since is None:
        state["orphan_since"] = autopilot.now_s
        if autopilot.armed:
            say("warning", "the app is gone, flying on to the failsafe")
        return
    if not autopilot.armed or autopilot.now_s - float(since) > _ORPHAN_S:
        state["over"] = True


if __name__ == "__main__":
    sys.exit(main())
