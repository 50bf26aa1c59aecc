"""The picture of a mission before it flies, for every command that offers one."""

from __future__ import annotations

import argparse
from pathlib import Path

from dart_flight.check.mission import modelled
from dart_flight.cli.terminal import say
from dart_flight.config.mission import Mission


def add_plot_option(parser: argparse.ArgumentParser) -> None:
    """`--plot FILE`."""
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="picture of the mission, where it leads and what uncertain walls change: png, svg or pdf",
    )


def write_picture(mission: Mission, path: Path) -> None:
    """Draw a mission by the planner's flight model, and say where the picture is.

    Raises:
        InputError: matplotlib is missing, or the file has an unknown ending or cannot be written.
    """
    from dart_flight.report.figures.mission import mission_figure
    from dart_flight.report.figures.style import save_figure

    save_figure(mission_figure(mission, modelled(mission)), path)
    say(f"picture: {path}")
