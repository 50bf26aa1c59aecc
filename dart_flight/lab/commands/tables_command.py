"""`dart-flight tables`: the paper's tables compared with the model."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.cli.terminal import emit_json, tables, write_text
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError, report_write_errors
from dart_flight.contact.law import Onset


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", metavar="FILE", help="write the page (docs/paper_tables.md)")


def run(arguments: argparse.Namespace) -> int:
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.config.vehicle import packaged
    from dart_flight.lab.paper import tables as paper

    vehicle, source = find_vehicle(arguments.config)
    if not vehicle.has_lock and arguments.config is None:  # use the paper's vehicle
        vehicle, source = find_vehicle(packaged("configs", "dart.yaml"))
    if not vehicle.has_lock:
        raise InputError("the paper's tables need a vehicle with a lock", key=("lock",))
    for surface in paper.SURFACES:
        if surface not in vehicle.materials:
            raise InputError(f"the tables need the material {surface}", key=("materials",))
    print_vehicle(source, arguments)
    if arguments.output:
        path = Path(arguments.output)
        with report_write_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, paper.page(vehicle))
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
                "refits": [
                    row._asdict() for onset in Onset for row in paper.refits(vehicle.airframe.mass_kg, onset)
                ],
                "dual_collision": [row._asdict() for row in paper.dual_rows(vehicle)],
                "vehicle": source,
            }
        )
    elif not arguments.output:
        from rich.markdown import Markdown

        tables().print(Markdown(paper.page(vehicle)))
    return 0
