"""`dart-flight tables`: the paper's collision tables beside the model's."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.document import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("-o", "--output", metavar="FILE", help="write the page (docs/paper_tables.md)")


def run(arguments: argparse.Namespace) -> int:
    """Compute the tables and print or write them."""
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.report import paper

    vehicle, source = find_vehicle(arguments.config)
    for surface in (paper.DROP_SURFACE, paper.FLIGHT_SURFACE):
        if surface not in vehicle.materials:
            raise InputError(f"the tables need the material {surface}", key=("materials",))
    say_vehicle(source, messages(), asked=arguments.config is not None)
    if arguments.output:
        try:
            Path(arguments.output).write_text(paper.page(vehicle), encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"cannot write: {error.strerror or error}", source=str(arguments.output)
            ) from None
        messages().print(f"wrote {arguments.output}")
    if arguments.json:
        emit_json(
            {
                "drops": [
                    row._asdict() | {"published": row.published._asdict()} for row in paper.drop_rows(vehicle)
                ],
                "flight": [row._asdict() for row in paper.flight_rows(vehicle)],
                "stiffness_ratio": {
                    "published": paper.STIFFNESS_RATIO,
                    "model": paper.stiffness_ratios(vehicle),
                },
                "vehicle": source,
            }
        )
    elif not arguments.output:
        from rich.markdown import Markdown

        tables().print(Markdown(paper.page(vehicle)))
    return 0
