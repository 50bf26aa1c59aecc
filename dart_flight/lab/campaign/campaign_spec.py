"""The specification of a campaign, and its flights: each combination of mission, settings, case and seed.

`dart-flight campaign` builds the specification from its options. For each measurement in the manual, a file
(`tools/campaigns/*.yaml`) contains a specification and names a function that evaluates each flight.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import shlex
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec

from dart_flight.config.document import Document, InputError, utf8_path
from dart_flight.config.mission import Mission
from dart_flight.recording.about import software_version
from dart_flight.run.fast import simulated_driver
from dart_flight.run.prepare import load_flyable
from dart_flight.sim.draws import draw_world, parse_vary


class Keep(StrEnum):
    """The flights whose logs are kept."""

    FAILED = "failed"  # logs of flights that did not complete
    ALL = "all"
    NONE = "none"


class CampaignSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A specification as written in a file or on the command line.

    A function is given as text, `module:function`.

    Attributes:
        missions: mission files.
        config: vehicle configuration that replaces the configuration of each mission.
        settings: configuration key -> the values to fly, as written.
        vary: entries that make the simulated world differ at random from the mission (`sim.draws`).
        runs: number of seeds. Each mission with each combination of values is flown with the seeds `seed`,
            `seed` + 1, and so on.
        keep: the flights whose logs are kept.
        cases: additional variations of the flights. Each case is a mapping key -> value, and the table has
            one column for each key. Instead of a list, a function that returns the cases can be named.
        fly: function that flies a grid point (`Point`) with a seed and returns the flown flight. If `fly` is
            empty, the mission is flown in simulated time.
        judge: function that converts a flown flight to a `msgspec.Struct`. The fields of the struct are
            columns of the table. If `judge` is empty, `fly` returns the struct. If both are empty, the
            columns are those of `dart-flight campaign`.
    """

    missions: tuple[str, ...]
    config: str | None = None
    settings: dict[str, tuple[str, ...]] = {}
    vary: tuple[str, ...] = ()
    runs: int = 1
    seed: int = 1
    keep: Keep = Keep.FAILED
    cases: tuple[dict[str, str], ...] | str = ()
    fly: str = ""
    judge: str = ""

    @property
    def makes_row(self) -> str:
        """The name of the function that returns the row; empty if the row has the default columns."""
        return self.judge or self.fly


class Point(NamedTuple):
    """One mission with one combination of settings and one case.

    Attributes:
        number: number of the point, from 1.
        path: mission file, as given.
        values: values of the settings in order, then the values of the case.
        spreads: standard deviations of the drawn quantities by name.
        digest: hash of the resolved mission and vehicle without their file names.
        case: key -> value; empty if the specification has no cases.
    """

    number: int
    path: str
    values: tuple[str, ...]
    mission: Mission
    spreads: dict[str, float]
    digest: str
    case: Mapping[str, str] = MappingProxyType({})


class Item(NamedTuple):
    """One flight, identified by the number of its point and by its seed."""

    point: int
    seed: int


