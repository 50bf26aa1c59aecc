"""Responses to a planned contact, a bounce, any other contact, and a mismatch of the lock's mode."""

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
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.mission_progress import NO_CHANGE, Change, MissionProgress
from dart_flight.core.mission.phases import AT_WALL, WATCHING, PhaseTrigger
from dart_flight.core.mission.planned_impact import expected_hit
from dart_flight.core.mission.proposal import MissionFinding
from dart_flight.core.mission.recovery import recovery_point
from dart_flight.core.mission.setpoints import Reference, SetpointTrigger, make_setpoint
from dart_flight.core.mission.wall_uncertainty import early_m
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.state import FlightState

_BOUNCES_US: Final = 1_000_000  # time after an impact in which a second contact with the wall is a bounce
_ANY_WALL: Final = ExpectedContact(watching=True)
_NO_WALL: Final = ExpectedContact()


class ImpactResponse:
    """Responses of the mission to the detector's events; it also supplies the contact to expect next.

    A rehearsal plans no contact.
    """

    def __init__(self, mission: Mission) -> None:
        self._mission = mission

    # -- which contact is expected --

    def expected(self, progress: MissionProgress, state: FlightState) -> ExpectedContact:
        collision, watching = progress.collision, progress.phase in WATCHING
        if (
            collision is None
            or not _is_expected(progress, collision)
            or self._is_bounce(progress, state.position, state)
        ):
            return _ANY_WALL if watching else _NO_WALL
        wall, before = collision.wall, progress.expected
        if before.wall is wall and before.watching is watching:
            return before
        return ExpectedContact(watching, wall.normal, wall.material, wall)

    def _is_due(self, progress: MissionProgress, collision: Collision) -> bool:
        """Return whether the plan expects an onset now; a second onset before the peak is unplanned."""
        rehearsed = self._mission.standoff_m is not None
        return not rehearsed and progress.phase is not Phase.CONTACT and _is_expected(progress, collision)

    # -- onset and peak --

    def on_onset(self, event: ImpactOnset, progress: MissionProgress, state: FlightState) -> Change:
        """Continue after a planned onset, leave the wall after a bounce, and report any other onset."""
        if self._is_bounce(progress, event.position_mission, state):
            return self._on_bounce(event, progress, state)
        change, collision = Change(replan=progress.replan.contact_begins()), progress.collision
        if collision is None or not self._is_due(progress, collision) or not event.planned:
            text = f"unplanned {_describe(event, progress)}"
            return change._replace(finding=MissionFinding("unplanned_hit", text))
        wall, (x, y, _) = progress.walls.known_wall(collision.wall, state.now_us), event.position_mission
        distance = wall.signed_distance((x, y))
        if collision.probe is None and distance > early_m(self._mission.vehicle.guard, wall, (x, y)):
            text = f"contact {distance:.2f} m before wall {collision.wall.name}"
            return change._replace(finding=MissionFinding("wall_met_early", text))
        if not state.lock_is_in(collision.mode):
            text = f"contact with wall {collision.wall.name} while the lock is not {collision.mode.value}"
            return change._replace(finding=MissionFinding("lock_not_settled", text))
        return change._replace(phase_trigger=PhaseTrigger.ONSET)

    def _is_bounce(self, progress: MissionProgress, place: Vec3, state: FlightState) -> bool:
        """Return whether a contact here would be a bounce: at the last wall, soon after its impact."""
        if progress.phase is not Phase.RECOVERY or progress.elapsed_us(state) > _BOUNCES_US:
            return False
        wall = progress.walls.known_wall(progress.last_collision.wall, state.now_us)
        distance_m = abs(wall.signed_distance(place))
        if distance_m > early_m(self._mission.vehicle.guard, wall, place):
            return False
        following = progress.collision
        if following is None or not _is_expected(progress, following):
            return True
        ahead = progress.walls.known_wall(following.wall, state.now_us)
        return ahead.name != wall.name and distance_m < abs(ahead.signed_distance(place))

    def _on_bounce(self, event: ImpactOnset, progress: MissionProgress, state: FlightState) -> Change:
        """Record a bounce, and keep clear of the wall until a new trajectory is planned."""
        course = None
        if progress.replan.trajectory is not None:
            hit = progress.last_collision.wall
            (nx, ny), (x, y, _) = progress.walls.known_wall(hit, state.now_us).normal, state.position
            away_m = self._mission.vehicle.guard.retreat_m
            course = progress.course.hold((x + away_m * nx, y + away_m * ny))
        finding = MissionFinding("unplanned_hit", f"bounce: {_describe(event, progress)}", note_only=True)
        return Change(finding=finding, course=course, replan=progress.replan.contact_begins())

    def on_detection_floor(self, event: DetectionFloor, progress: MissionProgress) -> Change:
        """Report a finding if vibration would hide the planned impact: PX4 would then push into the wall."""
        collision, vehicle = progress.collision, self._mission.vehicle
        if collision is None or event.threshold_n <= vehicle.detection.force_threshold_n:
            return NO_CHANGE
        hit = expected_hit(self._mission, collision)
        floor = event.rigid_n if collision.mode is Mode.RIGID else event.flexible_n
        if hit is None or floor is None or hit.peak_normal_force_n >= floor:
            return NO_CHANGE
        what = f"{collision.mode.value}, {hit.peak_normal_force_n:.0f} N at wall {collision.wall.name}"
        text = f"{what}, below the detection limit of {floor:.0f} N at this vibration level"
        return Change(finding=MissionFinding("hit_in_noise", text))

    def on_peak(
        self, event: ImpactPeak, progress: MissionProgress, state: FlightState, added: Vec3 | None
    ) -> Change:
        """Begin the recovery with the paper's setpoint when the planned contact reaches its peak force.

        `added` is a feed-forward acceleration (`contact_feedforward`) for the setpoint, mission frame, m/s2.
        """
        collision, course = progress.collision, progress.course
        if progress.phase is not Phase.CONTACT or collision is None:
            return NO_CHANGE
        point = recovery_point(
            event.position_mission[:2],
            event.normal,
            (max(0.0, event.normal_force_n), event.tangential_force_n),
            (collision.alpha_normal_m_per_n, collision.alpha_tangential_m_per_n),
        )
        if collision.probe is not None:
            away, (px, py, _), (nx, ny) = collision.probe.back_m, event.position_mission, event.normal
            point = (px + away * nx, py + away * ny)
        course = course.hold(point)
        assert state.frame is not None
        trigger = SetpointTrigger(event.detected_us, event.received_us, recovery=True)
        heading = progress.heading.commanded
        setpoint = make_setpoint(state.frame, trigger, Reference(course.target), heading, added=added)
        force, finding = math.hypot(event.normal_force_n, event.tangential_force_n), None
        if force > self._mission.limits.peak_force_n:
            limit_n = self._mission.limits.peak_force_n
            detail = f"{force:.0f} N at wall {collision.wall.name}, limit {limit_n:g} N"
            finding = MissionFinding("peak_force", detail)
        elif collision.peak_limit_n is not None and force > collision.peak_limit_n:
            detail = f"{force:.0f} N at wall {collision.wall.name}, limit {collision.peak_limit_n:g} N"
            finding = MissionFinding("harder_hit", detail)
        return Change(PhaseTrigger.PEAK, outputs=(setpoint,), finding=finding, course=course)

    # -- lock state indicated by a contact --

    def on_wall_estimate(self, estimate: WallEstimate) -> Change:
        """Report a contact whose estimated mode of the arms differs from the mode that the lock reports."""
        if estimate.mode_felt is None or estimate.mode_reported in (None, estimate.mode_felt):
            return NO_CHANGE
        detail = (
            f"contact with wall {estimate.wall} indicates {estimate.mode_felt.value} arms, but the lock "
            f"reports {estimate.mode_reported.value} (log odds {abs(estimate.log_odds):.1f})"
        )
        noted = self._mission.mode_mismatch is ModeMismatch.NOTE_ONLY
        return Change(finding=MissionFinding("mode_felt", detail, noted))


def _is_expected(progress: MissionProgress, collision: Collision) -> bool:
    """Return whether the plan has an impact on this wall in this phase."""
    if progress.phase is Phase.RECOVERY:
        return collision.approach_m_s is None
    return progress.phase in AT_WALL


def _describe(event: ImpactOnset, progress: MissionProgress) -> str:
    force = math.hypot(event.force_mission[0], event.force_mission[1])
    return f"impact of {force:.0f} N in phase {progress.phase.value}"
