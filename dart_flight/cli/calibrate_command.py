"""`dart-flight calibrate thrust LOG...`: the thrust curve from hover."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import msgspec
from rich.table import Table

from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config import InputError, default_config_path, find_vehicle
from dart_flight.config.document import Key
from dart_flight.config.edit import write_values
from dart_flight.config.vehicle import packaged
from dart_flight.identify.thrust_curve import (
    ThrustCalibration,
    calibrate_thrust,
    read_track,
    said_of,
)
from dart_flight.recording.found import from_each, logs_in


def configure(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument("what", choices=("thrust",))
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help=".mcap, PX4 ULog (.ulg), or a folder of flights"
    )
    parser.add_argument("--write", action="store_true", help="write the curve into the configuration")


def run(arguments: argparse.Namespace) -> int:
    """Carry the command out. Returns the exit status."""
    path = Path(arguments.config) if arguments.config else default_config_path()
    vehicle, source = find_vehicle(path)
    if arguments.write:
        _refuse_unwritable(arguments, path)
    left_out: list[str] = []
    tracks = from_each(logs_in(arguments.logs), read_track, left_out.append)
    result = calibrate_thrust(tracks, vehicle)
    for line in left_out:
        messages().print(line, markup=False, soft_wrap=True)
    say_vehicle(source, messages(), asked=arguments.config is not None)
    if arguments.json:
        emit_json({**msgspec.structs.asdict(result), "vehicle": source})
    else:
        tables().print(_table(result))
        for note in result.notes:
            messages().print(note, soft_wrap=True)
        messages().print(f"windows rejected: {said_of(result.rejected) or 'none'}", soft_wrap=True)
    if arguments.write:
        values: dict[Key, float] = {("thrust", "full_n"): round(result.full_n, 4)}
        if result.model_factor_error is not None:
            values["thrust", "model_factor"] = round(result.model_factor, 4)
        if result.reference_v is not None:
            values["estimation", "battery", "reference_v"] = round(result.reference_v, 3)
        if result.battery_exponent_error is not None:
            values["estimation", "battery", "exponent"] = round(result.battery_exponent, 3)
        write_values(path, values)
        messages().print(f"written: {path}", soft_wrap=True)
    return 0


def _refuse_unwritable(arguments: argparse.Namespace, path: Path) -> None:
    if not arguments.config and path == packaged("configs", "dart.yaml"):
        raise InputError(
            "is the packaged default; copy it with `dart-flight init` and name the copy with --config",
            source=str(path),
        )
    if not os.access(path, os.W_OK):
        raise InputError("the calibration would be written here, but it is not writable", source=str(path))


def _table(r: ThrustCalibration) -> Table:
    table = Table(title=f"thrust curve from {r.segments} half seconds of hover", title_justify="left")
    for column in ("", "value", "standard error"):
        table.add_column(column, justify="left" if not column else "right")

    def error(value: float | None) -> str:
        return "kept, not told by these flights" if value is None else f"{value:.3g}"

    table.add_row("full thrust of one motor, N", f"{r.full_n:.3f}", error(r.full_n_error))
    table.add_row("model factor", f"{r.model_factor:.3f}", error(r.model_factor_error))
    table.add_row("battery exponent", f"{r.battery_exponent:.2f}", error(r.battery_exponent_error))
    table.add_row("reference voltage, V", "-" if r.reference_v is None else f"{r.reference_v:.2f}", "")
    table.add_row("command at hover", f"{r.hover_command:.3f}", "")
    table.add_row("commands seen", f"{r.command_range[0]:.3f} to {r.command_range[1]:.3f}", "")
    table.add_row(
        "residual rms, N (of the whole thrust)", f"{r.residual_rms_n:.3f}", f"{r.residual_percent:.1f} %"
    )
    table.add_row("worst residual, N", f"{r.residual_worst_n:.3f}", "")
    return table
