"""Drawing of a map (`lab/map_model.py`) from above and from the side, with the vehicle to scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.figure_style import (
    ESTIMATED,
    FORCE,
    GREY,
    GUARD,
    PREDICTED,
    REPLANNED,
    SET_POINT,
    TRUE,
    Look,
)
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import (
    THICKNESS_M,
    DrawnVehicle,
    DrawnWall,
    Line,
    MapKind,
    RoomMap,
    arms_m,
    circle,
    placed,
)
from dart_flight.lab.report.figures.labels import name_walls, place_labels

_WIDE_IN = 6.0  # minimum figure width for a legend with three columns
_NORTH_PT = 16.0  # length of the north arrow
_OUTSIDE_M = 0.6  # the view omits parts of walls that are farther outside of the bounds
_NAME_M = 0.15  # space for the name behind a wall
BELOW_M = 0.05  # margin of the side view below the ground
_EDGE_ON = 0.26  # sine of 15 degrees, the largest angle at which the side view shows a wall edge-on
_SAME_M = 0.12  # distance below which hits share a label in the side view
_DRAWS_SHUNNED = 8  # labels avoid the lines of only every eighth draw
_SOLID = {"facecolor": "#dcdcdc", "edgecolor": "#777777", "hatch": "////"}
_DRAWN = "#8db4e2"

_LINES: dict[MapKind, dict[str, Any]] = {
    MapKind.BOUNDS: {"color": GREY, "linewidth": 1.0, "linestyle": (0, (1, 2))},
    MapKind.WALL: {"color": "#222222", "linewidth": 1.8, "solid_capstyle": "butt", "zorder": 1.6},
    MapKind.PLANE: {"color": GREY, "linewidth": 0.7, "linestyle": (0, (4, 3)), "zorder": 1.6},
    MapKind.GROUND: {"color": "#222222", "linewidth": 1.4},
    MapKind.GOAL_ALTITUDE: {"color": GREY, "linewidth": 0.8, "linestyle": ":"},
    MapKind.CAPTURE: {"color": "#000000", "linewidth": 0.7},
    MapKind.DRAW: {"color": _DRAWN, "linewidth": 0.5, "alpha": 0.6, "zorder": 1.8},
    MapKind.PREDICTED: PREDICTED,
    MapKind.PLANNED: PREDICTED,
    MapKind.REPLANNED: REPLANNED,
    MapKind.PROBE: {"color": FORCE, "linewidth": 1.2, "linestyle": (0, (5, 3))},
    MapKind.TRUE: {**TRUE, "linewidth": 1.35},
    MapKind.ESTIMATED: {**ESTIMATED, "linewidth": 1.2},
    MapKind.ONE_OF_MANY: {**TRUE, "linewidth": 0.8, "alpha": 0.6},
    MapKind.RECOVERY: {
        "color": SET_POINT, "linewidth": 1.0, "linestyle": "--", "marker": "x", "markersize": 6,
        "markevery": [-1], "zorder": 4,
    },
    MapKind.TRUE_WALL: {"color": GREY, "linewidth": 3.0, "alpha": 0.5},
    MapKind.MEASURED_WALL: {"color": "#000000", "linewidth": 1.6},
    MapKind.BAND: {"color": _DRAWN, "alpha": 0.5, "linewidth": 0.0},
}  # fmt: skip
_SYMBOLS: dict[MapKind, dict[str, Any]] = {
    MapKind.WAYPOINT: {"marker": "s", "markersize": 5},
    # A ring remains visible around a waypoint, the goal or a run-up at the same place.
    MapKind.START: {"marker": "o", "markersize": 11, "markerfacecolor": "none", "zorder": 4.5},
    MapKind.GOAL: {"marker": "*", "markersize": 9},
    MapKind.RUN_UP: {"marker": "s", "markersize": 4, "markerfacecolor": "white", "zorder": 4},
    MapKind.HIT: {"marker": "o", "color": FORCE, "markersize": 2.5, "zorder": 5},
    MapKind.CONTACT: {"marker": ".", "color": FORCE, "markersize": 5, "zorder": 5},
    MapKind.SECOND: {
        "marker": "o", "markersize": 2.6, "markerfacecolor": "white", "markeredgewidth": 0.7, "zorder": 4,
    },
    MapKind.LABELLED_SECOND: {"marker": "o", "markersize": 3.2, "zorder": 4.5},
    MapKind.GUARD: {"marker": "D", "color": GUARD, "markersize": 6, "zorder": 6},
}  # fmt: skip
_ARMS: dict[Mode | None, dict[str, Any]] = {
    Mode.RIGID: {"linewidth": 2.4, "linestyle": "-"},
    Mode.FLEXIBLE: {"linewidth": 1.1, "linestyle": (0, (2, 1.5))},
    None: {"linewidth": 1.0, "linestyle": ":"},
}
# Kinds that the side view shows. The other kinds have no altitude of their own.
_PATHS_BESIDE = (MapKind.PREDICTED, MapKind.PROBE)
_PLACES_BESIDE = (MapKind.WAYPOINT, MapKind.GOAL)


def draw_map(axis: Any, shown: RoomMap) -> None:
    """Draw a map from above, without north, labels and names of walls."""
    (x0, x1), (y0, y1) = shown.bounds.x, shown.bounds.y
    _plot(axis, Line(MapKind.BOUNDS, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])))
    for wall in shown.walls:
        draw_wall(axis, wall)
    for post in shown.posts:
        outline = circle(post.centre, post.radius_m)
        axis.fill(*outline.T, linewidth=1.8, zorder=1.6, **{**_SOLID, "edgecolor": "#222222"})
    for area in shown.areas:
        axis.fill(*area.points.T, label=area.legend or area.kind, **_LINES[area.kind])
    for path in shown.paths:
        _plot(axis, path)
    for body in shown.bodies:
        draw_vehicle(axis, shown.airframe, body.at, body.yaw_rad, body.mode)
    for kind, begin, end in shown.arrows:
        if kind is MapKind.FORCE:
            draw_arrow(axis, begin, end, FORCE)
        else:
            colour = FORCE if kind is MapKind.PROBE else "#000000"
            draw_arrow(axis, begin, end, colour, linewidth=0.0, mutation_scale=10)
    if shown.newton_per_m:
        scale = f"{MapKind.FORCE}, 0.1 m: {0.1 * shown.newton_per_m:.0f} N"
        axis.plot([], [], color=FORCE, linewidth=1.6, marker=">", markersize=4, label=scale)
    _draw_places(axis, shown, list(_SYMBOLS))


def _plot(axis: Any, path: Line, along: tuple[int, int] = (0, 1)) -> None:
    axis.plot(*path.points[:, along].T, label=path.legend or path.kind, **_LINES[path.kind])


def _draw_places(axis: Any, shown: RoomMap, kinds: Sequence[MapKind], up: int = 1) -> None:
    """Draw the symbols of these kinds in x and in the coordinate `up`, which is 1 for y and 2 for z."""
    for kind, at, legend in shown.places:
        if kind in kinds:
            style = {"color": "#000000", "linestyle": "none", **_SYMBOLS[kind]}
            axis.plot(at[0], at[up], label=legend or kind, **style)


def draw_wall(axis: Any, wall: DrawnWall) -> None:
    """Draw a wall, and a thin line through the positions of the vehicle's centre at the first touch."""
    axis.fill(*wall.outline.T, linewidth=0.0, zorder=1.5, **_SOLID)
    _plot(axis, Line(MapKind.WALL, wall.outline[:2]))
    _plot(axis, Line(MapKind.PLANE, np.array(wall.plane.ends)))


