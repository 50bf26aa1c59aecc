"""A real PX4 on the ground, and dry-runs with a real PX4 in their own process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import Parameter, PositionSource, Value
from dart_flight.run.prepare import load_flyable
from dart_flight.run.simulator_process import Px4SimulatorProcess
from dart_flight.sim.pipe import Px4SimulatorSpec, SimulatorSpec
from dart_flight.sim.px4.launch import ONBOARD_PORT, flight_parameters
from tests.doubles.operator_station import OperatorStation
from tests.real_time import TooSlow, wait_until

MISSIONS = Path(__file__).parents[2] / "missions"
SINGLE = load_flyable(MISSIONS / "paper_single_wall.yaml")
MOCAP = PositionSource.MOCAP


@contextmanager
def waiting_px4(
    px4_dir: Path,
    folder: Path,
    changes: Mapping[str, Value] | None = None,
    *,
    mission: Mission = SINGLE,
    source: PositionSource = MOCAP,
    base: Mapping[str, Parameter] | None = None,
) -> Iterator[str]:
    """Start PX4 on the ground and yield its URL.

    Args:
        px4_dir: installation of PX4.
        folder: working folder.
        changes: parameters that differ from `base`.
        mission: mission with the vehicle.
        source: where the position comes from.
        base: parameters; default: those of a dry-run.
    """
    folder.mkdir(exist_ok=True)
    own = {name: Parameter(name, value, "") for name, value in (changes or {}).items()}
    parameters = {**(flight_parameters(mission.vehicle, source) if base is None else base), **own}
    px4 = Px4SimulatorSpec(str(px4_dir), str(folder), parameters, source)
    world = Px4SimulatorProcess(SimulatorSpec(mission, 1, [], None, px4), lambda record: None)
    try:
        world.wait_ready()
        yield f"udpin://127.0.0.1:{world.port}"
    finally:
        world.close()


def station_of(url: str) -> OperatorStation:
    """Return the ground station of a waiting PX4, whose instance is 0 only if no other PX4 runs."""
    return OperatorStation.of_px4(int(url.rpartition(":")[2]) - ONBOARD_PORT)


def vehicle_findings(mission: Mission, url: str) -> dict[str, CheckFinding]:
    """Return what `check` finds at a vehicle, by item; every item has one finding."""
    findings = run_checks(FlightContext(mission, url=url), Stage.VEHICLE)
    items = {found.item: found for found in findings}
    assert len(items) == len(findings)
    return items


class DryRun:
    """A dry-run with a real PX4, in its own process.

    Attributes:
        folder: folder of the flight's logs.
        process: the process.
    """

    def __init__(self, px4_dir: Path, folder: Path, mission: Path, *options: str) -> None:
        self.folder = folder
        words = [sys.executable, "-m", "dart_flight", "dry-run", str(mission), "--json"]
        words += ["--px4", str(px4_dir), "--log-dir", str(folder), *options]
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def text(self) -> str:
        """Return the world's log so far."""
        return "".join(path.read_text() for path in self.folder.glob("*/autopilot.log"))

    def wait_for(self, pattern: str, timeout_s: float = 40.0) -> str:
        """Wait for a match in the world's log and return its first group, or all of it."""
        try:
            found = wait_until(lambda: re.search(pattern, self.text()), timeout_s, repr(pattern))
        except TooSlow as error:
            raise TooSlow(f"{error}: {self.text()}") from None
        return found[1] if found.groups() else found[0]

    def verdict(self, timeout_s: float = 40.0) -> tuple[dict[str, Any], str]:
        """Wait for the end; return the printed verdict and the messages."""
        out, error = self.process.communicate(timeout=timeout_s)
        assert out, error
        return json.loads(out), error
