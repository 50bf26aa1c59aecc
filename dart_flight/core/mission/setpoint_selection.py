"""Which setpoint a phase wants: of a trajectory, coasting, of a contact, or a step; and with what heading."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import Vec2, Vec3, rotate, wrap_angle
from dart_flight.base.records import AfterImpact, OdometrySample, Phase
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.contact_feedforward import LONGEST_S, ContactFeedforward, balancing_m_s2
from dart_flight.core.mission.heading import HeadingControl
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import TO_IMPACT
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.replan_requests import ReplanRequests
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.mission.setpoints import BOTH, Reference, Trigger, make_setpoint
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_COASTING_S: Final = 0.25  # before an impact: so long does the attitude take to come to what is asked
_COASTS_US: Final = 500_000  # after a contact, until when an answer is there, even to a second request
_SQUARE_RAD: Final = 0.09  # off in heading at a hit: a hit at 3 m/s turns the vehicle little from there
_SILENT: Final = frozenset({Phase.READYING, Phase.LANDING, Phase.DONE, Phase.OVERRULED})
_STILL: Final[Vec3] = (0.0, 0.0, 0.0)
_NO_THRUST: Final[Vec3] = (0.0, 0.0, 0.0)
_TURNED: Final = frozenset({Phase.CONTACT, Phase.RECOVERY, Phase.GOAL})
# In which a trajectory leads to the target, from the phase's beginning on; in a rehearsal the recovery, too.
_UNDERWAY: Final = frozenset({Phase.CLIMB, Phase.WAYPOINT, Phase.TRANSIT, Phase.APPROACH, Phase.GOAL})


class SetpointSelection:
    """One setpoint for every odometry sample of a flight."""

    def __init__(
        self,
        mission: Mission,
        progress: MissionProgress,
        lock: LockOrders,
        references: SetpointGenerator,
        replanning: ReplanRequests,
        walls: EstimatedWalls,
        feedforward: ContactFeedforward,
    ) -> None:
        self._mission, self._progress, self._lock = mission, progress, lock
        self._references, self._replanning = references, replanning
        self._walls, self._feedforward = walls, feedforward
        rehearsed = mission.standoff_m is not None
        self._underway = _UNDERWAY | {Phase.RECOVERY} if rehearsed else _UNDERWAY
        # Of missions along trajectories: between their hits there is no time to come to rest.
        self._heading = None if mission.goal_trajectory is None else HeadingControl(mission.vehicle)
        self._yaw_before = 0.0  # heading asked for before the first contact
        self._height_m: float | None = None  # of the walls' force above the centre of mass
        # After a contact; by the collision that they lead to, None: to the goal.
        self._written = {
            index: Trajectory.from_mission(pieces, mission.altitude_m)
            for index, pieces in (
                *((c.index, c.trajectory) for c in mission.collisions if c.approach_m_s is None),
                (None, mission.goal_trajectory),
            )
            if pieces is not None and mission.after_impact is AfterImpact.REPLAN
        }

    def update(self, sensed: Sensed) -> None:
        """Take what an input has told of force and walls."""
        if sensed.estimate is not None:
            self._feedforward.update(sensed)
            self._height_m = sensed.height_m

    # -- heading --

    def wanted_yaw(self, state: FlightState) -> float:
        """The heading that the phase wants: parallel or square to the wall that comes next."""
        collision, phase = self._progress.collision, self._progress.phase
        led_back = self._heading is not None and phase is Phase.RECOVERY
        if collision is None or not (led_back or phase in TO_IMPACT):
            return self._yaw_before if led_back else self._references.yaw
        near = self._yaw_before if led_back else state.yaw
        turned = 0.0 if self._heading is None else self._walls.turned(collision.wall)
        return wrap_angle(collision.wall.parallel_yaw(near - turned) + turned)

    def square_us(self, state: FlightState) -> int:
        """From when on the vehicle, which a contact has turned, is square to the wall; autopilot time."""
        if self._heading is None:
            return state.now_us
        off = state.yaw - self._references.yaw
        return state.now_us + round(1e6 * self._heading.time_to_s(off, _yaw_rate(state), _SQUARE_RAD))

    def _yaw_asked(self, state: FlightState) -> float | None:
        """The heading that leads to the wanted one, from a contact on; None: at once."""
        if self._heading is None or self._progress.phase not in _TURNED:
            self._yaw_before = self._references.yaw
            if self._heading is not None:
                self._heading.begin(state.now_us)
            return None
        return self._heading.setpoint(self._references.yaw, state.yaw, _yaw_rate(state), state.now_us)

    # -- trajectories --

    @property
    def _trajectory_since_us(self) -> int | None:
        """Since when a trajectory leads on; None: the target is a step."""
        phase = self._progress.phase
        if phase in self._underway:
            return self._progress.entered_us
        return self._replanning.trajectory_since_us if phase is Phase.RECOVERY else None

    def _until_impact_s(self, state: FlightState) -> float:
        """Time until the mission's own trajectory meets its wall; infinite where it leads to none."""
        collision, phase = self._progress.collision, self._progress.phase
        if collision is None or collision.trajectory is None:
            return math.inf
        if phase is Phase.APPROACH:
            return self._references.impact_s - self._progress.elapsed_us(state) * 1e-6
        return self._replanning.impact_in_s(state) if phase is Phase.RECOVERY else math.inf

    def coasts(self, state: FlightState) -> bool:
        """Whether a trajectory of the mission's is about to go on after a contact.

        A setpoint far away, as it leads a recovery, would have PX4's integral gather until then what puts
        the vehicle beside the trajectory.
        """
        if self._progress.phase is not Phase.RECOVERY or self._written_next is None:
            return False
        end_us = self._lock.contact_end_us
        return end_us is None or state.now_us - end_us < _COASTS_US

    @property
    def _written_next(self) -> Trajectory | None:
        """The mission's own trajectory to what comes next."""
        collision = self._progress.collision
        return self._written.get(None if collision is None else collision.index)

    def _thrust_after_contact(self, state: FlightState) -> Vec3:
        """Return the acceleration of the mission's trajectory, as if it began where the contact ended.

        None is asked for in a contact, or if the vehicle is as fast already, as one that leans off the wall.
        """
        trajectory, end_us = self._written_next, self._lock.contact_end_us
        if trajectory is None or end_us is None:
            return _NO_THRUST
        since_s = (state.now_us - end_us) * 1e-6
        if math.hypot(*state.velocity[:2]) >= math.hypot(*trajectory.at(since_s).velocity[:2]):
            return _NO_THRUST
        return self._references.led(trajectory, since_s).acceleration

    # -- setpoints --

    def send(self, sample: OdometrySample, state: FlightState, p: Proposal) -> None:
        """Propose the setpoint for an odometry sample, as the phase wants it."""
        references, frame, phase = self._references, p.frame or state.frame, self._progress.phase
        if frame is None:
            return
        references.yaw_asked = self._yaw_asked(state)
        in_contact = phase is Phase.CONTACT
        if phase in _SILENT or (in_contact and self._progress.takes_longer_than(LONGEST_S, state)):
            return
        since_us, added = self._trajectory_since_us, self._feedforward.feed_forward
        along: tuple[Vec2, ...] = ()
        wall = self._wall_coasted_to(state, since_us)
        if in_contact or (since_us is None and self.coasts(state)):
            thrust = _NO_THRUST if in_contact else self._thrust_after_contact(state)
            reference, along = Reference((0.0, 0.0, references.altitude_m), _STILL, thrust), BOTH
        elif wall is not None:
            reference, along = references.reference(sample.t_us, since_us), (wall.normal,)
            added = self._push_off(wall)
        else:
            reference = references.reference(sample.t_us, since_us)
            if reference.velocity is not None or phase is not Phase.RECOVERY:
                added = None
        if not in_contact and wall is None:
            references.slew_yaw(self.wanted_yaw(state), state.now_us)
        free = references.free_axes(frame, sample, along) if along else None
        trigger = Trigger(sample.t_us, sample.received_us)
        p.outputs.append(make_setpoint(frame, trigger, reference, references.heading, free, added))

    def _wall_coasted_to(self, state: FlightState, since_us: int | None) -> Wall | None:
        """Return the wall that a trajectory of the mission is about to meet.

        A vehicle that is late must not lean into it to catch up: a contact rolls a leaning vehicle over.
        """
        collision = self._progress.collision
        if collision is None or since_us is None or self._until_impact_s(state) >= _COASTING_S:
            return None
        return None if self._progress.phase is Phase.CONTACT else collision.wall

    def _push_off(self, wall: Wall) -> Vec3:
        """Return the acceleration off a wall that balances the contact's torque, mission frame, m/s2."""
        collision = self._progress.collision
        assert collision is not None
        leaned = self._progress.phase is Phase.RECOVERY and self._replanning.is_leaned
        out_m = self._mission.vehicle.airframe.contact_distance_m
        push_m_s2 = 0.0 if leaned else balancing_m_s2(self._height_m, out_m, collision.mode)
        return (push_m_s2 * wall.normal[0], push_m_s2 * wall.normal[1], 0.0)


def _yaw_rate(state: FlightState) -> float:
    """Of the heading, rad/s, mission frame."""
    if state.imu is None or state.attitude is None:
        return 0.0
    return -rotate(state.attitude.q_frd_to_ned, state.imu.rate_frd)[2]
