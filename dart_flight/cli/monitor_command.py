"""`dart-flight monitor`: live force, detection, streams, lock and phase."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
from rich.console import Group
from rich.table import Table
from rich.text import Text

from dart_flight.base.records import Record
from dart_flight.base.text import printable
from dart_flight.cli.live_options import add_live_options, live_view
from dart_flight.cli.options import add_mocap_option, link_of, number
from dart_flight.cli.terminal import emit_json, live_screen, print_status, styled
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.link_url import endpoint_of
from dart_flight.config.mission import Mission, load_empty_room, load_mission
from dart_flight.recording.about import flown_mission
from dart_flight.recording.follow import LogFollower
from dart_flight.run.monitor import MonitorView, TelemetryMonitor, monitor_log, monitor_vehicle
from dart_flight.run.prepare import with_mocap
from dart_flight.vehicle.link import Holder, LinkInUseError, LinkLease, find_holder, held_links

_PERIOD_S = 0.2
_BAR_N, _BAR_WIDTH = 40.0, 24


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--connection",
        metavar="URL",
        help="vehicle to watch (default: a flight in progress on this computer, else connection.url)",
    )
    parser.add_argument("--mission", metavar="FILE", help="show forces along this mission's axes")
    parser.add_argument("--log", type=Path, metavar="FILE", help="follow this flight's log")
    add_mocap_option(parser)
    add_live_options(parser)
    parser.add_argument("--seconds", type=number(0.0, 1e6), metavar="S", help="stop after this many seconds")


def run(arguments: argparse.Namespace) -> int:
    """With --json, print only the last view, at the end."""
    views: list[MonitorView] = []

    def keep(view: MonitorView) -> None:
        views[:] = [view]

    if arguments.json:
        mission = _watch(arguments, keep)
        view = msgspec.structs.asdict(views[-1]) if views else {}
        emit_json({**view, "vehicle": mission.flown_vehicle()})
        return 0
    with live_screen() as live:
        _watch(arguments, lambda view: live(screen(view), line(view)))
    return 0


def _watch(arguments: argparse.Namespace, show: Callable[[MonitorView], None]) -> Mission:
    """Watch a flight through its log, or a vehicle through the link; return the mission that was used."""
    placed = arguments.mission is not None
    load = partial(load_mission, arguments.mission) if placed else load_empty_room
    if arguments.connection is None:
        # A flight's log contains the configuration. Load a file only to choose among several flights.
        flight = _flight(arguments.log, lambda: load(arguments.config).vehicle.connection.url)
        if flight is not None:
            return _follow(*flight, show, arguments)
    mission = with_mocap(load(arguments.config), arguments.mocap)
    connection = mission.vehicle.connection
    url = link_of(arguments, connection)
    print_vehicle(mission.flown_vehicle(), arguments)
    lease = LinkLease(url, "monitor")
    try:
        lease.acquire()
    except LinkInUseError as error:
        raise InputError(
            f"{error.message}; without --connection, `monitor` follows the log of a flight in progress",
            source=url,
        ) from None
    seconds, timeout_s = arguments.seconds, connection.timeout_s
    try:
        with live_view(arguments, mission, show_room=placed, frame_known=True) as live:
            watcher = TelemetryMonitor(mission, placed, live or _ignore)
            asyncio.run(monitor_vehicle(watcher, url, timeout_s, show, _PERIOD_S, seconds, lease.lock_device))
    finally:
        lease.release()
    return mission


def _flight(log: Path | None, link: Callable[[], str]) -> tuple[Path, Callable[[], bool]] | None:
    """Return the log of the flight in progress, and a function that returns whether the flight continues.

    The result is None if no flight is in progress. `link` returns the URL of the configuration's link.

    Raises:
        InputError: several flights are in progress, and that link does not identify one of them.
    """
    if log is not None:
        held = [holder for holder in held_links() if holder.log == printable(str(log.resolve()))]
        return log, _still_held(held[0]) if held else lambda: False
    flights = [holder for holder in held_links() if holder.log is not None]
    if not flights:
        return None
    if len(flights) > 1:
        several = "; ".join(f"{holder.describe()}: {holder.log}" for holder in flights)
        own = endpoint_of(link())
        flights = [holder for holder in flights if endpoint_of(holder.url) == own]
        if len(flights) != 1:
            raise InputError(f"several flights are in progress; choose one with --log: {several}")
    flight = flights[0]
    print_status(f"watching {flight.describe()} through its log {flight.log}")
    return Path(flight.log or ""), _still_held(flight)


def _still_held(flight: Holder) -> Callable[[], bool]:
    return lambda: find_holder(flight.url) == flight


def _ignore(record: Record) -> None:
    """Ignore a record, because there is no live view."""


def _follow(
    log: Path, flying: Callable[[], bool], show: Callable[[MonitorView], None], arguments: argparse.Namespace
) -> Mission:
    follower = LogFollower(log)
    first = follower.read()
    mission = flown_mission(follower.about, str(log))
    watcher = TelemetryMonitor(mission, frame_known=True)
    with live_view(arguments, mission) as live:
        viewer = live.feed if live is not None else _ignore
        for entry in first:
            watcher.process_record(entry.record)
            viewer(entry.record)
        monitor_log(watcher, follower, show, _PERIOD_S, arguments.seconds, flying, viewer)
    return mission


def line(view: MonitorView) -> Text:
    force = "-" if view.filtered_n is None else " ".join(f"{n:+.1f}" for n in view.filtered_n)
    slow = [s.name for s in view.streams if s.rate_hz < s.expected_hz]
    parts = [
        "armed" if view.armed else "disarmed",
        view.flight_mode,
        view.landed,
        f"force {force} N ({view.frame})",
        view.detection,
        f"phase {view.phase or '-'}",
        f"lock {view.lock or '-'}",
        *([f"slow: {', '.join(slow)}"] if slow else []),
        *([f"no poses: {view.pose_problem}"] if view.pose_problem is not None else []),
    ]
    return styled("   ".join(parts))


def screen(view: MonitorView) -> Group:
    return Group(_force(view), _streams(view))


def _force(view: MonitorView) -> Table:
    table = Table(title=f"force, N ({view.frame})", title_justify="left", show_header=False, min_width=60)
    table.add_column()
    table.add_column(justify="right", min_width=8)
    table.add_column(min_width=_BAR_WIDTH)
    if view.filtered_n is None:
        table.add_row("waiting for telemetry", "", "")
    else:
        for axis, value in zip("xyz", view.filtered_n, strict=True):
            length = min(_BAR_WIDTH, round(abs(value) / _BAR_N * _BAR_WIDTH))
            table.add_row(axis, f"{value:+.2f}", ("+" if value > 0.0 else "-") * length)
        sigma = f"{view.sigma_n:.2f}" if view.sigma_n is not None else "-"
        table.add_row("standard deviation", sigma, styled(("clipped" if view.clipped else "", "red")))
    table.add_row("detection", "", view.detection)
    for age, normal, tangential in view.peaks[:3]:
        table.add_row(f"impact {age:.1f} s ago", f"{normal:.1f}", f"tangential {tangential:+.1f}")
    for one in view.walls:
        figures = ", ".join(
            f"{name} {after:.4g} ± {100.0 * sd:.0f} % ({before:.4g})"
            for name, before, after, sd in zip(
                ("k", "f", "mu"), one.prior, one.posterior, one.posterior_sd, strict=True
            )
        )
        table.add_row(f"wall {one.wall}", one.mode_felt or "?", figures)
    if view.plan is not None:
        table.add_row("new plan", "", view.plan)
    bias = ", ".join(f"{b:+.2f}" for b in view.bias_m_s2)
    table.add_row(
        f"thrust from {view.thrust_source or 'no source yet'}",
        f"x {view.thrust_scale:.3f}",
        f"noise {view.noise_m_s2:.2f}, bias {bias} m/s2",
    )
    return table


def _streams(view: MonitorView) -> Table:
    battery = f"{view.battery_v:.1f} V" if view.battery_v is not None else "battery unknown"
    state = f"{'armed' if view.armed else 'disarmed'}, {view.flight_mode}, {view.landed}, {battery}"
    table = Table(title=state, title_justify="left", min_width=60)
    for column in ("stream", "Hz", "needed", "age ms"):
        table.add_column(column, justify="left" if column == "stream" else "right")
    for s in view.streams:
        colour = "green" if s.rate_hz >= s.expected_hz else "red"
        age = "-" if s.age_ms is None else f"{s.age_ms:.0f}"
        table.add_row(s.name, styled((f"{s.rate_hz:.0f}", colour)), f"{s.expected_hz:.0f}", age)
    p = view.poses
    if p is not None:
        colour = "green" if p.rate_hz > 0.0 else "red"
        age = "-" if p.age_ms is None else f"{p.age_ms:.0f}"
        table.add_row("motion capture", styled((f"{p.rate_hz:.0f}", colour)), "", age)
    poses = "" if view.pose_problem is None else f"no poses: {view.pose_problem}\n"
    table.caption = (
        f"{poses}phase {view.phase or '-'}   lock {view.lock or '-'}   "
        f"this program {view.cpu_percent:.1f} % of a core"
    )
    table.caption_justify = "left"
    return table
