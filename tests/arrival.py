"""Arrival times at the goal, of flown and of planned flights. Both use the same limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission
from dart_flight.lab.search.plan import Plan
from dart_flight.recording.reader import Log

THERE_M, STILL_M_S = 0.15, 0.3  # distance from the goal and speed at which a flight or plan has arrived
_UNDER_WAY_US = 500_000  # shortest flight, for missions that start at their goal


class GoalArrival(NamedTuple):
    """The arrival of a flight at its goal; times are stamps of the flight's log, us.

    Attributes:
        begin_us: time at which the mission's own trajectories begin.
        visits_us: time at which the vehicle passes each visited place, up to the first missed place.
        there_us: time after the visits at which the vehicle is nearly at rest at the goal; None if it landed
            earlier.
    """

    begin_us: float
    visits_us: tuple[float, ...]
    there_us: float | None

    @property
    def there_s(self) -> float | None:
        """The duration of the flight to the goal."""
        return None if self.there_us is None else (self.there_us - self.begin_us) * 1e-6


def arrival_of(log: Log, mission: Mission, visits: Sequence[tuple[Vec2, float]]) -> GoalArrival | None:
    """Return the arrival of a simulated flight, or None if its trajectories never began.

    `visits` are (place, largest distance in metres at which the vehicle may pass this place).
    """
    truth, phases = log["/truth/state"], log["/event/phase"]
    changes = list(zip(phases["t_us"], map(str, phases["after"]), phases["collision"], strict=True))
    # A touch before the mission's own trajectories also has an approach.
    own = next((c.index for c in mission.collisions if c.trajectory is not None), None)
    first = "goal" if own is None else "approach"
    begins = [t for t, after, led_to in changes if after == first and own in (None, led_to)]
    if not begins:
        return None
    begin_us = float(begins[0])
    landing_us = max((float(t) for t, after, _ in changes if after == "landing"), default=-math.inf)
    t, place = np.asarray(truth["t_us"]), np.asarray(truth["position_mission"])[:, :2]
    speed = np.linalg.norm(np.asarray(truth["velocity_mission"])[:, :2], axis=1)
    passed: list[float] = []
    for at, within_m in visits:
        earliest = passed[-1] if passed else begin_us
        near = np.flatnonzero((np.linalg.norm(place - np.array(at), axis=1) <= within_m) & (t >= earliest))
        if not near.size:
            break
        passed.append(float(t[near[0]]))
    last = max(passed[-1] if passed else 0.0, begin_us + _UNDER_WAY_US)
    still = np.linalg.norm(place - np.array(mission.goal.position_m), axis=1) <= THERE_M
    still &= (speed <= STILL_M_S) & (t > last) & (t < landing_us)
    there = np.flatnonzero(still)
    return GoalArrival(begin_us, tuple(passed), float(t[there[0]]) if there.size else None)


def planned_there_s(plan: Plan, goal: tuple[float, float]) -> float:
    """Return the time, s, after which a planned flight remains slow and close to the goal."""
    last = plan.legs[-1]
    begin = plan.time_to_goal_s - last.duration_s
    there = begin
    for before, after in zip(last.states(), last.states()[1:], strict=False):
        for share in np.linspace(0.0, 1.0, 20):
            t = before.t_s + share * (after.t_s - before.t_s)
            p = [a + share * (b - a) for a, b in zip(before.position, after.position, strict=True)]
            v = [a + share * (b - a) for a, b in zip(before.velocity, after.velocity, strict=True)]
            if math.dist(p, goal) > THERE_M or math.hypot(*v) > STILL_M_S:
                there = float(begin + t)
    return there
