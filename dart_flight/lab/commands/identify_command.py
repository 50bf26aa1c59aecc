"""`dart-flight identify`: contact coefficients from recorded trials."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dart_flight.cli.options import add_set_option
from dart_flight.cli.terminal import emit_json, messages, print_status, styled, tables, write_text
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError


def _height_or_trial(text: str) -> float | str:
    """Return the value of `--drop`: a height, or the name of a trial file if the value is not a number."""
    try:
        return float(text)
    except ValueError:
        return text


_FIT = {
    True: ("fit: good", "green"),
    False: ("fit: poor", "red"),
    None: ("fit: quality cannot be assessed", ""),
}


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "trials",
        nargs="*",
        metavar="TRIAL",
        help="CSV, PX4 ULog or flight log; all trials must be of one wall",
    )
    parser.add_argument(
        "--mode",
        choices=("rigid", "flexible"),
        help="mode of the arms in the trials; a flight log contributes only its collisions in this mode",
    )
    parser.add_argument(
        "--surface",
        help="name of the material, for -o; a flight log contributes only its collisions with this material",
    )
    parser.add_argument(
        "--drop",
        nargs="?",
        type=_height_or_trial,
        const=True,
        metavar="HEIGHT",
        help="the trials are drops, with gravity along the normal; the impact speed is compared with a "
        "fall from HEIGHT (m)",
    )
    parser.add_argument(
        "--onset", choices=("lcp", "touch"), help="onset rule (default: from the configuration)"
    )
    parser.add_argument(
        "--contact-distance",
        type=float,
        default=0.0,
        metavar="M",
        help="metres to subtract from normal_m if normal_m is the distance of the vehicle's centre "
        "from the wall or ground",
    )
    parser.add_argument(
        "--columns", metavar="NAME=HEADER,...", help="headers in the CSV files, e.g. time_s=t,normal_m=x"
    )
    parser.add_argument(
        "--wall",
        nargs=3,
        type=float,
        metavar=("NORTH", "EAST", "HEADING"),
        help="for PX4 logs: a point of the plane of first touch in local NED (m), and the heading of "
        "the plane's outward normal (degrees)",
    )
    parser.add_argument(
        "--mass", type=float, metavar="KG", help="vehicle mass (default: from the configuration)"
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="write a materials entry (YAML)")
    parser.add_argument("--plot", metavar="FILE", help="plot recordings and fit (PNG, PDF, SVG)")
    add_set_option(parser)


def run(arguments: argparse.Namespace) -> int:
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.contact.law import Onset
    from dart_flight.lab.identify import identify_trials as identification
    from dart_flight.lab.identify.trials import UNLABELLED, TrialReading

    paths = list(arguments.trials)
    drop = arguments.drop
    if isinstance(drop, str):
        paths.insert(0, drop)
        drop = True
    if not paths:
        raise InputError("no trials given", key=("TRIAL",))
    vehicle, source = find_vehicle(arguments.config, arguments.set)
    reading = TrialReading(
        mode=arguments.mode or UNLABELLED,
        surface=arguments.surface,
        drop=drop is not None,
        height_m=drop if isinstance(drop, float) else None,
        contact_distance_m=arguments.contact_distance,
        columns=identification.columns_of(arguments.columns),
        wall=tuple(arguments.wall) if arguments.wall else None,
        mass_kg=arguments.mass,
    )
    if arguments.output and not arguments.surface:
        raise InputError("-o needs --surface, the name of the entry", key=("output",))
    onset = Onset(arguments.onset) if arguments.onset else None
    done = identification.identify_trials(paths, reading, vehicle, onset=onset)
    found = done.found
    if done.flown is not None:
        source = done.flown.source
    print_vehicle(source, arguments, flown=done.flown is not None)
    print_status(*found.notes)
    for line in found.fit.messages:
        messages().print(line, style="red", soft_wrap=True)
    # Print the result first, in case a file cannot be written.
    if arguments.json:
        emit_json({**identification.as_json(found), "vehicle": source})
    else:
        _print(found)
        tables().print(styled(_FIT[found.fit.good]))
    if arguments.output:
        _write(arguments, found, done.vehicle, poor=found.fit.good is False)
    if arguments.plot:
        from dart_flight.lab.identify.trial_plot import plot_fit

        plot_fit(arguments.plot, done)
    return 0


def _write(arguments: argparse.Namespace, found: Any, vehicle: Any, *, poor: bool) -> None:
    from dart_flight.lab.identify.materials_entry import materials_entry

    entry = materials_entry(found, arguments.surface, vehicle, poor=poor)
    write_text(Path(arguments.output), entry.text)
    console = messages()
    if entry.assumed:
        console.print(
            "these trials do not determine some values, which are written as 0 and marked: "
            f"{', '.join(entry.assumed)}",
            style="yellow",
            soft_wrap=True,
        )
    for mode in entry.missing:
        console.print(
            f"incomplete: a configuration also needs mode {mode}; identify trials with --mode {mode}",
            style="yellow",
            soft_wrap=True,
        )


def _estimates(title: str, rows: Any) -> None:
    """Print a table of estimates; each row is (name, estimate, unit), and an unknown estimate is None."""
    from rich.table import Table

    table = Table(title=title)
    for name in ("", "value", "low", "high", "unit"):
        table.add_column(name, justify="left" if name in ("", "unit") else "right")
    for name, estimate, unit in rows:
        shown = ["unknown", "", ""] if estimate is None else [f"{v:.4g}" for v in estimate]
        table.add_row(name, *shown, unit)
    tables().print(table)


def _print(found: Any) -> None:
    from rich.table import Table

    from dart_flight.config.units import COEFFICIENTS

    for mode, coefficients in found.coefficients.items():
        rows = [(name, estimate, COEFFICIENTS[name]) for name, estimate in coefficients.items()]
        rows += [
            ("restitution", found.restitution[mode], ""),
            ("tangential ratio", found.tangential_ratio[mode], ""),
        ]
        _estimates(f"{mode}: coefficients with 95 % intervals", rows)
        if found.held_out[mode].law is not None:
            _print_held_out(found.held_out[mode])
    table = Table(title="trials")
    columns = (
        "trial",
        "normal m/s",
        "out m/s",
        "along m/s",
        "peak N",
        "samples in contact",
        "set aside",
        "used",
    )
    for name in columns:
        table.add_column(name, justify="left" if name in ("trial", "used") else "right")
    for trial in found.trials:
        numbers = (trial.normal_m_s, trial.normal_out_m_s, trial.tangential_m_s)
        shown = ["" if v is None else f"{v:.3f}" for v in numbers]
        peak = "" if trial.peak_force_n is None else f"{trial.peak_force_n:.1f}"
        aside = f"{trial.set_aside.contact} in contact, {trial.set_aside.free} free"
        table.add_row(trial.name, *shown, peak, str(trial.samples_in_contact), aside, trial.used)
    tables().print(table)
    if found.plane_m is not None:
        plane = found.plane_m
        tables().print(
            f"plane of first touch at {1e3 * plane.value:.1f} mm "
            f"({1e3 * plane.low:.1f} to {1e3 * plane.high:.1f}); residuals: "
            + ", ".join(f"{name} {value:.3g}" for name, value in found.residuals.items())
        )


def _print_held_out(compared: Any) -> None:
    from rich.table import Table

    what = "speeds" if compared.held_out == "speed" else "hits"
    table = Table(title=f"{compared.mode}: median error on held-out {what}")
    for name in ("", "peak force", "outgoing speed"):
        table.add_column(name, justify="right" if name else "left")
    rows = {"the law": compared.law, **compared.baselines, "scatter of repeats": compared.scatter}
    for name, errors in rows.items():
        table.add_row(name, *("" if v is None else f"{100.0 * v:.1f} %" for v in errors))
    tables().print(table)
