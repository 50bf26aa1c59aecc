"""The state of one flight's mission. The executive alone writes it; its helpers return a `Change`."""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.geometry import MissionFrame, Vec3
from dart_flight.base.records import MissionEnd, Mode, Output, Phase, VehicleAction
from dart_flight.config.mission import Collision, Mission, Waypoint
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.course import Course
from dart_flight.core.mission.heading import Heading
from dart_flight.core.mission.lock_orders import LockMemory
from dart_flight.core.mission.phases import PhaseTrigger
from dart_flight.core.mission.proposal import MissionFinding
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.state import FlightState

_SLOWEST: Final = 3.0  # host's time over vehicle's


class MissionState:
    """Phase, leg, course, contacts and walls of one flight.

    Args:
        mission: as it was loaded.
        approaches: by the index of their collision.

    Attributes:
        phase: of the mission.
        entered_us, entered_host_us: when the phase began, autopilot's and host's time.
        asked_us: when a vehicle command was last sent in this phase; None: not yet.
        collisions: of the mission; a sought wall that has been met replaces the written one.
        index: of the collision that comes next or is under way.
        stops: number of waypoints and pauses that are over.
        approaches: by collision.
        course: where the vehicle is sent.
        heading: where it is turned.
        lock: contacts and orders that decide about the lock.
        replan: requests to the planner, and the trajectory that it answered.
        walls: as contacts have found them.
        anchors: contacts that corrected the mission frame; None if PX4's position does not drift.
        expected: the contact that comes next.
        contact_height_m: of the walls' force above the centre of mass; None: not known.
        arrived_us, reached_us, captured_us: since when the vehicle is at the target, at the waypoint, at the
            goal.
        least_miss_m: least distance to the goal after the last contact.
        final_error_m: distance from the goal when it had been held; None: it was not.
        stood_at_ned: where the vehicle stood when the mission frame was laid.
        down_us: since when the vehicle is landed and disarmed.
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
        self.lock = LockMemory()
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
        """The collision that comes next or is under way."""
        collisions = self.collisions
        return collisions[self.index] if self.index < len(collisions) else None

    @property
    def last_collision(self) -> Collision:
        """The collision that is over; there must have been one."""
        return self.mission.collisions[self.index - 1]

    @property
    def waypoint(self) -> Waypoint | None:
        """The waypoint or pause that comes next or is under way, before the next collision."""
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
        """Whether the phase lasts longer than a limit, by autopilot time."""
        return self.elapsed_us(state) > limit_s * 1e6

    def is_late(self, state: FlightState, travel_s: float = 0.0) -> bool:
        """Whether the phase has exceeded its timeout, allowing for the planned travel time.

        The host's clock decides if the autopilot's has jumped back, with room for a slow simulation.
        """
        limit_s = self.mission.vehicle.flying.ready_timeout_s + travel_s
        host_us = state.host_us - (self.entered_host_us or state.host_us)
        return self.takes_longer_than(limit_s, state) or host_us > _SLOWEST * limit_s * 1e6


class Change(NamedTuple):
    """What a helper of the executive wants changed; None leaves a thing as it is.

    Attributes:
        cue, reason: the transition, which comes last, and its reason in the record.
        outputs: records, in their order.
        finding: for the guard.
        action: vehicle command, to be repeated until telemetry confirms it.
        mode: in which the lock should be.
        course, heading, replan: new values of the state.
        approach: of the collision that comes next.
        frame, stood_at_ned: the mission frame, and where the vehicle stood when it was laid.
        end: of the mission.
    """

    cue: PhaseTrigger | None = None
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
