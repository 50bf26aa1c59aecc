"""`dart-flight calibrate thrust|inertia LOG...`: the thrust curve from hover, the inertia from rotation.

`calibrate airframe` prints PX4's motor positions in the format of the configuration.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from rich.table import Table

from dart_flight.cli.options import link_of, refuse_unwritable
from dart_flight.cli.terminal import emit_json, messages, print_status, tables
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError, Key
from dart_flight.config.edit import write_values
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.rotors import (
    COUNT,
    motors_from_parameters,
    rotor_differences,
    rotor_names,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.config.vehicle.configuration import default_config_path
from dart_flight.lab.calibrate.airframe_reader import motors_block, read_airframe, refuse_unmeasured
from dart_flight.lab.calibrate.inertia import WINDOW_S, InertiaCalibration, calibrate_inertia
from dart_flight.lab.calibrate.thrust_curve import (
    ThrustCalibration,
    calibrate_thrust,
    format_rejected,
)
from dart_flight.lab.track import Track, read_calibration_series
from dart_flight.recording.found import find_logs, read_each
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=("thrust", "inertia", "airframe"))
    parser.add_argument(
        "logs",
        nargs="*",
        metavar="LOG",
        help="flight.mcap, PX4 ULog (.ulg), or a folder of flights; for `airframe`: a ULog, a .params file "
        "of QGroundControl, or the output of `param show -a`",
    )
    parser.add_argument(
        "--connection", metavar="URL", help="for `airframe`: read the parameters of the connected vehicle"
    )
    parser.add_argument("--write", action="store_true", help="write the result into the configuration")


def run(arguments: argparse.Namespace) -> int:
    if arguments.what == "airframe":
        return _airframe(arguments)
    if arguments.connection is not None or not arguments.logs:
        raise InputError(f"calibrate {arguments.what} needs logs and cannot use --connection")
    path = Path(arguments.config) if arguments.config else default_config_path()
    vehicle, source = find_vehicle(path)
    if arguments.write:
        refuse_unwritable(arguments, path)
        if arguments.what == "thrust" and vehicle.thrust.table is not None:
            raise InputError(
                "--write sets full_n and model_factor, which are invalid with a table: remove thrust.table",
                source=str(path),
            )
    left_out: list[str] = []
    tracks = read_each(find_logs(arguments.logs), read_calibration_series, left_out.append)
    calibrate = _thrust if arguments.what == "thrust" else _inertia
    result, table, notes, values = calibrate(tracks, vehicle)
    print_status(*left_out)
    print_vehicle(source, arguments)
    if arguments.json:
        emit_json({**result, "vehicle": source})
    else:
        tables().print(table)
        print_status(*notes)
    if arguments.write:
        write_values(path, values)
        messages().print(f"written: {path}", soft_wrap=True)
    return 0


def _airframe(arguments: argparse.Namespace) -> int:
    if arguments.write:
        raise InputError("calibrate airframe prints a block to paste under `airframe:`; it writes no file")
    if (arguments.connection is None) != (len(arguments.logs) == 1):
        raise InputError("calibrate airframe needs one file, or --connection URL")
    vehicle, source = find_vehicle(arguments.config)
    if arguments.connection is not None:
        url = link_of(arguments, vehicle.connection)
        with LinkLease(url, "calibrate"), GroundLink(url, vehicle.connection.timeout_s) as link:
            values = link.read_parameters([COUNT])
            motors = motors_from_parameters(
                values | link.read_parameters(rotor_names(values.get(COUNT, 0.0))), url
            )
    else:
        motors = read_airframe(Path(arguments.logs[0]))
    refuse_unmeasured(motors, arguments.connection or arguments.logs[0])
    print_vehicle(source, arguments)
    other, sizes = rotor_differences(vehicle.airframe.motors, motors)
    if arguments.json:
        emit_json({"motors": motors, "other_than_configured": other, "other_sizes": sizes})
        return 0
    tables().print(motors_block(motors), soft_wrap=True)
    print_status(*other, *sizes)
    return 0


class _Calibrated(NamedTuple):
    """A calibration as JSON and as a table, with notes and the values for the configuration."""

    result: dict[str, Any]
    table: Table
    note: list[str]
    values: dict[Key, float]


def _thrust(tracks: list[Track], vehicle: VehicleConfig) -> _Calibrated:
    result = calibrate_thrust(tracks, vehicle)
    values: dict[Key, float] = {("thrust", "full_n"): round(result.full_n, 4)}
    if result.model_factor_error is not None:
        values["thrust", "model_factor"] = round(result.model_factor, 4)
    if result.reference_v is not None:
        values["estimation", "battery", "reference_v"] = round(result.reference_v, 3)
    if result.battery_exponent_error is not None:
        values["estimation", "battery", "exponent"] = round(result.battery_exponent, 3)
    notes = [*result.notes, f"windows rejected: {format_rejected(result.rejected) or 'none'}"]
    return _Calibrated(msgspec.structs.asdict(result), _table(result), notes, values)


def _inertia(tracks: list[Track], vehicle: VehicleConfig) -> _Calibrated:
    result = calibrate_inertia(tracks, vehicle)
    values: dict[Key, float] = {
        ("airframe", "inertia_kg_m2", i): round(axis.value, 6)
        for i, axis in enumerate(result.axes)
        if axis.value is not None
    }
    refused = [f"{axis.axis} kept: {axis.refused}" for axis in result.axes if axis.refused]
    return _Calibrated(
        {**msgspec.structs.asdict(result), "inertia_kg_m2": result.inertia_kg_m2},
        _inertia_table(result),
        [*result.notes, *refused],
        values,
    )


def _inertia_table(r: InertiaCalibration) -> Table:
    title = f"inertia from {r.windows} windows of {1000.0 * WINDOW_S:.0f} ms"
    table = Table(title=title, title_justify="left")
    for column in ("about", "kg m2", "95 % interval", "torque, N m", "explained"):
        table.add_column(column, justify="left" if column == "about" else "right")
    for axis in r.axes:
        known = axis.value is not None and axis.low is not None and axis.high is not None
        table.add_row(
            axis.axis,
            f"{axis.value:.5f}" if known else "not determined",
            f"{axis.low:.5f} to {axis.high:.5f}" if known else "-",
            f"{axis.torque_nm:.3f}",
            f"{100.0 * axis.explained:.0f} %",
        )
    table.add_row("motor lag, s", f"{r.motor_lag_s:.4f}", "", "", "")
    return table


def _table(r: ThrustCalibration) -> Table:
    table = Table(title=f"thrust curve from {r.segments} segments of 0.5 s in hover", title_justify="left")
    for column in ("", "value", "standard error"):
        table.add_column(column, justify="left" if not column else "right")

    def error(value: float | None) -> str:
        return "unchanged: these flights do not determine this value" if value is None else f"{value:.3g}"

    table.add_row("full thrust of one motor, N", f"{r.full_n:.3f}", error(r.full_n_error))
    table.add_row("model factor", f"{r.model_factor:.3f}", error(r.model_factor_error))
    table.add_row("battery exponent", f"{r.battery_exponent:.2f}", error(r.battery_exponent_error))
    table.add_row("reference voltage, V", "-" if r.reference_v is None else f"{r.reference_v:.2f}", "")
    table.add_row("command at hover", f"{r.hover_command:.3f}", "")
    table.add_row("range of commands", f"{r.command_range[0]:.3f} to {r.command_range[1]:.3f}", "")
    table.add_row(
        "residual rms, N (fraction of the thrust)", f"{r.residual_rms_n:.3f}", f"{r.residual_percent:.1f} %"
    )
    table.add_row("worst residual, N", f"{r.residual_worst_n:.3f}", "")
    return table
