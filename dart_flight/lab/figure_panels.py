"""Figures of panels above each other. Needs matplotlib, the `report` extra; nothing else here imports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dart_flight.config.document import InputError, writing

# Okabe and Ito's colours: told apart by everyone, also in grey.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"


def blank(width_in: float, height_in: float) -> Any:
    """A figure without any window system.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        raise InputError("needs matplotlib: pip install 'dart-flight[report]'", key=("plot",)) from None
    return Figure(figsize=(width_in, height_in), layout="constrained")


def panels(rows: int) -> tuple[Any, Any]:
    """A figure of panels above each other that share the time axis.

    Raises:
        InputError: matplotlib is not installed.
    """
    figure = blank(7.2, 2.1 * rows + 0.9)
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


def legend_entries(axis: Any) -> dict[str, Any]:
    """Label -> handle of what an axis shows, each label once."""
    handles, labels = axis.get_legend_handles_labels()
    return dict(zip(labels, handles, strict=True))


def shade(axes: Sequence[Any], begin_ms: float, end_ms: float) -> None:
    """Mark a stretch of time, such as a contact, in every panel."""
    for axis in axes:
        axis.axvspan(begin_ms, end_ms, color=BLUE, alpha=0.07, linewidth=0)
