"""`dart-flight identify`: contact coefficients from recorded trials."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.document import InputError


def _height_or_trial(text: str) -> float | str:
    """`--drop` may stand before a file: what is not a number is a trial."""
    try:
        return float(text)
    except ValueError:
        return text


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "trials", nargs="*", metavar="TRIAL", help="CSV, PX4 ULog or flight log; all share one wall"
    )
    parser.add_argument("--mode", choices=("rigid", "flexible"), help="state of the arms in the trials")
    parser.add_argument(
        "--surface", help="name of the material, for -o; of a flight log, its collisions with it"
    )
    parser.add_argument(
        "--drop",
        nargs="?",
        type=_height_or_trial,
        const=True,
        metavar="HEIGHT",
        help="drops: gravity along the normal; the height in m, if given, is compared with the recording",
    )
    parser.add_argument("--onset", choices=("lcp", "touch"), help="rule for the onset (the configuration's)")
    parser.add_argument(
        "--contact-distance",
        type=float,
        default=0.0,
        metavar="M",
        help="subtract this from normal_m: recordings of the centre's height above the ground",
    )
    parser.add_argument(
        "--columns", metavar="NAME=HEADER,...", help="other headers, e.g. time_s=t,normal_m=x"
    )
    parser.add_argument(
        "--wall",
        nargs=3,
        type=float,
        metavar=("NORTH", "EAST", "HEADING"),
        help="for flight logs: a point of the plane of first touch in local NED (m), and the heading of its "
        "outward normal (degrees)",
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="write a materials entry (YAML)")
    parser.add_argument("--plot", metavar="FILE", help="recordings and fit (PNG, PDF, SVG)")


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, print, write."""
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.contact.law import Onset
    from dart_flight.identify import job as identification

    paths = list(arguments.trials)
    drop = arguments.drop
    if isinstance(drop, str):
        paths.insert(0, drop)
        drop = True
    if not paths:
        raise InputError("no trials given", key=("TRIAL",))
    vehicle, source = find_vehicle(arguments.config)
    job = identification.Job(
        paths=paths,
        mode=arguments.mode,
        drop=drop is not None,
        height_m=drop if isinstance(drop, float) else None,
        onset=Onset(arguments.onset or vehicle.onset),
        contact_distance_m=arguments.contact_distance,
        columns=arguments.columns,
        wall=tuple(arguments.wall) if arguments.wall else None,
    )
    if arguments.output and not arguments.surface:
        raise InputError("-o needs --surface, the name of the entry", key=("output",))
    from dart_flight.identify.flight_trials import readers

    trials, found = identification.carry_out(job, vehicle, readers(arguments.surface))
    say_vehicle(source, messages(), asked=arguments.config is not None)
    for note in found.notes:
        messages().print(note, markup=False, soft_wrap=True)
    from dart_flight.identify.judgement import expected_residuals, judge_fit

    judged = judge_fit(found.residuals, expected_residuals(trials))
    for line in judged.says:
        messages().print(f"[red]{line}[/]", soft_wrap=True)
    # First what was found, whatever becomes of the files.
    if arguments.json:
        emit_json({**identification.as_json(found), "fit": judged._asdict(), "vehicle": source})
    else:
        _print(found)
        tables().print("[green]fit: good[/]" if judged.good else "[red]fit: poor[/]")
    if arguments.output:
        _write(arguments, found, vehicle, poor=not judged.good)
    if arguments.plot:
        from dart_flight.report import contact_figures as plots

        plots.plot_fit(arguments.plot, trials, found, vehicle.airframe.mass_kg, job.onset)
    return 0


def _write(arguments: argparse.Namespace, found: Any, vehicle: Any, *, poor: bool) -> None:
    from dart_flight.identify.materials_entry import materials_entry

    entry = materials_entry(found, arguments.surface, vehicle, poor=poor)
    try:
        Path(arguments.output).write_text(entry.text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write: {error.strerror or error}", source=str(arguments.output)) from None
    console = messages()
    console.print(f"wrote {arguments.output}", markup=False, soft_wrap=True)
    if entry.assumed:
        console.print(
            f"[yellow]not seen in these trials, written as 0 and marked: {', '.join(entry.assumed)}[/]",
            soft_wrap=True,
        )
    for mode in entry.missing:
        console.print(
            f"[yellow]not complete: {mode} is not known; a configuration needs it: "
            f"identify trials with --mode {mode}[/]",
            soft_wrap=True,
        )


def _print(found: Any) -> None:
    from rich.table import Table

    from dart_flight.identify.job import UNITS

    for mode, coefficients in found.coefficients.items():
        table = Table(title=f"{mode}: coefficients with 95 % intervals")
        for name in ("", "value", "low", "high", "unit"):
            table.add_column(name, justify="left" if name in ("", "unit") else "right")
        for name, estimate in coefficients.items():
            shown = ["unknown", "", ""] if estimate is None else [f"{v:.4g}" for v in estimate]
            table.add_row(name, *shown, UNITS[name])
        tables().print(table)
    table = Table(title="trials")
    for name in ("trial", "normal m/s", "along m/s", "samples in contact"):
        table.add_column(name, justify="left" if name == "trial" else "right", overflow="fold")
    for trial in found.trials:
        along = "" if trial.tangential_m_s is None else f"{trial.tangential_m_s:.3f}"
        table.add_row(trial.name, f"{trial.normal_m_s:.3f}", along, str(trial.samples_in_contact))
    tables().print(table)
    plane = found.plane_m
    tables().print(
        f"plane of first touch at {1e3 * plane.value:.1f} mm "
        f"({1e3 * plane.low:.1f} to {1e3 * plane.high:.1f}); residuals: "
        + ", ".join(f"{name} {value:.3g}" for name, value in found.residuals.items())
    )
