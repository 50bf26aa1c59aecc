"""The predicted path of a mission: the planner's flight model from start to goal, for `check` and the report.

A mission file contains the approach and the gains, but not the path. This module computes the path with the
model that `plan` uses to choose an approach and gains (`planning.rollout`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import AfterImpact
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.mission_file import GoalSpec, MotionState, TrajectoryPieces
from dart_flight.core.mission.approach import TransitSegment, transit_segments
from dart_flight.core.mission.planned_impact import expected_hit
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.planning.flight_model import FreeFlight
from dart_flight.planning.rollout import (
    Arrivals,
    PredictedContacts,
    Rollout,
    UncertaintyDraw,
    new_flight,
    stages_for,
)
from dart_flight.planning.task import MissionTask, make_task

_POINTS = 60  # points per leg


class PredictedContact(NamedTuple):
    """A predicted contact.

    Attributes:
        position: position of the vehicle's centre at the onset, mission frame.
        normal_m_s, tangential_m_s: velocity at the onset, collision frame.
        normal_n, tangential_n: peak of the normal force, and peak of the friction along the wall's tangent.
        setpoint: recovery setpoint, mission frame.
    """

    position: Vec2
    normal_m_s: float
    tangential_m_s: float
    normal_n: float
    tangential_n: float
    setpoint: Vec2


class PredictedFlight(msgspec.Struct):
    """The path of a mission as the flight model predicts it.

    Attributes:
        approaches: line of each approach, by the index of the approached collision; mission frame, metres. A
            line leads from the previous resting position (if known and different) through the run-up point to
            the impact. For a collision with its own trajectory, the line consists of points of this
            trajectory.
        legs: arrays (n, 4) of x, y, vx, vy by collision index. A leg begins at the onset of a contact. The
            leg ends at the next onset, or at the closest approach to the goal. The leg with index 0 leads
            from rest at the start to the goal. In the first row of a leg after a contact, the velocity is 0.
        hits: contacts that the model reaches, by collision index.
        goal_miss_m: smallest distance to the goal after the last contact; None if not predicted.
        walls: walls at random positions, drawn from the uncertainty that the mission declares; empty if the
            prediction uses the nominal walls.
    """

    approaches: dict[int, list[Vec2]]
    legs: dict[int, NDArray[np.float64]]
    hits: dict[int, PredictedContact]
    goal_miss_m: float | None = None
    walls: tuple[Wall, ...] = ()


def impact_place(collision: Collision, hits: Mapping[int, PredictedContact]) -> Vec2:
    """Return the impact point, mission frame: from the mission, else the model, else the wall's middle."""
    if collision.impact_point is not None:
        return collision.impact_point
    if collision.predicted is not None:
        return collision.predicted.position_m
    hit = hits.get(collision.index)
    return hit.position if hit is not None else collision.wall.point


def predicted_segments(mission: Mission, hits: Mapping[int, PredictedContact]) -> list[TransitSegment]:
    """Return the rest-to-rest segments; a segment after a recovery begins at the predicted setpoint.

    The beginning is None if the preceding collision has no predicted impact.
    """
    found = []
    ends = {w.name: w.after for w in mission.waypoints}
    for segment in transit_segments(mission):
        flown = ends.get(segment.name, len(mission.collisions))
        if segment.begin is None and flown in hits and mission.standoff_m is None:
            segment = segment._replace(begin=(*hits[flown].setpoint, mission.altitude_at(flown - 1)))
        found.append(segment)
    return found


def describe_goal_miss(
    miss_m: float,
    goal: GoalSpec,
    after_impact: AfterImpact = AfterImpact.SETPOINT,
    along_trajectory: bool = False,
) -> str:
    if along_trajectory:
        return (
            "the vehicle reaches the goal at rest, along a trajectory "
            f"(capture radius {goal.capture_radius_m:g} m)"
        )
    text = f"passes the goal at a distance of {miss_m:.2f} m (capture radius {goal.capture_radius_m:g} m)"
    if after_impact is AfterImpact.REPLAN:
        return (
            "the vehicle replans after every collision to pass through the goal; without replanning, "
            "the vehicle " + text
        )
    return text


