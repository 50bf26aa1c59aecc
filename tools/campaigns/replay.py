"""Replays of recorded flights of every world: whether all decisions come out again, bit for bit.

python -m tools.campaigns.replay                      20 fast and 5 embedded flights (these in real time)
python -m tools.campaigns.replay --px4 2              and two of PX4, named by DART_PX4_DIR

Writes docs/results/replay.md. What was measured of a world before is kept where this run does not fly it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from dart_flight.base.records import ImuSample, MissionEnd
from dart_flight.config.vehicle import packaged
from dart_flight.recording.reader import read_log
from dart_flight.run.embedded import fly_embedded
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.run.px4_flight import fly_px4
from dart_flight.run.replay import replay
from tools.campaigns.results import RESULTS, measured_by

MISSIONS = ("paper_dual_collision", "paper_single_wall")
WORLDS = ("fast", "embedded", "px4")
_HEAD = "| world | mission | seed | outcome | MB/min | inputs | outputs | decisions | differ | replay s |"
_RULE = "|---|---|---:|---|---:|---:|---:|---:|---:|---:|"


class Result(msgspec.Struct):
    """One flight and its replay."""

    world: str
    mission: str
    seed: int
    outcome: str
    mb_per_minute: float
    inputs: int
    outputs: int
    decisions: int
    differences: int
    missing: int
    replay_s: float

    @property
    def row(self) -> str:
        """As a row of the table."""
        counts = f"{self.inputs} | {self.outputs} | {self.decisions} | {self.differences}"
        flown = f"{self.world} | {self.mission} | {self.seed} | {self.outcome} | {self.mb_per_minute:.2f}"
        return f"| {flown} | {counts} | {self.replay_s:.1f} |"


def fly_and_replay(world: str, mission_name: str, seed: int, folder: Path) -> Result:
    """Fly one mission in a world, read its log back and replay it."""
    mission = load_flyable(packaged("missions", f"{mission_name}.yaml"), packaged("configs", "dart.yaml"))
    if world == "fast":
        verdict = fly_fast(mission, seed, folder)
    elif world == "embedded":
        verdict = fly_embedded(mission, seed, folder)
    else:
        verdict = fly_px4(mission, None, seed, folder)
    assert verdict.log is not None
    return judge(Path(verdict.log))


def judge(path: Path) -> Result:
    """Replay one log."""
    log = read_log(path)
    begin = time.process_time()
    again = replay(log)
    stamps = [e.record.t_us for e in log.entries if isinstance(e.record, ImuSample)]
    minutes = (max(stamps) - min(stamps)) / 60e6
    end = next((e.record for e in log.entries if isinstance(e.record, MissionEnd)), None)
    if not again.exact:
        raise SystemExit(f"{path} is from another kind of machine")
    for difference in again.differences[:3]:
        print(f"{path}: {difference.text()}", file=sys.stderr)
    return Result(
        log.world or "unknown",
        log.about["mission"],
        log.seed or 0,
        end.outcome if end else "cut",
        path.stat().st_size / 1e6 / minutes,
        again.inputs,
        again.outputs,
        len(again.recorded),
        len(again.differences),
        again.missing,
        time.process_time() - begin,
    )


def kept_rows(page: Path, flown: set[str]) -> list[str]:
    """Rows of an earlier report about worlds that were not flown now."""
    if not page.exists():
        return []
    lines = page.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith("| ") and line.split()[1] in set(WORLDS) - flown]


def report(results: Sequence[Result], kept: Sequence[str]) -> Iterator[str]:
    """The lines of the page."""
    rows = [*(r.row for r in results), *kept]
    rows.sort(key=lambda row: WORLDS.index(row.split()[1]))
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    yield from (
        "# Replays",
        "",
        measured_by("tools.campaigns.replay"),
        "",
        "Every flight is recorded, read back and replayed through a fresh core; every output (setpoints,",
        "commands, estimates, decisions) is compared bit for bit.",
        "",
    )
    for world in WORLDS:
        mine = [c for c in cells if c[0] == world]
        if mine:
            outputs, decisions, differ = (sum(int(c[i]) for c in mine) for i in (6, 7, 8))
            equal = sum(c[8] == "0" for c in mine)
            yield (
                f"- {world}: {equal} of {len(mine)} flights equal; {outputs} outputs, {decisions} of them "
                f"decisions, {differ} differ."
            )
    yield from ("", _HEAD, _RULE, *rows)


def main() -> int:
    """Fly, replay, write; 1 where anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--fast", type=int, default=20, metavar="N")
    parser.add_argument("--embedded", type=int, default=5, metavar="N")
    parser.add_argument("--px4", type=int, default=0, metavar="N")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "replay.md")
    given = parser.parse_args()
    results = []
    for world in WORLDS:
        for i in range(getattr(given, world)):
            with tempfile.TemporaryDirectory() as folder:
                seed = 1 + i // len(MISSIONS)
                results.append(fly_and_replay(world, MISSIONS[i % len(MISSIONS)], seed, Path(folder)))
            print(results[-1].row, flush=True)
    lines = list(report(results, kept_rows(given.output, {r.world for r in results})))
    given.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 1 if any(r.differences or r.missing for r in results) else 0


if __name__ == "__main__":
    sys.exit(main())
