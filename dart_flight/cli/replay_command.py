"""`dart-flight replay LOG...`: replay recorded flights and compare the decisions."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from rich.table import Table

from dart_flight.cli.terminal import emit_json, print_status, styled, tables
from dart_flight.config.mission import Mission
from dart_flight.recording.about import flown_mission
from dart_flight.recording.found import find_logs, read_each
from dart_flight.recording.reader import read_log
from dart_flight.run.replay import Replay, decision_rows, replay

_MAX_SHOWN = 40
_PARTS = re.compile(r", (?![^(]*\))")  # a comma separates two parts, but not within a vector's parentheses


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flight.mcap, or a folder of flights")
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replay with a changed key of the configuration or mission, "
        "such as detection.force_threshold_n=8 or collisions[0].alpha_m_per_n=[0.1,0.02]; repeatable",
    )


def run(arguments: argparse.Namespace) -> int:
    """Return 0 if all decisions are equal, 1 if one differs.

    With --json, print one object. For several logs, `equal` states whether all decisions are equal, and
    `replays` has one object per log.
    """
    paths = find_logs(arguments.logs)
    summaries: list[dict[str, Any]] = []

    def one(path: Path) -> bool:
        log = read_log(path)
        mission = flown_mission(log.about, log.source)
        result = replay(log, arguments.settings)
        name = f"{path}: " if len(paths) > 1 else ""
        if result.note:
            print_status(f"{name}{result.note}")
        if arguments.json:
            summaries.append(_summary(path, mission, result))
        else:
            _print(name, result)
        return result.equal

    equal = all(read_each(paths, one, print_status))
    if arguments.json:
        emit_json(summaries[0] if len(paths) == 1 else {"equal": equal, "replays": summaries})
    return 0 if equal else 1


def _summary(path: Path, mission: Mission, result: Replay) -> dict[str, Any]:
    return {
        "log": str(path),
        "equal": result.equal,
        "exact": result.exact,
        "inputs": result.inputs,
        "outputs": result.outputs,
        "decisions": len(result.recorded),
        "differences": len(result.differences),
        "first": result.differences[0].text() if result.differences else None,
        "missing_inputs": result.missing,
        "note": result.note,
        "rows": [list(row) for row in decision_rows(result)],
        "vehicle": mission.flown_vehicle(),
    }


def _print(name: str, result: Replay) -> None:
    out = tables()
    how = (
        "bit for bit"
        if result.exact
        else "with a tolerance of 1e-9 (the log is from another type of machine)"
    )
    if result.equal:
        out.print(
            styled(
                name,
                ("equal", "green"),
                f": {result.inputs} inputs gave {result.outputs} outputs, "
                f"of which {len(result.recorded)} are decisions; the outputs were compared {how}",
            ),
            soft_wrap=True,
        )
        return
    first = result.differences[0]
    out.print(
        styled(
            name,
            ("different", "red"),
            f": {len(result.differences)} of {result.outputs} outputs differ when compared {how}. The "
            f"first is at input {first.number}, {(first.t_us - result.zero_us) * 1e-6:.3f} s: {first.text()}",
        ),
        soft_wrap=True,
    )
    rows = decision_rows(result)
    different = [row for row in rows if row[2] != row[3]]
    if different:
        table = Table("s", "decision", "recorded", "replayed", title="decisions", title_justify="left")
        for time_s, decision, before, after in different[:_MAX_SHOWN]:
            table.add_row(f"{time_s:.3f}", decision, *_changes(before, after))
        out.print(table)
    if len(different) > _MAX_SHOWN:
        out.print(f"and {len(different) - _MAX_SHOWN} more")
    out.print(f"{len(rows) - len(different)} decisions are as recorded")


def _changes(before: str, after: str) -> tuple[str, str]:
    """Return the parts in which two descriptions of a decision differ.

    If the decision is missing in the recording or in the replay, return both descriptions unchanged.
    """
    one, other = _PARTS.split(before), _PARTS.split(after)
    if len(one) != len(other) or "-" in (before, after):
        return before, after
    apart = [(a, b) for a, b in zip(one, other, strict=True) if a != b]
    return ", ".join(a for a, _ in apart), ", ".join(b for _, b in apart)