def predict_mission(mission: Mission) -> PredictedFlight:
    """Predict the path that follows from the mission's approaches, modes and gains.

    If the model does not complete all collisions that follow from one approach, the prediction contains only
    the approach. A rehearsal has no impacts, so its prediction contains only approaches.
    """
    return flights_with(mission, [None])[0]


def flights_with(mission: Mission, draws: Sequence[UncertaintyDraw | None]) -> list[PredictedFlight]:
    """Predict the path for each random draw of the walls' positions; None means the nominal walls."""
    found = [PredictedFlight({}, {}, {}, walls=() if d is None else tuple(d.walls.values())) for d in draws]
    if mission.goal_trajectory is not None and not mission.collisions:
        rows = [(*state.position, *state.velocity) for state in _sampled(mission.goal_trajectory)]
        for planned in found:
            planned.legs[0] = np.array(rows)
    for group in _groups(mission.collisions):
        if group[0].trajectory is not None:
            for planned in found:
                _add_written(planned, mission, group)
            continue
        flight, begin, all_arrivals = _fly(mission, group, draws)
        impact = group[0].impact_point
        assert impact is not None
        before = mission.place_before(group[0].index - 1)
        line = [begin, impact] if before in (None, begin) else [before, begin, impact]
        last = group[-1] is mission.collisions[-1] and mission.recovers_to_goal
        for planned, arrivals in zip(found, all_arrivals, strict=True):
            planned.approaches[group[0].index] = line
            if arrivals is not None and mission.standoff_m is None:
                _add_prediction(planned, group, flight, arrivals, last)
    return found


def _add_prediction(
    planned: PredictedFlight, group: Sequence[Collision], flight: FreeFlight, arrivals: Arrivals, last: bool
) -> None:
    """Add the prediction of the collisions that follow from one approach.

    `last` is True if the vehicle recovers to the goal after the last of these collisions.
    """
    for i, (collision, hit) in enumerate(zip(group, arrivals.hits, strict=True)):
        planned.hits[collision.index] = PredictedContact(
            position=(float(hit.x[0]), float(hit.y[0])),
            normal_m_s=float(hit.normal_m_s[0]),
            tangential_m_s=float(hit.tangential_m_s[0]),
            normal_n=float(hit.normal_n[0]),
            tangential_n=float(hit.tangential_n[0]),
            setpoint=(float(hit.leg.goal_x[0]), float(hit.leg.goal_y[0])),
        )
        following = arrivals.hits[i + 1].t_s if i + 1 < len(group) else arrivals.t_s if last else None
        if following is not None:
            planned.legs[collision.index] = _path(flight, hit, float(following[0]))
    if last:
        planned.goal_miss_m = float(arrivals.miss_m[0])


def _add_written(planned: PredictedFlight, mission: Mission, group: Sequence[Collision]) -> None:
    first = group[0]
    assert first.trajectory is not None
    planned.approaches[first.index] = [state.position for state in _sampled(first.trajectory)]
    if mission.standoff_m is not None:
        return
    for i, collision in enumerate(group):
        assert collision.predicted is not None
        predicted = collision.predicted
        hit = expected_hit(mission, collision)
        friction_n = (
            0.0 if hit is None else -math.copysign(hit.peak_friction_force_n, predicted.tangential_m_s)
        )
        alphas = (collision.alpha_normal_m_per_n, collision.alpha_tangential_m_per_n)
        peaks = (predicted.peak_force_n, friction_n)
        planned.hits[collision.index] = PredictedContact(
            predicted.position_m,
            predicted.normal_m_s,
            predicted.tangential_m_s,
            predicted.peak_force_n,
            friction_n,
            recovery_point(predicted.position_m, collision.wall.normal, peaks, alphas),
        )
        last = collision is mission.collisions[-1]
        following = mission.goal_trajectory if last else group[i + 1].trajectory if group[i + 1 :] else None
        if following is not None:
            rows = [(*state.position, *state.velocity) for state in _sampled(following)]
            planned.legs[collision.index] = np.array([(*predicted.position_m, 0.0, 0.0), *rows])
    if group[-1] is mission.collisions[-1] and mission.recovers_to_goal and mission.predicted is not None:
        planned.goal_miss_m = mission.predicted.goal_miss_m


