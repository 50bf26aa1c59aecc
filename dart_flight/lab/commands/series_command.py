"""`dart-flight series`: a trial series on one wall, from the first hit to dated coefficients."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from dart_flight.base.errors import FlightError
from dart_flight.base.signals import StopSignals
from dart_flight.cli.options import number, whole_number
from dart_flight.cli.terminal import emit_json, messages, print_status, tables, write_text
from dart_flight.config.document import InputError
from dart_flight.config.provenance import display_path

# Options that `series fly` passes on, each with its value: a metavar, or None for a flag.
_EMBEDDED: Final = "--dry-run"  # `dry-run` without any of the other options
_FOR_SIMULATION: Final = {"--px4": "DIR", "--hitl": "URL", "--fast": None, _EMBEDDED: None}
_PASSED_ON: Final = {
    "--connection": "URL", "--mocap": "SOURCE", "--driver": "DRIVER", "--seed": "N", "--speed": "X",
    "--fault": "NAME", "--vary": "NAME", "--set": "KEY=VALUE", "--overrule": "ITEM",
    "--position-from": "SOURCE",
    "--yes": None, "--px4-log": None,
}  # fmt: skip
_REPEATABLE: Final = ("--vary", "--set", "--overrule")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    new = _action(actions, "new", "create a series: a folder with its settings")
    new.add_argument("--mission", type=Path, metavar="M", help="mission with the wall")
    new.add_argument("--wall", metavar="W", help="name of the wall in the mission")
    new.add_argument("--drop", metavar="LOW..HIGH", help="a series of drops from these heights, m")
    new.add_argument("--ground", metavar="MATERIAL", help="with --drop: material of the ground")
    new.add_argument("--modes", metavar="MODE,...", help="modes to identify (default: all of the vehicle)")
    new.add_argument("--speeds", default="0.3..1.5", metavar="LOW..HIGH", help="normal speeds, m/s")
    new.add_argument("--peak-force", type=number(1.0, 2000.0), metavar="N", help="default: the mission's")
    new.add_argument("--aim", action="append", default=[], metavar="NAME=PERCENT", help="half width of the "
                     "statistical 95 %% interval of k, f or mu; repeatable")  # fmt: skip
    new.add_argument("--held-out", type=number(0.0, 0.5), default=0.2, metavar="SHARE",
                     help="share of the hits that only check the prediction (default 0.2)")  # fmt: skip
    new.add_argument("--hits-per-flight", type=whole_number(1, 100), default=8, metavar="N",
                     help="hits that one battery can fly (default 8)")  # fmt: skip

    _action(actions, "next", "write the next batch as a mission, and check it")
    fly = _action(actions, "fly", "write the next batch and fly it, on the vehicle or in simulation")
    for option, metavar in {**_FOR_SIMULATION, **_PASSED_ON}.items():
        if metavar is None:
            text = "fly in the embedded simulation" if option == _EMBEDDED else "as for fly and dry-run"
            fly.add_argument(option, action="store_true", help=text)
        elif option == "--px4":
            fly.add_argument(option, nargs="?", const="", metavar=metavar, help="as for dry-run")
        elif option in _REPEATABLE:
            fly.add_argument(
                option, action="append", default=[], metavar=metavar, help="as for fly and dry-run"
            )
        else:
            fly.add_argument(option, metavar=metavar, help="as for fly and dry-run")

    _action(actions, "status", "show coefficients, hits, held-out hits and what is missing")
    report = _action(actions, "report", "write the page of the series")
    report.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: FOLDER/series.html")
    _action(actions, "apply", "write the coefficients into the vehicle's configuration (--config)")
    exclude = _action(actions, "exclude", "exclude a hit")
    exclude.add_argument("hit", metavar="FLIGHT:HIT", help="as shown by status")
    exclude.add_argument("--why", required=True, metavar="TEXT", help="the reason")
    add = _action(actions, "add", "add a flight of the same wall that another command flew")
    add.add_argument("flight", type=Path, metavar="FLIGHT", help="folder or flight.mcap; a drop: CSV or ULog")
    add.add_argument("--mode", choices=("rigid", "flexible"), help="of a drop: mode of the arms")
    add.add_argument("--height", type=number(0.01, 10.0), metavar="M", help="of a drop: its height, if known")
    add.add_argument("--contact-distance", type=number(0.0, 1.0), default=0.0, metavar="M",
                     help="of a drop: recorded height at first touch")  # fmt: skip


def _action(actions: Any, name: str, text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the series")
    if name not in ("new", "add", "exclude"):
        parser.add_argument("--json", action="store_true", default=argparse.SUPPRESS)
    parser.add_argument("--config", default=argparse.SUPPRESS, metavar="FILE", help="vehicle configuration")
    return parser


def run(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.series.series_file import SETTINGS, locked

    actions = {
        "new": _new, "next": _next, "fly": _fly, "status": _status, "report": _report, "apply": _apply,
        "exclude": _exclude, "add": _add,
    }  # fmt: skip
    do, folder = actions[arguments.action], arguments.folder
    if do in (_status, _report):
        return do(arguments)
    if do is not _new and not (folder / SETTINGS).exists():
        _open(arguments)  # raises the error for a folder without a series
    with locked(folder):
        return do(arguments)


def _open(arguments: argparse.Namespace) -> Any:
    from dart_flight.lab.series.series_file import SeriesFolder

    return SeriesFolder(arguments.folder, arguments.config)


# --- new ---------------------------------------------------------------------------------------------------


def _new(arguments: argparse.Namespace) -> int:
    from dart_flight.base.records import Mode
    from dart_flight.config.document import unknown_name
    from dart_flight.config.mission import load_empty_room, load_mission
    from dart_flight.lab.series.series_file import SeriesSettings, create_series

    drop = arguments.drop is not None
    if drop:
        if arguments.mission or arguments.wall or not arguments.ground:
            raise InputError(
                "a series of drops has --ground, and neither --mission nor --wall", key=("--drop",)
            )
        mission = load_empty_room(arguments.config)
        if arguments.ground not in mission.vehicle.materials:
            known = list(mission.vehicle.materials)
            raise InputError(unknown_name(arguments.ground, known), key=("--ground",))
    elif not (arguments.mission and arguments.wall):
        raise InputError("give --mission and --wall, or --drop and --ground")
    else:
        mission = load_mission(arguments.mission, arguments.config)
    walls = {wall.name: wall for wall in mission.flat_walls}
    if not drop and arguments.wall not in walls:
        raise InputError(
            f"no wall {arguments.wall!r} in the mission; it has {', '.join(walls)}", key=("--wall",)
        )
    modes = mission.vehicle.modes
    if arguments.modes is not None:
        try:
            modes = tuple(Mode(name.strip()) for name in arguments.modes.split(","))
        except ValueError as error:
            raise InputError(f"{error}; modes are rigid and flexible", key=("--modes",)) from None
        for mode in modes:
            if (problem := mission.vehicle.mode_problem(mode)) is not None:
                raise InputError(problem, key=("--modes",))
    source = mission.vehicle_source
    config = arguments.config or (None if source is None or source.packaged else source.source)
    settings = SeriesSettings(
        vehicle=None if config is None else os.path.relpath(config, arguments.folder),
        wall=arguments.ground if drop else arguments.wall,
        modes=tuple(sorted(modes, key=lambda mode: mode is Mode.RIGID)),
        speeds_m_s=_range(arguments.speeds, "--speeds"),
        peak_force_n=arguments.peak_force or mission.limits.peak_force_n,
        aims=_aims(arguments.aim),
        held_out=arguments.held_out,
        hits_per_flight=arguments.hits_per_flight,
        heights_m=_range(arguments.drop, "--drop") if drop else None,
    )
    create_series(arguments.folder, arguments.mission, settings)
    folder = display_path(arguments.folder)
    print_status(f"wrote {folder}; next: dart-flight series next {folder}")
    return 0


def _range(text: str, option: str) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    try:
        if not dots:
            raise ValueError
        return float(low), float(high)
    except ValueError:
        raise InputError(f"{text!r} is not LOW..HIGH, such as 0.3..1.5", key=(option,)) from None


def _aims(given: list[str]) -> Any:
    from dart_flight.lab.identify.next_hits import FITTED
    from dart_flight.lab.series.series_file import Aims

    values = {}
    for text in given:
        name, _, percent = text.partition("=")
        try:
            values[name] = 0.01 * float(percent.rstrip("%"))
        except ValueError:
            raise InputError(f"{text!r} is not NAME=PERCENT, such as k=4", key=("--aim",)) from None
        if name not in FITTED:
            raise InputError(f"no aim for {name!r}; choose one of {', '.join(FITTED)}", key=("--aim",))
    return Aims(**values)


# --- next and fly -----------------------------------------------------------------------------------------


def _next(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.series.status import describe, next_heights

    if _open(arguments).settings.heights_m is not None:
        folder, mission, _, status = _read(arguments)
        for mode, one in status.modes.items():
            heights = next_heights(folder.settings, mission, one.fit)
            shown = ", ".join(f"{height:.2f}" for height in heights) or "none is below the force limit"
            print_status(f"{mode}: drop from these heights, m: {shown}")
        print_status(f"missing: {describe(status)}")
        return 0
    return 0 if _plan(arguments)[1] else 1


def _plan(arguments: argparse.Namespace) -> tuple[Path, bool]:
    """Write the next batch; return the mission's path, and whether `check` has no objection."""
    from dart_flight.check.checks import FlightContext, Stage, run_checks
    from dart_flight.check.findings import decide
    from dart_flight.cli.check_command import show
    from dart_flight.config.mission import load_mission
    from dart_flight.lab.identify.next_hits import FITTED, expected_halves
    from dart_flight.lab.series.batch import plan_batch
    from dart_flight.lab.series.status import describe, hit_limits

    folder, mission, _, status = _read(arguments)
    settings = folder.settings
    if settings.heights_m is not None:
        raise InputError(
            "drops are not flown: `series next` names their heights, `series add` adds recordings"
        )
    limits = hit_limits(settings, mission)
    fits = {mode: status.modes[mode.value].statistical_fit for mode in settings.modes}
    name = f"{settings.wall} {folder.next_batch().name}"
    hits, tree, _ = plan_batch(settings, mission, status, name)
    path = folder.write_batch(tree)
    batch = load_mission(path, arguments.config)
    lines = [f"{display_path(path)}: {len(hits)} hits on {settings.wall}"]
    lines += [
        f"  {hit.mode.value}, {-hit.normal_m_s:.2f} m/s and {hit.tangential_m_s:.2f} m/s along: "
        f"{hit.peak_n:.0f} N, at most {hit.highest_n:.0f} N"
        for hit in hits
    ]
    for mode, fit in fits.items():
        own = [hit for hit in hits if hit.mode is mode]
        if own:
            halves = expected_halves(fit, limits, own)
            gains = [f"{n} {_percent(getattr(fit, n).half)} to {_percent(halves[n])}" for n in FITTED]
            lines.append(f"  expected statistical intervals, {mode.value}: {', '.join(gains)}")
    lines.append(f"  missing: {describe(status)}")
    print_status(*lines)
    report = decide(batch, run_checks(FlightContext(batch), Stage.FILE))
    show(report, messages())
    return path, report.go


