"""Inputs of a rollout: the vehicle, the room, and the modes and gains at each wall.

`make_task` returns the inputs for part of a mission. A scenario of the planner has the same fields (`Task`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import msgspec

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.mission_file import BoundsSpec, GoalSpec, Limits
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.mission.approach import run_up


class MissionTask(NamedTuple):
    """The inputs of a rollout from a mission; `make_task` gives each collision its own wall name."""

    vehicle: VehicleConfig
    start: Vec2
    goal: GoalSpec
    bounds: BoundsSpec
    walls: dict[str, Wall]
    limits: Limits
    modes: tuple[Mode, ...]
    alphas: dict[str, tuple[float, float]]


class Task(Protocol):
    """The inputs of a rollout, from part of a mission (`MissionTask`) or from a scenario."""

    @property
    def vehicle(self) -> VehicleConfig: ...

    @property
    def start(self) -> Vec2:
        """Start of the run-up, mission frame, metres."""

    @property
    def goal(self) -> GoalSpec: ...

    @property
    def bounds(self) -> BoundsSpec: ...

    @property
    def walls(self) -> dict[str, Wall]:
        """Walls by name; each is hit at most once."""

    @property
    def limits(self) -> Limits: ...

    @property
    def modes(self) -> tuple[Mode, ...]: ...

    @property
    def alphas(self) -> dict[str, tuple[float, float]]:
        """Gains (A_n, A_t) of the recovery setpoint per wall, m/N."""


def make_task(mission: Mission, group: Sequence[Collision]) -> MissionTask:
    """Return a task with one candidate only: the approach of the group's first collision."""
    first = group[0]
    assert first.approach_m_s is not None
    assert first.impact_point is not None
    # A rollout's wall is on the ray from the start, so the run-up begins at the start.
    vx, vy, _ = first.approach_velocity()
    flying = mission.vehicle.flying
    start = run_up(mission.start, first.impact_point, (vx, vy), flying, first.wall).begin
    return MissionTask(
        mission.vehicle,
        start,
        mission.goal,
        mission.bounds,
        {str(c.index): msgspec.structs.replace(c.wall, name=str(c.index)) for c in group},
        mission.limits,
        mission.vehicle.modes,
        {str(c.index): (c.alpha_normal_m_per_n, c.alpha_tangential_m_per_n) for c in group},
    )


def drag_along(wall: Wall, drag_per_s: Sequence[float]) -> tuple[float, float]:
    """Return the air drag along a wall's normal and tangent, 1/s, from the drag along the mission's axes."""
    n2 = wall.normal[0] ** 2
    bx, by = drag_per_s[:2]
    return n2 * bx + (1.0 - n2) * by, n2 * by + (1.0 - n2) * bx
