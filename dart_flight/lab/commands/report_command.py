"""`dart-flight report LOG... -o FILE.html`: an HTML page of one flight, or a comparison of several."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from dart_flight.cli.terminal import emit_json, print_status, write_text
from dart_flight.recording.found import find_logs, read_each

if TYPE_CHECKING:
    from dart_flight.lab.report.recorded_flight import RecordedFlight


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "logs",
        nargs="+",
        metavar="LOG",
        help="flight.mcap, or a folder of flights; for several logs, the page compares the flights",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="HTML file (default: report.html beside the logs)",
    )
    parser.add_argument(
        "--pdf",
        type=Path,
        metavar="FILE",
        help="also write the figures, one per page, as wide as a paper's column",
    )
    parser.add_argument("--svg", type=Path, metavar="DIR", help="also write the figures as SVG files")


def run(arguments: argparse.Namespace) -> int:
    """Write the page and return 0, even if a log was cut."""
    from dart_flight.lab.report.page import comparison_page, flight_page
    from dart_flight.lab.report.recorded_flight import RecordedFlight

    paths = find_logs(arguments.logs)
    flights = read_each(paths, RecordedFlight.read, print_status)
    output = arguments.output or _default_output(paths)
    write_text(output, flight_page(flights[0]) if len(flights) == 1 else comparison_page(flights))
    _write_figures(arguments, flights)
    if arguments.json:
        emit_json({"page": str(output), "verdicts": [flight.verdict for flight in flights]})
    return 0


def _write_figures(arguments: argparse.Namespace, flights: list[RecordedFlight]) -> None:
    from dart_flight.lab.report.figures.paper_set import write_pdf, write_svgs

    if arguments.pdf is not None:
        write_pdf(flights, arguments.pdf)
        print_status(f"wrote {arguments.pdf}")
    if arguments.svg is not None:
        written = write_svgs(flights, arguments.svg)
        print_status(f"wrote {len(written)} figures to {arguments.svg}")


def _default_output(logs: list[Path]) -> Path:
    return Path(os.path.commonpath([log.parent.resolve() for log in logs])) / "report.html"
