"""Options `--live`, `--live-port` and `--live-host`: the live 3D view of a flight."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from dart_flight.base.records import Record
from dart_flight.cli.options import whole_number
from dart_flight.cli.terminal import print_status
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import display_path
from dart_flight.config.vehicle import packaged
from dart_flight.lab_entries import LIVE_VIEW, load_entry

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8765
_LOCAL = ("127.0.0.1", "::1", "localhost")


class LiveView:
    """The lab's live view; if it fails, the flight continues and the operator is informed."""

    def __init__(self, view: Any) -> None:
        self._view = view
        self.port: int = view.port
        self._failed = False

    def __call__(self, record: Record) -> None:
        """Pass a record to the view without blocking; safe from any thread."""
        self._try(self._view, record)

    def feed(self, record: Record) -> None:
        """Pass a record to the view, and wait if the view is slow."""
        self._try(self._view.feed, record)

    def close(self) -> None:
        self._failed = False
        self._try(self._view.close)

    def _try(self, action: Callable[..., None], *arguments: Record) -> None:
        if self._failed:
            return
        try:
            action(*arguments)
        except Exception as error:
            self._failed = True
            print_status(f"the live view failed ({error!r}); the flight continues without it")


def add_live_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("live view (docs/live.md)")
    group.add_argument(
        "--live", action="store_true", help="show the flight live in 3D in Foxglove or Lichtblick"
    )
    group.add_argument(
        "--live-port",
        type=whole_number(1, 65535),
        metavar="PORT",
        help=f"port for viewers (default {DEFAULT_PORT})",
    )
    group.add_argument(
        "--live-host",
        metavar="ADDRESS",
        help=f"address to listen on (default {DEFAULT_HOST}: this computer only; 0.0.0.0: every computer)",
    )


@contextlib.contextmanager
def live_view(
    arguments: argparse.Namespace,
    mission: Mission,
    *,
    show_room: bool = True,
    frame_known: bool = False,
    from_truth: bool = False,
) -> Iterator[LiveView | None]:
    """Open the live view and print the address; close the view at the end of the context.

    Yields None without `--live`, or if the view cannot be opened.

    Args:
        show_room: whether to show the mission's room.
        frame_known: whether the mission frame's position is known when the view opens. Otherwise the
            flight's records give this position.
        from_truth: whether to show only the simulated vehicle, at its true pose.

    Raises:
        InputError: the port cannot be opened, or another live option is given without `--live`.
    """
    if not arguments.live:
        for name in ("live_port", "live_host"):
            if getattr(arguments, name) is not None:
                raise InputError(f"--{name.replace('_', '-')} needs --live")
        yield None
        return

    host = arguments.live_host or DEFAULT_HOST
    port = arguments.live_port or DEFAULT_PORT
    view = _open(mission, host, port, show_room, frame_known, from_truth)
    if view is None:
        yield None
        return
    try:
        layout = display_path(packaged("docs", "foxglove_layout.json"))
        print_status(
            f"live: in Foxglove or Lichtblick open the connection ws://{host}:{view.port}; layout {layout}"
        )
        if host not in _LOCAL:
            print_status(f"live: every computer that reaches {host} can watch (read-only)")
        yield view
    finally:
        view.close()


def _open(mission: Mission, host: str, port: int, *shown: bool) -> LiveView | None:
    """Return the view. Report an error and return None, but raise an `InputError`."""
    try:
        return LiveView(load_entry(LIVE_VIEW)(mission, host, port, *shown, print_status))
    except InputError:
        raise
    except Exception as error:
        print_status(f"no live view ({error!r}); the flight continues without it")
        return None
