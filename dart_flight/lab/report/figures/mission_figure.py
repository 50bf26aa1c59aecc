"""The figure of a mission before the flight: its path, and the effect of uncertain walls."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import transit_segments
from dart_flight.core.mission.planned_impact import describe_force
from dart_flight.lab.figure_style import FORCE, Look, in_style, new_figure, save_figure
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import (
    Arrow,
    DrawnVehicle,
    Label,
    Line,
    MapKind,
    Place,
    RoomMap,
    at_altitude,
    planned_lines,
    room_map,
)
from dart_flight.lab.report.figures.map_drawing import (
    BELOW_M,
    draw_map,
    draw_side,
    finish_map,
    set_view,
    view_of,
)
from dart_flight.lab.search.drawn import predict_with_draws
from dart_flight.planning.envelope import impact_yaw, incidence_deg
from dart_flight.planning.predicted_flight import PredictedFlight, describe_goal_miss

SHEET = Look(7.2, 9.0)
_NOTE_WIDTH = 96  # width in characters of the text below the picture
_ABOVE_M = 0.4  # margin of the side view above the flight
_ROOM_M, _ROOM_SHARE = 12.0, 2.5  # larger bounds are shown completely only if the flight is of a similar size


@in_style
def mission_figure(mission: Mission, planned: PredictedFlight | None, *, look: Look = SHEET) -> Any:
    """Draw plan view and side view of a mission, with the effect of uncertain walls on the prediction.

    Without a prediction (`planned`), as for an approach that cannot be flown, only the room is drawn.
    """
    # Trajectories end at their goal in every draw, but uncertain walls still move.
    varies = mission.goal_trajectory is None or any(wall.is_uncertain for wall in mission.walls)
    drawn = predict_with_draws(mission) if planned is not None and planned.hits and varies else []
    shown = mission_map(mission, planned, drawn)
    view = view_of(shown, _extent(mission, planned))
    highest = max(mission.altitude_m, *(leg.end[2] for leg in transit_segments(mission)), 0.0)
    top = min(mission.bounds.z[1] + 0.05, highest + _ABOVE_M)
    ratios = [view[1, 1] - view[0, 1], top + BELOW_M]
    figure, (plan, side) = new_figure(look, 6.0, 2, 1, sharex=True, height_ratios=ratios)
    set_view(plan, view)
    draw_map(plan, shown)
    draw_side(side, shown, top)
    side.set_ylabel("z, m")
    plan.set_title(mission.name, fontsize=look.font_pt + 1.0, loc="left")
    words = "\n".join(textwrap.fill(line, _NOTE_WIDTH) for line in prediction_lines(mission, planned, drawn))
    finish_map(figure, plan, shown, look, below=side, note=words)
    return figure


def mission_map(
    mission: Mission, planned: PredictedFlight | None, drawn: Sequence[PredictedFlight] = ()
) -> RoomMap:
    """Return a map of a mission with its predicted path and the predictions for varied walls."""
    shown = room_map(mission)
    climb = [(*mission.start, z) for z in (0.0, mission.altitude_m)]
    shown.paths.append(Line(MapKind.PREDICTED, np.array(climb)))
    _add_draws(shown, mission, drawn)
    _add_probes(shown, mission, labelled=planned is None)
    if planned is not None:
        _add_trajectory(shown, mission, planned)
        _add_hits(shown, mission, planned)
    shown.labels += [Label(text, place, (1.0, 1.0)) for text, place in _stops(mission)]
    return shown


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
    points += [line[:, :2] for line in planned_lines(mission, planned)]
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


def _add_probes(shown: RoomMap, mission: Mission, *, labelled: bool) -> None:
    for collision in mission.collisions:
        if collision.probe is None:
            continue
        path = np.array([collision.probe.begin, collision.probe.end])
        z = mission.altitude_at(collision.index - 1)
        shown.paths.append(Line(MapKind.PROBE, at_altitude(path, z)))
        (dx, dy), middle = path[1] - path[0], path[0] + 0.6 * (path[1] - path[0])
        (x, y) = collision.probe.end
        shown.arrows.append(Arrow(MapKind.PROBE, (x - 0.06 * dx, y - 0.06 * dy), (x, y)))
        if labelled:
            across = (-dy / math.hypot(dx, dy), dx / math.hypot(dx, dy))
            text = f"{collision.index} probe for {collision.wall.name}\n{collision.probe.speed_m_s:g} m/s"
            shown.labels.append(Label(text, (float(middle[0]), float(middle[1])), across, FORCE))


def _add_draws(shown: RoomMap, mission: Mission, drawn: Sequence[PredictedFlight]) -> None:
    """Add the wall surfaces and the paths after the hits for every set of randomly varied walls."""
    legend = f"{len(drawn)} draws of the walls"
    for flight in drawn:
        surfaces = [np.array(mission.vehicle.airframe.wall_surface(wall).ends) for wall in flight.walls]
        legs = [at_altitude(leg, mission.altitude_at(index - 1)) for index, leg in flight.legs.items()]
        shown.paths += [Line(MapKind.DRAW, points, legend) for points in (*legs, *surfaces)]


def _add_trajectory(shown: RoomMap, mission: Mission, planned: PredictedFlight) -> None:
    shown.paths += [Line(MapKind.PREDICTED, line) for line in planned_lines(mission, planned)]
    for index, line in planned.approaches.items():
        begins = 0 if mission.collisions[index - 1].trajectory is not None else -2
        shown.places.append(Place(MapKind.RUN_UP, line[begins]))
        (ax, ay), (bx, by) = line[-2:]
        middle, tip = ((ax + share * (bx - ax), ay + share * (by - ay)) for share in (0.55, 0.61))
        shown.arrows.append(Arrow(MapKind.PREDICTED, middle, tip))


def _add_hits(shown: RoomMap, mission: Mission, planned: PredictedFlight) -> None:
    forces: list[tuple[Vec2, Vec2]] = []
    for collision in mission.collisions:
        hit, wall = planned.hits.get(collision.index), collision.wall
        at = hit.position if hit is not None else collision.impact_point
        if at is None:
            continue
        stops = hit is None or mission.standoff_m is not None
        place = (*at, mission.altitude_at(collision.index - 1))
        body = DrawnVehicle(place, impact_yaw(mission, collision), collision.mode, collision.index)
        shown.add_hit(body, None if hit is None or stops else hit.setpoint)
        if hit is None:
            continue
        if not stops:
            x, y, _ = wall.from_collision((hit.normal_n, hit.tangential_n, 0.0))
            forces.append((at, (x, y)))
        speed = math.hypot(hit.normal_m_s, hit.tangential_m_s)
        force = describe_force(hit.normal_n, hit.tangential_n)
        text = f"{collision.index} {collision.mode.value}\n{speed:.2f} m/s, {force}"
        incidence = incidence_deg(mission, collision)
        if incidence >= 1.0:
            text += f"\nincidence {incidence:.0f}°"
        shown.labels.append(Label(text, hit.position, (-wall.normal[0], -wall.normal[1]), FORCE))
    shown.add_forces(forces)


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


def write_mission_picture(mission: Mission, planned: PredictedFlight | None, path: Path) -> None:
    save_figure(mission_figure(mission, planned), path)
