"""`dart-flight inspect LOG...`: impacts detected in PX4's own logs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from dart_flight.cli.terminal import emit_json, messages, print_status, tables, write_text
from dart_flight.config.document import InputError
from dart_flight.recording.found import px4_logs_in

if TYPE_CHECKING:
    from dart_flight.lab.inspect.impacts import InspectedFlight


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help="PX4 ULog (.ulg) of any multirotor, PX4 1.9 or later"
    )
    parser.add_argument(
        "--mass", type=float, metavar="KG", help="mass of the vehicle; the output has forces only with a mass"
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="write a page (HTML)")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="write every impact as a trial for `identify`"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the command; the exit status is 2 if a log was rejected."""
    from dart_flight.config.vehicle import load_vehicle
    from dart_flight.lab.inspect.inspection import inspect_file
    from dart_flight.lab.inspect.trial_writer import write_trials

    if arguments.mass is not None and not arguments.mass > 0.0:
        raise InputError("must be above 0", key=("mass",))
    vehicle = load_vehicle(arguments.config)
    flights: list[InspectedFlight] = []
    refused: list[InputError] = []
    for log in px4_logs_in(arguments.logs):
        try:
            flights.append(inspect_file(log, vehicle, arguments.mass))
        except InputError as error:
            refused.append(error)
    if not flights and len(refused) == 1:
        raise refused[0]
    print_status(*(error.one_line() for error in refused))
    if arguments.output is not None:
        if arguments.mass is None:
            messages().print("without --mass the trials contain no force")
        for path in (p for flight in flights for p in write_trials(flight, arguments.output)):
            messages().print(f"wrote {path}", soft_wrap=True)
    if arguments.report is not None:
        _write_page(arguments.report, flights)
    if arguments.json:
        emit_json([_public(flight) for flight in flights])
    else:
        for flight in flights:
            _print(flight)
    return 2 if refused else 0


def _write_page(path: Path, flights: list[InspectedFlight]) -> None:
    from dart_flight.lab.report.inspection_page import inspection_page

    write_text(path, inspection_page(flights))


def _public(flight: InspectedFlight) -> dict[str, Any]:
    return {n: getattr(flight, n) for n in flight.__struct_fields__ if n != "series"}


def _print(flight: InspectedFlight) -> None:
    out = tables()
    version = flight.px4_version or "of unknown version"
    out.print(
        f"{flight.log}: PX4 {version}, {flight.duration_s:.0f} s, {flight.flight_s:.0f} s in the air",
        soft_wrap=True,
    )
    thrust = flight.thrust
    if thrust is not None:
        out.print(
            f"thrust fitted from {thrust.windows} segments of 0.5 s ({thrust.said}): "
            f"{thrust.full_m_s2:.1f} m/s2 at full command, held-out residual {thrust.held_out_percent:.1f} %",
            soft_wrap=True,
        )
    if flight.flight_s > 0.0:
        out.print(
            f"noise: {flight.noise_m_s2:.2f} m/s2 in one sample, {flight.noise_short_m_s2:.2f} in the mean "
            f"over the detector's short window, {flight.noise_long_m_s2:.2f} in the mean over the long "
            "window; contacts are detected reliably above "
            f"{flight.floor_rigid_m_s2:.1f} m/s2 (rigid) or {flight.floor_flexible_m_s2:.1f} m/s2 (flexible)",
            soft_wrap=True,
        )
    clear = [i for i in flight.impacts if i.kind != "untold"]
    if clear:
        table = Table()
        for column in ("at s", "peak m/s2", "peak N", "from north deg", "before m/s", "height m", ""):
            table.add_column(column, justify="right" if column else "left")
        for i in clear:
            force = "-" if i.force_n is None else f"{i.force_n:.1f} ± {i.force_sd_n:.1f}"
            remark = i.kind + (", clipped: a lower bound" if i.clipped else "")
            table.add_row(
                f"{i.t_s:.2f}",
                f"{i.acceleration_m_s2:.1f} ± {i.acceleration_sd_m_s2:.1f}",
                force,
                f"{i.direction_deg:.0f}",
                f"{i.speed_m_s:.1f}",
                "-" if i.height_m is None else f"{i.height_m:.1f}",
                remark,
            )
        out.print(table)
    else:
        out.print(flight.nothing_found)
    if flight.weak:
        out.print(
            f"{flight.weak} short threshold crossings are not impacts (fitted peak below the threshold)",
            soft_wrap=True,
        )
    if flight.untold:
        out.print(
            f"{flight.untold} threshold crossings may be contacts or manoeuvres: in fast flight with unknown "
            "thrust, after a crash, or with a peak below four standard deviations",
            soft_wrap=True,
        )
    for what in flight.unknown:
        out.print(f"unknown: {what}", soft_wrap=True)
