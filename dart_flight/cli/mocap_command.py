"""`dart-flight mocap`: forward a motion capture's poses to PX4 without a flight."""

from __future__ import annotations

import argparse
import asyncio
import contextlib

import msgspec
from rich.text import Text

from dart_flight.cli.options import add_mocap_option, link_of, number
from dart_flight.cli.terminal import emit_json, live_screen, print_status, styled
from dart_flight.cli.vehicle_line import print_vehicle
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_empty_room
from dart_flight.run.pose_forwarding import forward_poses
from dart_flight.run.prepare import with_mocap
from dart_flight.vehicle.link import LinkLease
from dart_flight.vehicle.motion_capture.pose_bridge import MotionCaptureBridge
from dart_flight.vehicle.motion_capture.pose_statistics import PoseFigures
from dart_flight.vehicle.motion_capture.source import open_source

_PERIOD_S = 0.2


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--connection", metavar="URL", help="the vehicle's link (default: connection.url)")
    add_mocap_option(parser)
    parser.add_argument("--seconds", type=number(0.0, 1e6), metavar="S", help="stop after this many seconds")


def run(arguments: argparse.Namespace) -> int:
    """Forward poses until interrupted and return 0; with --json, print the last figures at the end."""
    mission = with_mocap(load_empty_room(arguments.config), arguments.mocap)
    if mission.vehicle.mocap.url is None:
        raise InputError("no motion capture: give --mocap URL, or set mocap.url (docs/motion_capture.md)")
    url = link_of(arguments, mission.vehicle.connection)
    print_vehicle(mission.flown_vehicle(), arguments)
    newest, problem = PoseFigures(), None
    with contextlib.ExitStack() as stack:
        source = open_source(
            mission.vehicle.mocap.url
        )  # open the source first, because it answers or fails sooner than the autopilot
        stack.callback(source.stop)
        print_status(f"poses: {source.place}; waiting for the autopilot at {url}")
        lease = stack.enter_context(LinkLease(url, "mocap"))
        view = None if arguments.json else stack.enter_context(live_screen())

        def show(figures: PoseFigures, bridge: MotionCaptureBridge) -> None:
            nonlocal newest, problem
            newest, problem = figures, bridge.problem
            if view is not None:
                view(shown := line(figures, problem), shown)

        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(
                forward_poses(mission, source, url, show, _PERIOD_S, arguments.seconds, lease.lock_device)
            )
    if arguments.json:
        found = {**msgspec.structs.asdict(newest), "problem": problem, "place": source.place}
        emit_json({**found, "vehicle": mission.flown_vehicle()})
    return 0


def line(figures: PoseFigures, problem: str | None) -> Text:
    f = figures
    parts = [f"lost {100.0 * f.lost:.0f} %"] if f.lost > 0.0 else []
    parts += [
        f"{f.gaps} gaps, longest {f.longest_gap_s:.2f} s",
        "age -" if f.age_ms is None else f"age {f.age_ms:.0f} ms",
    ]
    if f.distance_to_px4_m is None or f.angle_to_px4_deg is None:
        parts.append("PX4 has no estimate yet")
    else:
        parts.append(f"PX4 {f.distance_to_px4_m:.2f} m and {f.angle_to_px4_deg:.1f} deg off")
    rate = (f"{f.rate_hz:.0f} Hz", "green" if f.rate_hz > 0.0 else "red")
    return styled(rate, "   " + "   ".join(parts), *(() if problem is None else ((f"   {problem}", "red"),)))