def _percent(half: float) -> str:
    return f"±{100.0 * half:.0f} %"


def _value(arguments: argparse.Namespace, option: str) -> Any:
    return getattr(arguments, option[2:].replace("-", "_"))


def _fly(arguments: argparse.Namespace) -> int:
    """Write the next batch and fly it by a child command, which checks and asks by itself."""
    simulated = [option for option in _FOR_SIMULATION if _value(arguments, option) not in (None, False)]
    if len(simulated) > 1 or (simulated and arguments.connection is not None and simulated != ["--hitl"]):
        raise InputError("give only one of --connection, --hitl, --px4, --fast and --dry-run")
    path, go = _plan(arguments)
    if not go and not arguments.overrule:
        raise FlightError("not flown: the check of the batch has an objection")
    folder = _open(arguments)
    command = "dry-run" if simulated else "fly"
    call = [
        sys.executable,
        "-m",
        "dart_flight",
        command,
        str(path),
        "--log-dir",
        str(folder.flights_of(path.parent)),
    ]
    for option, metavar in {**_FOR_SIMULATION, **_PASSED_ON}.items():
        value = _value(arguments, option)
        if metavar is None:
            call += [option] if value and option != _EMBEDDED else []
        else:
            for one in value if isinstance(value, list) else [] if value is None else [value]:
                call += [option, one]
    if arguments.config is not None:
        call += ["--config", arguments.config]
    # With the same seed, the noise of every batch would be the same.
    if simulated and simulated != ["--hitl"] and arguments.seed is None:
        call += ["--seed", str(int(path.parent.name))]
    before = folder.logs()
    status = run_child(call)
    new = [log for name, log in folder.logs().items() if name not in before]
    for log in new:
        print_status(f"the flight is in {display_path(log.parent)}")
    if new or not status:
        _print_status_table(_read(arguments)[3])
    if status < 0:
        raise FlightError(f"{signal.Signals(-status).name} has ended the flight's program; its hits are kept")
    return status


