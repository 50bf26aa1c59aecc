"""Where the vehicle is sent: target, trajectory, heading, and the references of them."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3, add, norm, scale, wrap_angle
from dart_flight.base.records import OdometrySample
from dart_flight.config.mission import Mission
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.setpoints import FreeAxes, Reference
from dart_flight.core.mission.trajectories import AfterEnd, Trajectory
from dart_flight.core.sense.state import FlightState

_ARRIVED_YAW_RAD: Final = 0.05
# Times the distance, speed and heading of an arrival where PX4's position drifts: it does not come to rest,
# and waiting for the last degrees after a hit ages the contacts by seconds.
_DRIFTING_NEAR: Final = 2.5
_DRIFTING_SLOW: Final = 4.0
_DRIFTING_TURNED: Final = 2.0


class SetpointGenerator:
    """The target and the trajectory to it.

    Without a trajectory the target is held as a step; a trajectory is a transit (rest to rest), an approach
    (into the wall) or one that was planned in flight, as a function of the time since `begin`.

    Attributes:
        target: where the vehicle is sent, mission frame, metres.
        yaw: heading wanted, mission frame, radians.
        yaw_asked: heading asked for where that is not the one wanted yet (`heading`).
        altitude_m: at which the vehicle is sent anywhere.
        impact_s: when the approach under way meets its wall, since its beginning.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission, self._flying = mission, mission.vehicle.flying
        self.target: Vec3 = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self.yaw_asked: float | None = None
        self.altitude_m = mission.altitude_m
        self.impact_s = 0.0
        self._trajectory: Trajectory | None = None
        self._yaw_us = 0
        self._arrived_us: int | None = None
        flying, drifts = self._flying, mission.is_anchored
        self._arrived_m = flying.arrive_m * (_DRIFTING_NEAR if drifts else 1.0)
        self._arrived_m_s = flying.arrive_speed_m_s * (_DRIFTING_SLOW if drifts else 1.0)
        self._arrived_rad = _ARRIVED_YAW_RAD * (_DRIFTING_TURNED if drifts else 1.0)
        self._delay_s = flying.setpoint_delay_s or 0.0
        self._dead_s = flying.attitude_delay_s or 0.0

    # -- where to --

    def stand(self, position: Vec3, yaw: float, now_us: int) -> None:
        """Where the vehicle stands on the ground."""
        self.target = (position[0], position[1], 0.0)
        self.yaw, self._yaw_us = yaw, now_us

    def hold(self, point: Vec2 | Vec3) -> None:
        """Hold a point at the present altitude, from now on."""
        self.target, self._trajectory = self._at_altitude(point), None

    def move_frame(self, by: Vec2) -> None:
        """The mission frame's origin has moved, in its axes: what is held stays where it is."""
        x, y, z = self.target
        self.target = (x - by[0], y - by[1], z)

    def climb(self) -> None:
        """From the ground to the mission's altitude."""
        self._transit_to(self._at_altitude(self.target), self._flying.climb_speed_m_s)

    def fly_to(self, point: Vec2, speed_m_s: float | None = None) -> None:
        """From rest at the target to rest at a point; by default at transit speed."""
        self._transit_to(self._at_altitude(point), speed_m_s or self._flying.transit_speed_m_s)

    def fly_to_waypoint(self, place: Vec3, speed_m_s: float) -> None:
        """From rest at the target to rest at a waypoint, whose altitude is kept from now on."""
        self.altitude_m = place[2]
        self._transit_to(place, speed_m_s)

    def approach(self, approach: Trajectory) -> None:
        """Along an approach, whose beginning is the target, into the wall."""
        self._trajectory, self.impact_s = approach, approach.duration_s

    def follow_trajectory(self, trajectory: Trajectory) -> None:
        """A trajectory that was planned, in flight or before it; its end becomes the target."""
        self.target, self._trajectory = trajectory.at(trajectory.duration_s).position, trajectory

    def _transit_to(self, target: Vec3, speed_m_s: float) -> None:
        flying = self._flying
        self._trajectory = Trajectory.rest_to_rest(
            self.target, target, speed_m_s, flying, flying.climb_speed_m_s
        )
        self.target = target

    def _at_altitude(self, point: Vec2 | Vec3) -> Vec3:
        return (point[0], point[1], self.altitude_m)

    # -- on the way --

    @property
    def on_transit(self) -> bool:
        """Whether a transit leads to the target."""
        return self._trajectory is not None and self._trajectory.after is AfterEnd.HOLD

    @property
    def duration_s(self) -> float:
        """Of the trajectory to the target; 0 without one."""
        return 0.0 if self._trajectory is None else self._trajectory.duration_s

    @property
    def along_trajectory(self) -> bool:
        """Whether a planned trajectory leads to the target; it may pass it before its end."""
        return self._trajectory is not None and self._trajectory.after is AfterEnd.CONTINUE

    def phase_begins(self) -> None:
        """Arrival counts anew."""
        self._arrived_us = None

    def has_arrived(self, state: FlightState, wanted_yaw: float) -> bool:
        """At the target, slow (`is_slow`), and heading as wanted, for the configured time."""
        near = (
            math.dist(state.position, self.target) < self._arrived_m
            and self.is_slow(state)
            and abs(wrap_angle(state.yaw - wanted_yaw)) < self._arrived_rad
        )
        if not near:
            self._arrived_us = None
            return False
        if self._arrived_us is None:
            self._arrived_us = state.now_us
        return state.now_us - self._arrived_us >= self._flying.arrive_s * 1e6

    def is_slow(self, state: FlightState) -> bool:
        """Whether the mean velocity over `flying.arrive_mean_s` is below `flying.arrive_speed_m_s`."""
        return norm(state.mean_velocity(self._flying.arrive_mean_s)) < self._arrived_m_s

    def slew_yaw(self, wanted: float, now_us: int) -> None:
        """Turn the heading asked for towards the wanted one, at the configured rate at most."""
        most = math.radians(self._flying.yaw_rate_deg_s) * (now_us - self._yaw_us) * 1e-6
        self.yaw = wrap_angle(self.yaw + max(-most, min(most, wrap_angle(wanted - self.yaw))))
        self._yaw_us = now_us

    # -- references --

    @property
    def heading(self) -> float:
        """Heading to command, mission frame, rad."""
        return self.yaw if self.yaw_asked is None else self.yaw_asked

    def reference(self, t_us: int, since_us: int | None) -> Reference:
        """Return what to command at a moment: of the trajectory, or the target as a step.

        Args:
            t_us: stamp of the sample that asks for it.
            since_us: when the trajectory began; None: there is none yet.
        """
        trajectory = self._trajectory
        if trajectory is None or since_us is None:
            return Reference(self.target)
        return self.led(trajectory, (t_us - since_us) * 1e-6)

    def led(self, trajectory: Trajectory, since_s: float) -> Reference:
        """Return the reference of a trajectory for the moment at which PX4 flies it.

        The acceleration is that of a later moment, because the attitude lags; but never of one beyond a wall,
        where a trajectory asks for no thrust. Added to it are the drag that the vehicle will meet and what
        PX4's D term takes away again, so that no error builds up for the position loop.
        """
        flown_s = since_s + self._delay_s
        flown = trajectory.at(flown_s)
        tilted_s = min(flown_s + self._dead_s, max(since_s, trajectory.duration_s))
        tilted = flown if tilted_s == flown_s else trajectory.at(tilted_s)
        v, a, b = flown.velocity, tilted.acceleration, self._mission.vehicle.airframe.drag_per_s
        d, lead = 1.0 + self._mission.vehicle.px4.mpc_xy_vel_d_acc, ATTITUDE_LAG_S - self._dead_s
        # The jerk of a flight from rest to rest jumps at both ends: it is not led.
        j = tilted.jerk if trajectory.after is AfterEnd.CONTINUE else (0.0, 0.0, 0.0)
        push = (
            (d + lead * b[0]) * a[0] + b[0] * v[0] + lead * j[0],
            (d + lead * b[1]) * a[1] + b[1] * v[1] + lead * j[1],
            a[2] + b[2] * v[2],
        )
        return Reference(flown.position, v, push)

    def free_axes(self, frame: MissionFrame, sample: OdometrySample, along: tuple[Vec2, ...]) -> FreeAxes:
        """Return axes to leave free, with the motion at the moment at which PX4 flies the setpoint."""
        velocity = frame.vector_from_ned(sample.velocity_ned)
        position = frame.point_from_ned(sample.position_ned)
        return FreeAxes(along, add(position, scale(velocity, self._delay_s)), velocity)
