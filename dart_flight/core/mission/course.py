"""The course of the vehicle: a target, the trajectory to it, and the conditions of arrival."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2, Vec3, norm, wrap_angle
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Flying
from dart_flight.core.mission.trajectories import AfterEnd, Trajectory
from dart_flight.core.sense.state import FlightState

ARRIVED_M: Final = 0.12  # largest distance from a reached target; PX4's error in hover is smaller
ARRIVED_M_S: Final = 0.1
ARRIVED_S: Final = 0.3  # position and speed must be within their limits for this time
MEAN_SPEED_S: Final = 0.3  # averaging time for PX4's velocity, which vibrates (docs/results/real_data.md)
_ARRIVED_YAW_RAD: Final = 0.05
# Factors on an arrival's limits of distance, speed and heading if PX4's position drifts. A drifting vehicle
# does not come to rest, and waiting for the last degrees lets the frame drift for seconds.
_DRIFTING_NEAR: Final = 2.5
_DRIFTING_SLOW: Final = 4.0
_DRIFTING_TURNED: Final = 2.0


class Course(NamedTuple):
    """Target and trajectory; each method returns the next course.

    Attributes:
        target: position to reach, mission frame, metres.
        altitude_m: current altitude of the mission.
        trajectory: leads to the target, or into a wall; None if only the target is commanded.
    """

    target: Vec3
    altitude_m: float
    trajectory: Trajectory | None = None

    def hold(self, point: Vec2 | Vec3) -> Course:
        return Course((point[0], point[1], self.altitude_m), self.altitude_m)

    def move_frame(self, by: Vec2) -> Course:
        """Keep the target's real position when the mission frame's origin moves by `by`, in frame axes."""
        x, y, z = self.target
        return self._replace(target=(x - by[0], y - by[1], z))

    def climb(self, flying: Flying) -> Course:
        x, y, _ = self.target
        return self._transit((x, y, self.altitude_m), flying.climb_speed_m_s, flying)

    def fly_to(self, point: Vec2, flying: Flying, speed_m_s: float | None = None) -> Course:
        """Fly from the current target to a point, from rest to rest, by default at transit speed."""
        target = (point[0], point[1], self.altitude_m)
        return self._transit(target, speed_m_s or flying.transit_speed_m_s, flying)

    def fly_to_waypoint(self, place: Vec3, flying: Flying, speed_m_s: float) -> Course:
        """Fly from rest at the target to rest at a waypoint; later targets keep the waypoint's altitude."""
        return self._replace(altitude_m=place[2])._transit(place, speed_m_s, flying)

    def follow(self, trajectory: Trajectory) -> Course:
        """Follow a planned trajectory; its end becomes the target."""
        end = trajectory.at(trajectory.duration_s).position
        return self._replace(target=end, trajectory=trajectory)

    def approach(self, trajectory: Trajectory) -> Course:
        """Follow an approach from the target into a wall."""
        return self._replace(trajectory=trajectory)

    def _transit(self, target: Vec3, speed_m_s: float, flying: Flying) -> Course:
        transit = Trajectory.rest_to_rest(self.target, target, speed_m_s, flying, flying.climb_speed_m_s)
        return self._replace(target=target, trajectory=transit)

    @property
    def on_transit(self) -> bool:
        """Whether a flight from rest to rest leads to the target."""
        return self.trajectory is not None and self.trajectory.after is AfterEnd.HOLD

    @property
    def duration_s(self) -> float:
        return 0.0 if self.trajectory is None else self.trajectory.duration_s


class Arrival:
    """The conditions of an arrival at a target."""

    def __init__(self, mission: Mission) -> None:
        drifts = mission.is_anchored
        self._near_m = ARRIVED_M * (_DRIFTING_NEAR if drifts else 1.0)
        self._slow_m_s = ARRIVED_M_S * (_DRIFTING_SLOW if drifts else 1.0)
        self._turned_rad = _ARRIVED_YAW_RAD * (_DRIFTING_TURNED if drifts else 1.0)

    def is_at(self, target: Vec3, yaw: float, state: FlightState) -> bool:
        return (
            math.dist(state.position, target) < self._near_m
            and self.is_slow(state)
            and abs(wrap_angle(state.yaw - yaw)) < self._turned_rad
        )

    def is_slow(self, state: FlightState) -> bool:
        return norm(state.mean_velocity(MEAN_SPEED_S)) < self._slow_m_s
