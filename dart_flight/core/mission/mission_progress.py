"""Progress of one flight's mission. Only the executive writes the progress; its helpers return a `Change`."""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import MissionEnd, Mode, Output, Phase, VehicleAction
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.course import Course
from dart_flight.core.mission.heading import Heading
from dart_flight.core.mission.lock_commands import LockCommandState
from dart_flight.core.mission.phases import PhaseTrigger
from dart_flight.core.mission.proposal import MissionFinding
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.state import FlightState

_SLOWEST: Final = 3.0  # the slowest simulation needs this host time for one second of the vehicle, s


class MissionProgress:
    """State of the mission in one flight: phase, leg, course, contacts and walls.

    Attributes:
        entered_us, entered_host_us: beginning of the phase, autopilot and host time.
        asked_us: time of the last vehicle command in this phase, or None.
        collisions: collisions of the mission; if a probe has found a wall, the found wall replaces the wall
            of the mission file.
        index: index of the next or current collision.
        stops: number of completed waypoints and pauses.
        approaches: trajectories of the approaches, by the index of their collision.
        walls: walls as estimated from contacts.
        anchors: contacts that corrected the mission frame; None if PX4's position does not drift.
        contact_height_m: height above the centre of mass at which the walls' force acts; None if unknown.
        arrived_us, reached_us, captured_us: times of arrival at the target, at the waypoint and at the goal.
        least_miss_m: smallest distance to the goal after the last contact.
        final_error_m: distance from the goal after the goal has been held; None before.
        stood_at_ned: position of the vehicle when the mission frame was set.
        down_us: time at which the vehicle was first landed and disarmed.
    """

    def __init__(self, mission: Mission, approaches: dict[int, Trajectory]) -> None:
        self.mission = mission
        self.phase = Phase.READYING
        self.entered_us: int | None = None
        self.entered_host_us: int | None = None
        self.asked_us: int | None = None
        self.collisions = list(mission.collisions)
        self.index = self.stops = 0
        self.approaches = approaches
        self.course = Course((0.0, 0.0, 0.0), mission.altitude_m)
        self.heading = Heading()
        self.lock = LockCommandState()
        self.replan = Replan()
        drift_m_s = mission.vehicle.estimation.position_drift_m_s
        self.anchors = FrameAnchors(drift_m_s) if mission.is_anchored else None
        self.walls = EstimatedWalls(self.anchors)
        self.expected = ExpectedContact()
        self.contact_height_m: float | None = None
        self.arrived_us: int | None = None
        self.reached_us: int | None = None
        self.captured_us: int | None = None
        self.least_miss_m = float("inf")
        self.final_error_m: float | None = None
        self.stood_at_ned: Vec3 = (0.0, 0.0, 0.0)
        self.down_us: int | None = None

    # -- legs --

    @property
    def collision(self) -> Collision | None:
        """The next or current collision, or None."""
        collisions = self.collisions
        return collisions[self.index] if self.index < len(collisions) else None

    @property
    def last_collision(self) -> Collision:
        """The last completed collision; there must be one."""
        return self.mission.collisions[self.index - 1]

    @property
    def waypoint(self) -> Waypoint | None:
        """The current or next waypoint or pause, if it comes before the next collision; otherwise None."""
        waypoints = self.mission.waypoints
        if self.stops < len(waypoints) and waypoints[self.stops].after == self.index:
            return waypoints[self.stops]
        return None

    # -- time --

    def elapsed_us(self, state: FlightState) -> int:
        """Return the time since the phase began, autopilot time."""
        assert self.entered_us is not None
        return state.now_us - self.entered_us

    def takes_longer_than(self, limit_s: float, state: FlightState) -> bool:
        """Return whether the phase has exceeded a limit, by autopilot time."""
        return self.elapsed_us(state) > limit_s * 1e6

    def is_late(self, state: FlightState, travel_s: float = 0.0) -> bool:
        """Return whether the phase has exceeded its timeout, allowing for the planned travel time.

        The timeout is also checked by the host's clock, in case the autopilot's clock has jumped back. This
        second limit is longer by a factor that allows for slow simulations.
        """
        limit_s = self.mission.vehicle.flying.ready_timeout_s + travel_s
        host_us = state.host_us - (self.entered_host_us or state.host_us)
        return self.takes_longer_than(limit_s, state) or host_us > _SLOWEST * limit_s * 1e6


class Change(NamedTuple):
    """Changes requested by a helper of the executive; None leaves a value unchanged.

    Attributes:
        phase_trigger, reason: trigger of a phase transition, and the reason to record for it. The transition
            is applied after all other changes.
        action: vehicle command, repeated until telemetry confirms it.
        mode: requested mode of the lock.
        approach: trajectory of the approach to the next collision.
        frame, stood_at_ned: the mission frame, and the vehicle's position when the frame was set.
    """

    phase_trigger: PhaseTrigger | None = None
    reason: str = ""
    outputs: tuple[Output, ...] = ()
    finding: MissionFinding | None = None
    action: VehicleAction | None = None
    mode: Mode | None = None
    course: Course | None = None
    heading: Heading | None = None
    replan: Replan | None = None
    approach: Trajectory | None = None
    frame: MissionFrame | None = None
    stood_at_ned: Vec3 = (0.0, 0.0, 0.0)
    end: MissionEnd | None = None


NO_CHANGE: Final = Change()