def draw_side(axis: Any, shown: RoomMap, top_m: float) -> None:
    """Draw a map as seen along y, up to an altitude.

    A wall that the view shows edge-on is hatched. Other walls are plain, because the vehicle flies in front
    of them.
    """
    axis.set(ylim=(-BELOW_M, top_m), aspect="equal")
    for wall in shown.walls:
        ends = wall.outline[:, 0]
        seen_from_side = abs(wall.surface.normal[1]) < _EDGE_ON
        style = _SOLID if seen_from_side else {"facecolor": "#f1f1f1"}
        zorder = 1.2 if seen_from_side else 1.0
        axis.fill_between([ends.min(), ends.max()], 0.0, top_m, linewidth=0.0, zorder=zorder, **style)
    axis.axhline(0.0, label=MapKind.GROUND, **_LINES[MapKind.GROUND])
    for z in shown.bounds.z:
        axis.axhline(z, label=MapKind.BOUNDS, **_LINES[MapKind.BOUNDS])
    for path in shown.paths:
        if path.kind in _PATHS_BESIDE:
            _plot(axis, path, (0, 2))
    out = shown.airframe.contact_distance_m
    for (x, z), numbers in _side_by_side(shown.bodies):
        axis.plot([x - out, x + out], [z, z], color="#000000", linewidth=2.5, label="vehicle, from the side")
        axis.annotate(numbers, (x, z), (0, 7), textcoords="offset points", ha="center", color=FORCE)
    _draw_places(axis, shown, _PLACES_BESIDE, up=2)
    for place in shown.places:
        if place.kind is MapKind.GOAL:
            x, z = place.at[0], place.at[-1]
            _plot(axis, Line(MapKind.GOAL_ALTITUDE, np.array([[x, 0.0], [x, z]])))


