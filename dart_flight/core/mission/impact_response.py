"""What a mission does about contacts: the planned one, a bounce, any other, and what they tell of walls."""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import (
    DetectionFloor,
    ImpactOnset,
    ImpactPeak,
    Mode,
    ModeMismatch,
    Phase,
    WallEstimate,
)
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.contact_feedforward import ContactFeedforward
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.mission_progress import MissionProgress
from dart_flight.core.mission.phases import AT_WALL, WATCHING, PhaseTrigger
from dart_flight.core.mission.planned_impact import expected_hit
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.mission.replan_requests import ReplanRequests
from dart_flight.core.mission.setpoint_generator import SetpointGenerator
from dart_flight.core.mission.setpoints import Reference, Trigger, make_setpoint
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls, early_m
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_BOUNCES_US: Final = 1_000_000  # for so long after a hit its wall may be touched again, as PX4 leans on it
_ANY_WALL: Final = ExpectedContact(watching=True)
_NO_WALL: Final = ExpectedContact()


class ImpactResponse:
    """Takes the detector's events and the walls' estimates of one flight; says which contact is expected.

    With a standoff, in a rehearsal, no contact is the plan's.
    """

    def __init__(
        self,
        mission: Mission,
        progress: MissionProgress,
        lock: LockOrders,
        references: SetpointGenerator,
        replanning: ReplanRequests,
        walls: EstimatedWalls,
        anchors: FrameAnchors | None,
        feedforward: ContactFeedforward,
    ) -> None:
        self._mission, self._progress, self._lock = mission, progress, lock
        self._references, self._replanning = references, replanning
        self._walls, self._anchors, self._feedforward = walls, anchors, feedforward
        self._expected = _NO_WALL

    def take(self, sensed: Sensed, state: FlightState, p: Proposal) -> None:
        """What the last input has shown of contacts and walls."""
        for event in sensed.impacts:
            if isinstance(event, ImpactOnset):
                self.on_onset(event, state, p)
            elif isinstance(event, ImpactPeak):
                self.on_peak(event, state, p)
            elif isinstance(event, DetectionFloor):
                self.on_detection_floor(event, p)
            else:
                self._lock.contact_ends(event.t_us)
        if sensed.wall is not None:
            self._on_wall_estimate(sensed.wall, state, p)

    # -- which contact is expected --

    def expected(self, state: FlightState) -> ExpectedContact:
        """The contact that comes next, for the detector."""
        collision, phase = self._progress.collision, self._progress.phase
        if (
            collision is None
            or not self._is_expected(collision)
            or self._is_at_wall_just_hit(state.position, state)
        ):
            return _ANY_WALL if phase in WATCHING else _NO_WALL
        wall, watching = collision.wall, phase in WATCHING
        if self._expected.wall is not wall or self._expected.watching is not watching:
            self._expected = ExpectedContact(watching, wall.normal, wall.material, wall)
        return self._expected

    def _is_expected(self, collision: Collision) -> bool:
        """Whether the plan has the vehicle meet this wall in this phase."""
        if self._progress.phase is Phase.RECOVERY:
            return collision.approach_m_s is None
        return self._progress.phase in AT_WALL

    def _is_due(self, collision: Collision) -> bool:
        """Whether an onset now is the plan's; a second one before the peak is not."""
        rehearsed = self._mission.standoff_m is not None
        return not rehearsed and self._progress.phase is not Phase.CONTACT and self._is_expected(collision)

    # -- onset and peak --

    def on_onset(self, event: ImpactOnset, state: FlightState, p: Proposal) -> None:
        """A contact begins: the planned one, a bounce off the wall just hit, or a finding."""
        self._lock.contact_begins(event.t_us)
        if self._is_at_wall_just_hit(event.position_mission, state):
            self._on_bounce(event, state, p)
            return
        self._replanning.contact_begins()
        collision = self._progress.collision
        if collision is None or not self._is_due(collision) or not event.planned:
            p.add_finding("unplanned_hit", f"unplanned {self._describe(event)}")
            return
        wall, (x, y, _) = self._walls.wall_now(collision.wall, state.now_us), event.position_mission
        distance = wall.signed_distance((x, y))
        if collision.probe is None and distance > early_m(self._mission.vehicle.guard, wall, (x, y)):
            p.add_finding("wall_met_early", f"{distance:.2f} m before wall {collision.wall.name}")
        elif not state.lock_is_in(collision.mode):
            detail = f"contact with wall {collision.wall.name} while the lock is not {collision.mode.value}"
            p.add_finding("lock_not_settled", detail)
        else:
            self._progress.go(PhaseTrigger.ONSET, state, p)

    def _describe(self, event: ImpactOnset) -> str:
        force = math.hypot(event.force_mission[0], event.force_mission[1])
        return f"impact of {force:.0f} N in phase {self._progress.phase.value}"

    def _is_at_wall_just_hit(self, place: Vec3, state: FlightState) -> bool:
        """Whether a contact here would be a bounce: at the wall hit last, and soon after that hit."""
        progress = self._progress
        if progress.phase is not Phase.RECOVERY or progress.elapsed_us(state) > _BOUNCES_US:
            return False
        wall = self._walls.wall_now(progress.last_collision.wall, state.now_us)
        distance_m = abs(wall.signed_distance(place))
        if distance_m > early_m(self._mission.vehicle.guard, wall, place):
            return False
        following = progress.collision
        if following is None or not self._is_expected(following):
            return True
        ahead = self._walls.wall_now(following.wall, state.now_us)
        return ahead.name != wall.name and distance_m < abs(ahead.signed_distance(place))

    def _on_bounce(self, event: ImpactOnset, state: FlightState, p: Proposal) -> None:
        """Note it, and get clear of the wall until a trajectory is planned from there."""
        p.add_finding("unplanned_hit", f"bounce, {self._describe(event)}", noted=True)
        if self._replanning.trajectory_since_us is not None:
            hit = self._progress.last_collision.wall
            (nx, ny), (x, y, _) = self._walls.wall_now(hit, state.now_us).normal, state.position
            away_m = self._mission.vehicle.guard.retreat_m
            self._references.hold((x + away_m * nx, y + away_m * ny))
        self._replanning.contact_begins()

    def on_detection_floor(self, event: DetectionFloor, p: Proposal) -> None:
        """Whether the planned hit can be told from the vibration at all; a wall not felt is flown into."""
        collision, vehicle = self._progress.collision, self._mission.vehicle
        if collision is None or event.threshold_n <= vehicle.detection.force_threshold_n:
            return
        hit = expected_hit(self._mission, collision)
        floor = event.rigid_n if collision.mode is Mode.RIGID else event.flexible_n
        if hit is not None and floor is not None and hit.peak_normal_force_n < floor:
            what = f"{collision.mode.value}, {hit.peak_normal_force_n:.0f} N at wall {collision.wall.name}"
            says = f"{what}: below the detection limit at this vibration level ({floor:.0f} N)"
            p.add_finding("hit_in_noise", says)

    def on_peak(self, event: ImpactPeak, state: FlightState, p: Proposal) -> None:
        """The planned contact is at its peak: recover from it, by the paper's setpoint."""
        progress, references = self._progress, self._references
        collision = progress.collision
        if progress.phase is not Phase.CONTACT or collision is None:
            return
        point = recovery_point(
            event.position_mission,
            event.normal,
            event.normal_force_n,
            event.tangential_force_n,
            collision.alpha_normal_m_per_n,
            collision.alpha_tangential_m_per_n,
            references.altitude_m,
        )
        if collision.probe is not None:
            away, (px, py, _), (nx, ny) = collision.probe.back_m, event.position_mission, event.normal
            point = (px + away * nx, py + away * ny, references.altitude_m)
        references.hold(point)
        assert state.frame is not None
        p.outputs.append(
            make_setpoint(
                state.frame,
                Trigger(event.detected_us, event.received_us, recovery=True),
                Reference(references.target),
                references.heading,
                added=self._feedforward.feed_forward,
            )
        )
        force = math.hypot(event.normal_force_n, event.tangential_force_n)
        if force > self._mission.limits.peak_force_n:
            p.add_finding("peak_force", f"{force:.0f} N at wall {collision.wall.name}")
        progress.go(PhaseTrigger.PEAK, state, p)
        progress.index += 1

    # -- what a contact has shown of its wall --

    def _on_wall_estimate(self, felt: WallEstimate, state: FlightState, p: Proposal) -> None:
        hit = next(c.wall for c in self._mission.collisions if c.wall.name == felt.wall)
        known = self._walls.wall_now(hit)
        self._walls.add_estimate(felt, hit)
        if self._anchors is not None and not known.sought:
            self._anchor_at(known, felt, state, p)
        if felt.mode_felt is None or felt.mode_reported in (None, felt.mode_felt):
            return
        detail = (
            f"contact at wall {felt.wall} indicates {felt.mode_felt.value} arms, the lock reports "
            f"{felt.mode_reported.value} (log odds {abs(felt.log_odds):.1f})"
        )
        p.add_finding("mode_felt", detail, noted=self._mission.mode_mismatch is ModeMismatch.NOTE_ONLY)

    def _anchor_at(self, wall: Wall, felt: WallEstimate, state: FlightState, p: Proposal) -> None:
        """Put the mission frame right along the normal of a wall that was met."""
        anchors, frame = self._anchors, p.frame or state.frame
        assert anchors is not None
        assert frame is not None
        anchor = anchors.take(wall, felt, state.now_us)
        self._walls.move_frame(anchor.moved_mission)
        self._references.move_frame(anchor.moved_mission)
        p.frame = frame.moved(*anchor.moved_mission)
        p.outputs.append(anchor)
