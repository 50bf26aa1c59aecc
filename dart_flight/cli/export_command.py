"""`dart-flight export LOG...`: flight logs as CSV files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dart_flight.cli.terminal import emit_json, messages


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flight.mcap, or a folder of flights")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="where the files go, of several logs in a folder each (default: csv beside the log)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status. With --json: one object, of several logs a list of them."""
    from dart_flight.recording.export import export_csv
    from dart_flight.recording.found import logs_in
    from dart_flight.recording.reader import read_log

    console = messages()
    paths = logs_in(arguments.logs)
    exports: list[dict[str, Any]] = []
    for path, folder in zip(paths, _folders(paths, arguments.output), strict=True):
        log = read_log(path)
        files = export_csv(log, folder)
        cut = "" if log.complete else "; the log was cut, exported up to there"
        console.print(
            f"{path}: {len(log.entries)} records in {len(files)} files in {folder}{cut}",
            markup=False,
            soft_wrap=True,
        )
        exports.append(
            {"files": [str(file) for file in files], "records": len(log.entries), "log": str(path)}
        )
    if arguments.json:
        emit_json(exports[0] if len(exports) == 1 else {"exports": exports})
    return 0


def _folders(logs: list[Path], output: Path | None) -> list[Path]:
    """Where the files of each log go; no two in the same folder."""
    if output is None:
        return [log.parent / ("csv" if log.stem == "flight" else f"{log.stem}_csv") for log in logs]
    if len(logs) == 1:
        return [output]
    folders: list[Path] = []
    for log in logs:
        name = log.resolve().parent.name if log.stem == "flight" else log.stem
        folder, number = output / name, 1
        while folder in folders:
            number += 1
            folder = output / f"{name}-{number}"
        folders.append(folder)
    return folders