def _side_by_side(bodies: Sequence[DrawnVehicle]) -> list[tuple[Vec2, str]]:
    """Return the position (x, z) and the number of each hit.

    Hits that are close together at the same altitude share one position.
    """
    found: list[tuple[Vec2, str]] = []
    for body in sorted(bodies, key=lambda body: body.at[0]):
        x, z, number = body.at[0], body.at[-1], body.number
        if found and x - found[-1][0][0] < _SAME_M and z == found[-1][0][1]:
            found[-1] = (found[-1][0], f"{found[-1][1]}, {number}")
        else:
            found.append(((x, z), str(number)))
    return found


# --- parts -------------------------------------------------------------------------------------------------


def draw_vehicle(axis: Any, airframe: Airframe, at: Vec2 | Vec3, yaw_rad: float, mode: Mode | None) -> None:
    """Draw the vehicle from above, at `at` and `yaw_rad` in the mission frame.

    Rigid arms are thick and solid, flexible arms thin and dashed, and arms in an unknown state (None) dotted.
    """
    colour = "#777777" if mode is None else "#000000"
    for guard in airframe.guards_m:
        outline = placed([*guard, guard[0]], at, yaw_rad)
        axis.fill(*outline.T, facecolor="white", edgecolor=colour, linewidth=0.9, alpha=0.55, zorder=3.0)
        axis.plot(*outline.T, color=colour, linewidth=0.9, zorder=3.1)
    legend = "vehicle" if mode is None else f"vehicle, {mode.value}"
    for arm in arms_m(airframe):
        ends = placed(list(arm), at, yaw_rad)
        axis.plot(
            *ends.T, color=colour, zorder=3.2, solid_capstyle="butt", label=legend, **_ARMS[mode]
        )  # fmt: skip
        axis.plot(
            *ends[1], "o", color=colour, markersize=3.0, zorder=3.3,
            markerfacecolor=colour if mode is Mode.RIGID else "white", markeredgewidth=0.8,
        )  # fmt: skip
    front = placed([(0.8 * airframe.contact_distance_m, 0.0)], at, yaw_rad)[0]
    axis.plot(*front, marker=(3, 0, math.degrees(yaw_rad) - 90.0), color=colour, markersize=4.0, zorder=3.3)


def draw_arrow(axis: Any, begin: Array | Vec2, end: Array | Vec2, colour: str, **style: Any) -> None:
    axis.annotate(
        "", end, begin, zorder=5,
        arrowprops={"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.6,
                    "mutation_scale": 9, **style},
    )  # fmt: skip


def _draw_north(axis: Any, north_rad: float) -> None:
    from matplotlib.offsetbox import AnchoredOffsetbox, DrawingArea, TextArea, VPacker  # noqa: PLC0415  (slow)
    from matplotlib.patches import FancyArrow  # noqa: PLC0415

    size = _NORTH_PT
    area = DrawingArea(size, size)
    x, y = 0.9 * size * math.cos(north_rad), 0.9 * size * math.sin(north_rad)
    area.add_artist(
        FancyArrow(
            0.5 * (size - x), 0.5 * (size - y), x, y, length_includes_head=True, width=0.8, head_width=5.0,
            head_length=6.0, color="#000000",
        )
    )  # fmt: skip
    north = VPacker(children=[TextArea("N"), area], pad=0.0, sep=1.0, align="center")
    axis.add_artist(
        AnchoredOffsetbox(
            "lower right", child=north, pad=0.1, frameon=False, bbox_to_anchor=(1.0, 1.0),
            bbox_transform=axis.transAxes,
        )
    )  # fmt: skip


# --- view and layout ---------------------------------------------------------------------------------------


def view_of(shown: RoomMap, points: Array, margin_m: float = 0.45) -> Array:
    """Return the limits of a view that contains the points (n, 2 or 3) and a margin around them.

    The limits are [[low x, low y], [high x, high y]], metres. The view includes the nearest part of every
    wall and post if that part is within the bounds. The view does not extend beyond the room, which consists
    of the bounds and the walls with their names.
    """
    (x0, x1), (y0, y1) = shown.bounds.x, shown.bounds.y
    surfaces = [along(np.array(wall.surface.ends)) for wall in shown.walls]
    posts = [circle(post.centre, post.radius_m) for post in shown.posts]
    names = [np.array(wall.surface.displaced(-THICKNESS_M - _NAME_M).ends) for wall in shown.walls]
    corners = np.vstack([[[x0, y0], [x1, y1]], *names, *posts])
    inside = points[np.isfinite(points).all(axis=1), :2]
    inside = np.vstack([inside, *(_nearest_part(shown, surface, inside) for surface in (*surfaces, *posts))])
    low = np.maximum(inside.min(axis=0) - margin_m, corners.min(axis=0) - 0.05)
    high = np.minimum(inside.max(axis=0) + margin_m, corners.max(axis=0) + 0.05)
    # Widen a narrow view around its centre.
    least = 0.5 * (high - low).max()
    middle, size = 0.5 * (low + high), np.maximum(high - low, least)
    return np.stack([middle - 0.5 * size, middle + 0.5 * size])


