"""Records of a plan and of a search's result, which both the grid search (`search`) and `quickest` return."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2, Vec2
from dart_flight.base.records import Mode
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.lab.search.scenario import Scenario
from dart_flight.planning.constraints import Refusal
from dart_flight.planning.flight_model import Array, Rows

_SPEED_USED = 0.95  # fraction of the speed limit used; the rest is a margin for tracking errors


class PlannedCollision(msgspec.Struct, frozen=True, omit_defaults=True):
    """A predicted collision.

    Attributes:
        wall, mode: wall and mode.
        t_s: time from the start of the run-up or of the first trajectory to the onset of the contact.
        position_m: position of the vehicle's centre at the onset, mission frame.
        normal_m_s, tangential_m_s: velocity at the onset, collision frame.
        peak_force_n: peak of the normal force.
        peak_friction_n: peak of the friction force.
        contact_time_s: duration of the contact.
        setpoint_m: recovery setpoint, mission frame; None if the plan continues along a trajectory.
        acceleration_m_s2: (normal, tangential) acceleration at the onset; None without trajectories.
    """

    wall: str
    mode: Mode
    t_s: float
    position_m: Vec2
    normal_m_s: float
    tangential_m_s: float
    peak_force_n: float
    peak_friction_n: float
    contact_time_s: float
    setpoint_m: Vec2 | None = None
    acceleration_m_s2: Vec2 | None = None


class Plan(msgspec.Struct, frozen=True):
    """A feasible flight from start to goal.

    The grid search plans the run-up to the first collision, and each recovery leads to the next wall or to
    the goal. With the objective `quickest`, a plan has trajectories, and may have no collision.

    Attributes:
        rank: 1 is the best.
        score: value of the ranking criterion; smaller is better. The unit is m (nearest, robust), s (fastest,
            quickest) or N (gentlest).
        goal_miss_m: smallest distance to the goal after the last contact, at nominal values.
        time_to_goal_s: time from `start` to the closest approach, including transit and run-up, plus the time
            for the remaining distance to the goal at transit speed.
        peak_force_n: largest force of any contact, normal and friction together.
        closest_m: position of the closest approach, mission frame.
        expected_miss_m, worst_miss_m: mean and largest miss of the goal over the random sets of values
            (draws), only for `robust`. If the plan fails in a draw, its miss is the distance from start to
            goal, but at least 1 m.
        failed_draws: fraction of the draws in which the plan fails because it violates a constraint.
        time_to_rest_s: time from `start` until the vehicle rests at the goal. In the grid search, the flight
            from the closest approach to rest uses the motion limits of the collision-free flight.
        saving_s: time of the fastest flight without a collision minus `time_to_rest_s`; negative if the plan
            is slower. None if the time of that flight is unknown.
        visits_s: time at which the vehicle passes each visit; if a hit serves a visit, this is the onset.
        cruise_m_s: speed until the vehicle reacts to the detected wall, in a scenario with `sight`.
        legs: trajectories to the collisions and to the goal; empty in the grid search.
    """

    rank: int
    score: float
    goal_miss_m: float
    time_to_goal_s: float
    peak_force_n: float
    closest_m: Vec2
    collisions: tuple[PlannedCollision, ...]
    expected_miss_m: float | None = None
    worst_miss_m: float | None = None
    failed_draws: float | None = None
    time_to_rest_s: float | None = None
    saving_s: float | None = None
    visits_s: tuple[float, ...] = ()
    cruise_m_s: float | None = None
    legs: tuple[TrajectoryPieces, ...] = ()

    @property
    def sequence(self) -> tuple[str, ...]:
        """The walls in the order of the hits."""
        return tuple(c.wall for c in self.collisions)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The modes of the collisions."""
        return tuple(c.mode for c in self.collisions)


class MotionLimits(msgspec.Struct, frozen=True):
    """The limits of a trajectory; None for `jerk_m_s3` means that the jerk is not limited."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float | None
    tilt_deg: float

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> MotionLimits:
        flying, px4 = scenario.vehicle.flying, scenario.vehicle.px4
        tilt = math.degrees(math.atan2(flying.acceleration_m_s2, GRAVITY_M_S2))
        speed = scenario.limits.speed_m_s
        if scenario.limits.acceleration_m_s2 is None:
            speed = min(speed, flying.transit_speed_m_s)
        return cls(
            _SPEED_USED * speed, flying.acceleration_m_s2, flying.jerk_m_s3, min(tilt, px4.mpc_tiltmax_air)
        )


class FreeTime(msgspec.Struct, frozen=True):
    """The time of the fastest contact-free flight from rest at the start to rest at the goal.

    Attributes:
        time_s: duration; None without a path.
        gap_s: upper bound on how much faster another flight could be; 0 for an optimum.
        length_m: length of the polyline.
        via: corners of the polyline, mission frame.
        limits: limits of the motion.
    """

    time_s: float | None
    gap_s: float
    length_m: float
    via: tuple[Vec2, ...]
    limits: MotionLimits


class Candidates(NamedTuple):
    """All feasible candidates of one sequence of walls and modes, as arrays (n,), for ranking and maps."""

    sequence: tuple[str, ...]
    modes: tuple[Mode, ...]
    rows: Rows  # indices into the grid of approach velocities, that of the normal velocity first
    normal_m_s: Array
    tangential_m_s: Array
    miss_m: Array
    time_s: Array
    force_n: Array
    x: Array
    y: Array
    score: Array
    expected_m: Array | None
    worst_m: Array | None
    failed: Array | None


class SearchResult(msgspec.Struct, frozen=True):
    """The result of a search for plans.

    Attributes:
        plans: the best plans, in order. With `quickest`, they are the fastest plan with a collision and the
        fastest plan without one; if the scenario requires a sequence, its plan is first. candidates,
        feasible: number of candidates, and number of feasible candidates. With `quickest`, candidates are
        sequences of collisions; sequences that their bounds rule out count as infeasible.
        trajectories: number of simulated or computed trajectories, including the draws of `robust`.
        elapsed_s: duration, including preparation.
        refused: number of rejected candidates for each reason.
        free_time: duration of the fastest collision-free flight, only in the grid search; None if the extra
            `plan` is not installed.
        maps: all feasible candidates of the grid search.
        gap_s: upper bound on how much faster than the best plan a skipped sequence could be.
        most_hits: maximum number of hits that was searched; None if more hits cannot be faster.
    """

    scenario: Scenario
    plans: tuple[Plan, ...]
    candidates: int
    feasible: int
    trajectories: int
    elapsed_s: float
    refused: dict[Refusal, int] = {}
    free_time: FreeTime | None = None
    maps: tuple[Candidates, ...] = ()
    gap_s: float = 0.0
    most_hits: int | None = None

    @property
    def best(self) -> Plan:
        """The best plan."""
        return self.plans[0]

    @property
    def free(self) -> Plan | None:
        """The best plan without a collision, which only `quickest` finds, or None."""
        return next((plan for plan in self.plans if not plan.collisions), None)

    @property
    def colliding(self) -> Plan | None:
        """The best plan with a collision, or None."""
        return next((plan for plan in self.plans if plan.collisions), None)

    @property
    def saving_s(self) -> float | None:
        """The time that the best plan with a collision saves; negative if this plan is slower."""
        return None if self.colliding is None else self.colliding.saving_s
