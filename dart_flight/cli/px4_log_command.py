"""`dart-flight px4-log FLIGHT`: download PX4's own log of a flight into the flight's folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection
from datetime import datetime
from pathlib import Path

from dart_flight.cli.options import link_of, whole_number
from dart_flight.cli.terminal import emit_json, messages, print_status
from dart_flight.config.document import InputError
from dart_flight.config.provenance import display_path
from dart_flight.recording.about import armed_span, flown_mission
from dart_flight.recording.found import PX4_LOG, find_logs
from dart_flight.recording.reader import read_log
from dart_flight.run.px4_log_download import fetch_px4_log
from dart_flight.vehicle.downloads import Px4LogEntry
from dart_flight.vehicle.link import LinkLease


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", metavar="FLIGHT", help="flight log or its folder")
    parser.add_argument(
        "--connection", metavar="URL", help="the vehicle's link (default: the link of the flight)"
    )
    parser.add_argument(
        "--log-id",
        type=whole_number(0, 65535),
        metavar="N",
        help="number of the log, if several may belong to the flight",
    )
    parser.add_argument("--again", action="store_true", help="download the log even if the file exists")


def run(arguments: argparse.Namespace) -> int:
    found = find_logs([arguments.flight])
    if len(found) != 1:
        raise InputError(f"{len(found)} flights below this folder; name one flight", source=arguments.flight)
    log = read_log(found[0])
    connection = flown_mission(log.about, log.source).vehicle.connection
    path = found[0].with_name(PX4_LOG)
    if path.exists() and not arguments.again:
        print_status(f"the file exists: {display_path(path)} (--again downloads it again)")
    else:
        url = link_of(arguments, connection)
        download_px4_log(url, connection.timeout_s, path.parent, armed_span(log), log_id=arguments.log_id)
    if arguments.json:
        emit_json({"px4_log": display_path(path)})
    return 0


def download_px4_log(
    url: str,
    timeout_s: float,
    folder: Path,
    armed: tuple[datetime, datetime] | None,
    *,
    before: Collection[Px4LogEntry] | None = None,
    log_id: int | None = None,
) -> Path:
    """Download PX4's log of a flight, show the progress, and return the path of the log.

    For the other arguments and `FlightError`, see `fetch_px4_log`.

    Args:
        log_id: number of the log that the operator has chosen. If it is None and several logs may belong to
            the flight, the operator must choose one.

    Raises:
        InputError: several logs may belong to the flight, and the operator has not chosen one of them.
    """
    from rich.progress import Progress, TimeRemainingColumn  # slow to import

    def choose(found: list[Px4LogEntry]) -> Px4LogEntry:
        bar.stop()
        chosen = _choose_log(found) if log_id is None else log_id
        for entry in found:
            if entry.id == chosen:
                return entry
        raise InputError(f"is none of {', '.join(str(entry.id) for entry in found)}", key=("--log-id",))

    console = messages()
    bar = Progress(
        *Progress.get_default_columns()[:-1],
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with LinkLease(url, "px4-log") as lease, bar:
        task = bar.add_task(PX4_LOG, total=1.0)
        path = fetch_px4_log(
            url,
            timeout_s,
            folder,
            armed,
            before=before,
            choose=choose,
            print_line=print_status,
            progress=lambda share: bar.update(task, completed=share),
            opened=lease.lock_device,
        )
    print_status(f"PX4's log: {display_path(path)}")
    return path


def _choose_log(found: list[Px4LogEntry]) -> int:
    """Ask the operator for the flight's log; return its number, or -1 for an invalid answer."""
    print_status("several logs may belong to this flight:", *(f"  {entry.line()}" for entry in found))
    if not sys.stdin.isatty():
        raise InputError(
            "several logs may belong to this flight: give the number of one log", key=("--log-id",)
        )
    sys.stderr.write("Which number? ")
    sys.stderr.flush()
    answer = sys.stdin.readline().strip()
    return int(answer) if answer.isdigit() else -1
