"""Selection of a phase's heading and setpoint: along a trajectory, coasting, in contact, or as a step."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3, add, rotate, scale, wrap_angle
from dart_flight.base.records import AfterImpact, Mode, OdometrySample, Phase, Setpoint
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.contact_feedforward import LONGEST_S, balancing_acceleration_m_s2
from dart_flight.core.mission.heading import Heading, HeadingControl
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import TO_IMPACT
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S
from dart_flight.core.mission.setpoints import BOTH, FreeAxes, Reference, SetpointTrigger, make_setpoint
from dart_flight.core.mission.trajectories import AfterEnd, Trajectory
from dart_flight.core.sense.state import FlightState

_COASTING_S: Final = 0.25  # for this time before an impact, errors across the wall are not corrected
_COASTS_US: Final = 500_000  # longest coasting after a contact, enough for two requests to the planner
_SQUARE_RAD: Final = 0.09  # heading error at which an impact at 3 m/s hardly rotates the vehicle
_SILENT: Final = frozenset({Phase.READYING, Phase.LANDING, Phase.DONE, Phase.OVERRULED})
_TURNED: Final = frozenset({Phase.CONTACT, Phase.RECOVERY, Phase.GOAL})
# Phases that begin with a trajectory to the target; a rehearsal adds the recovery.
_UNDERWAY: Final = frozenset({Phase.CLIMB, Phase.WAYPOINT, Phase.TRANSIT, Phase.APPROACH, Phase.GOAL})
_OFF_TIME_S: Final = 0.1  # an impact's deviation from its planned time is corrected up to this limit
_CLOSES_M_S: Final = 0.3
# [ours] Fraction of the attitude's delay that the jerk term does not compensate, chosen with six PX4 seeds.
_STRAIGHT_SHARE: Final = 0.5
_NONE: Vec3 = (0.0, 0.0, 0.0)


class SetpointSelection:
    """Rules that select the setpoint for every odometry sample of a flight."""

    def __init__(self, mission: Mission) -> None:
        vehicle = mission.vehicle
        self._airframe, self._kd = vehicle.airframe, vehicle.px4.mpc_xy_vel_d_acc
        self._delay_s = vehicle.flying.setpoint_delay_s or 0.0
        self._dead_s = vehicle.flying.attitude_delay_s or 0.0
        self._yaw_rad_s = math.radians(vehicle.flying.yaw_rate_deg_s)
        rehearsed = mission.standoff_m is not None
        self._underway = _UNDERWAY | {Phase.RECOVERY} if rehearsed else _UNDERWAY
        # Missions along trajectories leave no time to come to rest between impacts.
        self._control = None if mission.goal_trajectory is None else HeadingControl(vehicle)
        # Trajectories after a contact, by the index of the collision at their end; None is the goal.
        self._written = {
            index: Trajectory.from_mission(pieces, mission.altitude_m)
            for index, pieces in (
                *((c.index, c.trajectory) for c in mission.collisions if c.approach_m_s is None),
                (None, mission.goal_trajectory),
            )
            if pieces is not None and mission.after_impact is AfterImpact.REPLAN
        }

    # -- heading --

    def wanted_yaw(self, progress: MissionProgress, state: FlightState) -> float:
        """Return the phase's desired heading; before a wall, one side is parallel to the wall."""
        collision, phase, heading = progress.collision, progress.phase, progress.heading
        led_back = self._control is not None and phase is Phase.RECOVERY
        if collision is None or not (led_back or phase in TO_IMPACT):
            return heading.before if led_back else heading.yaw
        near = heading.before if led_back else state.yaw
        turned = 0.0 if self._control is None else progress.walls.rotation(collision.wall)
        return wrap_angle(collision.wall.parallel_yaw(near - turned) + turned)

    def square_us(self, progress: MissionProgress, state: FlightState) -> int:
        """Return the autopilot time at which a vehicle rotated by a contact is square to the wall again."""
        if self._control is None:
            return state.now_us
        off = state.yaw - progress.heading.yaw
        return state.now_us + round(1e6 * self._control.time_to_s(off, _yaw_rate(state), _SQUARE_RAD))

    def heading(self, progress: MissionProgress, state: FlightState) -> Heading:
        """Return the heading and the command that leads back to the desired heading after a contact."""
        heading, control = progress.heading, self._control
        if control is None or progress.phase not in _TURNED:
            if heading.before != heading.yaw or heading.asked is not None:
                heading = heading._replace(before=heading.yaw, asked=None)
            return heading if control is None else heading._replace(integral=0.0, integral_us=state.now_us)
        return control.lead(heading, state.yaw, _yaw_rate(state), state.now_us)

    # -- setpoints --

    def setpoint(
        self,
        sample: OdometrySample,
        progress: MissionProgress,
        state: FlightState,
        frame: MissionFrame,
        added: Vec3 | None,
    ) -> tuple[Setpoint | None, Heading]:
        """Return the setpoint of the phase for the triggering odometry sample, and the updated heading.

        `added` is a feed-forward acceleration (`contact_feedforward`) for the setpoint, mission frame, m/s2.
        """
        phase, heading = progress.phase, progress.heading
        in_contact = phase is Phase.CONTACT
        if phase in _SILENT or (in_contact and progress.takes_longer_than(LONGEST_S, state)):
            return None, heading
        since_us = self._trajectory_since_us(progress)
        wall = None if in_contact else self._wall_ahead(progress, state, since_us)
        along: tuple[Vec2, ...] = ()
        if in_contact or (since_us is None and self.coasts(progress, state)):
            thrust = _NONE if in_contact else self._thrust_after_contact(progress, state)
            reference, along = Reference((0.0, 0.0, progress.course.altitude_m), _NONE, thrust), BOTH
        else:
            reference = self._reference(progress, sample.t_us, since_us)
            if wall is not None:
                along = (wall.normal,)
            elif reference.velocity is not None or phase is not Phase.RECOVERY:
                added = None
        if not in_contact and wall is None:
            heading = heading.turn(self.wanted_yaw(progress, state), state.now_us, self._yaw_rad_s)
        free = self._free_axes(frame, sample, along) if along else None
        if wall is not None and free is not None and since_us is not None:
            since_s = (sample.t_us - since_us) * 1e-6
            across_m_s2 = self._push_off_m_s2(progress, wall) + self._timing_correction_m_s2(
                progress, since_s, free
            )
            added = (across_m_s2 * wall.normal[0], across_m_s2 * wall.normal[1], 0.0)
        trigger = SetpointTrigger(sample.t_us, sample.received_us)
        return make_setpoint(frame, trigger, reference, heading.commanded, free, added), heading

    def coasts(self, progress: MissionProgress, state: FlightState) -> bool:
        """Return whether the vehicle waits after a contact for one of the mission's trajectories to begin.

        The vehicle then coasts, because a distant recovery setpoint would wind up PX4's integrator and push
        the vehicle off that trajectory.
        """
        if progress.phase is not Phase.RECOVERY or self._next_trajectory(progress) is None:
            return False
        end_us = progress.lock.contact_end_us
        return end_us is None or state.now_us - end_us < _COASTS_US

    def _trajectory_since_us(self, progress: MissionProgress) -> int | None:
        """Return the start time of the active trajectory; None if the target is commanded as a step."""
        if progress.phase in self._underway:
            return progress.entered_us
        return progress.replan.since_us if progress.phase is Phase.RECOVERY else None

    def _next_trajectory(self, progress: MissionProgress) -> Trajectory | None:
        collision = progress.collision
        return self._written.get(None if collision is None else collision.index)

    def _thrust_after_contact(self, progress: MissionProgress, state: FlightState) -> Vec3:
        """Return the acceleration of the mission's trajectory, as if it began at the end of the contact.

        The acceleration is zero during a contact. It is also zero if the vehicle is already as fast as the
        trajectory, for example after tilting away from the wall.
        """
        trajectory, end_us = self._next_trajectory(progress), progress.lock.contact_end_us
        if trajectory is None or end_us is None:
            return _NONE
        since_s = (state.now_us - end_us) * 1e-6
        if math.hypot(*state.velocity[:2]) >= math.hypot(*trajectory.at(since_s).velocity[:2]):
            return _NONE
        x, y, _ = self._lead(trajectory, since_s).acceleration
        return (x, y, 0.0)

    def _wall_ahead(self, progress: MissionProgress, state: FlightState, since_us: int | None) -> Wall | None:
        """Return the wall that a trajectory of the mission is about to reach.

        A vehicle that is late must not tilt into the wall to catch up: a contact rolls a tilted vehicle over.
        """
        collision, trajectory = progress.collision, progress.course.trajectory
        if collision is None or collision.trajectory is None or since_us is None or trajectory is None:
            return None
        if progress.phase is Phase.APPROACH:
            until_s = trajectory.duration_s - progress.elapsed_us(state) * 1e-6
        else:
            until_s = progress.replan.impact_in_s(state) if progress.phase is Phase.RECOVERY else math.inf
        return collision.wall if until_s < _COASTING_S and trajectory.after is AfterEnd.CONTINUE else None

    def _push_off_m_s2(self, progress: MissionProgress, wall: Wall) -> float:
        """Return the acceleration off a wall that balances the contact's torque."""
        collision = progress.collision
        assert collision is not None
        if _is_leaned(progress):
            return 0.0
        out_m = self._airframe.contact_distance_m
        return balancing_acceleration_m_s2(progress.contact_height_m, out_m, collision.mode)

    def _timing_correction_m_s2(self, progress: MissionProgress, since_s: float, free: FreeAxes) -> float:
        """Return the thrust to add along a wall's normal if the vehicle is ahead of or behind its trajectory.

        The vehicle's actual time to impact corresponds to a point of the trajectory. The result is the
        planned thrust at this point minus the planned thrust at `since_s`. Without this correction, a vehicle
        ahead of its trajectory would reach the wall before it tilts away from the wall. `free` has the wall's
        normal, and the motion at the time at which PX4 executes the setpoint.
        """
        trajectory, (nx, ny) = progress.course.trajectory, free.along[0]
        assert trajectory is not None
        assert progress.collision is not None
        # For rigid arms, the planner reduces the lean at the end and counts on the attitude's lag.
        if _is_leaned(progress) and progress.collision.mode is Mode.RIGID:
            return 0.0
        closing_m_s, own_s = -(free.velocity[0] * nx + free.velocity[1] * ny), since_s
        if closing_m_s > _CLOSES_M_S:
            x, y, _ = trajectory.at(trajectory.duration_s).position
            ahead_m = (free.position[0] - x) * nx + (free.position[1] - y) * ny
            own_s = trajectory.duration_s - self._delay_s - ahead_m / closing_m_s
            own_s = max(since_s - _OFF_TIME_S, min(since_s + _OFF_TIME_S, own_s))
        (ax, ay, _), (bx, by, _) = (self._lead(trajectory, t).acceleration for t in (own_s, since_s))
        return (ax - bx) * nx + (ay - by) * ny

    # -- references --

    def _reference(self, progress: MissionProgress, t_us: int, since_us: int | None) -> Reference:
        """Return the command at a time: a point of the trajectory or, without a trajectory, the target."""
        course = progress.course
        if course.trajectory is None or since_us is None:
            return Reference(course.target)
        return self._lead(course.trajectory, (t_us - since_us) * 1e-6)

    def _lead(self, trajectory: Trajectory, since_s: float) -> Reference:
        """Return the reference of a trajectory for the time at which PX4 executes the setpoint.

        The acceleration is taken at an even later time, because the attitude lags. If the trajectory ends at
        rest or tilted, this time is limited to its end. Drag and the response of PX4's D term are added, so
        that no error builds up in the position loop.
        """
        flown_s = since_s + self._delay_s
        flown = trajectory.at(flown_s)
        straight_on = trajectory.goes_straight_on
        tilted_s = flown_s + self._dead_s
        if tilted_s > trajectory.duration_s and not straight_on:
            tilted_s = min(tilted_s, max(since_s, trajectory.duration_s))
        tilted = flown if tilted_s == flown_s else trajectory.at(tilted_s)
        v, a, b = flown.velocity, tilted.acceleration, self._airframe.drag_per_s
        d, lead = 1.0 + self._kd, ATTITUDE_LAG_S - (_STRAIGHT_SHARE if straight_on else 1.0) * self._dead_s
        # The jerk of a rest-to-rest flight is not fed forward, because it is discontinuous at both ends.
        j = tilted.jerk if trajectory.after is AfterEnd.CONTINUE else _NONE
        push = (
            (d + lead * b[0]) * a[0] + b[0] * v[0] + lead * j[0],
            (d + lead * b[1]) * a[1] + b[1] * v[1] + lead * j[1],
            a[2] + b[2] * v[2],
        )
        return Reference(flown.position, v, push)

    def _free_axes(self, frame: MissionFrame, sample: OdometrySample, along: tuple[Vec2, ...]) -> FreeAxes:
        """Return the free axes, with the motion predicted for the time at which PX4 executes the setpoint."""
        velocity = frame.vector_from_ned(sample.velocity_ned)
        position = frame.point_from_ned(sample.position_ned)
        return FreeAxes(along, add(position, scale(velocity, self._delay_s)), velocity)


def _is_leaned(progress: MissionProgress) -> bool:
    """Return whether the active trajectory ends with the tilt that balances the contact."""
    return progress.phase is Phase.RECOVERY and progress.replan.is_leaned


def _yaw_rate(state: FlightState) -> float:
    """Return the rate of the heading, mission frame, rad/s."""
    assert state.imu is not None
    assert state.attitude is not None
    return -rotate(state.attitude.q_frd_to_ned, state.imu.rate_frd)[2]
