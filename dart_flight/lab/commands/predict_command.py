"""`dart-flight predict`: one wall hit, one drop, or a file of wall hits."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from typing import Any

from dart_flight.cli.options import add_set_option
from dart_flight.cli.terminal import emit_json, tables, write_output
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    # argparse accepts -0.5 as a number but takes -5e-1 for an option; scripts print both forms.
    parser._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
    parser.add_argument("--surface", help="a material of the configuration")
    parser.add_argument(
        "--mode", choices=("rigid", "flexible"), help="state of the arms; optional without a lock"
    )
    events = parser.add_mutually_exclusive_group(required=True)
    events.add_argument(
        "--velocity",
        nargs=2,
        type=float,
        metavar=("NORMAL", "TANGENTIAL"),
        help="velocity at the onset of a wall hit, in the collision frame, m/s; NORMAL is negative",
    )
    events.add_argument("--drop", type=float, metavar="HEIGHT", help="drop from this height, m")
    events.add_argument("--batch", metavar="FILE", help="CSV of wall hits: mode, normal_m_s, tangential_m_s")
    parser.add_argument(
        "--restitution",
        type=float,
        metavar="E",
        help="ratio of outgoing to incoming normal speed, as `identify` prints it; replaces --surface",
    )
    parser.add_argument(
        "--tangential-ratio",
        type=float,
        metavar="R",
        help="ratio of outgoing to incoming speed along the wall; needs --restitution",
    )
    parser.add_argument(
        "--onset", choices=("lcp", "touch"), help="onset rule (default: from the configuration)"
    )
    parser.add_argument(
        "--incidence-deg",
        type=float,
        default=0.0,
        metavar="DEG",
        help="angle between leading edge and wall, degrees (default 0)",
    )
    parser.add_argument(
        "--plot", metavar="FILE", help="plot position, velocity and force over time (PNG, PDF, SVG)"
    )
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.lab.predict import prediction

    if arguments.restitution is not None or arguments.tangential_ratio is not None:
        return _from_ratios(arguments)
    if arguments.surface is None:
        raise InputError("--surface or --restitution is required", key=("surface",))
    vehicle, source = find_vehicle(arguments.config, arguments.set)

    where = (arguments.surface, arguments.onset, arguments.incidence_deg)
    if arguments.batch is not None:
        if arguments.plot or arguments.mode:
            raise InputError("--batch reads the mode from the file and cannot plot; omit --mode and --plot")
        if arguments.json:
            rows = prediction.predict_batch_rows(vehicle, *where, path=arguments.batch)
            print_vehicle(source, arguments)
            emit_json({"collisions": rows, "vehicle": source})
        else:
            text = prediction.predict_batch(vehicle, *where, path=arguments.batch)
            print_vehicle(source, arguments)
            write_output(text)
        return 0
    if arguments.mode is None and vehicle.has_lock:
        raise InputError("--mode is required: rigid or flexible")
    mode = arguments.mode or vehicle.modes[0].value
    condition = prediction.condition(vehicle, where[0], mode, where[1], where[2])
    if arguments.drop is None:
        numbers = prediction.predict_wall(condition, *arguments.velocity)
    else:
        numbers = prediction.predict_drop(condition, arguments.drop)
    if arguments.plot:
        _plot(arguments, condition)
    print_vehicle(source, arguments)
    if arguments.json:
        emit_json({**numbers, "vehicle": source})
    else:
        if arguments.drop is None:
            event = "{:g} m/s normal, {:g} m/s tangential".format(*arguments.velocity)
        else:
            event = f"drop from {arguments.drop:g} m"
        _print(
            f"{condition.surface}, {condition.mode.value}, onset {condition.onset.value}: {event}", numbers
        )
    return 0


def _from_ratios(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.predict import prediction

    if arguments.restitution is None:
        raise InputError("--tangential-ratio needs --restitution", key=("restitution",))
    given = [
        name for name in ("surface", "mode", "batch", "onset", "plot") if getattr(arguments, name) is not None
    ]
    given += ["set"] if arguments.set else []
    if given:
        raise InputError(f"--restitution cannot be combined with --{given[0]}", key=("restitution",))
    ratios = prediction.Ratios(arguments.restitution, arguments.tangential_ratio)
    if arguments.drop is None:
        numbers = prediction.predict_wall_from_ratios(ratios, *arguments.velocity)
    else:
        numbers = prediction.predict_drop_from_ratios(ratios, arguments.drop)
    if arguments.json:
        emit_json(numbers)
        return 0
    _print(
        "predicted from restitution and tangential ratio, which do not determine forces and times", numbers
    )
    return 0


def _plot(arguments: argparse.Namespace, condition: Any) -> None:
    from dart_flight.lab.paper import contact_figures as plots
    from dart_flight.lab.paper import tables as paper
    from dart_flight.lab.predict import prediction

    if arguments.drop is None:
        contact = prediction.wall_contact(condition, *arguments.velocity)
        plots.plot_wall(arguments.plot, condition, contact, arguments.velocity[1])
    else:
        contact = prediction.drop_contact(condition, arguments.drop)
        shown = None
        if condition.surface == paper.DROP_SURFACE:
            shown = paper.published_drop(arguments.drop, condition.mode)
        plots.plot_drop(arguments.plot, condition, contact, arguments.drop, shown)


def _print(title: str, numbers: Mapping[str, float | None]) -> None:
    from rich.table import Table

    from dart_flight.lab.predict.prediction import described

    table = Table(title=title)
    table.add_column("quantity")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for name, value in numbers.items():
        table.add_row(*described(name, value))
    tables().print(table)
