"""Which vehicle the numbers are for: a line on standard error, before them."""

from __future__ import annotations

import argparse

from dart_flight.cli.terminal import messages
from dart_flight.config.provenance import VehicleSource, passed_over


def say_vehicle(source: VehicleSource | None, arguments: argparse.Namespace, *, flown: bool = False) -> None:
    """Name the configuration and its mass; where the packaged one is taken and another is at hand, say so.

    Args:
        source: what was found; None says nothing.
        arguments: of the command; where --config names the file nothing was passed over.
        flown: nor where a log says the vehicle.
    """
    if source is None:
        return
    console = messages()
    which = source.source or "from the log"
    if source.packaged:
        which = f"the packaged configuration ({which})"
    changed = f", with {', '.join(source.set)}" if source.set else ""
    console.print(f"vehicle: {which}, {source.mass_kg:g} kg{changed}", soft_wrap=True)
    others = [] if flown or arguments.config is not None else passed_over(source)
    if others:
        more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
        console.print(
            f"note: {others[0]}{more} found but not used; select it with --config {others[0]}",
            style="yellow",
            soft_wrap=True,
        )
