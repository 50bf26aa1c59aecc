"""The map of a flight: the plan, the flown path, and every hit with its force and the next setpoint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.lab.figure_style import (
    ESTIMATED,
    FORCE,
    GREY,
    GUARD,
    PAGE,
    PREDICTED,
    REPLANNED,
    TRUE,
    Look,
    in_style,
    new_figure,
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
    fit_map,
    name_hits,
    name_walls,
    set_view,
    view_of,
)
from dart_flight.lab.report.recorded_flight import RecordedFlight

_FEW_LABELS = 14
_STEPS_S = (1, 2, 5, 10, 20, 50, 100)
_ARROW_EVERY_M = 0.9


@in_style
def flight_map(flights: Sequence[RecordedFlight], *, look: Look = PAGE) -> Any:
    """Draw walls, plan and flown paths from above; the paths of several flights overlap.

    The map of a single flight also shows the direction, a dot at every second, and the guard's actions. At
    each hit it shows the vehicle, the state of the arms, the peak force and the recovery setpoint.
    """
    mission = flights[0].mission
    figure, axis = new_figure(look, 5.0)
    shown = [np.array([mission.start, mission.goal.position_m])]
    for flight in flights:
        shown += [place for (_, place), _, _ in _paths(flight)]
        shown += [np.array([hit.verdict.onset.position_mission[:2]]) for hit in flight.impacts]
        shown += flight.planned_lines()  # includes walls that an aborted flight did not reach
    set_view(axis, view_of(mission, np.vstack(shown)))
    draw_room(axis, mission)
    draw_north(axis, mission)
    if len(flights) == 1:
        labels, lines = _draw_one(axis, flights[0])
    else:
        _draw_many(axis, flights)
    axis.grid(visible=False)
    axis.set_xlabel("x, m")
    axis.set_ylabel("y, m")
    fit_map(figure, axis)
    names = name_walls(axis, mission, look.small_pt)
    if len(flights) == 1:
        place_labels(axis, labels, lines, names, look.small_pt)
    return figure


# --- one flight ----------------------------------------------------------------------------------------


def _draw_one(axis: Any, flight: RecordedFlight) -> tuple[list[Label], list[Array]]:
    """Draw everything but the labels; return the labels, and the lines that the labels should not cover.

    The labels are ordered by importance: hits, guard actions, seconds.
    """
    paths = _paths(flight)
    for line in flight.planned_lines():
        axis.plot(line[:, 0], line[:, 1], label="planned", **PREDICTED)
    for (_, place), style, label in paths:
        thin = {**style, "linewidth": 0.75 * float(style["linewidth"])}
        axis.plot(place[:, 0], place[:, 1], label=label, **thin)
    for path in flight.planned_trajectories():
        axis.plot(path[:, 0], path[:, 1], label="planned in flight", **REPLANNED)
    labels: list[Label] = []
    lines: list[Array] = []
    forces = [impact.verdict.force for impact in flight.impacts]
    largest = max((math.hypot(*force) for force in forces if force is not None), default=0.0)
    heading = flight.heading
    for impact, force in zip(flight.impacts, forces, strict=True):
        hit, size = impact.verdict, ""
        (x, y, _), (nx, ny) = hit.onset.position_mission, hit.collision.wall.normal
        setpoint = None if hit.recovery is None else hit.recovery[:2]
        yaw = float(np.interp(impact.at_s, heading.time_s, heading.yaw)) if heading.time_s.size else 0.0
        lines += draw_hit(axis, flight.mission.vehicle.airframe, (x, y), yaw, hit.lock_mode, setpoint)
        if force is not None:
            draw_arrow(axis, (x, y), (x, y) + LONGEST_ARROW_M / largest * np.array(force), FORCE)
            size = f": {math.hypot(*force):.0f} N"
        labels.append(Label(f"{hit.index}{size}", (x, y), (-nx, -ny), FORCE))
    if largest > 0.0:
        name_hits(axis, largest)
    for act in flight.guard_acts():
        if act.place is not None:
            axis.plot(*act.place, "D", color=GUARD, markersize=6, label="guard", linestyle="none", zorder=6)
            labels.append(Label(f"{act.rule}:\n{act.action}", act.place, colour=GUARD))
    if paths:
        (times, place), _, _ = paths[0]
        _draw_direction(axis, place)
        _draw_seconds(axis, (times, place))
        lines.append(along(place))
        seconds = _second_labels(times, place)
        for second in seconds:
            axis.plot(*second.at, "o", markersize=3.2, color="black", zorder=4.5)
        labels += seconds
    return labels, lines


def _paths(flight: RecordedFlight) -> list[tuple[tuple[Array, Array], dict[str, Any], str]]:
    """Return ((times, places), style, name) of each flown path: the true path, then the estimated path."""
    air = flight.airborne
    found = []
    for motion, style, label in (
        (flight.course.true, TRUE, "flown (true)"),
        (flight.course.estimated, ESTIMATED, "flown (estimated)"),
    ):
        if air is None or not motion.time_s.size:
            continue
        inside = (motion.time_s >= air[0]) & (motion.time_s <= air[1])
        if inside.any():
            found.append(((motion.time_s[inside], motion.position[inside, :2]), style, label))
    return found


def _draw_direction(axis: Any, place: Array) -> None:
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    for at in np.arange(0.5 * _ARROW_EVERY_M, distance[-1], _ARROW_EVERY_M):
        i, j = np.searchsorted(distance, at - 0.01), np.searchsorted(distance, at + 0.05)
        if j < distance.size and np.linalg.norm(place[j] - place[i]) > 0.02:
            draw_arrow(axis, place[i], place[j], "#000000", linewidth=0.0, mutation_scale=10)


def _draw_seconds(axis: Any, path: tuple[Array, Array]) -> None:
    times, place = path
    whole = np.arange(math.ceil(times[0]), times[-1])
    dots = np.stack([np.interp(whole, times, place[:, i]) for i in (0, 1)], axis=1)
    axis.plot(
        dots[:, 0], dots[:, 1], "o", markersize=2.6, color="black", markerfacecolor="white",
        markeredgewidth=0.7, label="every second", linestyle="none", zorder=4,
    )  # fmt: skip


def _second_labels(times: Array, place: Array) -> list[Label]:
    duration = times[-1] - times[0]
    step = next((s for s in _STEPS_S if duration / s <= _FEW_LABELS), _STEPS_S[-1])
    found: list[Label] = []
    for at in np.arange(math.ceil(times[0] / step) * step, times[-1], step):
        x, y = (float(np.interp(at, times, place[:, i])) for i in (0, 1))
        # Label a hovering vehicle only once.
        if not found or math.dist(found[-1].at, (x, y)) > 0.1:
            found.append(Label(f"{at:.0f} s", (x, y), colour=GREY))
    return found


# --- several -------------------------------------------------------------------------------------------


def _draw_many(axis: Any, flights: Sequence[RecordedFlight]) -> None:
    for flight in flights:
        paths = _paths(flight)
        if paths:
            (_, place), style, label = paths[0]
            thin = {**style, "linewidth": 0.8, "alpha": 0.6}
            axis.plot(place[:, 0], place[:, 1], label=label, **thin)
        for hit in flight.impacts:
            x, y, _ = hit.verdict.onset.position_mission
            axis.plot(x, y, "o", color=FORCE, markersize=2.5, label="hit", linestyle="none", zorder=5)
    for line in flights[0].planned_lines():
        axis.plot(line[:, 0], line[:, 1], label="planned", **PREDICTED)