def _sampled(written: TrajectoryPieces) -> list[MotionState]:
    planned = Trajectory.from_mission(written, 0.0)
    found = []
    for t in np.linspace(0.0, planned.duration_s, _POINTS):
        at = planned.at(float(t))
        found.append(MotionState(float(t), at.position[:2], at.velocity[:2], at.acceleration[:2]))
    return found


def _groups(collisions: Sequence[Collision]) -> list[list[Collision]]:
    """Return the collisions in groups; all collisions of a group follow from the same approach."""
    begins = [i for i, c in enumerate(collisions) if c.impact_point is not None]
    return [list(collisions[a:b]) for a, b in pairwise([*begins, len(collisions)])]


def _fly(
    mission: Mission, group: Sequence[Collision], draws: Sequence[UncertaintyDraw | None]
) -> tuple[FreeFlight, Vec2, list[Arrivals | None]]:
    """Return the flight model, the run-up point, and the arrivals of each draw.

    If a draw does not complete the collisions, None replaces its arrivals.
    """
    task = make_task(mission, group)
    flight = new_flight(task)
    rollout = _rollout(task, flight)
    assert group[0].approach_m_s is not None
    normal, tangential = (np.array([v]) for v in group[0].approach_m_s)
    grid = rollout.approach(normal, tangential)
    begin = (float(np.ravel(grid.begin_x)[0]), float(np.ravel(grid.begin_y)[0]))
    modes = tuple(c.mode for c in group)
    found = []
    drawn = [_rename_walls(draw, group) for draw in draws]
    for stages, draw in zip(stages_for(task, drawn), drawn, strict=True):
        drawn_rollout = rollout if draw is None or not draw.walls else _rollout(task, flight, draw.walls)
        arrivals = drawn_rollout.fly(stages, normal, tangential, grid, draw)
        found.append(next((a for a in arrivals if a.modes == modes and a.rows.size), None))
    return flight, begin, found


def _rename_walls(draw: UncertaintyDraw | None, group: Sequence[Collision]) -> UncertaintyDraw | None:
    """Return a draw whose walls have the names in the task: one wall per collision, named by its index."""
    if draw is None:
        return None
    places = {
        str(c.index): msgspec.structs.replace(draw.walls[c.wall.name], name=str(c.index))
        for c in group
        if c.wall.name in draw.walls
    }
    return draw._replace(walls=places)


def _rollout(task: MissionTask, flight: FreeFlight, walls: Mapping[str, Wall] | None = None) -> Rollout:
    """Return the rollout of a task's only candidate; if `walls` are given, the vehicle hits these walls."""
    there = task._replace(walls=task.walls | dict(walls or {}))
    return Rollout(there, tuple(task.walls), flight, None, keep_hits=True)


def _path(flight: FreeFlight, hit: PredictedContacts, until_s: float) -> NDArray[np.float64]:
    """Return the path from the onset of an impact to `until_s`, mission frame, (n, 4).

    The first row is the onset. All other rows are after the release.
    """
    release_s = float(hit.t_s[0] + hit.duration_s[0])
    x, y = flight.along(hit.leg, np.linspace(0.0, max(until_s - release_s, 0.0), _POINTS))
    after = np.stack([x[:, 0] + hit.leg.goal_x[0], y[:, 0] + hit.leg.goal_y[0], x[:, 1], y[:, 1]], axis=1)
    return np.concatenate([[(hit.x[0], hit.y[0], 0.0, 0.0)], after])
