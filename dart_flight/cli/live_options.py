"""`--live`: the flight in a viewer's 3D while it goes on."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator

from dart_flight.cli.options import whole_number
from dart_flight.cli.terminal import say
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import shown_path
from dart_flight.config.vehicle import packaged
from dart_flight.scene.live import DEFAULT_HOST, DEFAULT_PORT, LiveView, Show

_LOCAL = ("127.0.0.1", "::1", "localhost")


def add_live_options(parser: argparse.ArgumentParser) -> None:
    """`--live` and where it listens."""
    group = parser.add_argument_group("live view (docs/live.md)")
    group.add_argument(
        "--live", action="store_true", help="show it in 3D in Foxglove or Lichtblick while it goes on"
    )
    group.add_argument(
        "--live-port",
        type=whole_number(1, 65535),
        metavar="PORT",
        help=f"that viewers connect to (default {DEFAULT_PORT})",
    )
    group.add_argument(
        "--live-host",
        metavar="ADDRESS",
        help=f"to listen at (default {DEFAULT_HOST}: this machine only; 0.0.0.0: all may watch)",
    )


@contextlib.contextmanager
def live_view(
    arguments: argparse.Namespace,
    mission: Mission,
    *,
    furnished: bool = True,
    placed: bool = False,
    from_truth: bool = False,
) -> Iterator[LiveView | None]:
    """The live view that was asked for, or None; says where viewers find it.

    Raises:
        InputError: its port cannot be opened, or an option of it is given without `--live`.
    """
    if not arguments.live:
        for name in ("live_port", "live_host"):
            if getattr(arguments, name) is not None:
                raise InputError(f"--{name.replace('_', '-')} needs --live")
        yield None
        return

    host = arguments.live_host or DEFAULT_HOST
    port = arguments.live_port or DEFAULT_PORT
    view = LiveView(Show(mission, host, port, furnished, placed, from_truth), say)
    try:
        layout = shown_path(packaged("docs", "foxglove_layout.json"))
        say(f"live: in Foxglove or Lichtblick open the connection ws://{host}:{view.port}; layout {layout}")
        if host not in _LOCAL:
            say(f"live: whoever reaches {host} may watch; nobody can publish")
        yield view
    finally:
        view.close()
