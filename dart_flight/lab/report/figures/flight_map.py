"""The map of a flight: the plan, the flown path, and every hit with its force and the next setpoint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from dart_flight.lab.figure_style import FORCE, GREY, GUARD, PAGE, Look, in_style, new_figure
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import Arrow, DrawnVehicle, Label, Line, MapKind, Place, RoomMap, room_map
from dart_flight.lab.report.figures.map_drawing import draw_map, finish_map, set_view, view_of
from dart_flight.lab.report.recorded_flight import RecordedFlight

_FEW_LABELS = 14
_STEPS_S = (1, 2, 5, 10, 20, 50, 100)
_ARROW_EVERY_M = 0.9


@in_style
def flight_map(flights: Sequence[RecordedFlight], *, look: Look = PAGE) -> Any:
    """Draw walls, plan and flown paths from above; the paths of all flights appear in one map.

    The map of a single flight also shows the direction, a dot at every second, and the guard's actions. At
    each hit it shows the vehicle, the state of the arms, the peak force and the recovery setpoint.
    """
    shown = room_map(flights[0].mission)
    seen = [np.array([place.at for place in shown.places])]
    for flight in flights:
        seen += [place for (_, place), _ in _paths(flight)]
        seen += [np.array([hit.verdict.onset.position_mission]) for hit in flight.impacts]
        seen += flight.planned_lines()  # an aborted flight does not reach all planned walls
    if len(flights) == 1:
        _add_one(shown, flights[0])
    else:
        _add_many(shown, flights)
    figure, axis = new_figure(look, 5.0)
    set_view(axis, view_of(shown, np.vstack(seen)))
    draw_map(axis, shown)
    finish_map(figure, axis, shown, look)
    return figure


# --- one flight ----------------------------------------------------------------------------------------


def _add_one(shown: RoomMap, flight: RecordedFlight) -> None:
    """Add a flight to a map; its labels are ordered by importance: hits, guard actions, seconds."""
    paths = _paths(flight)
    shown.paths += [Line(MapKind.PLANNED, line) for line in flight.planned_lines()]
    shown.paths += [Line(kind, place) for (_, place), kind in paths]
    shown.paths += [Line(MapKind.REPLANNED, path) for path in flight.planned_trajectories()]
    heading, forces = flight.heading, []
    for impact in flight.impacts:
        hit, size = impact.verdict, ""
        (x, y, z), (nx, ny) = hit.onset.position_mission, impact.collision.wall.normal
        yaw = float(np.interp(impact.at_s, heading.time_s, heading.yaw)) if heading.time_s.size else 0.0
        setpoint = None if hit.recovery is None else (hit.recovery[0], hit.recovery[1])
        shown.add_hit(DrawnVehicle((x, y, z), yaw, hit.lock_mode, hit.index), setpoint)
        if hit.force is not None:
            forces.append(((x, y), (hit.force[0], hit.force[1])))
            size = f": {math.hypot(*hit.force):.0f} N"
        shown.labels.append(Label(f"{hit.index}{size}", (x, y), (-nx, -ny), FORCE))
    shown.add_forces(forces)
    for act in flight.guard_acts():
        if act.place is not None:
            shown.places.append(Place(MapKind.GUARD, act.place))
            shown.labels.append(Label(f"{act.rule}:\n{act.action}", act.place, colour=GUARD))
    if paths:
        (times, place), _ = paths[0]
        shown.arrows += _directions(place)
        seconds = _second_labels(times, place)
        whole = np.arange(math.ceil(times[0]), times[-1])
        dots = np.stack([np.interp(whole, times, place[:, i]) for i in (0, 1)], axis=1)
        shown.places += [Place(MapKind.SECOND, (x, y)) for x, y in dots]
        shown.places += [Place(MapKind.LABELLED_SECOND, second.at) for second in seconds]
        shown.labels += seconds


def _paths(flight: RecordedFlight) -> list[tuple[tuple[Array, Array], MapKind]]:
    """Return ((times, places), kind) of each flown path: the true path, then the estimated path."""
    air = flight.airborne
    found = []
    for motion, kind in ((flight.course.true, MapKind.TRUE), (flight.course.estimated, MapKind.ESTIMATED)):
        if air is None or not motion.time_s.size:
            continue
        inside = (motion.time_s >= air[0]) & (motion.time_s <= air[1])
        if inside.any():
            found.append(((motion.time_s[inside], motion.position[inside]), kind))
    return found


def _directions(place: Array) -> Iterator[Arrow]:
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place[:, :2], axis=0), axis=1))])
    for at in np.arange(0.5 * _ARROW_EVERY_M, distance[-1], _ARROW_EVERY_M):
        i, j = np.searchsorted(distance, at - 0.01), np.searchsorted(distance, at + 0.05)
        if j < distance.size and np.linalg.norm(place[j, :2] - place[i, :2]) > 0.02:
            yield Arrow(MapKind.TRUE, (place[i, 0], place[i, 1]), (place[j, 0], place[j, 1]))


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


def _add_many(shown: RoomMap, flights: Sequence[RecordedFlight]) -> None:
    for flight in flights:
        for (_, place), kind in _paths(flight)[:1]:
            shown.paths.append(Line(MapKind.ONE_OF_MANY, place, kind))
        for hit in flight.impacts:
            shown.places.append(Place(MapKind.HIT, hit.verdict.onset.position_mission))
    shown.paths += [Line(MapKind.PLANNED, line) for line in flights[0].planned_lines()]