class Campaign(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of `campaign.json`; a resumed campaign must agree with it.

    Attributes:
        digests: digests of the points in order.
        columns: columns of the table.
        software: version, with the commit if known.
    """

    asked: CampaignSpec
    digests: tuple[str, ...]
    columns: tuple[str, ...]
    software: str
    version: int = 1


def load_specification(path: Path) -> CampaignSpec:
    return Document.load(path).convert(CampaignSpec)


def parse_grid(settings: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the values of each key from settings in the form `KEY=V1,V2,...`.

    A comma within brackets or quotes belongs to a value.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        values = tuple(part.strip() for part in _split(text))
        if not equals or not key.strip() or not all(values):
            raise InputError(f"--set {setting}: expected KEY=V1,V2,..., such as airframe.mass_kg=1.2,1.4")
        if key.strip() in grid:
            raise InputError(f"--set {setting}: this key appears twice; separate its values with commas")
        if len(set(values)) < len(values):
            raise InputError(f"--set {setting}: a value appears twice")
        grid[key.strip()] = values
    return grid


def _split(text: str) -> Iterator[str]:
    """Split a text at commas outside of brackets and quotes."""
    depth, quote, begin = 0, "", 0
    for i, c in enumerate(text):
        if quote:
            quote = "" if c == quote else quote
        elif c in "'\"":
            quote = c
        elif c in "[{(":
            depth += 1
        elif c in "]})":
            depth -= 1
        elif c == "," and not depth:
            yield text[begin:i]
            begin = i + 1
    yield text[begin:]


def named_function(name: str) -> Callable[..., Any]:
    """Import the function that a specification gives as `module:function`."""
    module, _, function = name.partition(":")
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{name}: {error}; name a function as module:function") from None
    return found


def row_type(name: str) -> type[msgspec.Struct]:
    found = typing.get_type_hints(named_function(name)).get("return")
    if not (isinstance(found, type) and issubclass(found, msgspec.Struct)):
        raise InputError(f"{name}: annotate the return type of this function as a msgspec.Struct")
    return found


def cases_of(asked: CampaignSpec) -> tuple[dict[str, str], ...]:
    """Return the cases of a specification, or one case without keys; all cases must have the same keys."""
    cases = named_function(asked.cases)() if isinstance(asked.cases, str) else asked.cases
    if any(case.keys() != cases[0].keys() for case in cases):
        raise InputError("all cases must have the same keys", key=("cases",))
    return tuple(cases) or ({},)


def keys_of(asked: CampaignSpec, points: Sequence[Point]) -> tuple[str, ...]:
    """Return the names of a point's values: the settings, then the keys of the cases."""
    return (*asked.settings, *points[0].case)


def points_of(asked: CampaignSpec) -> list[Point]:
    """Load and check every mission with every combination of settings and every case."""
    if len(set(asked.missions)) < len(asked.missions):
        raise InputError("a mission appears twice", key=("MISSION",))
    points: list[Point] = []
    cases = cases_of(asked)
    for path, values in itertools.product(asked.missions, itertools.product(*asked.settings.values())):
        settings = [f"{key}={value}" for key, value in zip(asked.settings, values, strict=True)]
        mission = load_flyable(utf8_path(path), asked.config, settings)
        simulated_driver(mission)
        spreads = parse_vary(asked.vary, mission.vehicle)
        for case in cases:
            number, all_values = len(points) + 1, (*values, *case.values())
            digest = _digest(mission, spreads, case)
            points.append(Point(number, path, all_values, mission, spreads, digest, case))
    return points


def _digest(mission: Mission, spreads: Mapping[str, float], case: Mapping[str, str]) -> str:
    bare = msgspec.structs.replace(mission, source="", vehicle_source=None, flown=None, written=None)
    flown = [bare, spreads, case] if case else [bare, spreads]
    return hashlib.sha256(msgspec.json.encode(flown, order="sorted")).hexdigest()[:32]


def items_of(asked: CampaignSpec, points: Sequence[Point]) -> Iterator[Item]:
    """Yield every flight by seed, then by point, so that a partial campaign covers all points evenly."""
    for seed in range(asked.seed, asked.seed + asked.runs):
        for point in points:
            yield Item(point.number, seed)


def campaign_of(asked: CampaignSpec, points: Sequence[Point]) -> Campaign:
    digests, keys = tuple(p.digest for p in points), keys_of(asked, points)
    if asked.makes_row:
        judged = row_type(asked.makes_row).__struct_fields__
        columns: tuple[str, ...] = ("mission", *keys, "seed", "error", *judged)
        return Campaign(asked, digests, columns, software_version())
    drawn = dict.fromkeys(name for p in points for name in draw_world(p.mission, asked.seed, p.spreads).drawn)
    collisions = max(len(p.mission.collisions) for p in points)
    columns = (
        *("mission", *keys, "seed", *drawn, "outcome", "reason", "guard_rule", "plan_followed"),
        "not_followed",
        *("goal_miss_m", "final_error_m", "max_tilt_deg", "flight_time_s", "unexplained_modes"),
        *(f"c{i + 1}_{name}" for i in range(collisions) for name in ("normal_m_s", "peak_force_n")),
    )
    return Campaign(asked, digests, columns, software_version())


def difference(kept: Campaign, wanted: Campaign) -> str | None:
    """Return why `kept` cannot be resumed as `wanted`; None if `wanted` is equal or only has more seeds."""
    a, b = kept.asked, wanted.asked
    for name, before, now in (
        ("the missions", a.missions, b.missions),
        ("--config", a.config, b.config),
        ("--set", a.settings, b.settings),
        ("--vary", a.vary, b.vary),
        ("--seed", a.seed, b.seed),
        ("--keep", a.keep, b.keep),
        ("the cases", a.cases, b.cases),
        ("the function that flies", a.fly, b.fly),
        ("the judge", a.judge, b.judge),
        ("the version of dart-flight", kept.software, wanted.software),
    ):
        if before != now:
            return f"{name}: {_format_setting(before)} in the existing campaign, not {_format_setting(now)}"
    if b.runs < a.runs:
        return f"--runs: {a.runs} in the existing campaign, not {b.runs}; runs can be added, but not removed"
    if kept.digests != wanted.digests:
        return "a mission or configuration file has changed since the campaign began"
    return None


def _format_setting(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k}={','.join(v)}" for k, v in value.items()) or "none"
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return "none" if value is None else str(value)


def log_name(point: Point, seed: int) -> str:
    stem = "".join(c if c.isalnum() else "-" for c in Path(point.path).stem)
    return f"{stem}-{point.number}-{seed}"


def command_of(asked: CampaignSpec, point: Point, seed: int) -> str:
    """Return the command that repeats one flight of a campaign."""
    words = ["dart-flight", "dry-run", point.path, "--fast", "--seed", str(seed)]
    words += [word for setting in asked.vary for word in ("--vary", setting)]
    for key, value in zip(asked.settings, point.values, strict=False):  # later values belong to the case
        words += ["--set", f"{key}={value}"]
    if asked.config is not None:
        words += ["--config", asked.config]
    return shlex.join(words)
