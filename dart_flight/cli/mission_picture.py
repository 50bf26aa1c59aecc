"""The picture of a mission before it flies, for every command that offers one."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.check.mission_check import predict_flight_path
from dart_flight.cli.terminal import print_status
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.lab_entries import MISSION_PICTURE, load_entry


def add_plot_option(parser: argparse.ArgumentParser) -> None:
    """`--plot FILE`."""
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="picture of the mission, where it leads and what uncertain walls change: png, svg or pdf",
    )


def write_picture(mission: Mission, path: Path) -> None:
    """Draw a mission by the planner's flight model, and say where the picture is, or why there is none: a
    failure of the drawing ends no flight.

    Raises:
        InputError: matplotlib is missing, or the file has an unknown ending or cannot be written.
    """
    try:
        load_entry(MISSION_PICTURE)(mission, predict_flight_path(mission), path)
    except InputError:
        raise
    except Exception as error:
        print_status(f"no picture ({error!r})")
        return
    print_status(f"picture: {path}")