def run_child(call: list[str]) -> int:
    """Run a child that lands the vehicle after a signal to stop, and return its status.

    A terminal sends Ctrl-C to both programs. Other signals reach only this program, and are passed on.
    """
    child: subprocess.Popen[bytes] | None = None
    told: list[signal.Signals] = []

    def pass_on(number: signal.Signals) -> None:
        told.append(number)
        if child is not None and number != signal.SIGINT:
            child.send_signal(number)

    with StopSignals(pass_on):
        child = subprocess.Popen(call)
        for number in told:  # arrived before the child existed
            child.send_signal(number)
        return child.wait()


# --- status, report, apply --------------------------------------------------------------------------------


def _read(arguments: argparse.Namespace) -> tuple[Any, Any, Any, Any]:
    """Return folder, mission, evidence and status."""
    from dart_flight.lab.series.evidence import read_evidence
    from dart_flight.lab.series.status import status_of

    folder = _open(arguments)
    mission, evidence = folder.mission(), read_evidence(folder)
    return folder, mission, evidence, status_of(folder.settings, mission, evidence)


def _status(arguments: argparse.Namespace) -> int:
    status = _read(arguments)[3]
    if arguments.json:
        emit_json(status)
    else:
        _print_status_table(status)
    return 0


def _print_status_table(status: Any) -> None:
    from rich.table import Table

    from dart_flight.config.units import COEFFICIENTS
    from dart_flight.lab.series.status import describe

    console = tables()
    for mode, one in status.modes.items():
        table = Table(title=f"{status.wall} ({status.material}), {mode}: {one.used} of {one.flown} hits used")
        for head in ("", "value", "unit", "statistical", "with allowance", "aim", "from the prior"):
            table.add_column(head, justify="left" if head in ("", "unit") else "right")
        for name, c in one.coefficients.items():
            table.add_row(
                name,
                f"{c.statistical.value:.4g}",
                COEFFICIENTS[name],
                *(f"{e.low:.4g} to {e.high:.4g}" for e in (c.statistical, c.whole)),
                "" if c.aim is None else _percent(c.aim),
                f"{100.0 * c.prior_share:.0f} %",
            )
        console.print(table)
        held = one.held_out
        if held.peak is not None and held.out_m_s is not None:
            console.print(
                f"held-out hits: {len(held.hits)}, peak force {100.0 * held.peak:.1f} % rms, outgoing speed "
                f"{held.out_m_s:.3f} m/s rms (constant restitution: {held.out_constant_m_s:.3f} m/s)",
                soft_wrap=True,
            )
        for hit, why in one.aside.items():
            console.print(f"set aside: {hit}: {why}", soft_wrap=True)
    for flight, ended in status.flights.items():
        console.print(f"flight {flight}: {ended or 'in progress'}", soft_wrap=True)
    for line in (*status.changes, describe(status)):
        console.print(line, soft_wrap=True)


