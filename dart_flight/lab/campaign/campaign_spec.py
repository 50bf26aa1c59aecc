"""The specification of a campaign: missions x settings x cases x seeds, and what its rows depend on.

`dart-flight campaign` makes one from its options; a measurement of the manual is one in a file
(`tools/campaigns/*.yaml`), with a function that judges each flight.
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
    """Whose logs are kept."""

    FAILED = "failed"  # flights that did not complete
    ALL = "all"
    NONE = "none"


class CampaignSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was asked for, in the words of the command or of a specification file.

    Functions are named `module:function`.

    Attributes:
        missions: files.
        config: vehicle configuration instead of that of the missions.
        settings: key of the configuration to its values, as written.
        vary: what is drawn, as written (`sim.draws`).
        runs: seeds, from `seed` on, for every mission and combination of values.
        keep: whose logs.
        cases: what else differs between flights, a column a key; or a function that returns this list.
        fly: function from point and seed to a flown flight; empty: a fast flight of the mission.
        judge: function from a flown flight to a `msgspec.Struct`, whose fields are the columns of the table;
            empty: `fly` returns it, or without `fly` the columns are those of `dart-flight campaign`.
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
        """Name of the function that makes a row; empty for the columns of `dart-flight campaign`."""
        return self.judge or self.fly


class Point(NamedTuple):
    """One mission with one value of every key that is set, and one case.

    Attributes:
        number: 1 for the first.
        path: of the mission, as given.
        values: of the keys, in their order; then those of the case.
        mission: resolved.
        spreads: what is drawn, standard deviations by name.
        digest: of the resolved mission and vehicle, without the names of their files.
        case: value by key; empty without cases.
    """

    number: int
    path: str
    values: tuple[str, ...]
    mission: Mission
    spreads: dict[str, float]
    digest: str
    case: Mapping[str, str] = MappingProxyType({})


class Item(NamedTuple):
    """One flight: which point of the grid, and its seed."""

    point: int
    seed: int


class Campaign(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file `campaign.json`: what another run must agree with to go on.

    Attributes:
        asked: in the command's words.
        digests: of the points, in their order.
        columns: of the table.
        software: version, and the commit where there is one.
    """

    asked: CampaignSpec
    digests: tuple[str, ...]
    columns: tuple[str, ...]
    software: str
    version: int = 1


def load_specification(path: Path) -> CampaignSpec:
    """Read a campaign's specification file.

    Raises:
        InputError: it cannot be read, or a key is unknown or has the wrong type.
    """
    return Document.load(path).convert(CampaignSpec)


def parse_grid(settings: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Values by key from `KEY=V1,V2,...`; commas within brackets and quotes belong to a value.

    Raises:
        InputError: it has another form, or a key is given twice.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        values = tuple(part.strip() for part in _split(text))
        if not equals or not key.strip() or not all(values):
            raise InputError(f"--set {setting}: expected KEY=V1,V2,..., such as airframe.mass_kg=1.2,1.4")
        if key.strip() in grid:
            raise InputError(f"--set {setting}: this key is given twice; separate its values by commas")
        if len(set(values)) < len(values):
            raise InputError(f"--set {setting}: a value is given twice")
        grid[key.strip()] = values
    return grid


def _split(text: str) -> Iterator[str]:
    """Parts between commas that are in no bracket and no quotes."""
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
    """Import the function that a specification names `module:function`.

    Raises:
        InputError: there is none.
    """
    module, _, function = name.partition(":")
    try:
        found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{name}: {error}; name a function as module:function") from None
    return found


def row_type(name: str) -> type[msgspec.Struct]:
    """Return the type of the rows that a function makes, from its annotation.

    Raises:
        InputError: the function is not annotated with a `msgspec.Struct`.
    """
    found = typing.get_type_hints(named_function(name)).get("return")
    if not (isinstance(found, type) and issubclass(found, msgspec.Struct)):
        raise InputError(f"{name}: annotate what it returns as a msgspec.Struct")
    return found


def cases_of(asked: CampaignSpec) -> tuple[dict[str, str], ...]:
    """Return the cases of a specification; one without keys where it has none.

    Raises:
        InputError: a function that is not there, or cases with different keys.
    """
    cases = named_function(asked.cases)() if isinstance(asked.cases, str) else asked.cases
    if any(case.keys() != cases[0].keys() for case in cases):
        raise InputError("all cases must have the same keys", key=("cases",))
    return tuple(cases) or ({},)


def keys_of(asked: CampaignSpec, points: Sequence[Point]) -> tuple[str, ...]:
    """Return the names of the values of a point: settings, then keys of the cases."""
    return (*asked.settings, *points[0].case)


def points_of(asked: CampaignSpec) -> list[Point]:
    """Every mission with every combination of values and every case, loaded and checked.

    Raises:
        InputError: in a mission, a configuration, a setting, a case, or what is to be drawn; a mission twice.
    """
    if len(set(asked.missions)) < len(asked.missions):
        raise InputError("a mission is given twice", key=("MISSION",))
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
    bare = msgspec.structs.replace(mission, source="", vehicle_source=None, flown=None)
    flown = [bare, spreads, case] if case else [bare, spreads]
    return hashlib.sha256(msgspec.json.encode(flown, order="sorted")).hexdigest()[:32]


def items_of(asked: CampaignSpec, points: Sequence[Point]) -> Iterator[Item]:
    """Every flight; every point's first seed, then every point's second, so that a part of it is even."""
    for seed in range(asked.seed, asked.seed + asked.runs):
        for point in points:
            yield Item(point.number, seed)


def campaign_of(asked: CampaignSpec, points: Sequence[Point]) -> Campaign:
    """What is to be written down before the first flight."""
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
    """Why a campaign is not the one that is kept; None where it is, perhaps with more seeds."""
    a, b = kept.asked, wanted.asked
    for name, before, now in (
        ("the missions", a.missions, b.missions),
        ("--config", a.config, b.config),
        ("--set", a.settings, b.settings),
        ("--vary", a.vary, b.vary),
        ("--seed", a.seed, b.seed),
        ("--keep", a.keep, b.keep),
        ("the cases", a.cases, b.cases),
        ("how it flies", a.fly, b.fly),
        ("the judge", a.judge, b.judge),
        ("the version of dart-flight", kept.software, wanted.software),
    ):
        if before != now:
            return f"{name}: it has {_format_setting(before)}, not {_format_setting(now)}"
    if b.runs < a.runs:
        return f"--runs: it has {a.runs}, not {b.runs}; runs can be added, not removed"
    if kept.digests != wanted.digests:
        return "a mission or configuration file has changed since"
    return None


def _format_setting(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k}={','.join(v)}" for k, v in value.items()) or "none"
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return "none" if value is None else str(value)


def log_name(point: Point, seed: int) -> str:
    """The folder of a kept log, below `logs/`."""
    stem = "".join(c if c.isalnum() else "-" for c in Path(point.path).stem)
    return f"{stem}-{point.number}-{seed}"


def command_of(asked: CampaignSpec, point: Point, seed: int) -> str:
    """The command that flies one flight of a campaign again."""
    words = ["dart-flight", "dry-run", point.path, "--fast", "--seed", str(seed)]
    words += [word for setting in asked.vary for word in ("--vary", setting)]
    for key, value in zip(asked.settings, point.values, strict=False):  # the case's values come after
        words += ["--set", f"{key}={value}"]
    if asked.config is not None:
        words += ["--config", asked.config]
    return shlex.join(words)
