"""`dart-flight monitor`: live force, detection, streams, lock and phase."""

from __future__ import annotations

import argparse
import asyncio

import msgspec
from rich.console import Group
from rich.live import Live
from rich.table import Table

from dart_flight.cli.options import link_of, number
from dart_flight.cli.terminal import emit_json, messages, tables
from dart_flight.cli.vehicle_line import say_vehicle
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import default_config_path, packaged
from dart_flight.worlds.monitor import Screen, Watcher, watch

_PERIOD_S = 0.2
_BAR_N, _BAR_WIDTH = 40.0, 24


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--connection", metavar="URL", help="default: connection.url of the configuration")
    parser.add_argument("--mission", metavar="FILE", help="show forces along this mission's axes")
    parser.add_argument("--seconds", type=number(0.0, 1e6), metavar="S", help="end by itself after this long")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit status. With --json: the last view, at the end."""
    placed = arguments.mission is not None
    # Without a mission of its own the vehicle is this folder's, not that of the packaged mission.
    config = arguments.config or (None if placed else default_config_path())
    mission = load_mission(arguments.mission if placed else packaged("missions", "single_wall.yaml"), config)
    watcher = Watcher(mission, placed)
    connection = mission.vehicle.connection
    url = link_of(arguments, connection)
    say_vehicle(mission.flown_vehicle(), messages(), asked=arguments.config is not None)
    views: list[Screen] = []
    console = tables()

    def keep(view: Screen) -> None:
        views[:] = [view]

    if arguments.json:
        asyncio.run(watch(watcher, url, connection.timeout_s, keep, _PERIOD_S, arguments.seconds))
        view = msgspec.structs.asdict(views[-1]) if views else {}
        emit_json({**view, "vehicle": mission.flown_vehicle()})
        return 0
    with Live(console=console, auto_refresh=False, transient=False) as live:

        def show(view: Screen) -> None:
            live.update(screen(view), refresh=True)

        asyncio.run(watch(watcher, url, connection.timeout_s, show, _PERIOD_S, arguments.seconds))
    return 0


def screen(view: Screen) -> Group:
    """A view as tables."""
    return Group(_force(view), _streams(view))


def _force(view: Screen) -> Table:
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
        table.add_row("standard deviation", sigma, "[red]clipped[/]" if view.clipped else "")
    table.add_row("detection", "", view.detection)
    for age, normal, tangential in view.peaks[:3]:
        table.add_row(f"impact {age:.1f} s ago", f"{normal:.1f}", f"along the wall {tangential:+.1f}")
    bias = ", ".join(f"{b:+.2f}" for b in view.bias_m_s2)
    table.add_row(
        f"thrust from {view.thrust_source or 'nothing yet'}",
        f"x {view.thrust_scale:.3f}",
        f"noise {view.noise_m_s2:.2f}, bias {bias} m/s2",
    )
    return table


def _streams(view: Screen) -> Table:
    battery = f"{view.battery_v:.1f} V" if view.battery_v is not None else "battery unknown"
    state = f"{'armed' if view.armed else 'disarmed'}, {view.flight_mode}, {view.landed}, {battery}"
    table = Table(title=state, title_justify="left", min_width=60)
    for column in ("stream", "Hz", "needed", "age ms"):
        table.add_column(column, justify="left" if column == "stream" else "right")
    for s in view.streams:
        colour = "green" if s.rate_hz >= s.expected_hz else "red"
        age = "-" if s.age_ms is None else f"{s.age_ms:.0f}"
        table.add_row(s.name, f"[{colour}]{s.rate_hz:.0f}[/]", f"{s.expected_hz:.0f}", age)
    table.caption = (
        f"phase {view.phase or '-'}   lock {view.lock or '-'}   "
        f"this program {view.cpu_percent:.1f} % of a core"
    )
    table.caption_justify = "left"
    return table
