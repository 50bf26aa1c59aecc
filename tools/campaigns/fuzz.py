"""Campaign: malformed files and MAVLink frames must be rejected in one line, without traceback or hang.

The number of an input (docs/results/fuzz.md) determines how a valid input is damaged: bytes or lines are
removed, doubled, swapped or replaced, or values are exchanged. An input fails if it raises an exception other
than `InputError` (for frames: any exception). It also fails if the error has several lines, or if the program
takes more than a second of processor time.
"""

from __future__ import annotations

import functools
import io
import random
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import yaml
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import parse_mission
from dart_flight.config.vehicle import LockDriver, VehicleConfig, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from tools.campaigns.results import markdown

_BLOCK = 100  # inputs per row
_SLOW_S = 1.0
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


class Tally(msgspec.Struct, frozen=True):
    """The results of a hundred inputs of one kind."""

    refused: int
    taken: int
    slowest_s: float
    failures: list[str]


def spoil_text(text: str, rng: random.Random) -> str:
    """Return a damaged copy of a valid file."""
    for _ in range(rng.randint(1, 4)):
        i = rng.randrange(len(text) + 1)
        j = min(len(text), i + rng.randint(1, 12))
        damage = rng.randrange(6)
        if damage == 0:
            text = text[:i] + text[j:]
        elif damage == 1:
            text = text[:j] + text[i:]
        elif damage == 2:
            text = text[:i] + rng.choice(_PIECES) + text[i:]
        elif damage == 3:
            lines = text.splitlines()
            k = rng.randrange(len(lines))
            lines.insert(rng.randrange(len(lines)), lines.pop(k))
            text = "\n".join(lines) + "\n"
        elif damage == 4:
            text = text[:i] + rng.choice(_VALUES) + text[j:]
        else:
            text = _exchange_value(text, rng)
    return text


def _exchange_value(text: str, rng: random.Random) -> str:
    """Return a copy of the text with the value of one key replaced."""
    lines = text.splitlines()
    keyed = [i for i, line in enumerate(lines) if ": " in line]
    if not keyed:
        return text
    i = rng.choice(keyed)
    head, _, _ = lines[i].partition(": ")
    lines[i] = f"{head}: {rng.choice(_VALUES)}"
    return "\n".join(lines) + "\n"


def spoil_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return a copy of the data with bytes flipped, removed, inserted or cut off."""
    body = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        i = rng.randrange(len(body)) if body else 0
        damage = rng.randrange(4)
        if damage == 0 and body:
            body[i] ^= 1 << rng.randrange(8)
        elif damage == 1:
            del body[i : i + rng.randint(1, 40)]
        elif damage == 2:
            body[i:i] = rng.randbytes(rng.randint(1, 20))
        elif rng.random() < 0.3:
            del body[i:]
    return bytes(body)


# --- inputs -------------------------------------------------------------------------------------------


class _Mission:
    def __init__(self) -> None:
        self._texts = [path.read_text() for path in sorted(packaged("missions").glob("*.yaml"))]
        self._vehicle: VehicleConfig = load_vehicle(packaged("configs", "dart.yaml"))

    def __call__(self, rng: random.Random) -> None:
        parse_mission(Document(spoil_text(rng.choice(self._texts), rng), "m.yaml"), self._vehicle)


class _Scenario:
    def __init__(self) -> None:
        self._texts = [path.read_text() for path in sorted(packaged("missions", "scenarios").glob("*.yaml"))]
        self._folder = tempfile.TemporaryDirectory()

    def __call__(self, rng: random.Random) -> None:
        path = Path(self._folder.name) / "scenario.yaml"
        path.write_text(spoil_text(rng.choice(self._texts), rng))
        load_scenario(path, packaged("configs", "dart.yaml"))


class _Configuration:
    def __init__(self) -> None:
        text = packaged("configs", "dart.yaml").read_text()
        # Without comments, so that the damage affects keys and values.
        self._text = yaml.safe_dump(yaml.safe_load(text), sort_keys=False)
        self._folder = tempfile.TemporaryDirectory()

    def __call__(self, rng: random.Random) -> None:
        path = Path(self._folder.name) / "dart.yaml"
        path.write_text(spoil_text(self._text, rng))
        load_vehicle(path)


class _Log:
    """Damaged logs, kept short because a reader stops at the damage."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        mission = load_flyable(packaged("missions", "paper_single_wall.yaml"))
        fly_fast(mission, 1, folder)
        whole = next(folder.glob("*/flight.mcap")).read_bytes()
        self._good = whole[:60_000]

    def __call__(self, rng: random.Random) -> None:
        path = Path(self._folder.name) / "log.mcap"
        path.write_bytes(spoil_bytes(self._good, rng))
        read_log(path)


