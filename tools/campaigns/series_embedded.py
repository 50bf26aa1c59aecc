"""Campaign: trial series by the commands of docs/series.md, then a mission with the identified entry.

A seed is a vehicle: `--vary contact=0.2` changes k, f and mu of the wall, the same in all flights. The last
flight has the identified entry; in the embedded world, the fault `wall-harder` gives the wall its true k.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Mode
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.identify.next_hits import FITTED
from dart_flight.lab.series.evidence import read_evidence
from dart_flight.lab.series.series_file import SeriesFolder
from dart_flight.lab.series.status import SeriesStatus, status_of
from dart_flight.sim.draws import draw_world
from tools.campaigns.results import markdown

_WALL, _SPREAD, _MOST_FLIGHTS, _HITS_PER_FLIGHT = "acrylic", 0.2, 6, 6
_WORLDS = {"embedded": ("--dry-run",), "px4": ("--px4", "--mocap", "optitrack")}


class CommandedSeries(msgspec.Struct, frozen=True):
    """The result of one series by commands.

    Attributes:
        coefficients: by `mode name`: estimate, low and high with the allowance, and the truth.
        flights, hits, used: numbers in the series.
        is_complete: whether the aims were reached.
        endings: how the flights of the series ended.
        last: outcome of the mission with the identified entry.
        followed: whether it followed its plan.
    """

    coefficients: dict[str, tuple[float, float, float, float]]
    flights: int
    hits: int
    used: int
    is_complete: bool
    endings: list[str]
    last: str
    followed: bool | None


def fly_by_commands(point: Point, seed: int) -> CommandedSeries:
    """Fly a series from `new` to `apply`, and the mission with its result.

    Raises:
        FlightError: a command failed.
    """
    world = _WORLDS[point.case["world"]]
    varied = ("--seed", str(seed), "--vary", f"contact={_SPREAD}", "--vary", "contact_scatter")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        series, config = folder / "series", folder / "mine.yaml"
        mission = packaged("missions") / "dual_collision.yaml"
        config.write_bytes((packaged("configs") / "dart.yaml").read_bytes())
        _command(
            *("series", "new", series, "--mission", mission, "--wall", _WALL, "--config", config),
            *("--hits-per-flight", _HITS_PER_FLIGHT),
        )
        status = _status(series)
        for _ in range(_MOST_FLIGHTS):
            _command("series", "fly", series, *world, "--speed", "max", *varied, may_fail=True)
            status = _status(series)
            if status.is_complete:
                break
        truths = draw_world(load_mission(mission, config), seed, {"contact": _SPREAD}).drawn
        configured = load_mission(mission, config).vehicle.materials[status.material]
        found = {}
        for mode, one in status.modes.items():
            for symbol in FITTED:
                c = one.coefficients[symbol]
                truth = getattr(configured.coefficients(Mode(mode)), symbol)
                truth *= float(truths[f"contact.{_WALL}.{mode}.{symbol}"])
                found[f"{mode} {symbol}"] = (c.statistical.value, *c.whole[1:], truth)
        _command("series", "apply", series, "--config", config)
        options = [*world, *("--speed", "max", "--config", config, "--seed", seed, "--log-dir", folder)]
        if point.case["world"] == "embedded":
            options.remove("--dry-run")
            options += ["--fault", f"wall-harder={found['rigid k'][-1] / found['rigid k'][0]:.3f}"]
        text = _command("dry-run", mission, *options, "--json", may_fail=True)
        last = json.loads(text)
    return CommandedSeries(
        found,
        len(status.flights),
        sum(one.flown for one in status.modes.values()),
        sum(one.used for one in status.modes.values()),
        status.is_complete,
        list(status.flights.values()),
        last["outcome"],
        last["plan_followed"],
    )


def _status(series: Path) -> SeriesStatus:
    folder = SeriesFolder(series, None)
    return status_of(folder.settings, folder.mission(), read_evidence(folder))


def _command(*arguments: Any, may_fail: bool = False) -> str:
    call = [sys.executable, "-m", "dart_flight", *map(str, arguments)]
    result = subprocess.run(call, capture_output=True, text=True, check=False)
    if result.returncode and not may_fail:
        raise FlightError(f"{' '.join(call[3:5])}: {result.stderr.strip().splitlines()[-1]}")
    return result.stdout


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every series, and one line for the coefficients of all of them."""
    table, inside, of = [], 0, 0
    for row in rows:
        one = row.row
        errors = {key: c[0] / c[-1] - 1.0 for key, c in one.coefficients.items()}
        inside += sum(c[1] <= c[-1] <= c[2] for c in one.coefficients.values())
        of += len(one.coefficients)
        shown = [
            " ".join(f"{100.0 * errors[f'{m} {n}']:+.1f}" for m in ("flexible", "rigid")) for n in FITTED
        ]
        table.append(
            [
                str(row.seed),
                f"{one.used}/{one.hits}",
                "yes" if one.is_complete else "no",
                *shown,
                "followed" if one.followed else one.last,
            ]
        )
    heads = (
        "seed",
        "hits used",
        "aims reached",
        *(f"{n}: flexible rigid, %" for n in FITTED),
        "plan",
    )
    return f"{markdown(heads, table)}\n{inside} of {of} intervals with allowance contain the truth."
