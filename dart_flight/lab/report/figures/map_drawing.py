"""The elements of every map: walls, bounds, start, goal, and the vehicle drawn to scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Airframe
from dart_flight.lab.figure_style import FORCE, GREY, SET_POINT
from dart_flight.lab.flight_arrays import Array

_WIDE_IN = 6.0  # figure width from which a legend has three columns
LONGEST_ARROW_M = 0.45  # length for the largest force
_HUB_SHARE = 0.45  # inner end of the drawn arms, as a fraction of the distance to the motor
_NORTH_PT = 16.0  # length of the north arrow
_OPPOSED, _SAME_PLANE_M = -0.9, 0.01  # cosine between opposite normals; distance of faces in one plane
_OUTSIDE_M = 0.6  # distance outside of the bounds at which a wall may still be hit
_BACK_TO_BACK_M = 0.4  # distance of two faces below which a name goes in front, not behind
THICKNESS_M = 0.12  # drawn thickness of a wall; the true one is unknown


def draw_room(axis: Any, mission: Mission) -> None:
    (x0, x1), (y0, y1) = mission.bounds.x, mission.bounds.y
    axis.plot(
        [x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="#666666", linewidth=1.0, linestyle=(0, (1, 2)),
        label="bounds_m",
    )  # fmt: skip
    for wall in mission.flat_walls:
        draw_wall(axis, wall, mission.vehicle.airframe, drawn_thickness_m(mission, wall))
    around = np.linspace(0.0, 2.0 * math.pi, 49)
    for post in mission.posts:
        (cx, cy), r = post.centre, post.radius_m
        axis.fill(
            cx + r * np.cos(around), cy + r * np.sin(around), facecolor="#dcdcdc", edgecolor="#222222",
            hatch="////", linewidth=1.8, zorder=1.6,
        )  # fmt: skip
    for waypoint in mission.waypoints:
        if waypoint.position is not None:
            x, y, _ = waypoint.position
            axis.plot(x, y, "s", color="black", markersize=5, label="waypoint", linestyle="none")
    # A ring remains visible around a waypoint, the goal or a run-up at the same place.
    axis.plot(
        *mission.start, "o", color="black", markersize=11, markerfacecolor="none", label="start",
        linestyle="none", zorder=4.5,
    )  # fmt: skip
    radius = mission.goal.capture_radius_m
    angle = np.linspace(0.0, 2.0 * math.pi, 49)
    goal = mission.goal.position_m
    axis.plot(
        goal[0] + radius * np.cos(angle), goal[1] + radius * np.sin(angle), color="black", linewidth=0.7
    )
    axis.plot(*goal, "*", color="black", markersize=9, label="goal", linestyle="none")


def draw_north(axis: Any, mission: Mission) -> None:
    from matplotlib.offsetbox import AnchoredOffsetbox, DrawingArea, TextArea, VPacker  # noqa: PLC0415  (slow)
    from matplotlib.patches import FancyArrow  # noqa: PLC0415

    heading, size = math.radians(mission.frame.heading_deg), _NORTH_PT
    area = DrawingArea(size, size)
    x, y = 0.9 * size * math.cos(heading), 0.9 * size * math.sin(heading)
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


def room_lines(mission: Mission) -> list[Array]:
    """Return the lines of `draw_room` that labels should not cover, each (n, 2) in metres."""
    (x0, x1), (y0, y1) = mission.bounds.x, mission.bounds.y
    found = [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])]
    for wall in mission.flat_walls:
        surface = mission.vehicle.airframe.wall_surface(wall)
        back_m = drawn_thickness_m(mission, wall)
        found += [np.array(wall.ends), *(
            np.array(surface.displaced(-share * back_m).ends) for share in (0.0, 0.5, 1.0)
        )]  # fmt: skip
    angle = np.linspace(0.0, 2.0 * math.pi, 25)
    circles = [(mission.goal.position_m, mission.goal.capture_radius_m)]
    circles += [(post.centre, post.radius_m) for post in mission.posts]
    found += [np.array(at) + r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for at, r in circles]
    return [along(line) for line in found]


def draw_wall(axis: Any, wall: Wall, airframe: Airframe, thickness_m: float = THICKNESS_M) -> None:
    """Draw a wall, and a thin line through the positions of the vehicle's centre at the first touch."""
    plane, surface = np.array(wall.ends), np.array(airframe.wall_surface(wall).ends)
    back = surface - thickness_m * np.array(wall.normal)
    axis.fill(
        *np.vstack([surface, back[::-1]]).T, facecolor="#dcdcdc", edgecolor="#777777", hatch="////",
        linewidth=0.0, zorder=1.5,
    )  # fmt: skip
    axis.plot(*surface.T, color="#222222", linewidth=1.8, solid_capstyle="butt", zorder=1.6)
    axis.plot(*plane.T, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), zorder=1.6)


