"""How well coefficients come out of flight logs: fast flights against walls whose coefficients are known.

    python -m tools.campaigns.flight_identify           (writes docs/results/flight_identification.md)
    python -m tools.campaigns.flight_identify --body guards     this kind of vehicle anew, the other as kept
    python -m tools.campaigns.flight_identify --resume          what an interrupted run has not done yet

Flights and what was found are kept below `--keep`.
"""

from __future__ import annotations

import argparse
import itertools
import math
import shutil
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import msgspec

from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.flight_trials import ALLOWANCE, trials_of
from dart_flight.lab.report.page import AGREES, beyond, disagreements
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.reader import read_log
from dart_flight.run.prepare import load_flyable
from tools.bench.other_wall import fly_against, with_walls
from tools.campaigns.results import RESULTS, ROOT, measured_by

# The law is a point's. A point shows what the fit is worth; a body with guards, which turns, what
# it makes of the vehicle that missions fly with by default.
POINT, GUARDS = "point", "guards"
MISSIONS = {
    "paper_single_wall": ("dart", POINT),
    "paper_dual_collision": ("dart", POINT),
    "single_wall, guards": ("dart", GUARDS),
    "dual_collision, guards": ("dart", GUARDS),
    "rigid_cage/single_wall, guards": ("rigid_cage", GUARDS),
}
WALLS: dict[str, tuple[dict[str, float], ...]] = {
    POINT: ({}, {"k": 1.2}, {"k": 1.4}, {"k": 0.8}, {"f": 1.5}, {"mu": 0.6}),
    GUARDS: ({}, {"k": 1.4}, {"mu": 0.6}),
}
FLIGHTS = 3
_FOUND = "found.json"


class Found(msgspec.Struct):
    """One coefficient of one set of flights."""

    mission: str
    walls: str
    material: str
    mode: str
    name: str
    truth: float
    value: float | None
    low: float | None
    high: float | None
    body: str
    turned_deg_s: float  # the most about the vertical in these contacts
    proposed: (
        bool  # the report disagrees, and an interval of the material's does not hold the configured value
    )

    @property
    def inside(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low is not None and self.high is not None and self.low <= self.truth <= self.high


def _flown(mission: Mission, real: Mission, seed: int, folder: Path) -> Path:
    """The log of a flight, flown where it is not there; one that was cut short leaves nothing behind."""
    path = folder / f"{seed}" / "flight.mcap"
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=folder) as begun:
            done = fly_against(mission, real, seed, Path(begun) / path.name)
            path.parent.mkdir(exist_ok=True)
            done.rename(path)
    return path


def run_case(name: str, factors: dict[str, float], first_seed: int, keep: Path) -> list[Found]:
    """Fly, identify, ask the report: all coefficients of one mission against one kind of walls.

    Args:
        name: of `MISSIONS`.
        factors: coefficient -> what the real walls' is multiplied by.
        first_seed: of `FLIGHTS` flights.
        keep: where flights are kept, and taken from where they are there.
    """
    file, (vehicle, body) = name.split(",", maxsplit=1)[0], MISSIONS[name]
    mission = load_flyable(
        packaged("missions", *f"{file}.yaml".split("/")),
        packaged("configs", f"{vehicle}.yaml"),
        [f"simulation.contact.body={body}"],
    )
    real = with_walls(mission, **factors)
    words = words_of(factors)
    found = []
    folder = folder_of(keep, name, factors)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [_flown(mission, real, seed, folder) for seed in range(first_seed, first_seed + FLIGHTS)]
    disagreement = disagreements([RecordedFlight.read(path) for path in paths])
    logs = [read_log(path) for path in paths]
    for material in dict.fromkeys(c.wall.material for c in mission.collisions):
        trials = [t for log in logs for t in trials_of(log, material).get(material, [])]
        result = identify(trials, mission.vehicle.airframe.mass_kg, Onset(mission.vehicle.onset))
        configured = mission.vehicle.materials[material]
        proposed = beyond(disagreement[material]) and any(
            e is not None and not e.low <= getattr(getattr(configured, mode), name) <= e.high
            for mode, coefficients in result.coefficients.items()
            for name, e in coefficients.items()
        )
        for mode, coefficients in result.coefficients.items():
            truth = getattr(real.vehicle.materials[material], mode)
            turned = math.degrees(max(t.turn_rad_s or 0.0 for t in trials if t.mode == mode))
            for coefficient, e in coefficients.items():
                value, low, high = (None, None, None) if e is None else e
                found.append(
                    Found(
                        file, words, material, mode, coefficient, getattr(truth, coefficient), value, low,
                        high, body, turned, proposed,
                    )
                )  # fmt: skip
    (folder / _FOUND).write_bytes(msgspec.json.encode(found))
    return found


def words_of(factors: dict[str, float]) -> str:
    """What the walls are, in words."""
    return ", ".join(f"{name} × {x:g}" for name, x in factors.items()) or "as configured"


def folder_of(keep: Path, name: str, factors: dict[str, float]) -> Path:
    """Where a case is kept."""
    return keep / "_".join((name + " " + words_of(factors)).replace(" × ", "_").replace(",", "").split())


