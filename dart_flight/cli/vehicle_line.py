"""The line about the vehicle's configuration, which commands print on standard error before their results."""

from __future__ import annotations

import argparse

from dart_flight.cli.terminal import messages
from dart_flight.config.provenance import VehicleSource, unused_configurations


def print_vehicle(
    source: VehicleSource | None, arguments: argparse.Namespace, *, flown: bool = False
) -> None:
    """Print the configuration's path and the vehicle's mass.

    A note follows if another configuration was found but not used. There is no note if the arguments contain
    --config, or if the configuration comes from a log (`flown`).
    """
    if source is None:
        return
    console = messages()
    which = source.source or "from the log"
    if source.packaged:
        which = f"the packaged configuration ({which})"
    changed = f", with {', '.join(source.set)}" if source.set else ""
    console.print(f"vehicle: {which}, {source.mass_kg:g} kg{changed}", soft_wrap=True)
    others = [] if flown or arguments.config is not None else unused_configurations(source)
    if others:
        more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
        console.print(
            f"note: {others[0]}{more} was found but is not used; to use it, give --config {others[0]}",
            style="yellow",
            soft_wrap=True,
        )
