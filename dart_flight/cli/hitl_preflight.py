"""Checks and confirmation before a flight with `dry-run --hitl`, and instructions after the flight.

The operator must confirm that the propellers are off, because arming is real.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from functools import partial

from dart_flight.base.errors import FlightError
from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import decide
from dart_flight.check.hitl_check import hitl_parameters
from dart_flight.cli.check_command import show
from dart_flight.cli.options import link_of
from dart_flight.cli.terminal import messages, print_status
from dart_flight.config.document import InputError
from dart_flight.config.link_url import endpoint_of, usable_link
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.recording.verdict import Verdict
from dart_flight.run.hitl_flight import fly_hitl
from dart_flight.vehicle.link import LinkLease

_WORD = "propellers off"


def prepare_hitl(
    arguments: argparse.Namespace,
    mission: Mission,
    position_from: PositionSource,
    spreads: Mapping[str, float],
) -> Callable[..., Verdict]:
    """Check the flight controller, ask for confirmation, and return the function that flies.

    Raises:
        InputError: the two links are the same, or the operator does not confirm.
        FlightError: the flight controller is not ready.
    """
    hitl_url = usable_link(arguments.hitl, "--hitl")
    url = link_of(arguments, mission.vehicle.connection)
    if endpoint_of(hitl_url).key == endpoint_of(url).key:
        raise InputError(
            "is also the link of the application; the flight controller needs a separate port for each link",
            key=("--hitl",),
        )
    context = FlightContext(mission, url=url, position_from=position_from)
    with LinkLease(url, "dry-run --hitl"):
        run_checks(context, Stage.HITL)
    report = decide(mission, context.found)
    show(report, messages())
    if not report.go:
        raise FlightError(
            "the flight controller is not ready for hardware in the loop; the mission was not flown"
        )
    motors = context.vehicle.motors
    _confirm()
    return partial(
        fly_hitl,
        hitl_url=hitl_url,
        url=url,
        motors=motors,
        position_from=position_from,
        spreads=spreads,
    )


def _confirm() -> None:
    sys.stderr.write(f"Motors may turn. Take the propellers off, then type '{_WORD}': ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() != _WORD:
        raise InputError(f"'{_WORD}' was not typed; the mission was not flown", key=("--hitl",))


def print_hitl_exit() -> None:
    """Print how to leave HITL mode."""
    others = ", ".join(p.name for p in hitl_parameters().values() if p.name != "SYS_HITL")
    print_status(
        f"to leave HITL mode: set SYS_HITL to 0, restore GPS_1_CONFIG, {others}, and restart the "
        "flight controller; until then, `fly` and `check` reject it"
    )
