"""The planned path of a mission: the planner's flight model from start to goal, for `check` and the report.

A mission file holds the approach and the gains, not the path; the path follows from them by the same model
that chose them (`planning.rollout`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.config.mission import Collision, Mission
from dart_flight.geometry import Vec2
from dart_flight.planning.flight_model import FreeFlight
from dart_flight.planning.rollout import Arrivals, Hits, Rollout, new_flight, stages_for
from dart_flight.planning.task import task_of

_POINTS = 60  # of a leg


class PlannedHit(NamedTuple):
    """A collision as the flight model meets it.

    Attributes:
        position: of the vehicle's centre at the onset, mission frame.
        normal_m_s, tangential_m_s: velocity then, collision frame.
        normal_n, tangential_n: peaks of the force, friction as a force along the wall's tangent.
    """

    position: Vec2
    normal_m_s: float
    tangential_m_s: float
    normal_n: float
    tangential_n: float


class PlannedFlight(msgspec.Struct):
    """What the flight model says of a mission.

    Attributes:
        approaches: straight lines, mission frame, metres: start, run-up point, impact.
        legs: (n, 4), x, y, vx, vy from an onset over the release to the next onset, the last to the closest
            approach to the goal. At the onset itself the velocity is given as 0.
        hits: collision index -> the hit; none for a wall that the model does not reach.
    """

    approaches: list[list[Vec2]]
    legs: list[NDArray[np.float64]]
    hits: dict[int, PlannedHit]


def planned_flight(mission: Mission) -> PlannedFlight:
    """The path that the mission's approaches, modes and gains lead to.

    Where the model does not reach the next wall, the path ends; a rehearsal has approaches only.
    """
    planned = PlannedFlight([], [], {})
    position = mission.start
    for group in _groups(mission.collisions):
        arrivals, flight, begin = _fly(mission, group)
        impact = group[0].impact_point
        assert impact is not None
        line = [position, begin, impact] if begin != position else [position, impact]
        planned.approaches.append(line)
        position = mission.start
        if arrivals is None or mission.standoff_m is not None:
            continue
        last = group[-1] is mission.collisions[-1]
        for i, (collision, hit) in enumerate(zip(group, arrivals.hits, strict=True)):
            planned.hits[collision.index] = PlannedHit(
                (float(hit.x[0]), float(hit.y[0])),
                *(float(v[0]) for v in (hit.normal_m_s, hit.tangential_m_s, hit.normal_n, hit.tangential_n)),
            )
            following = arrivals.hits[i + 1].t_s if i + 1 < len(group) else arrivals.t_s if last else None
            if following is not None:
                planned.legs.append(_path(flight, hit, float(following[0])))
    return planned


def _groups(collisions: Sequence[Collision]) -> list[list[Collision]]:
    """Collisions that follow from one approach each."""
    begins = [i for i, c in enumerate(collisions) if c.impact_point is not None]
    return [list(collisions[a:b]) for a, b in pairwise([*begins, len(collisions)])]


def _fly(mission: Mission, group: Sequence[Collision]) -> tuple[Arrivals | None, FreeFlight, Vec2]:
    """One approach and what follows from it; None where it does not get through; and its run-up point."""
    task = task_of(mission, group)
    flight = new_flight(task)
    rollout = Rollout(task, tuple(task.walls), flight, None, keep_hits=True)
    assert group[0].approach_m_s is not None
    normal, tangential = (np.array([v]) for v in group[0].approach_m_s)
    grid = rollout.approach(normal, tangential)
    begin = (float(np.ravel(grid.begin_x)[0]), float(np.ravel(grid.begin_y)[0]))
    found = rollout.fly(stages_for(task, [None])[0], normal, tangential, grid)
    modes = tuple(c.mode for c in group)
    return next((a for a in found if a.modes == modes and a.rows.size), None), flight, begin


def _path(flight: FreeFlight, hit: Hits, until_s: float) -> NDArray[np.float64]:
    """From the onset of a hit over its release to a time, mission frame (n, 4)."""
    release_s = float(hit.t_s[0] + hit.duration_s[0])
    points = [(float(hit.x[0]), float(hit.y[0]), 0.0, 0.0)]
    for t_s in np.linspace(0.0, max(until_s - release_s, 0.0), _POINTS):
        at = flight.at(hit.leg, float(t_s))
        x, y = float(at.x[0, 0] + at.goal_x[0]), float(at.y[0, 0] + at.goal_y[0])
        points.append((x, y, float(at.x[1, 0]), float(at.y[1, 0])))
    return np.array(points)
