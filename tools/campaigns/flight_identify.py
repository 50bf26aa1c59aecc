"""How well coefficients come out of flight logs: fast flights against walls whose coefficients are known.

python -m tools.campaigns.flight_identify           (writes docs/flight_identification.md)
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import msgspec

from dart_flight.config.vehicle import packaged
from dart_flight.contact.law import Onset
from dart_flight.identification.fit import identify
from dart_flight.identification.flight_trials import ALLOWANCE, trials_of
from dart_flight.recording.reader import read_log
from dart_flight.report.flight import Flight
from dart_flight.report.proposal import AGREES, propose
from dart_flight.worlds.prepare import load_flyable
from tools.bench.other_wall import fly_against, with_walls

ROOT = Path(__file__).parents[2]
MISSIONS = ("single_wall", "dual_collision")
WALLS: tuple[dict[str, float], ...] = ({}, {"k": 1.2}, {"k": 1.4}, {"k": 0.8}, {"f": 1.5}, {"mu": 0.6})
FLIGHTS = 3


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
    proposed: bool  # whether the report of these flights proposes an entry for the material
    seconds: float

    @property
    def inside(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low is not None and self.high is not None and self.low <= self.truth <= self.high


def run_case(mission_name: str, factors: dict[str, float], flights: int = FLIGHTS) -> list[Found]:
    """Fly, identify, ask the report: all coefficients of one mission against one kind of walls."""
    # The law that is fitted is a point's, and so is the vehicle that flies it.
    mission = load_flyable(
        packaged("missions", f"{mission_name}.yaml"),
        packaged("configs", "dart.yaml"),
        ["simulation.contact.body=point"],
    )
    real = with_walls(mission, **factors)
    words = ", ".join(f"{name} × {x:g}" for name, x in factors.items()) or "as configured"
    found = []
    with tempfile.TemporaryDirectory() as folder:
        paths = [
            fly_against(mission, real, seed, Path(folder) / f"{seed}" / "flight.mcap")
            for seed in range(1, flights + 1)
        ]
        proposals = {p.material: bool(p.entry) for p in propose([Flight.read(path) for path in paths])}
        logs = [read_log(path) for path in paths]
    for material in dict.fromkeys(c.wall.material for c in mission.collisions):
        trials = [t for log in logs for t in trials_of(log, material).get(material, [])]
        begin = time.process_time()
        result = identify(
            trials, mission.vehicle.airframe.mass_kg, Onset(mission.vehicle.onset), compare_laws=False
        )
        seconds = time.process_time() - begin
        for mode, coefficients in result.coefficients.items():
            truth = getattr(real.vehicle.materials[material], mode)
            for name, e in coefficients.items():
                value, low, high = (None, None, None) if e is None else e
                found.append(
                    Found(
                        mission_name, words, material, mode, name, getattr(truth, name), value, low, high,
                        proposals[material], seconds,
                    )
                )  # fmt: skip
    return found


def _rows(found: Sequence[Found]) -> Iterator[str]:
    for f in found:
        if f.value is None:
            result = "– | – | –"
        else:
            error = f"{100.0 * (f.value / f.truth - 1.0):+.1f}"
            result = f"{f.value:.4g} | {error} | {f.low:.4g} to {f.high:.4g}"
        yield (
            f"| {f.mission} | {f.walls} | {f.material}, {f.mode} | {f.name} | {f.truth:.4g} | {result} "
            f"| {'yes' if f.inside else 'no' if f.value is not None else 'unknown'} "
            f"| {'yes' if f.proposed else 'no'} |"
        )


def page(found: Sequence[Found]) -> str:
    """The report as Markdown."""
    known = [f for f in found if f.value is not None]
    allowed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in ALLOWANCE.items())
    errors = {
        name: [abs((f.value or 0.0) / f.truth - 1.0) for f in known if f.name == name] for name in ALLOWANCE
    }
    worst = ", ".join(f"{name} {100 * max(values):.1f} %" for name, values in errors.items() if values)
    lines = [
        "# Coefficients from flight logs",
        "",
        "Written by `python -m tools.campaigns.flight_identify`; do not edit. Fast flights, seeds 1 to "
        f"{FLIGHTS}, against",
        "walls whose coefficients differ from the configuration's as said; `identify` and "
        "`report` see only the",
        "logs.",
        "",
        "The intervals are the statistical 95 % interval and an allowance for what such "
        "recordings are off by,",
        f"however many there are ({allowed} of the value): PX4's velocity loop brakes",
        "the vehicle while the wall does, which looks like damping of the wall, and it holds the "
        "height against",
        "the vertical force.",
        f"Largest errors: {worst}. The interval holds the truth in {sum(f.inside for f in known)} of",
        f"{len(known)} cases.",
        "",
        "`proposed`: the report of these flights proposes a new entry for the material. It does so where the "
        "mean",
        "of measured over predicted peak, of the normal force or of friction above 5 N, is off by more than",
        f"{100 * AGREES:.0f} % and by more than its own 95 % interval, and a coefficient's interval does not "
        "hold",
        "the configured value. A wrong nu alone is found with `report --identify`.",
        "",
        "| mission | walls | material, mode | | truth | found | error % | 95 % interval | holds "
        "truth | proposed |",
        "|---|---|---|---|---|---|---|---|---|---|",
        *_rows(found),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Run the campaign and write its report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "flight_identification.md")
    parser.add_argument("--workers", type=int)
    given = parser.parse_args()
    jobs = [(name, walls) for name in MISSIONS for walls in WALLS]
    found: list[Found] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for (name, walls), part in zip(jobs, pool.map(run_case, *zip(*jobs, strict=True)), strict=True):
            found += part
            print(
                name,
                walls,
                " ".join(f"{f.name}:{f.value and f.value / f.truth:.3f}" for f in part if f.value),
            )
    given.output.write_text(page(found), encoding="utf-8")


if __name__ == "__main__":
    main()