def _nearest_part(shown: RoomMap, surface: Array, points: Array) -> Array:
    """Return the points of a surface that are nearest to the box around the points (n, 2).

    If this part is outside of the bounds, the result is empty.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    away = np.linalg.norm(np.maximum(0.0, np.maximum(low - surface, surface - high)), axis=1)
    part = surface[away <= away.min() + 1e-6]
    within = [shown.bounds.excess2((float(x), float(y))) <= _OUTSIDE_M for x, y in part]
    return np.asarray(part[np.array(within)])


def set_view(axis: Any, view: Array) -> None:
    (x0, y0), (x1, y1) = view
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")


def along(line: Array, step_m: float = 0.03) -> Array:
    """Return points every few centimetres on a polyline, seen from above (n, 2)."""
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    at = np.arange(0.0, distance[-1] + step_m, step_m)
    return np.stack([np.interp(at, distance, line[:, i]) for i in (0, 1)], axis=1)


def finish_map(
    figure: Any, plan: Any, shown: RoomMap, look: Look, *, below: Any = None, note: str = ""
) -> None:
    """Finish a map whose view is set: add the north arrow, axes, legend, names of walls and labels.

    Args:
        figure: a figure with constrained layout.
        plan: the view from above.
        below: the view from the side, with the same width.
        note: lines of text above the legend.
    """
    _draw_north(plan, shown.north_rad)
    (below or plan).set_xlabel("x, m")
    plan.set_ylabel("y, m")
    for axis in (plan, below) if below is not None else (plan,):
        axis.grid(visible=False)
    _fit(figure, plan, below, note)
    lines = lines_of(shown)
    place_labels(
        plan, shown.labels, lines, name_walls(plan, shown.walls, look.small_pt, lines), look.small_pt
    )


def lines_of(shown: RoomMap) -> list[Array]:
    """Return the lines that labels should not cover, each (n, 2) in metres."""
    (x0, x1), (y0, y1) = shown.bounds.x, shown.bounds.y
    found = [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])]
    for wall in shown.walls:
        found += [np.array(wall.plane.ends)]
        found += [np.array(wall.surface.displaced(-s * wall.thickness_m).ends) for s in (0.0, 0.5, 1.0)]
    found += [circle(post.centre, post.radius_m) for post in shown.posts]
    found += [path.points for path in shown.paths if path.kind is not MapKind.DRAW]
    found += [path.points for path in shown.paths if path.kind is MapKind.DRAW][::_DRAWS_SHUNNED]
    for body in shown.bodies:
        at = np.array(body.at[:2])
        for guard in shown.airframe.guards_m:
            outline = placed(guard, body.at, body.yaw_rad)
            found += [at + share * (outline - at) for share in (1.0, 0.7, 0.4)]
    found += [np.array([arrow.begin, arrow.end]) for arrow in shown.arrows]
    return [along(line) for line in found]


def _fit(figure: Any, plan: Any, below: Any, note: str) -> None:
    """Set the figure's height from the views' aspect, and put the legend in columns under the views."""
    views = (plan, below) if below is not None else (plan,)
    unique = {
        label: line for view in views for line, label in zip(*view.get_legend_handles_labels(), strict=True)
    }
    width = figure.get_size_inches()[0]
    columns = 2 if width < _WIDE_IN else 3
    rows = -(-len(unique) // columns) + (note.count("\n") + 2 if note else 0)
    letter = float(plan.xaxis.label.get_size()) / 72.0
    height = 0.55 + 1.35 * letter * rows
    for view in views:
        (x0, x1), (y0, y1) = plan.get_xlim(), view.get_ylim()
        height += (width - 0.6) * (y1 - y0) / (x1 - x0) + (0.25 if view is below else 0.0)
    figure.set_size_inches(width, height)
    legend = figure.legend(
        unique.values(), unique.keys(), loc="outside lower left", ncols=columns, borderaxespad=0.1,
        columnspacing=1.2, handlelength=2.2, labelspacing=0.3, alignment="left",
        title=note or None, title_fontsize=72.0 * letter,
    )  # fmt: skip
    legend.get_title().set_multialignment("left")
