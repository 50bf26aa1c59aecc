"""The figure of a mission before the flight: its path, and the effect of uncertain walls."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import transit_segments
from dart_flight.lab.figure_style import Look, in_style, new_figure, save_figure
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import planned_lines
from dart_flight.lab.mission_map import mission_map
from dart_flight.lab.report.figures.map_drawing import (
    BELOW_M,
    draw_map,
    draw_side,
    finish_map,
    set_view,
    view_of,
)
from dart_flight.lab.search.drawn import predict_with_draws
from dart_flight.planning.predicted_flight import PredictedFlight, describe_goal_miss

SHEET = Look(7.2, 9.0)
_NOTE_WIDTH = 96  # width in characters of the text below the picture
_ABOVE_M = 0.4  # margin of the side view above the flight
_ROOM_M, _ROOM_SHARE = 12.0, 2.5  # bounds are shown up to this size, m, or multiple of the flight's size


@in_style
def mission_figure(mission: Mission, planned: PredictedFlight | None, *, look: Look = SHEET) -> Any:
    """Draw plan view and side view of a mission, with the effect of uncertain walls on the prediction.

    Without a prediction (`planned`), as for an approach that cannot be flown, only the room is drawn.
    """
    # With trajectories, every draw ends at the goal, and only uncertain walls make the draws differ.
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
    """Return the points that the plan view must include: the flight, but no setpoint outside of the bounds.

    The bounds are included if they are small or not much larger than the flight.
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


def write_mission_picture(mission: Mission, planned: PredictedFlight | None, path: Path) -> None:
    save_figure(mission_figure(mission, planned), path)