def _gap_behind_m(mission: Mission, wall: Wall) -> float:
    """Return the distance from a wall's surface to the nearest opposite surface behind it, or infinity."""
    surface_of = mission.vehicle.airframe.wall_surface
    own, gaps = surface_of(wall), [math.inf]
    for other in mission.flat_walls:
        face = surface_of(other)
        opposed = own.normal[0] * face.normal[0] + own.normal[1] * face.normal[1] < _OPPOSED
        # Surfaces that do not overlap along the wall are not back to back.
        beside_m = abs(own.along(face.point)) - 0.5 * (own.length_m + face.length_m)
        if opposed and beside_m < 0.0:
            gap_m = -own.signed_distance(face.point)
            gaps += [gap_m] if gap_m > -_SAME_PLANE_M else []
    return max(0.0, min(gaps))


def drawn_thickness_m(mission: Mission, wall: Wall) -> float:
    """Return the thickness with which to draw a wall: at most half of a partition, if it is a face of one."""
    return min(THICKNESS_M, 0.5 * _gap_behind_m(mission, wall))


def name_walls(axis: Any, mission: Mission, font_pt: float, lines: Sequence[Array] = ()) -> list[Array]:
    """Write names and materials behind the visible parts of walls, or in front of thin partitions.

    A name is in the middle of the visible part, or at the nearest place where it covers none of the lines.

    Returns:
        The areas of the names, each [[low x, low y], [high x, high y]] in metres.
    """
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    unit = points_per_unit(axis)
    covered = []
    for wall in mission.walls:
        tangent, normal = np.array(wall.tangent), np.array(wall.normal)
        line, away = (
            np.array(mission.vehicle.airframe.wall_surface(wall).point) - THICKNESS_M * normal,
            -normal,
        )
        if _gap_behind_m(mission, wall) < _BACK_TO_BACK_M:
            line, away = np.array(wall.point), normal
        along = np.linspace(-0.5 * wall.length_m, 0.5 * wall.length_m, 201)
        place = line + along[:, None] * tangent + 0.75 * font_pt / unit * away
        visible = (place[:, 0] > x0) & (place[:, 0] < x1) & (place[:, 1] > y0) & (place[:, 1] < y1)
        if not visible.any():
            continue
        slope = math.degrees(math.atan2(tangent[1], tangent[0]))
        text = wall.name if wall.name == wall.material else f"{wall.name} ({wall.material})"
        half = 0.5 * font_pt / unit * (np.abs(tangent) * 0.6 * len(text) + np.abs(normal) * 1.2)
        shunned = np.vstack([np.empty((0, 2)), *lines])
        middle = min(
            place[visible],
            key=lambda at: (
                int((np.abs(shunned - at) < half).all(axis=1).sum()),
                float(np.linalg.norm(at - place[visible].mean(axis=0))),
            ),
        )
        axis.annotate(
            text, middle, ha="center", va="center", color="#333333", fontsize=font_pt,
            rotation=(slope + 90.0) % 180.0 - 90.0, rotation_mode="anchor",
        )  # fmt: skip
        covered.append(np.stack([middle - half, middle + half]))
    return covered


def set_view(axis: Any, view: Array) -> None:
    (x0, y0), (x1, y1) = view
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")


def view_of(mission: Mission, points: Array, margin_m: float = 0.45) -> Array:
    """Return the limits of a view that contains the points (n, 2) and a margin around them.

    The limits are [[low x, low y], [high x, high y]], metres. The view includes the nearest part of every
    wall, unless that part is outside of the bounds. The view does not extend beyond the room, which consists
    of the bounds and the walls with their names.
    """
    (x0, x1), (y0, y1) = mission.bounds.x, mission.bounds.y
    room = [np.array([[x0, y0], [x1, y1]])]
    for wall in mission.walls:
        surface = np.array(mission.vehicle.airframe.wall_surface(wall).ends)
        room.append(surface - (THICKNESS_M + 0.15) * np.array(wall.normal))
    corners = np.vstack(room)
    inside = points[np.isfinite(points).all(axis=1)]
    inside = np.vstack([inside, *(_nearest_part(mission, wall, inside) for wall in mission.walls)])
    low = np.maximum(inside.min(axis=0) - margin_m, corners.min(axis=0) - 0.05)
    high = np.minimum(inside.max(axis=0) + margin_m, corners.max(axis=0) + 0.05)
    # Widen a narrow view around its centre.
    least = 0.5 * (high - low).max()
    middle, size = 0.5 * (low + high), np.maximum(high - low, least)
    return np.stack([middle - 0.5 * size, middle + 0.5 * size])


def _nearest_part(mission: Mission, wall: Wall, points: Array) -> Array:
    """Return the part of a wall's surface that is nearest to the box around the points (n, 2).

    If this part is outside of the mission's bounds, the result is empty.
    """
    ends = np.array(mission.vehicle.airframe.wall_surface(wall).ends)
    line = ends[0] + np.linspace(0.0, 1.0, 101)[:, None] * (ends[1] - ends[0])
    low, high = points.min(axis=0), points.max(axis=0)
    away = np.linalg.norm(np.maximum(0.0, np.maximum(low - line, line - high)), axis=1)
    part = line[away <= away.min() + 1e-6]
    within = [mission.bounds.excess2((float(x), float(y))) <= _OUTSIDE_M for x, y in part]
    return np.asarray(part[np.array(within)])


