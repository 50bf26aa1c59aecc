"""Flights that several tests use; the first worker that needs a flight flies it for all workers."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from dart_flight.config.vehicle import packaged
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import parse_fault
from tests.doubles.ports import free_udp_port
from tests.real_time import run_within

ROOT = Path(__file__).parents[1]
VERDICT, COMMANDED = "verdict.json", "said.json"
PATIENCE_S = 0.5
# Settings for real-time flights whose tests do not concern silence, because other tests run in parallel.
PATIENT = tuple(
    f"guard.{key}={PATIENCE_S}" for key in ("imu_timeout_s", "stream_timeout_s", "telemetry_late_s")
)


PLAIN_GPS = ("simulation.position_from=plain",)


class Flown(NamedTuple):
    """The verdict and the log of a flight. Tests share the log, so copy it before a change."""

    verdict: Verdict
    log: Path


class SharedFlights:
    """Flights of the shipped missions, each with its own configuration."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, Flown] = {}

    def __call__(
        self,
        mission: str,
        seed: int,
        fault: str | None = None,
        *,
        vary: tuple[str, ...] = (),
        settings: tuple[str, ...] = (),
    ) -> Flown:
        """Return the flight of a mission, such as `single_wall` or `rigid_cage/square`.

        Args:
            mission: name of the mission's file.
            seed: seed of the flight.
            fault: fault to inject.
            vary: quantities to draw, as for `--vary`.
            settings: changed keys of mission or configuration, as for `--set`.
        """
        name = "-".join([mission.replace("/", "-"), str(seed), fault or "healthy", *vary, *settings])
        if name not in self._known:
            folder = self.once(name, lambda target: self._fly(target, mission, seed, fault, vary, settings))
            verdict = msgspec.json.decode((folder / VERDICT).read_bytes(), type=Verdict)
            self._known[name] = Flown(verdict, next(folder.glob("*/flight.mcap")).resolve())
        return self._known[name]

    @staticmethod
    def _fly(
        folder: Path,
        mission: str,
        seed: int,
        fault: str | None,
        vary: tuple[str, ...],
        settings: tuple[str, ...],
    ) -> None:
        loaded = load_flyable(packaged("missions", f"{mission}.yaml"), settings=settings)
        broken = None if fault is None else parse_fault(fault)
        spreads = parse_vary(vary, loaded.vehicle)
        verdict = fly_fast(loaded, seed, folder, fault=broken, spreads=spreads)
        (folder / VERDICT).write_bytes(msgspec.json.encode(verdict))

    def once(self, name: str, fly: Callable[[Path], object]) -> Path:
        """Return the folder `name`, which `fly` has filled once, in this worker or in another."""
        folder = self._folder / name
        folder.mkdir(parents=True, exist_ok=True)
        with open(folder / "lock", "w", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be filling it
            if not (folder / "done").exists():
                fly(folder)
                (folder / "done").touch()
        return folder


class Commanded(msgspec.Struct):
    """The result of a command through MAVSDK: its working folder, exit status and output."""

    folder: str
    status: int
    output: str
    errors: str

    @property
    def log(self) -> Path:
        """The log of the command's flight."""
        return next(Path(self.folder).glob("flights/*/flight.mcap"))


def patient(config: str) -> str:
    """Return the text of a configuration with the settings of `PATIENT`."""
    keys = "imu_timeout_s|stream_timeout_s|telemetry_late_s"
    text, count = re.subn(rf"({keys}): [0-9.]+", rf"\1: {PATIENCE_S}", config)
    assert count == 3
    return text


class LiveFlights:
    """Commands that fly through MAVSDK, each in a folder made by `init`.

    In real time the guard has the settings of `PATIENT`.

    Args:
        shared: flights that hold the folders.
    """

    def __init__(self, shared: SharedFlights) -> None:
        self._shared = shared

    def __call__(self, command: str, simulate: str | None = None) -> Commanded:
        """Return the result of a command; `simulate` runs its vehicle in a parallel process.

        A flight with such a vehicle gets a free port, `--yes` instead of the question on a terminal, and
        `--json`.
        """
        name = "-".join(re.findall(r"[\w.]+", command))
        folder = self._shared.once(name, lambda folder: self._run(folder, command, simulate))
        return msgspec.json.decode((folder / COMMANDED).read_bytes(), type=Commanded)

    @staticmethod
    def _run(folder: Path, command: str, simulate: str | None) -> None:
        shim = folder / "bin" / "dart-flight"
        shim.parent.mkdir(exist_ok=True)
        shim.write_text(f'#!/bin/sh\nexec {sys.executable} -m dart_flight "$@"\n')
        shim.chmod(0o755)
        lab = folder / "lab"
        environment = os.environ | {
            "PATH": f"{shim.parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "DART_FLIGHT_STATE_DIR": str(folder / "state"),
        }
        shutil.rmtree(lab / "flights", ignore_errors=True)
        if not lab.exists():
            start = [str(shim), "init", str(lab)]
            subprocess.run(start, env=environment, check=True, capture_output=True, timeout=60)
        with contextlib.ExitStack() as stack:
            if simulate is not None or "--realtime" in command:
                config = lab / "configs" / "dart.yaml"
                config.write_text(patient(config.read_text(encoding="utf-8")), encoding="utf-8")
            if simulate is not None:
                port = str(free_udp_port())
                command = f"{command.replace('14540', port)} --yes --json"
                simulate = f"{simulate.replace(' --port 14540', '')} --port {port}"
                stack.enter_context(_in_parallel(simulate, lab, environment))
            done = run_within(120.0, ["bash", "-c", command], cwd=lab, env=environment)
        result = Commanded(str(lab), done.returncode, done.stdout, done.stderr)
        (folder / COMMANDED).write_bytes(msgspec.json.encode(result))


@contextlib.contextmanager
def _in_parallel(command: str, folder: Path, environment: dict[str, str]) -> Iterator[None]:
    process = subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        time.sleep(1.0)
        assert process.poll() is None, "`simulate` has ended"
        yield
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SharedFlights:
    """Flights that are flown once for all tests."""
    own = tmp_path_factory.getbasetemp()
    return SharedFlights((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "flown")


@pytest.fixture
def commanded(flown: SharedFlights) -> LiveFlights:
    """Commands that fly through MAVSDK, run once for all tests."""
    return LiveFlights(flown)
