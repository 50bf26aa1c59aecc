"""Option `--plot`: the picture of a mission before its flight, for `check` and `fly`."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.check.mission_check import predict_flight_path
from dart_flight.cli.terminal import print_status
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.lab_entries import MISSION_PICTURE, load_entry


def add_plot_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="file for a picture of the mission, its path and the effect of uncertain walls: png, svg or pdf",
    )


def write_picture(mission: Mission, path: Path) -> None:
    """Draw a mission with the planner's flight model, and print the path of the picture.

    All other failures are only reported, because the flight does not need the picture.

    Raises:
        InputError: matplotlib is missing, or the file has an unknown extension or cannot be written.
    """
    try:
        load_entry(MISSION_PICTURE)(mission, predict_flight_path(mission), path)
    except InputError:
        raise
    except Exception as error:
        print_status(f"no picture: {error!r}")
        return
    print_status(f"picture: {path}")
