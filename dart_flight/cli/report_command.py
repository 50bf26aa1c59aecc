"""`dart-flight report LOG... -o FILE.html`: flights as a page."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, messages
from dart_flight.config.document import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flight.mcap; several give a comparison")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the HTML file")
    parser.add_argument(
        "--identify",
        action="store_true",
        help="identify contact coefficients also where prediction and measurement agree",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command; 0 once a page is written, also from a log that was cut."""
    from dart_flight.report.flight import Flight
    from dart_flight.report.page import comparison_page, flight_page

    flights = [Flight.read(path) for path in arguments.logs]
    identify = arguments.identify
    if len(flights) == 1:
        page = flight_page(flights[0], identify=identify)
    else:
        page = comparison_page(flights, identify=identify)
    try:
        arguments.output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write: {error.strerror}", source=str(arguments.output)) from None
    messages().print(f"wrote {arguments.output}", soft_wrap=True)
    if arguments.json:
        emit_json({"page": str(arguments.output), "verdicts": [flight.verdict for flight in flights]})
    return 0
