"""Malformed files and MAVLink frames: a refusal in one line, no traceback, no hang.

    python -m tools.campaigns.fuzz --inputs 100000

Each input is a good one made bad (bytes or lines lost, doubled, swapped, replaced, values exchanged),
numbered, so that a failure can be repeated. An input counts as wrong when anything but `InputError` (for
frames: anything at all) is raised, when the error is more than one line, or when it takes more than a
second of processor time.
"""

from __future__ import annotations

import argparse
import io
import random
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import yaml
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import parse_mission
from dart_flight.config.vehicle import LockDriver, VehicleConfig, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from tools.campaigns.results import RESULTS, measured_by

KINDS = ("mission", "scenario", "configuration", "log", "frame")
SLOW_S = 1.0
_SHARE = {"mission": 0.3, "scenario": 0.1, "configuration": 0.1, "log": 0.05, "frame": 0.45}
_PIECES = "{}[]:,-#&*!|>'\"%@`\t\n\\0é"
_VALUES = (
    "1e400",
    ".inf",
    ".nan",
    "null",
    "~",
    "[]",
    "{}",
    "-0",
    "yes",
    "-1",
    "1e-320",
    "''",
    "999999999999",
)


class Tally(msgspec.Struct):
    """What came of the inputs of one kind."""

    kind: str
    inputs: int = 0
    refused: int = 0
    taken: int = 0
    slowest_s: float = 0.0
    failures: list[str] = []


def spoil_text(text: str, chance: random.Random) -> str:
    """A good file made bad."""
    for _ in range(chance.randint(1, 4)):
        i = chance.randrange(len(text) + 1)
        j = min(len(text), i + chance.randint(1, 12))
        how = chance.randrange(6)
        if how == 0:
            text = text[:i] + text[j:]
        elif how == 1:
            text = text[:j] + text[i:]
        elif how == 2:
            text = text[:i] + chance.choice(_PIECES) + text[i:]
        elif how == 3:
            lines = text.splitlines()
            k = chance.randrange(len(lines))
            lines.insert(chance.randrange(len(lines)), lines.pop(k))
            text = "\n".join(lines) + "\n"
        elif how == 4:
            text = text[:i] + chance.choice(_VALUES) + text[j:]
        else:
            text = _exchange_value(text, chance)
    return text


def _exchange_value(text: str, chance: random.Random) -> str:
    """The value of one key replaced by something else."""
    lines = text.splitlines()
    keyed = [i for i, line in enumerate(lines) if ": " in line]
    if not keyed:
        return text
    i = chance.choice(keyed)
    head, _, _ = lines[i].partition(": ")
    lines[i] = f"{head}: {chance.choice(_VALUES)}"
    return "\n".join(lines) + "\n"


def spoil_bytes(data: bytes, chance: random.Random) -> bytes:
    """Bytes flipped, lost, doubled or cut off."""
    body = bytearray(data)
    for _ in range(chance.randint(1, 6)):
        i = chance.randrange(len(body)) if body else 0
        how = chance.randrange(4)
        if how == 0 and body:
            body[i] ^= 1 << chance.randrange(8)
        elif how == 1:
            del body[i : i + chance.randint(1, 40)]
        elif how == 2:
            body[i:i] = chance.randbytes(chance.randint(1, 20))
        elif chance.random() < 0.3:
            del body[i:]
    return bytes(body)


# --- what is fed -------------------------------------------------------------------------------------------


class _Mission:
    def __init__(self) -> None:
        self._texts = [path.read_text() for path in sorted(packaged("missions").glob("*.yaml"))]
        self._vehicle: VehicleConfig = load_vehicle(packaged("configs", "dart.yaml"))

    def __call__(self, chance: random.Random) -> None:
        parse_mission(Document(spoil_text(chance.choice(self._texts), chance), "m.yaml"), self._vehicle)


class _Scenario:
    def __init__(self) -> None:
        self._texts = [path.read_text() for path in sorted(packaged("missions", "scenarios").glob("*.yaml"))]
        self._folder = tempfile.TemporaryDirectory()

    def __call__(self, chance: random.Random) -> None:
        path = Path(self._folder.name) / "scenario.yaml"
        path.write_text(spoil_text(chance.choice(self._texts), chance))
        load_scenario(path, packaged("configs", "dart.yaml"))


class _Configuration:
    def __init__(self) -> None:
        text = packaged("configs", "dart.yaml").read_text()
        # Without its comments: what is spoiled should be values.
        self._text = yaml.safe_dump(yaml.safe_load(text), sort_keys=False)
        self._folder = tempfile.TemporaryDirectory()

    def __call__(self, chance: random.Random) -> None:
        path = Path(self._folder.name) / "dart.yaml"
        path.write_text(spoil_text(self._text, chance))
        load_vehicle(path)


