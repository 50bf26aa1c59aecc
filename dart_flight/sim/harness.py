"""The app's end of a simulated vehicle that runs in a process of its own."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from dart_flight.errors import FlightError
from dart_flight.samples import TruthContact, TruthSample
from dart_flight.sim.faults import Fault
from dart_flight.sim.process import FaultLine, Horn, Ready, Truth, WorldOutput, WorldSpec

_READY_TIMEOUT_S = 20.0


class WorldError(FlightError):
    """The simulated vehicle did not start, or died."""


class EmbeddedWorld:
    """Plant and embedded autopilot in a process and session of their own, which outlive Ctrl-C and the app.

    Args:
        spec: what to simulate.
        on_truth: takes every truth record, on a thread of its own.
    """

    def __init__(self, spec: WorldSpec, on_truth: Callable[[TruthSample | TruthContact], None]) -> None:
        self._on_truth = on_truth
        self._ready = threading.Event()
        self._lock = threading.Lock()
        self._log = spec.log
        # What goes wrong over there belongs beside what it says, not into the app's terminal.
        with open(spec.log or os.devnull, "ab") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "dart_flight.sim.process"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
            )
        self._send_line(msgspec.json.encode(spec))
        threading.Thread(target=self._read, name="truth", daemon=True).start()

    @property
    def pid(self) -> int:
        """Process id, for tests that break things."""
        return self._process.pid

    @property
    def died(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    def wait_ready(self) -> None:
        """Block until the autopilot sends.

        Raises:
            WorldError: it does not within 20 s.
        """
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while not self._ready.wait(0.05):
            if self.died or time.monotonic() > deadline:
                where = f", see {self._log}" if self._log else ""
                raise WorldError(f"the simulated vehicle did not start{where}")

    def send_horn(self, pulse_us: float) -> None:
        """Tell the plant where the mock servo's horn is."""
        self._send_line(msgspec.json.encode(Horn(pulse_us)))

    def send_fault(self, fault: Fault) -> None:
        """A fault begins over there."""
        self._send_line(msgspec.json.encode(FaultLine(fault)))

    def close(self, timeout_s: float = 30.0) -> None:
        """Let go of the vehicle: it flies on to its failsafe if it is in the air, then the process ends."""
        with contextlib.suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send_line(self, line: bytes) -> None:
        assert self._process.stdin is not None
        with self._lock, contextlib.suppress(OSError, ValueError):  # it has died: the streams will show it
            self._process.stdin.write(line + b"\n")
            self._process.stdin.flush()

    def _read(self) -> None:
        assert self._process.stdout is not None
        decoder = msgspec.json.Decoder(WorldOutput)
        for line in self._process.stdout:
            with contextlib.suppress(msgspec.DecodeError):
                item = decoder.decode(line)
                if isinstance(item, Ready):
                    self._ready.set()
                elif isinstance(item, Truth):
                    record = item.state or item.contact
                    if record is not None:
                        self._on_truth(record)


def free_udp_port() -> int:
    """A UDP port on the loopback that nobody uses at the moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def world_log(folder: Path) -> str:
    """Where the simulated vehicle writes its text log."""
    return str((folder / "autopilot.log").resolve())