class _Frame:
    """Frames that arrive at the autopilot's endpoint: valid, damaged and invented ones."""

    def __init__(self) -> None:
        mission = load_flyable(packaged("missions", "paper_single_wall.yaml"))
        self._vehicle = SimulatedVehicle(mission, 1, LockDriver.PX4)
        self._endpoint = MavlinkEndpoint(self._vehicle.autopilot, (9,))
        self._link = self._endpoint.links[0]
        self._address = self._link.socket.getsockname()
        self._from = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._pack = mavlink.MAVLink(io.BytesIO(), srcSystem=245, srcComponent=190)

    def __call__(self, rng: random.Random) -> None:
        self._from.sendto(self._frame(rng), self._address)
        self._vehicle.advance()
        self._endpoint.exchange()

    def _frame(self, rng: random.Random) -> bytes:
        def number() -> float:
            return rng.choice((0.0, 1.0, -1.0, float("nan"), float("inf"), 3e38, rng.uniform(-1e6, 1e6)))

        kind = rng.randrange(5)
        if kind == 0:
            return rng.randbytes(rng.randrange(0, 300))
        if kind == 1:
            ids = (400, 176, 22, 21, 20, 511, 512, 187, rng.randrange(65536))
            message: Any = mavlink.MAVLink_command_long_message(
                1, 1, rng.choice(ids), 0, *(number() for _ in range(7))
            )
        elif kind == 2:
            parts = [number() for _ in range(11)]
            mask = rng.randrange(65536)
            message = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, *parts)
        elif kind == 3:
            name = rng.choice((b"MPC_XY_P", b"PWM_AUX_MIN1", rng.randbytes(8)))
            message = mavlink.MAVLink_param_set_message(1, 1, name, number(), rng.choice((6, 9)))
        else:
            message = mavlink.MAVLink_param_request_read_message(
                1, 1, rng.randbytes(8), rng.randrange(-1, 300)
            )
        packed = bytes(message.pack(self._pack))
        return packed if rng.random() < 0.5 else spoil_bytes(packed, rng)


_FEEDERS: dict[str, Callable[[], Callable[[random.Random], None]]] = {
    "mission": _Mission,
    "scenario": _Scenario,
    "configuration": _Configuration,
    "log": _Log,
    "frame": _Frame,
}


_feeder = functools.cache(lambda kind: _FEEDERS[kind]())


def fly(point: Point, seed: int) -> Tally:
    """Feed the hundred inputs whose numbers follow from the seed."""
    kind, refused, taken, slowest_s = point.case["kind"], 0, 0, 0.0
    failures: list[str] = []
    feed = _feeder(kind)  # the first call flies a mission, which is not the input's time
    for number in range(_BLOCK * (seed - 1), _BLOCK * seed):
        begin_s = time.process_time()
        try:
            feed(random.Random(f"{kind} {number}"))
            taken += 1
        except InputError as error:
            refused += 1
            if "\n" in error.one_line():
                failures.append(f"{kind} {number}: more than one line")
        except Exception as error:
            failures.append(f"{kind} {number}: {type(error).__name__}: {error}")
        processor_s = time.process_time() - begin_s
        slowest_s = max(slowest_s, processor_s)
        if processor_s > _SLOW_S:
            failures.append(f"{kind} {number}: took {processor_s:.1f} s")
    return Tally(refused, taken, slowest_s, failures)


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every kind, and the failures."""
    kinds: dict[str, list[Tally]] = {}
    for r in rows:
        kinds.setdefault(r.values["kind"], []).append(r.row)
    table = [
        [
            kind,
            str(_BLOCK * len(mine)),
            str(sum(tally.refused for tally in mine)),
            str(sum(tally.taken for tally in mine)),
            str(sum(len(tally.failures) for tally in mine)),
            f"{1e3 * max(tally.slowest_s for tally in mine):.0f}",
        ]
        for kind, mine in kinds.items()
    ]
    failures = [f"- {failure}" for mine in kinds.values() for tally in mine for failure in tally.failures]
    heads = ("kind", "inputs", "rejected", "accepted", "failures", "slowest ms")
    return "\n".join([markdown(heads, table), *failures])
