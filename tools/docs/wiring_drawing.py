"""Draws the wiring of `docs/field.md`, from the table below, as SVG.

python -m tools.docs.wiring_drawing [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

FILE = Path(__file__).resolve().parents[2] / "docs" / "img" / "wiring.svg"


class Box(NamedTuple):
    """A device: lower left corner, size, and its name."""

    x: float
    y: float
    width: float
    height: float
    name: str


class Wire(NamedTuple):
    """A wire along points, with what stands at its ends and on it."""

    points: tuple[tuple[float, float], ...]
    begin: str
    end: str
    style: Any = "-"
    width: float = 1.6


DASHED, DOTTED = (0, (5, 2)), (0, (1, 1.5))

BOXES = (
    Box(0.2, 3.2, 2.6, 2.6, "Pixhawk (PX4)"),
    Box(5.6, 3.2, 2.8, 2.6, "Raspberry Pi 4"),
    Box(5.6, 0.4, 2.8, 1.6, "Pololu Maestro"),
    Box(0.2, 0.4, 2.6, 1.6, "servo HS-322HD"),
    Box(9.6, 0.4, 2.2, 1.6, "5 V BEC, 3 A"),
    Box(9.6, 4.2, 2.2, 1.6, "5 V BEC, 3 A"),
)
SERIAL = (
    Wire(((2.8, 5.0), (5.6, 5.0)), "TELEM2 pin 2, TX", "pin 10, GPIO 15, RXD"),
    Wire(((2.8, 4.3), (5.6, 4.3)), "TELEM2 pin 3, RX", "pin 8, GPIO 14, TXD"),
    Wire(((2.8, 3.6), (5.6, 3.6)), "TELEM2 pin 6, GND", "pin 6, GND", "-", 2.8),
)
OTHERS = (
    Wire(((7.0, 3.2), (7.0, 2.0)), "USB", "", DASHED),
    Wire(((5.6, 1.5), (2.8, 1.5)), "channel 0: signal", ""),
    Wire(((5.6, 1.0), (2.8, 1.0)), "servo rail: +5 V", "", DASHED),
    Wire(((5.6, 0.6), (2.8, 0.6)), "ground", "", "-", 2.8),
    Wire(((9.6, 1.0), (8.4, 1.0)), "+5 V", "", DASHED),
    Wire(((9.6, 0.6), (8.4, 0.6)), "ground", "", "-", 2.8),
    Wire(((9.6, 5.0), (8.4, 5.0)), "USB-C", "", DASHED),
)


def draw(path: Path) -> None:
    """Write the drawing."""
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "dart-flight", "font.size": 9.0})
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    axis = figure.subplots()
    for box in BOXES:
        shape = FancyBboxPatch(
            (box.x, box.y), box.width, box.height, "round,pad=0.0,rounding_size=0.12", facecolor="#f2f2f2"
        )
        axis.add_patch(shape)
        axis.text(box.x + 0.5 * box.width, box.y + box.height - 0.28, box.name, ha="center", weight="bold")
    for wire in (*SERIAL, *OTHERS):
        xs, ys = zip(*wire.points, strict=True)
        axis.plot(xs, ys, color="black", linestyle=wire.style, linewidth=wire.width)
    for wire in SERIAL:
        (x0, y0), (x1, y1) = wire.points[0], wire.points[-1]
        axis.text(x0 - 0.1, y0, wire.begin, ha="right", va="center")
        axis.text(x1 + 0.1, y1, wire.end, ha="left", va="center")
    for wire in OTHERS:
        (x0, y0), (x1, y1) = wire.points[0], wire.points[-1]
        upright = x0 == x1
        place = (x0 + 0.12, 0.5 * (y0 + y1)) if upright else (0.5 * (x0 + x1), y0 + 0.08)
        axis.text(
            *place, wire.begin, ha="left" if upright else "center", va="center" if upright else "bottom"
        )
    notes = (
        "3.3 V signals; TELEM2 pin 1 (+5 V) stays open.",
        "The servo has a supply of its own. All grounds meet.",
    )
    for row, note in enumerate(notes):
        axis.text(0.2, -0.1 - 0.34 * row, note, va="top")
    axis.set(xlim=(0.0, 12.0), ylim=(-0.8, 6.0), aspect="equal")
    axis.axis("off")
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
