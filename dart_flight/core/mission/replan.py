"""State of the planning after a contact: request, answer, and the active trajectory."""

from __future__ import annotations

import math
from typing import NamedTuple

from dart_flight.base.records import PlanAnswer, PlanRequest
from dart_flight.core.mission.position_loop import PlaneImpact
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.sense.state import FlightState


class Replan(NamedTuple):
    """State of one flight's requests to the planner, with the trajectory in flight; times are autopilot time.

    Attributes:
        number, tries: number of requests in this flight, and since the last contact.
        has_wall_estimate: whether the last contact has produced an estimate of its wall.
        request: the request that an answer must match.
        answer: accepted answer whose trajectory has not begun; otherwise None.
        from_rest: whether the request was for an approach from rest.
        trajectory, begin_us: the active trajectory and its start time.
        ends_leaning: whether the trajectory ends with the tilt that the impact needs, like the mission's own
            trajectories.
        must_not_be_later: whether to reject a new trajectory that ends much later than the active trajectory.
        impact_us: time at which the trajectory reaches the next wall.
    """

    number: int = 0
    tries: int = 0
    has_wall_estimate: bool = False
    request: PlanRequest | None = None
    answer: PlanAnswer | None = None
    from_rest: bool = False
    trajectory: Trajectory | None = None
    begin_us: int = 0
    ends_leaning: bool = False
    must_not_be_later: bool = True
    impact_us: int | None = None

    def contact_begins(self) -> Replan:
        """Discard earlier requests and plans at an onset."""
        return Replan(
            self.number,
            from_rest=self.from_rest,
            begin_us=self.begin_us,
            must_not_be_later=self.must_not_be_later,
        )

    @property
    def since_us(self) -> int | None:
        """Start time of the active trajectory, or None if only a position setpoint is active."""
        return None if self.trajectory is None else self.begin_us

    @property
    def is_leaned(self) -> bool:
        return self.trajectory is not None and self.ends_leaning

    def is_over(self, now_us: int) -> bool:
        return self.trajectory is not None and now_us - self.begin_us >= self.trajectory.duration_s * 1e6

    def impact_in_s(self, state: FlightState) -> float:
        """Return the time until the trajectory's next impact; minus infinity if no impact is planned."""
        return -math.inf if self.impact_us is None else (self.impact_us - state.now_us) * 1e-6

    def predict_impact(self, closing_m_s: float, state: FlightState) -> PlaneImpact | None:
        """Return the trajectory's predicted impact with the next wall, or None if no impact is planned."""
        if self.impact_us is None:
            return None
        return PlaneImpact(max(0.0, (self.impact_us - state.now_us) * 1e-6), -closing_m_s)
