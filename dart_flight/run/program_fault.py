"""Injection of a fault into a flight over MAVSDK: in the app, the lock or the simulated vehicle."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import time
from pathlib import Path

from dart_flight.base.records import Record
from dart_flight.run.app import FlightApp
from dart_flight.run.simulator_process import SimulatorProcess
from dart_flight.sim.faults.fault_table import Fault, FaultSite, Trigger, make_mock_faults

_HANG_S = 60


class ProgramFault:
    """Onlooker on the core thread that begins one fault when the fault is due.

    Args:
        log: path of the flight log. With the fault `disk-full`, writing to this file fails.
    """

    def __init__(
        self, fault: Fault, app: FlightApp, world: SimulatorProcess | None = None, log: Path | None = None
    ) -> None:
        self.fault, self._app, self._world, self._log = fault, app, world, log
        self._trigger = Trigger(fault)
        self._begun = False

    def __call__(self, record: Record) -> None:
        if self._begun or not self._trigger.process(record):
            return
        now_us = getattr(record, "t_us", 0)
        if now_us and self._trigger.is_due(now_us):
            self._begun = True
            # Another process measures delays from this time, because all processes share the monotonic clock.
            sys.stderr.write(f"fault {self.fault.name} at monotonic {time.monotonic():.4f} s\n")
            sys.stderr.flush()
            self._begin()

    def _begin(self) -> None:
        fault, loop, mock = self.fault, self._app.loop, self._app.mock
        if fault.kind.site is FaultSite.LOCK:
            if mock is not None:
                mock.inject(make_mock_faults(fault))
        elif fault.kind.site is not FaultSite.APP:
            if self._world is not None:
                self._world.send_fault(fault)
        elif fault.name == "hang-core":
            time.sleep(_HANG_S)
        elif fault.name == "hang-loop" and loop is not None:
            loop.call_soon_threadsafe(time.sleep, _HANG_S)
        elif fault.name == "hang-lock":
            ctypes.PyDLL(None).sleep(_HANG_S)  # PyDLL keeps the interpreter lock
        elif fault.name == "disk-full":
            fill_disk_of(self._log)
        else:
            stop = signal.SIGSTOP if fault.name == "sigstop" else signal.SIGKILL
            os.kill(os.getpid(), stop)


def fill_disk_of(path: Path | None) -> None:
    """Make every write of this process to the open file `path` fail with ENOSPC, as on a full disk."""
    full = os.open("/dev/full", os.O_WRONLY)
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if path is not None and os.readlink(f"/proc/self/fd/{name}") == str(path.resolve()):
                os.dup2(full, int(name))
    os.close(full)
