"""`dart-flight doctor`: show what this installation can do."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.check.installation_check import Computer, check_installation
from dart_flight.cli.check_command import print_finding
from dart_flight.cli.terminal import emit_json, tables, write_text


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write the findings as a text for a bug report, without names, addresses and serial numbers",
    )


def run(arguments: argparse.Namespace) -> int:
    """Return 0 if no check has failed."""
    findings = check_installation(Computer(private=arguments.report is not None))
    go = all(finding.go for finding in findings)
    if arguments.report is not None:
        lines = (f"{'' if f.go else 'FAILED '}{f.item}: {f.message}\n" for f in findings)
        write_text(arguments.report, "".join(lines))
    if arguments.json:
        emit_json({"go": go, "findings": findings})
    elif arguments.report is None:
        for finding in findings:
            print_finding(finding, tables(), "ok", "FAILED")
    return 0 if go else 1
