"""Figures of panels above each other. Needs matplotlib, the `report` extra; nothing else here imports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dart_flight.config.document import InputError, writing

# Okabe and Ito's colours: told apart by everyone, also in grey.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"


def panels(rows: int, width_in: float = 7.2, row_in: float = 2.1) -> tuple[Any, Any]:
    """A figure of panels above each other that share the time axis, without any window system.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        raise InputError("needs matplotlib: pip install dart-flight[report]", key=("plot",)) from None
    figure = Figure(figsize=(width_in, row_in * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axis in axes:
        axis.grid(visible=True, color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
    return figure, axes


def save(figure: Any, path: str | Path) -> None:
    """Write the figure in the format of its suffix.

    Raises:
        InputError: the format is unknown or the file cannot be written.
    """
    with writing(path):
        try:
            figure.savefig(path, dpi=150)
        except ValueError as error:
            raise InputError(str(error), source=str(path)) from None


def shade(axes: Sequence[Any], begin_ms: float, end_ms: float) -> None:
    """Mark a stretch of time, such as a contact, in every panel."""
    for axis in axes:
        axis.axvspan(begin_ms, end_ms, color=BLUE, alpha=0.07, linewidth=0)