def points_per_unit(axis: Any) -> float:
    """Return the scale of an axis with equal aspect in the current layout: typographic points per metre."""
    figure = axis.figure
    figure.get_layout_engine().execute(figure)
    axis.apply_aspect()
    width = axis.get_xlim()[1] - axis.get_xlim()[0]
    return float(axis.get_window_extent().width / width * 72.0 / figure.dpi)


def placed(points: list[Vec2], at: Vec2, yaw_rad: float) -> Array:
    """Convert points from body axes (forward, left) to the mission frame, (n, 2)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([(at[0] + c * x - s * y, at[1] + s * x + c * y) for x, y in points])


def arms_m(airframe: Airframe) -> list[tuple[Vec2, Vec2]]:
    """Return each arm from the frame to its motor (forward, left), m."""
    return [
        ((_HUB_SHARE * motor.x_m, -_HUB_SHARE * motor.y_m), (motor.x_m, -motor.y_m))
        for motor in airframe.motors
    ]


def draw_vehicle(
    axis: Any, airframe: Airframe, at: Vec2, yaw_rad: float, mode: Mode | None, colour: str = "#000000"
) -> None:
    """Draw the vehicle from above, at `at` and `yaw_rad` in the mission frame.

    Rigid arms are thick and solid, flexible arms thin and dashed, and arms in an unknown state (None) dotted.
    """
    outline = placed(airframe.outline_m, at, yaw_rad)
    axis.fill(*outline.T, facecolor="white", edgecolor=colour, linewidth=0.9, alpha=0.55, zorder=3.0)
    axis.plot(*np.vstack([outline, outline[:1]]).T, color=colour, linewidth=0.9, zorder=3.1)
    style: dict[str, Any] = {
        Mode.RIGID: {"linewidth": 2.4, "linestyle": "-"},
        Mode.FLEXIBLE: {"linewidth": 1.1, "linestyle": (0, (2, 1.5))},
    }.get(mode, {"linewidth": 1.0, "linestyle": ":"})  # type: ignore[arg-type]
    for arm in arms_m(airframe):
        ends = placed(list(arm), at, yaw_rad)
        axis.plot(*ends.T, color=colour, zorder=3.2, solid_capstyle="butt", **style)
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


def draw_hit(
    axis: Any, airframe: Airframe, at: Vec2, yaw_rad: float, mode: Mode | None, set_point: Vec2 | None
) -> list[Array]:
    """Draw the vehicle at its hit, and a line to the recovery setpoint.

    Returns:
        The lines (n, 2) that labels should not cover.
    """
    draw_vehicle(axis, airframe, at, yaw_rad, mode)
    outline = placed(airframe.outline_m, at, yaw_rad)
    lines = [along(at + share * (outline - at)) for share in (1.0, 0.7, 0.4)]
    if set_point is not None:
        line = np.array([at, set_point])
        axis.plot(*line.T, "--", color=SET_POINT, linewidth=1.0, zorder=4)
        axis.plot(*set_point, "x", color=SET_POINT, markersize=6, zorder=5)
        lines.append(along(line))
    return lines


def name_hits(axis: Any, largest_n: float) -> None:
    """Add two legend entries: the force arrows with their scale, and the recovery setpoints."""
    words = f"peak force, 0.1 m: {0.1 * largest_n / LONGEST_ARROW_M:.0f} N"
    axis.plot([], [], color=FORCE, linewidth=1.6, marker=">", markersize=4, label=words)
    axis.plot([], [], "x--", color=SET_POINT, linewidth=1.0, markersize=5, label="recovery setpoint")


def along(line: Array, step_m: float = 0.03) -> Array:
    """Return points every few centimetres on a polyline (n, 2)."""
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.arange(0.0, distance[-1] + step_m, step_m)
    return np.stack([np.interp(at, distance, line[:, i]) for i in (0, 1)], axis=1)


def fit_map(figure: Any, axis: Any, *, below: Any = None, note: str = "") -> None:
    """Set the figure's height from the map's aspect, and put the legend in columns under the map.

    Args:
        figure: a figure with constrained layout.
        below: another view under the map, with an equal aspect and the map's width.
        note: lines of text under the legend.
    """
    unique = {label: line for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    width = figure.get_size_inches()[0]
    columns = 2 if width < _WIDE_IN else 3
    rows = -(-len(unique) // columns) + (note.count("\n") + 2 if note else 0)
    letter = float(axis.xaxis.label.get_size()) / 72.0
    height = 0.55 + 1.35 * letter * rows
    for view in (axis, below) if below is not None else (axis,):
        (x0, x1), (y0, y1) = axis.get_xlim(), view.get_ylim()
        height += (width - 0.6) * (y1 - y0) / (x1 - x0) + (0.25 if view is below else 0.0)
    figure.set_size_inches(width, height)
    legend = figure.legend(
        unique.values(), unique.keys(), loc="outside lower left", ncols=columns, borderaxespad=0.1,
        columnspacing=1.2, handlelength=2.2, labelspacing=0.3, alignment="left",
        title=note or None, title_fontsize=72.0 * letter,
    )  # fmt: skip
    legend.get_title().set_multialignment("left")