class _Log:
    """Short logs, because a spoiled one is read up to its damage."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        mission = load_flyable(packaged("missions", "paper_single_wall.yaml"))
        fly_fast(mission, 1, folder)
        whole = next(folder.glob("*/flight.mcap")).read_bytes()
        self._good = whole[:60_000]

    def __call__(self, chance: random.Random) -> None:
        path = Path(self._folder.name) / "log.mcap"
        path.write_bytes(spoil_bytes(self._good, chance))
        read_log(path)


class _Frame:
    """Frames that arrive at the autopilot's endpoint, valid, spoiled and invented."""

    def __init__(self) -> None:
        mission = load_flyable(packaged("missions", "paper_single_wall.yaml"))
        self._vehicle = SimulatedVehicle(mission, 1, LockDriver.PX4)
        self._endpoint = MavlinkEndpoint(self._vehicle.autopilot, (9,))
        self._link = self._endpoint.links[0]
        self._address = self._link.socket.getsockname()
        self._from = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._pack = mavlink.MAVLink(io.BytesIO(), srcSystem=245, srcComponent=190)

    def __call__(self, chance: random.Random) -> None:
        self._from.sendto(self._frame(chance), self._address)
        self._vehicle.advance()
        self._endpoint.exchange()

    def _frame(self, chance: random.Random) -> bytes:
        def number() -> float:
            return chance.choice(
                (0.0, 1.0, -1.0, float("nan"), float("inf"), 3e38, chance.uniform(-1e6, 1e6))
            )

        kind = chance.randrange(5)
        if kind == 0:
            return chance.randbytes(chance.randrange(0, 300))
        if kind == 1:
            ids = (400, 176, 22, 21, 20, 511, 512, 187, chance.randrange(65536))
            message: Any = mavlink.MAVLink_command_long_message(
                1, 1, chance.choice(ids), 0, *(number() for _ in range(7))
            )
        elif kind == 2:
            parts = [number() for _ in range(11)]
            mask = chance.randrange(65536)
            message = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, *parts)
        elif kind == 3:
            name = chance.choice((b"MPC_XY_P", b"PWM_AUX_MIN1", chance.randbytes(8)))
            message = mavlink.MAVLink_param_set_message(1, 1, name, number(), chance.choice((6, 9)))
        else:
            message = mavlink.MAVLink_param_request_read_message(
                1, 1, chance.randbytes(8), chance.randrange(-1, 300)
            )
        packed = bytes(message.pack(self._pack))
        return packed if chance.random() < 0.5 else spoil_bytes(packed, chance)


_FEEDERS: dict[str, Callable[[], Callable[[random.Random], None]]] = {
    "mission": _Mission,
    "scenario": _Scenario,
    "configuration": _Configuration,
    "log": _Log,
    "frame": _Frame,
}


def feed(kind: str, first: int, count: int) -> Tally:
    """Feed the inputs numbered from `first` on."""
    tally, one = Tally(kind), _FEEDERS[kind]()
    for number in range(first, first + count):
        began = time.process_time()
        try:
            one(random.Random(f"{kind} {number}"))
            tally.taken += 1
        except InputError as error:
            tally.refused += 1
            if "\n" in error.one_line():
                tally.failures.append(f"{kind} {number}: more than one line")
        except Exception as error:
            tally.failures.append(f"{kind} {number}: {type(error).__name__}: {error}")
        took = time.process_time() - began
        tally.slowest_s = max(tally.slowest_s, took)
        tally.inputs += 1
        if took > SLOW_S:
            tally.failures.append(f"{kind} {number}: took {took:.1f} s")
    return tally


def _feed(job: tuple[str, int, int]) -> Tally:
    return feed(*job)


def run(report_dir: Path, inputs: int = 100_000) -> None:
    """Feed them all, two processes; writes `fuzz.md` into `report_dir`.

    Raises:
        RuntimeError: something else than a refusal happened.
    """
    jobs = []
    for kind in KINDS:
        total = round(inputs * _SHARE[kind])
        half = total // 2
        jobs += [(kind, 0, half), (kind, half, total - half)]
    with ProcessPoolExecutor(2) as pool:
        tallies = list(pool.map(_feed, jobs))
    (report_dir / "fuzz.md").write_text(report(tallies))
    failures = [f for tally in tallies for f in tally.failures]
    if failures:
        raise RuntimeError(f"{len(failures)} inputs went wrong, first: {failures[0]}")


def report(tallies: list[Tally]) -> str:
    """The page."""
    lines = [
        "# Malformed input",
        "",
        measured_by("tools.campaigns.fuzz", "on two processes"),
        "",
        "Good missions, scenarios, configurations, logs and MAVLink frames made bad; refused: one line of",
        "`InputError`; taken means that the damage left it meaningful (or, for a log, readable up to the",
        "damage). Wrong is everything else, and what takes over 1 s of processor time.",
        "",
        "| kind | inputs | refused | taken | wrong | slowest ms |",
        "|---|---|---|---|---|---|",
    ]
    for kind in KINDS:
        mine = [t for t in tallies if t.kind == kind]
        sums = [sum(getattr(t, name) for t in mine) for name in ("inputs", "refused", "taken")]
        wrong = sum(len(t.failures) for t in mine)
        slowest = 1e3 * max(t.slowest_s for t in mine)
        lines.append(f"| {kind} | {sums[0]} | {sums[1]} | {sums[2]} | {wrong} | {slowest:.0f} |")
    lines += [""] + [f"- {failure}" for t in tallies for failure in t.failures]
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--report-dir", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    run(arguments.report_dir, arguments.inputs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