def _report(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.report.series_page import series_page

    folder, mission, evidence, status = _read(arguments)
    output = arguments.output or folder.path / "series.html"
    write_text(output, series_page(folder.settings, mission, evidence, status, output.parent))
    if arguments.json:
        emit_json({"page": str(output), "status": status})
    return 0


def _apply(arguments: argparse.Namespace) -> int:
    from dart_flight.config.provenance import find_vehicle
    from dart_flight.lab.series.evidence import refuse_other_vehicle
    from dart_flight.lab.series.history import apply_status
    from dart_flight.lab.series.status import describe

    if arguments.config is None:
        raise InputError("name the configuration to write, such as configs/mine.yaml", key=("--config",))
    config = Path(arguments.config)
    arguments.config = None  # the series has been flown with its own configuration
    folder, mission, evidence, status = _read(arguments)
    refuse_other_vehicle(find_vehicle(config).config, mission.vehicle, str(config))
    entries = apply_status(status, evidence, config, folder.path)
    if arguments.json:
        emit_json(entries)
    for entry in entries:
        values = ", ".join(f"{name} {c.value:g}" for name, c in entry.coefficients.items())
        print_status(f"{config}: {entry.material} {entry.mode}: {values} ({entry.hits} hits, {entry.date})")
    if not status.is_complete:
        print_status(f"the aims are not reached: {describe(status)}")
    return 0


def _exclude(arguments: argparse.Namespace) -> int:
    from dart_flight.lab.series.evidence import read_evidence
    from dart_flight.lab.series.series_file import ExcludedHit

    folder = _open(arguments)
    flight, colon, hit = arguments.hit.rpartition(":")
    if not colon or not hit.isdigit() or int(hit) < 1:
        raise InputError(f"{arguments.hit!r} is not FLIGHT:HIT, such as {'01/NAME'}:3", key=("FLIGHT:HIT",))
    excluded = ExcludedHit(folder.flight_named(flight), int(hit), arguments.why)
    hits = [one.number for one in read_evidence(folder).hits if one.flight == excluded.flight]
    if excluded.hit not in hits:
        raise InputError(f"{excluded.flight} has {len(hits)} hits", key=("FLIGHT:HIT",))
    kept = [
        one for one in folder.settings.excluded if (one.flight, one.hit) != (excluded.flight, excluded.hit)
    ]
    folder.change(excluded=(*kept, excluded))
    print_status(f"excluded {excluded.flight}:{excluded.hit}")
    return 0


def _add(arguments: argparse.Namespace) -> int:
    from dart_flight.base.records import Mode
    from dart_flight.lab.series.evidence import read_drop, refuse_foreign
    from dart_flight.lab.series.series_file import DropTrial
    from dart_flight.recording.found import LOG_NAME
    from dart_flight.recording.reader import read_log

    folder = _open(arguments)
    if folder.settings.heights_m is not None:
        mode = arguments.mode or (folder.settings.modes[0] if len(folder.settings.modes) == 1 else None)
        if mode is None or Mode(mode) not in folder.settings.modes:
            raise InputError(f"give one of {', '.join(folder.settings.modes)}", key=("--mode",))
        drop = DropTrial(arguments.flight.name, Mode(mode), arguments.height, arguments.contact_distance)
        read_drop(arguments.flight, arguments.flight.name, drop, folder)  # refuses an unusable recording
        print_status(f"added {folder.add_drop(arguments.flight, drop)}")
        return 0
    log = arguments.flight / LOG_NAME if arguments.flight.is_dir() else arguments.flight
    refuse_foreign(read_log(log), folder)
    print_status(f"added {folder.add(log)}")
    return 0
