"""Run-ups and approaches of all candidates together, by the core's rules (`core.mission.approach`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.arithmetic import Number
from dart_flight.base.walls import Wall
from dart_flight.contact.coefficients import Array
from dart_flight.core.mission.approach import impact_time_s, is_blocked, run_up, segments_to_impact
from dart_flight.core.mission.trajectories import transit_time_s
from dart_flight.core.mission.wall_uncertainty import end_margin_m
from dart_flight.planning.constraints import Constraints, Refusal
from dart_flight.planning.task import Task

Codes = NDArray[np.int8]


class ApproachGrid(NamedTuple):
    """The approach of every candidate to the first wall; arrays that broadcast with the velocities.

    Attributes:
        wall: the first wall at its assumed position; the true wall may be displaced.
        codes: reason to refuse the approach (`Refusal`), 0 if it can be flown.
        impact_x, impact_y: point at which the centre reaches the wall's plane, mission frame, m.
        begin_x, begin_y: point at which the run-up starts, mission frame, m.
        impact_s: time from the start of the run-up to the impact.
        transit_s: duration of the flight from the task's `start` to the run-up point.
    """

    wall: Wall
    codes: Codes
    impact_x: Array
    impact_y: Array
    begin_x: Array
    begin_y: Array
    impact_s: Array
    transit_s: Array


def approach_grid(
    task: Task, wall: Wall, normal: Array, tangential: Array, constraints: Constraints | None
) -> ApproachGrid:
    """Return the approaches to a wall at given velocities in its collision frame (m/s, normal < 0).

    If `constraints` is None, no approach is refused.
    """
    flying, (sx, sy) = task.vehicle.flying, task.start
    (nx, ny), (tx, ty) = wall.normal, wall.tangent
    vx, vy = nx * normal + tx * tangential, ny * normal + ty * tangential
    until = wall.signed_distance(task.start) / -normal
    impact: tuple[Number, Number] = (sx + vx * until, sy + vy * until)
    begin, _, speed, ramp = run_up(task.start, impact, (vx, vy), flying, wall)
    length = np.hypot(begin[0] - impact[0], begin[1] - impact[1])
    distance_m = np.hypot(begin[0] - sx, begin[1] - sy)
    transit = transit_time_s(distance_m, flying.transit_speed_m_s, flying.acceleration_m_s2, flying.jerk_m_s3)
    codes = np.zeros(np.shape(speed), dtype=np.int8)
    grid = ApproachGrid(wall, codes, *impact, *begin, impact_time_s(length, speed, ramp), transit)
    if constraints is None:
        return grid
    mark = constraints.mark
    legs = segments_to_impact(task.start, begin, impact, wall, first=True)
    for other in task.walls.values():
        for leg in legs(other):
            mark(codes, is_blocked(other, *leg), Refusal.RUN_UP_BLOCKED)
    b = task.bounds
    for x, y in (impact, begin):
        outside = (x < b.x[0]) | (x > b.x[1]) | (y < b.y[0]) | (y > b.y[1])
        mark(codes, outside, Refusal.RUN_UP_ROOM)
    beyond = (wall.end_distance_m(impact) < end_margin_m(wall, impact)) | (until + 0.0 * speed <= 0.0)
    mark(codes, beyond, Refusal.BEYOND_WALL)
    mark(codes, speed > task.limits.speed_m_s, Refusal.APPROACH_SPEED)
    return grid
