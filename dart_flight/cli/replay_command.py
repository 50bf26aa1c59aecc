"""`dart-flight replay LOG`: the flight again through the same decisions."""

from __future__ import annotations

import argparse

from rich.markup import escape
from rich.table import Table

from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.recording.reader import read_log
from dart_flight.worlds.replay import Replay, decision_rows, replay

_MOST_SHOWN = 40


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", metavar="LOG", help="flight.mcap of a flight")
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
    """Run the command; returns the exit status: 0 all equal, 1 something differs."""
    result = replay(read_log(arguments.log), arguments.settings)
    if result.note:
        messages().print(result.note)
    if arguments.json:
        emit_json(_summary(result))
    else:
        _print(result)
    return 0 if result.equal else 1


def _summary(result: Replay) -> dict[str, object]:
    return {
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
    }


def _print(result: Replay) -> None:
    out = tables()
    how = "bit for bit" if result.exact else "to 1e-9 (recorded on another kind of machine)"
    if result.equal:
        out.print(
            f"[green]equal[/]: {result.outputs} outputs on {result.inputs} inputs, "
            f"{len(result.recorded)} of them decisions, {how}"
        )
        return
    first = result.differences[0]
    out.print(
        f"[red]different[/]: {len(result.differences)} of {result.outputs} outputs, compared {how}. "
        f"First at input {first.number}, {first.t_us * 1e-6:.3f} s: {escape(first.text())}",
        soft_wrap=True,
    )
    table = Table("s", "decision", "recorded", "replayed", title="decisions", title_justify="left")
    rows = decision_rows(result)
    for time_s, name, before, after in rows[:_MOST_SHOWN]:
        style = None if before == after else "bold"
        table.add_row(f"{time_s:.3f}", name, escape(before), escape(after), style=style)
    out.print(table)
    if len(rows) > _MOST_SHOWN:
        out.print(f"and {len(rows) - _MOST_SHOWN} more")
