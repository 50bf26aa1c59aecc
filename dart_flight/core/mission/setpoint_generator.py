"""Where the vehicle is sent: target, references on the way to it, heading, and the setpoints of them."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3, add, norm, scale, wrap_angle
from dart_flight.base.records import OdometrySample, Setpoint
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import Approach, PlannedApproach
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.trajectories import PlannedTrajectory, TrajectoryPoint, TransitTrajectory
from dart_flight.core.sense.state import FlightState

ARRIVED_M: Final = 0.12  # nearer to the target than PX4's position loop strays in hover
ARRIVED_M_S: Final = 0.1
ARRIVED_S: Final = 0.3  # place and speed have to hold for so long
MEAN_SPEED_S: Final = 0.3  # PX4's velocity shakes with the accelerometer (docs/results/real_data.md)
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
        self._trajectory: TransitTrajectory | Approach | PlannedApproach | PlannedTrajectory | None = None
        self._yaw_us = 0
        self._arrived_us: int | None = None
        flying, drifts = self._flying, mission.is_anchored
        self._arrived_m = ARRIVED_M * (_DRIFTING_NEAR if drifts else 1.0)
        self._arrived_m_s = ARRIVED_M_S * (_DRIFTING_SLOW if drifts else 1.0)
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

    def approach(self, approach: Approach | PlannedApproach) -> None:
        """Along an approach, whose beginning is the target, into the wall."""
        self._trajectory, self.impact_s = approach, approach.impact_s

    def follow_trajectory(self, trajectory: PlannedTrajectory) -> None:
        """A trajectory that was planned, in flight or before it; its end becomes the target."""
        self.target, self._trajectory = trajectory.at(trajectory.duration_s).position, trajectory

    def _transit_to(self, target: Vec3, speed_m_s: float) -> None:
        flying = self._flying
        self._trajectory = TransitTrajectory.between(
            self.target, target, speed_m_s, flying, flying.climb_speed_m_s
        )
        self.target = target

    def _at_altitude(self, point: Vec2 | Vec3) -> Vec3:
        return (point[0], point[1], self.altitude_m)

    # -- on the way --

    @property
    def on_transit(self) -> bool:
        """Whether a transit leads to the target."""
        return isinstance(self._trajectory, TransitTrajectory)

    @property
    def duration_s(self) -> float:
        """Of the trajectory to the target; 0 without one."""
        trajectory = self._trajectory
        return trajectory.duration_s if isinstance(trajectory, TransitTrajectory | PlannedTrajectory) else 0.0

    @property
    def along_trajectory(self) -> bool:
        """Whether a planned trajectory leads to the target; it may pass it before its end."""
        return isinstance(self._trajectory, PlannedTrajectory)

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
        return state.now_us - self._arrived_us >= ARRIVED_S * 1e6

    def is_slow(self, state: FlightState) -> bool:
        """Whether the mean velocity over `MEAN_SPEED_S` is below `ARRIVED_M_S`."""
        return norm(state.mean_velocity(MEAN_SPEED_S)) < self._arrived_m_s

    def slew_yaw(self, wanted: float, now_us: int) -> None:
        """Turn the heading asked for towards the wanted one, at the configured rate at most."""
        most = math.radians(self._flying.yaw_rate_deg_s) * (now_us - self._yaw_us) * 1e-6
        self.yaw = wrap_angle(self.yaw + max(-most, min(most, wrap_angle(wanted - self.yaw))))
        self._yaw_us = now_us

    # -- setpoints --

    def setpoint(
        self,
        frame: MissionFrame,
        t_us: int,
        received_us: int,
        since_us: int | None,
        feed_forward: Vec3 | None = None,
    ) -> Setpoint:
        """The setpoint for a sample.

        Args:
            frame: of the mission.
            t_us, received_us: of the sample.
            since_us: when the trajectory began; None: go to the target as a step.
            feed_forward: acceleration to a step, mission frame, m/s2 (`yielding`).
        """
        if self._trajectory is None or since_us is None:
            return self._make(frame, t_us, received_us, self.target, feed_forward=feed_forward)
        reference = self._reference((t_us - since_us) * 1e-6)
        return self._make(frame, t_us, received_us, reference.position, reference)

    def coasting_setpoint(
        self, frame: MissionFrame, sample: OdometrySample, since_us: int, wall: Wall, push_m_s2: float = 0.0
    ) -> Setpoint:
        """The reference along a wall, but of what it asks across it only the thrust.

        Who comes a little late or slow to a wall must not lean into it to make up for that: the contact turns
        a leaning vehicle over. But for `push_m_s2` off the wall, that balances it.
        """
        assert self._trajectory is not None
        reference = self._reference((sample.t_us - since_us) * 1e-6)
        (nx, ny), p, v = wall.normal, reference.position, reference.velocity
        now = frame.vector_from_ned(sample.velocity_ned)
        here = add(frame.point_from_ned(sample.position_ned), scale(now, self._delay_s))
        off = (here[0] - p[0]) * nx + (here[1] - p[1]) * ny
        off_m_s = (now[0] - v[0]) * nx + (now[1] - v[1]) * ny
        ax, ay, az = self._feed_forward(reference)
        return Setpoint(
            t_us=sample.t_us,
            trigger_received_us=sample.received_us,
            position_ned=frame.point_to_ned((p[0] + off * nx, p[1] + off * ny, self.altitude_m)),
            yaw_ned_rad=self._yaw_ned(frame),
            velocity_ned=frame.vector_to_ned((v[0] + off_m_s * nx, v[1] + off_m_s * ny, 0.0)),
            acceleration_ned=frame.vector_to_ned((ax + push_m_s2 * nx, ay + push_m_s2 * ny, az)),
        )

    def recovery_setpoint(
        self, frame: MissionFrame, t_us: int, received_us: int, feed_forward: Vec3 | None = None
    ) -> Setpoint:
        """The target as the setpoint of an impact, whose latency is measured."""
        return self._make(frame, t_us, received_us, self.target, recovery=True, feed_forward=feed_forward)

    def contact_setpoint(
        self,
        frame: MissionFrame,
        sample: OdometrySample,
        feed_forward: Vec3 | None,
        reference: TrajectoryPoint | None = None,
    ) -> Setpoint:
        """What the vehicle does anyway, at the present altitude: nothing pushes on into a wall.

        Of a trajectory (`reference`) that begins after the contact only the thrust is asked for.
        """
        x, y, _ = frame.point_from_ned(sample.position_ned)
        vx, vy, _ = frame.vector_from_ned(sample.velocity_ned)
        if reference is not None:
            push, extra = self._feed_forward(reference), feed_forward or (0.0, 0.0, 0.0)
            feed_forward = (push[0] + extra[0], push[1] + extra[1], 0.0)
        return Setpoint(
            t_us=sample.t_us,
            trigger_received_us=sample.received_us,
            position_ned=frame.point_to_ned((x, y, self.altitude_m)),
            yaw_ned_rad=self._yaw_ned(frame),
            velocity_ned=frame.vector_to_ned((vx, vy, 0.0)),
            acceleration_ned=frame.vector_to_ned(feed_forward or (0.0, 0.0, 0.0)),
        )

    def _yaw_ned(self, frame: MissionFrame) -> float:
        return frame.yaw_to_ned(self.yaw if self.yaw_asked is None else self.yaw_asked)

    def _make(
        self,
        frame: MissionFrame,
        t_us: int,
        received_us: int,
        position: Vec3,
        reference: TrajectoryPoint | None = None,
        recovery: bool = False,
        feed_forward: Vec3 | None = None,
    ) -> Setpoint:
        velocity = acceleration = None
        if feed_forward is not None:  # PX4 takes an acceleration only with a velocity
            velocity, acceleration = (0.0, 0.0, 0.0), frame.vector_to_ned(feed_forward)
        if reference is not None:
            velocity = frame.vector_to_ned(reference.velocity)
            acceleration = frame.vector_to_ned(self._feed_forward(reference))
        return Setpoint(
            t_us=t_us,
            trigger_received_us=received_us,
            position_ned=frame.point_to_ned(position),
            yaw_ned_rad=self._yaw_ned(frame),
            velocity_ned=velocity,
            acceleration_ned=acceleration,
            recovery=recovery,
        )

    def _reference(self, since_s: float) -> TrajectoryPoint:
        """Position and velocity when the setpoint is flown; acceleration and jerk ahead, for the attitude.

        Never beyond the wall before its time: a trajectory asks for no thrust there.
        """
        trajectory = self._trajectory
        assert trajectory is not None
        if isinstance(trajectory, Approach):  # at a steady speed through its wall
            end_s = math.inf
        else:
            end_s = self.impact_s if isinstance(trajectory, PlannedApproach) else self.duration_s
        flown_s = min(since_s + self._delay_s, max(since_s, end_s))
        reference, tilted_s = trajectory.at(flown_s), min(flown_s + self._dead_s, max(flown_s, end_s))
        if tilted_s == flown_s:
            return reference
        tilted = trajectory.at(tilted_s)
        return msgspec.structs.replace(reference, acceleration=tilted.acceleration, jerk=tilted.jerk)

    def _feed_forward(self, reference: TrajectoryPoint) -> Vec3:
        """Acceleration fed forward, mission frame, m/s2.

        Beside the reference's own: the drag that it will meet, and what PX4's D term takes away again, so
        that no error builds up for the position loop to make up for. The lead in time makes up for the
        attitude's lag, but for its dead time (`_reference`), so that a wall is met at the planned velocity.
        """
        b, v, a = self._mission.vehicle.airframe.drag_per_s, reference.velocity, reference.acceleration
        d = 1.0 + self._mission.vehicle.px4.mpc_xy_vel_d_acc
        lead, j = ATTITUDE_LAG_S - self._dead_s, reference.jerk
        return (
            (d + lead * b[0]) * a[0] + b[0] * v[0] + lead * j[0],
            (d + lead * b[1]) * a[1] + b[1] * v[1] + lead * j[1],
            a[2] + b[2] * v[2],
        )
