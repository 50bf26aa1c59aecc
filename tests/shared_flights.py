"""Fast flights that several tests look at: flown once for the whole run of the tests, by whichever worker
comes first."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from dart_flight.config.vehicle import packaged
from dart_flight.sim.faults.kinds import parse_fault
from dart_flight.verdict import Verdict
from dart_flight.worlds.fast import fly_fast
from dart_flight.worlds.prepare import load_flyable

VERDICT = "verdict.json"


class Flown(NamedTuple):
    """What is left of a flight: its verdict and its log. The log is shared: copy it to change it."""

    verdict: Verdict
    log: Path


class SharedFlights:
    """Flights of the shipped missions with the shipped configuration."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, Flown] = {}

    def __call__(self, mission: str, seed: int, fault: str | None = None) -> Flown:
        """The flight of a mission (`single_wall`, `dual_collision`) with a seed and perhaps a fault."""
        name = f"{mission}-{seed}-{fault or 'healthy'}"
        if name not in self._known:
            folder = self.once(name, lambda there: self._fly(there, mission, seed, fault))
            verdict = msgspec.json.decode((folder / VERDICT).read_bytes(), type=Verdict)
            self._known[name] = Flown(verdict, next(folder.glob("*/flight.mcap")).resolve())
        return self._known[name]

    @staticmethod
    def _fly(folder: Path, mission: str, seed: int, fault: str | None) -> None:
        loaded = load_flyable(packaged("missions", f"{mission}.yaml"), packaged("configs", "dart.yaml"))
        broken = None if fault is None else parse_fault(fault)
        verdict = fly_fast(loaded, seed, folder, fault=broken)
        (folder / VERDICT).write_bytes(msgspec.json.encode(verdict))

    def once(self, name: str, fly: Callable[[Path], object]) -> Path:
        """The folder `name`, into which `fly` has put what it leaves, in this worker or in another."""
        folder = self._folder / name
        folder.mkdir(parents=True, exist_ok=True)
        with open(folder / "lock", "w", encoding="utf-8") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be flying it at this moment
            if not (folder / "done").exists():
                fly(folder)
                (folder / "done").touch()
        return folder


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> SharedFlights:
    """Flights that are flown once."""
    own = tmp_path_factory.getbasetemp()
    return SharedFlights((own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "flown")