def _rows(found: Sequence[Found]) -> Iterator[str]:
    """A row for each case: its coefficients as found, bold where the interval does not hold the truth."""
    for (mission, walls, material, mode), case in itertools.groupby(
        found, key=lambda f: (f.mission, f.walls, f.material, f.mode)
    ):
        named = {f.name: f for f in case}
        first = next(iter(named.values()))
        cells = [_cell(named[name]) for name in ALLOWANCE]
        yield (
            f"| {mission} | {walls} | {material}, {mode} | {first.turned_deg_s:.0f} | {' | '.join(cells)} "
            f"| {'yes' if first.proposed else 'no'} |"
        )


def _cell(f: Found) -> str:
    if f.value is None:
        return "unknown"
    shown = f"{f.value:.4g}, {100.0 * (f.value / f.truth - 1.0):+.1f} %"
    return shown if f.inside else f"**{shown}**"


def _errors(found: Sequence[Found]) -> str:
    """Median and largest error of each coefficient, and how many intervals hold."""
    known = [f for f in found if f.value is not None]
    said = []
    for name in ALLOWANCE:
        sizes = sorted(abs((f.value or 0.0) / f.truth - 1.0) for f in known if f.name == name)
        if sizes:
            said.append(f"{name} {100 * statistics.median(sizes):.1f} % and {100 * sizes[-1]:.1f} %")
    return (
        f"Median and largest errors: {', '.join(said)}.\n"
        f"The interval holds the truth in {sum(f.inside for f in known)} of {len(known)} cases."
    )


_HEAD = (
    f"| mission | walls | material, mode | turned, deg/s | {' | '.join(ALLOWANCE)} | proposed |\n"
    + "|---" * (5 + len(ALLOWANCE))
    + "|"
)


def page(found: Sequence[Found], missing: Sequence[str], first_seed: int = 1) -> str:
    """The report as Markdown."""
    allowed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in ALLOWANCE.items())
    point, guards = ([f for f in found if f.body == body] for body in (POINT, GUARDS))
    last = first_seed + FLIGHTS - 1
    left_out = f"Not run: {'; '.join(missing)}.\n\n" if missing else ""
    return f"""# Coefficients from flight logs

{measured_by("tools.campaigns.flight_identify")}

Fast flights, seeds {first_seed} to
{last}, against walls whose coefficients differ from the configuration's as said; `identify` and `report`
see only the logs.

The intervals are the statistical 95 % interval and an allowance for what such recordings are off by,
however many there are ({allowed} of the value): PX4's velocity loop brakes
the vehicle while the wall does, which looks like damping of the wall, and it holds the height against
the vertical force. Where the vehicle turned, mu's interval is wider by that too. Each coefficient is given as
found, with its error; bold where the interval does not hold the truth.

`proposed`: the report of these flights says to identify the material, and a coefficient's interval does
not hold the configured value. The report says so where the mean of measured over predicted peak, of the
normal force or of friction above 5 N, is off by more than {100 * AGREES:.0f} % and by more than its own 95 %
interval. A wrong nu alone is found with `identify`.

{left_out}## A point, as the law has it

{_errors(point)}

{_HEAD}
{chr(10).join(_rows(point))}

## A body with guards, as missions fly by default

The friction turns it, which a point's law does not know.
{_errors(guards)}

{_HEAD}
{chr(10).join(_rows(guards))}
"""


def main() -> None:
    """Run the campaign and write its report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "flight_identification.md")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--body", choices=(POINT, GUARDS), help="only these anew, the others as kept")
    parser.add_argument("--resume", action="store_true", help="take flights and results that are kept")
    parser.add_argument("--keep", type=Path, default=ROOT / "build" / "flight_identify", metavar="DIR")
    given = parser.parse_args()
    jobs = [(name, walls) for name, (_, body) in MISSIONS.items() for walls in WALLS[body]]
    anew = [(name, walls) for name, walls in jobs if given.body in (None, MISSIONS[name][1])]
    if given.resume:
        anew = [job for job in anew if not (folder_of(given.keep, *job) / _FOUND).exists()]
    else:
        for job in anew:
            shutil.rmtree(folder_of(given.keep, *job), ignore_errors=True)
    with ProcessPoolExecutor(given.workers) as pool:
        running = {pool.submit(run_case, *job, given.first_seed, given.keep): job for job in anew}
        for done in as_completed(running):
            ratios = " ".join(
                f"{f.name}:{f.value and f.value / f.truth:.3f}" for f in done.result() if f.value
            )
            print(*running[done], ratios, flush=True)
    found: list[Found] = []
    missing = []
    for name, walls in jobs:
        file = folder_of(given.keep, name, walls) / _FOUND
        if file.exists():
            found += msgspec.json.decode(file.read_bytes(), type=list[Found])
        else:
            missing.append(f"{name}, {words_of(walls)}")
    given.output.write_text(page(found, missing, given.first_seed), encoding="utf-8")


if __name__ == "__main__":
    main()
