"""Placement of wall names, and of labels near their points, so that they cover neither texts nor lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import THICKNESS_M, DrawnWall, Label

_DIRECTIONS = 16
_REACHES_PT = (13.0, 21.0, 31.0, 43.0, 57.0, 75.0, 95.0)
_PER_LETTER, _LINE = 0.6, 1.25  # width of a letter and height of a line, in font sizes
_PAD_PT = 1.5


class _Box(NamedTuple):
    left: float
    low: float
    right: float
    high: float

    def overlap(self, other: _Box) -> float:
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.high, other.high) - max(self.low, other.low)
        return max(width, 0.0) * max(height, 0.0)

    def holds(self, points: Array) -> int:
        x, y = points[:, 0], points[:, 1]
        return int(((x > self.left) & (x < self.right) & (y > self.low) & (y < self.high)).sum())


def points_per_unit(axis: Any) -> float:
    """Return the scale of an axis with equal aspect in the current layout: typographic points per metre."""
    figure = axis.figure
    figure.get_layout_engine().execute(figure)
    axis.apply_aspect()
    width = axis.get_xlim()[1] - axis.get_xlim()[0]
    return float(axis.get_window_extent().width / width * 72.0 / figure.dpi)


def name_walls(
    axis: Any, walls: Sequence[DrawnWall], font_pt: float, lines: Sequence[Array] = ()
) -> list[Array]:
    """Write names and materials behind the visible parts of walls, or in front of thin partitions.

    A name is in the middle of the visible part, or at the nearest place where it covers none of the lines.

    Returns:
        The areas of the names, each [[low x, low y], [high x, high y]] in metres.
    """
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    unit = points_per_unit(axis)
    covered = []
    shunned = np.vstack([np.empty((0, 2)), *lines])
    for wall in walls:
        tangent, normal = np.array(wall.plane.tangent), np.array(wall.plane.normal)
        line, away = np.array(wall.surface.point) - THICKNESS_M * normal, -normal
        if wall.name_in_front:
            line, away = np.array(wall.plane.point), normal
        along = np.linspace(-0.5 * wall.plane.length_m, 0.5 * wall.plane.length_m, 201)
        place = line + along[:, None] * tangent + 0.75 * font_pt / unit * away
        visible = (place[:, 0] > x0) & (place[:, 0] < x1) & (place[:, 1] > y0) & (place[:, 1] < y1)
        if not visible.any():
            continue
        slope = math.degrees(math.atan2(tangent[1], tangent[0]))
        half = 0.5 * font_pt / unit * (np.abs(tangent) * 0.6 * len(wall.name) + np.abs(normal) * 1.2)
        middle = min(
            place[visible],
            key=lambda at: (
                int((np.abs(shunned - at) < half).all(axis=1).sum()),
                float(np.linalg.norm(at - place[visible].mean(axis=0))),
            ),
        )
        axis.annotate(
            wall.name, middle, ha="center", va="center", color="#333333", fontsize=font_pt,
            rotation=(slope + 90.0) % 180.0 - 90.0, rotation_mode="anchor",
        )  # fmt: skip
        covered.append(np.stack([middle - half, middle + half]))
    return covered


def place_labels(
    axis: Any, labels: Sequence[Label], lines: Iterable[Array], taken: Iterable[Array], font_pt: float
) -> None:
    """Write every label near its point, at the position with the lowest cost.

    If a label is far from its point, a thin line connects the two. The possible positions lie on several
    rings around the point. The cost of a position grows with the overlap with existing text, with the covered
    lines, and with the distance. Set the limits and the equal aspect of the axis before the call.

    Args:
        labels: labels, the most important first.
        lines: lines that should stay visible, each (n, 2) in data coordinates.
        taken: areas of other texts, each [[low x, low y], [high x, high y]] in data coordinates.
        font_pt: font size, points.
    """
    scale = points_per_unit(axis)
    x0, y0 = axis.get_xlim()[0], axis.get_ylim()[0]
    page = _Box(0.0, 0.0, (axis.get_xlim()[1] - x0) * scale, (axis.get_ylim()[1] - y0) * scale)

    def on_page(x: float, y: float) -> tuple[float, float]:
        return (x - x0) * scale, (y - y0) * scale

    covered = np.vstack([np.empty((0, 2)), *((line - (x0, y0)) * scale for line in lines)])
    anchors = [on_page(*label.at) for label in labels]
    written = [_Box(ax - 6.0, ay - 6.0, ax + 6.0, ay + 6.0) for ax, ay in anchors]
    written += [_Box(*on_page(*low), *on_page(*high)) for low, high in taken]
    for label, anchor in zip(labels, anchors, strict=True):
        rows = label.text.split("\n")
        half = (
            0.5 * _PER_LETTER * font_pt * max(map(len, rows)) + _PAD_PT,
            (0.5 * _LINE * font_pt * len(rows) + _PAD_PT),
        )
        best = min(
            _places(anchor, half, label.away), key=lambda place: _cost(place, half, page, written, covered)
        )
        written.append(_around(best[0], half))
        middle = (best[0][0] / scale + x0, best[0][1] / scale + y0)
        line = {"arrowstyle": "-", "color": "#888888", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0}
        axis.annotate(
            label.text, label.at, xytext=middle, ha="center", va="center", fontsize=font_pt,
            color=label.colour, arrowprops=line if best[1] > _REACHES_PT[1] else None, zorder=9,
            linespacing=1.1,
            bbox={"boxstyle": "square,pad=0.08", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip


def _places(
    anchor: tuple[float, float], half: tuple[float, float], away: tuple[float, float]
) -> Iterable[tuple[tuple[float, float], float, float]]:
    """Yield positions of a text around its point: centre, distance from the point to its edge, and cost."""
    for reach in _REACHES_PT:
        for i in range(_DIRECTIONS):
            angle = 2.0 * math.pi * i / _DIRECTIONS
            c, s = math.cos(angle), math.sin(angle)
            # Distance from the centre of the text to its edge in this direction.
            edge = min(half[0] / max(abs(c), 1e-9), half[1] / max(abs(s), 1e-9))
            reached = reach - _REACHES_PT[0] + 7.0 + edge
            wrong = 1.0 - (c * away[0] + s * away[1]) if away != (0.0, 0.0) else 0.0
            yield (
                (anchor[0] + reached * c, anchor[1] + reached * s),
                reach,
                0.8 * reach + 6.0 * wrong,
            )


def _around(middle: tuple[float, float], half: tuple[float, float]) -> _Box:
    return _Box(middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1])


def _cost(
    place: tuple[tuple[float, float], float, float],
    half: tuple[float, float],
    page: _Box,
    written: Sequence[_Box],
    covered: Array,
) -> float:
    box = _around(place[0], half)
    outside = 4.0 * half[0] * half[1] - box.overlap(page)
    common = sum(box.overlap(other) for other in written)
    return 3.0 * (common + outside) + 12.0 * box.holds(covered) + place[2]
