"""`dart-flight export LOG -o DIR`: a flight log as CSV files."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, messages


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("log", metavar="LOG", help="flight.mcap of a flight")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="where the files go")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    from dart_flight.recording.export import export_csv
    from dart_flight.recording.reader import read_log

    log = read_log(arguments.log)
    paths = export_csv(log, arguments.output)
    if not log.complete:
        messages().print("the log was cut; exported up to there")
    if arguments.json:
        emit_json({"files": [str(path) for path in paths], "records": len(log.entries)})
    else:
        messages().print(f"{len(log.entries)} records in {len(paths)} files in {arguments.output}")
    return 0
