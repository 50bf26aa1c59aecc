"""The figure of a mission before the flight: its path, and the effect of uncertain walls."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import AfterImpact
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import transit_segments
from dart_flight.core.mission.planned_impact import describe_force
from dart_flight.lab.figure_style import (
    FORCE,
    GREY,
    PREDICTED,
    Look,
    in_style,
    new_figure,
    save_figure,
)
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.report.figures.labels import Label, place_labels
from dart_flight.lab.report.figures.map_drawing import (
    LONGEST_ARROW_M,
    along,
    draw_arrow,
    draw_hit,
    draw_north,
    draw_room,
    drawn_thickness_m,
    fit_map,
    name_hits,
    name_walls,
    room_lines,
    set_view,
    view_of,
)
from dart_flight.lab.search.drawn import predict_with_draws
from dart_flight.planning.envelope import impact_yaw, incidence_deg
from dart_flight.planning.predicted_flight import PredictedFlight, describe_goal_miss, predicted_segments

SHEET = Look(7.2, 9.0)
_NOTE_WIDTH = 96  # characters below the picture
_ABOVE_M, _BELOW_M = 0.35, 0.05  # margins of the side view above the flight and below the ground
_SAME_M = 0.12  # distance below which hits share a label in the side view
_DRAWN = "#8db4e2"
_DRAWS_SHUNNED = 8  # labels avoid every eighth draw, which stand for all of them
_ROOM_M, _ROOM_SHARE = 12.0, 2.5  # larger bounds are shown whole only around a flight of a similar size
_EDGE_ON = 0.26  # sine of 15 degrees, the largest angle of a wall in side view


@in_style
def mission_figure(mission: Mission, planned: PredictedFlight | None, *, look: Look = SHEET) -> Any:
    """Draw plan view and side view of a mission, with the effect of uncertain walls on the prediction.

    Without a prediction (`planned`), as for an approach that cannot be flown, only the room is drawn.
    """
    # Trajectories end at their goal in every draw, but uncertain walls still move.
    varies = mission.goal_trajectory is None or any(wall.is_uncertain for wall in mission.walls)
    drawn = predict_with_draws(mission) if planned is not None and planned.hits and varies else []
    view = view_of(mission, _extent(mission, planned))
    highest = max(mission.altitude_m, *(leg.end[2] for leg in transit_segments(mission)), 0.0)
    top = min(mission.bounds.z[1], highest + _ABOVE_M) + 0.05
    ratios = [view[1, 1] - view[0, 1], top + _BELOW_M]
    figure, (plan, side) = new_figure(look, 6.0, 2, 1, sharex=True, height_ratios=ratios)
    set_view(plan, view)
    side.set(ylim=(-_BELOW_M, top), aspect="equal")
    draw_room(plan, mission)
    probes = _draw_probes(plan, mission)
    _draw_draws(plan, mission, drawn)
    labels: list[Label] = []
    lines: list[Array] = []
    if planned is not None:
        _draw_trajectory(plan, mission, planned)
        labels, lines = _draw_hits(plan, mission, planned)
    _draw_side(side, mission, planned, top)
    for axis in (plan, side):
        axis.grid(visible=False)
    plan.set_ylabel("y, m")
    side.set(xlabel="x, m", ylabel="z, m")
    draw_north(plan, mission)
    plan.set_title(mission.name, fontsize=look.font_pt + 1.0, loc="left")
    words = "\n".join(textwrap.fill(line, _NOTE_WIDTH) for line in prediction_lines(mission, planned, drawn))
    fit_map(figure, plan, below=side, note=words)
    labels += [label for label, _ in probes if planned is None]
    lines += [along(path) for _, path in probes]
    labels += [Label(text, place, (1.0, 1.0), "#000000") for text, place in _stops(mission)]
    lines += room_lines(mission)
    lines += [along(leg[:, :2]) for flight in drawn[::_DRAWS_SHUNNED] for leg in flight.legs.values()]
    if planned is not None:
        lines += [along(np.array(line)) for line in planned.approaches.values()]
        lines += [along(leg[:, :2]) for leg in _legs(mission, planned).values()]
        lines += [along(path[:, :2]) for path in _from_rest(mission, planned)]
    names = name_walls(plan, mission, look.small_pt, lines)
    place_labels(plan, labels, lines, names, look.small_pt)
    return figure


def prediction_lines(
    mission: Mission, planned: PredictedFlight | None, drawn: Sequence[PredictedFlight]
) -> list[str]:
    """Return sentences on the predicted miss of the goal and on the effect of uncertain walls."""
    if any(c.wall.sought for c in mission.collisions):
        return ["The path after a probe depends on the place where the probe hits its wall."]
    if planned is None:
        return ["An approach cannot be flown; run `check` for the reason."]
    if mission.standoff_m is not None:
        return [f"Rehearsal: the vehicle stops {mission.standoff_m:g} m before each wall."]
    lines = []
    missing = [c for c in mission.collisions if c.index not in planned.hits]
    if missing:
        lines.append(
            f"In the flight model, collision {missing[0].index} does not reach wall {missing[0].wall.name}."
        )
    if planned.goal_miss_m is not None:
        words = describe_goal_miss(
            planned.goal_miss_m, mission.goal, mission.after_impact, mission.goal_trajectory is not None
        )
        lines.append(f"{words[0].upper()}{words[1:]}.")
    misses = [flight.goal_miss_m for flight in drawn if flight.goal_miss_m is not None]
    if mission.goal_trajectory is not None:
        # A planned trajectory ends at the goal in every draw; only flights deviate.
        lines.append(_flown_line(mission))
    elif misses:
        low, high = np.quantile(misses, (0.05, 0.95))
        spread = mission.vehicle.estimation.walls.spread
        uncertain = [wall.name for wall in mission.walls if wall.is_uncertain]
        if uncertain:
            lines.append(f"The positions of {' and '.join(uncertain)} are varied within their uncertainty.")
        lines.append(
            f"If k, f and mu of the walls vary by ± {100 * spread:.0f} %, the vehicle misses the goal by "
            f"{low:.2f} to {high:.2f} m in nine of ten draws"
            + (
                f"; in {len(drawn) - len(misses)} of {len(drawn)} draws, it does not reach the goal."
                if len(misses) < len(drawn)
                else "."
            )
        )
    return lines


def _flown_line(mission: Mission) -> str:
    record = mission.flown
    if record is None or record.digest != mission.digest:
        return (
            "This mission has not been flown in simulation as written; its trajectories may not be flyable."
        )
    return f"Flown in simulation: {record.summary}."


def _extent(mission: Mission, planned: PredictedFlight | None) -> Array:
    """Return the points that the plan view must include, without setpoints outside of the bounds.

    The view includes the bounds, unless the flight would become small in it.
    """
    b = mission.bounds
    corners = np.array([[b.x[0], b.y[0]], [b.x[1], b.y[1]]])
    points = [np.array([mission.start, mission.goal.position_m])]
    if planned is None:
        return corners
    points += [np.array(line) for line in planned.approaches.values()]
    points += [path[:, :2] for path in _from_rest(mission, planned)]
    points += [leg[:, :2] for leg in _legs(mission, planned).values()]
    points += [np.array([hit.position]) for hit in planned.hits.values()]
    points += [
        np.array([hit.setpoint])
        for hit in planned.hits.values()
        if mission.bounds.excess2(hit.setpoint) <= 0.0
    ]
    flown = np.vstack(points)
    size = (flown.max(axis=0) - flown.min(axis=0)).max()
    shown = (corners[1] - corners[0]).max() <= max(_ROOM_M, _ROOM_SHARE * size)
    return np.vstack([flown, corners]) if shown else flown


def _draw_probes(axis: Any, mission: Mission) -> list[tuple[Label, Array]]:
    found = []
    for collision in mission.collisions:
        if collision.probe is None:
            continue
        path = np.array([collision.probe.begin, collision.probe.end])
        axis.plot(path[:, 0], path[:, 1], color=FORCE, linewidth=1.2, linestyle=(0, (5, 3)), label="probe")
        draw_arrow(axis, path[1] - 0.06 * (path[1] - path[0]), path[1], FORCE, linewidth=0.0)
        (dx, dy), middle = path[1] - path[0], path[0] + 0.6 * (path[1] - path[0])
        across = (-dy / math.hypot(dx, dy), dx / math.hypot(dx, dy))
        text = f"{collision.index} probe for {collision.wall.name}\n{collision.probe.speed_m_s:g} m/s"
        found.append((Label(text, (float(middle[0]), float(middle[1])), across, FORCE), path))
    return found


def _from_rest(mission: Mission, planned: PredictedFlight) -> list[Array]:
    """Return the two ends (2, 3), m, of each straight segment from rest to rest, also after recoveries.

    A recovery that ends at rest leads straight from the hit to the setpoint. With `after_impact: replan`, the
    last recovery leads to the goal instead of the setpoint.
    """
    segments = predicted_segments(mission, planned.hits)
    found = [np.array([segment.begin or segment.end, segment.end]) for segment in segments]
    for index, hit in planned.hits.items():
        if index not in _legs(mission, planned) and mission.standoff_m is None:
            z, to_goal = mission.altitude_at(index - 1), index == _replanned_to_goal(mission)
            ends = mission.goal.position_m if to_goal else hit.setpoint
            found.append(np.array([(*hit.position, z), (*ends, z)]))
    return found


def _replanned_to_goal(mission: Mission) -> int | None:
    """Return the index of the collision after which the vehicle plans a trajectory to the goal, or None."""
    replans = mission.after_impact is AfterImpact.REPLAN and mission.goal_trajectory is None
    return len(mission.collisions) if replans and mission.recovers_to_goal else None


def _legs(mission: Mission, planned: PredictedFlight) -> dict[int, Array]:
    """Return the predicted legs, without the leg that the flight replaces by a trajectory to the goal."""
    return {index: leg for index, leg in planned.legs.items() if index != _replanned_to_goal(mission)}


def _draw_draws(axis: Any, mission: Mission, drawn: Sequence[PredictedFlight]) -> None:
    """For every set of randomly varied walls, draw the wall surfaces and the paths after the hits."""
    label = f"{len(drawn)} draws of the walls"
    for flight in drawn:
        surfaces = [np.array(mission.vehicle.airframe.wall_surface(wall).ends) for wall in flight.walls]
        for path in [*flight.legs.values(), *surfaces]:
            axis.plot(path[:, 0], path[:, 1], color=_DRAWN, linewidth=0.5, alpha=0.6, zorder=1.8, label=label)


def _draw_trajectory(axis: Any, mission: Mission, planned: PredictedFlight) -> None:
    for path in _from_rest(mission, planned):
        axis.plot(path[:, 0], path[:, 1], label="predicted trajectory", **PREDICTED)
    for index, line in planned.approaches.items():
        path = np.array(line)
        axis.plot(path[:, 0], path[:, 1], label="predicted trajectory", **PREDICTED)
        begins = 0 if mission.collisions[index - 1].trajectory is not None else -2
        axis.plot(
            *path[begins], "s", color="#000000", markersize=4, markerfacecolor="white", linestyle="none",
            label="run-up begins", zorder=4,
        )  # fmt: skip
        middle = path[-2] + 0.55 * (path[-1] - path[-2])
        draw_arrow(axis, middle, middle + 0.06 * (path[-1] - path[-2]), "#000000", linewidth=0.0)
    for leg in _legs(mission, planned).values():
        axis.plot(leg[:, 0], leg[:, 1], label="predicted trajectory", **PREDICTED)


def _draw_hits(axis: Any, mission: Mission, planned: PredictedFlight) -> tuple[list[Label], list[Array]]:
    """Draw the hits; return their labels, and the lines that the labels should not cover."""
    largest = max((math.hypot(h.normal_n, h.tangential_n) for h in planned.hits.values()), default=0.0)
    labels: list[Label] = []
    lines: list[Array] = []
    for collision in mission.collisions:
        hit, wall = planned.hits.get(collision.index), collision.wall
        at = hit.position if hit is not None else collision.impact_point
        if at is None:
            continue
        stops = hit is None or mission.standoff_m is not None
        set_point = None if hit is None or stops else hit.setpoint
        yaw = impact_yaw(mission, collision)
        lines += draw_hit(axis, mission.vehicle.airframe, at, yaw, collision.mode, set_point)
        if hit is None:
            continue
        if not stops:
            x, y, _ = wall.from_collision((hit.normal_n, hit.tangential_n, 0.0))
            tip = at + LONGEST_ARROW_M / largest * np.array([x, y])
            draw_arrow(axis, at, tip, FORCE)
            lines.append(along(np.array([at, tip])))
        speed = math.hypot(hit.normal_m_s, hit.tangential_m_s)
        force = describe_force(hit.normal_n, hit.tangential_n)
        text = f"{collision.index} {collision.mode.value}\n{speed:.2f} m/s, {force}"
        incidence = incidence_deg(mission, collision)
        if incidence >= 1.0:
            text += f"\nincidence {incidence:.0f}°"
        labels.append(Label(text, hit.position, (-wall.normal[0], -wall.normal[1]), FORCE))
    if planned.hits and mission.standoff_m is None:
        name_hits(axis, largest)
    return labels, lines


def _draw_side(axis: Any, mission: Mission, planned: PredictedFlight | None, top: float) -> None:
    """Draw the side view along y.

    A wall that the view shows edge-on is hatched. Other walls are plain, because the vehicle flies in front
    of them.
    """
    out = mission.vehicle.airframe.contact_distance_m
    for wall in mission.walls:
        nx, ny = wall.normal
        surface, thickness_m = (
            mission.vehicle.airframe.wall_surface(wall).ends,
            drawn_thickness_m(mission, wall),
        )
        ends = [x - back * nx for x, _ in surface for back in (0.0, thickness_m)]
        seen_from_side = abs(ny) < _EDGE_ON
        style = {"hatch": "////", "facecolor": "#dcdcdc"} if seen_from_side else {"facecolor": "#f1f1f1"}
        axis.fill_between(
            [min(ends), max(ends)], 0.0, top, edgecolor="#777777", linewidth=0.0,
            zorder=1.2 if seen_from_side else 1.0, **style,
        )  # fmt: skip
    axis.axhline(0.0, color="#222222", linewidth=1.4)
    for z in mission.bounds.z:
        axis.axhline(z, color="#999999", linewidth=0.8, linestyle=(0, (1, 2)))
    start = mission.start
    axis.plot([start[0]] * 2, [0.0, mission.altitude_m], **PREDICTED)
    if planned is not None:
        for index, line in [*planned.approaches.items(), *_legs(mission, planned).items()]:
            path = np.array(line)
            axis.plot(path[:, 0], np.full(len(path), mission.altitude_at(index - 1)), **PREDICTED)
        for path in _from_rest(mission, planned):
            axis.plot(path[:, 0], path[:, 2], **PREDICTED)
        for (x, z), numbers in _side_by_side(mission, planned):
            axis.plot(x + np.array([-out, out]), [z, z], color="#000000", linewidth=2.5)
            axis.annotate(numbers, (x, z), (0, 7), textcoords="offset points", ha="center", color=FORCE)
    for waypoint in mission.waypoints:
        if waypoint.position is not None:
            x, _, z = waypoint.position
            axis.plot(x, z, "s", color="#000000", markersize=5, zorder=4)
    goal = mission.goal.position_m
    at_goal = mission.altitude_at(len(mission.collisions))
    axis.plot(goal[0], at_goal, "*", color="black", markersize=9)
    axis.plot([goal[0]] * 2, [0.0, at_goal], color=GREY, linewidth=0.8, linestyle=":")


def _stops(mission: Mission) -> list[tuple[str, Vec2]]:
    """Return the labels and places of start, goal, waypoints (numbered) and changes of altitude."""
    found: dict[Vec2, str] = {mission.start: "start"}
    goal = mission.goal.position_m
    found[goal] = f"{found[goal]}, goal" if goal in found else "goal"
    z_before = mission.altitude_m
    for waypoint in mission.waypoints:
        if waypoint.position is None:
            continue
        x, y, z = waypoint.position
        text = f"{waypoint.index}" if z == z_before else f"{waypoint.index}: {z:g} m high"
        found[x, y] = f"{found[x, y]}, {text}" if (x, y) in found else text
        z_before = z
    return [(text, place) for place, text in found.items()]


def _side_by_side(mission: Mission, planned: PredictedFlight) -> list[tuple[Vec2, str]]:
    """Return the position (x, z) and the number of each hit.

    Hits that are close together at the same altitude share one position.
    """
    found: list[tuple[Vec2, str]] = []
    for index, hit in sorted(planned.hits.items(), key=lambda item: item[1].position[0]):
        x, z = hit.position[0], mission.altitude_at(index - 1)
        if found and x - found[-1][0][0] < _SAME_M and z == found[-1][0][1]:
            found[-1] = (found[-1][0], f"{found[-1][1]}, {index}")
        else:
            found.append(((x, z), str(index)))
    return found


def write_mission_picture(mission: Mission, planned: PredictedFlight | None, path: Path) -> None:
    save_figure(mission_figure(mission, planned), path)
