"""Replanning after a contact, in the core: when to send a request, and which answer to fly.

The planner (`dart_flight.planning.replanner`) runs outside the core's step. A `PlanRequest` leaves with the
other outputs, and a `PlanAnswer` arrives like any other input, or never. The paper's setpoint is active until
a trajectory from an answer begins. This setpoint stays active if the answer is late, if the answer reports
that there is no trajectory, or if the vehicle is not at the beginning of the trajectory.
"""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.records import AfterImpact, PlanAnswer, PlanRequest, PlanTaken
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.core.mission.lock_commands import LockCommands
from dart_flight.core.mission.mission_progress import NO_CHANGE, Change, MissionProgress
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import late_s
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_FELT_WITHIN_US = 150_000  # longest wait for a contact's fit; a fit takes a third (docs/contact_fit.md)
# A request is repeated only at this age, and only this long before the trajectory's end.
_AGAIN_US, _NOT_AGAIN_US = 300_000, 400_000
_HELD_TO_M = 0.2
_TRIES = 6  # limit of the requests for a trajectory after one contact
_LATER_S = 0.15  # a new trajectory may end at most this much later than the active one
# Allowed offset of the vehicle from a trajectory's beginning; the loop corrects it within tenths of a second.
_BESIDE_M, _BESIDE_M_S = 0.08, 0.25


class ReplanRequests:
    """Rules for requests and answers; with `after_impact: setpoint` there are no requests."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._lock = LockCommands(mission.vehicle.lock)
        self._enabled = mission.after_impact is AfterImpact.REPLAN
        self._within_us = round(mission.vehicle.flying.replan_within_s * 1e6)

    # -- request and answer --

    def request(
        self, progress: MissionProgress, state: FlightState, sensed: Sensed, square_us: int, coasts: bool
    ) -> Change:
        """Request a plan for the next leg, once after each contact.

        In a mission with its own trajectories, the request is repeated in flight (`_should_repeat`), because
        these trajectories are too short for the errors of PX4's loop to decay.

        Args:
            square_us: time at which the vehicle, rotated by the contact, is square to the wall again.
            coasts: whether the setpoint commands only thrust, so that no position setpoint pulls the vehicle.
        """
        replan = progress.replan
        again = self._should_repeat(replan, state.now_us)
        if not self._enabled or not (replan.request is None or again):
            return NO_CHANGE
        if (
            sensed.estimate is None
            or sensed.in_contact
            or self._should_wait_for_wall(progress, replan, state)
        ):
            return NO_CHANGE
        following = progress.collision
        along = following is not None and following.trajectory is not None
        lock = progress.lock
        ready_us = state.now_us if following is None else self._lock.ready_us(lock, following.mode, state)
        # If the vehicle would not be square to the wall in time, any replacement is accepted.
        turned = replan.trajectory is not None and (replan.impact_us or square_us) < square_us
        m, (push_x, push_y) = self._mission.vehicle.airframe.mass_kg, sensed.estimate.push_mission
        asked = PlanRequest(
            t_us=state.now_us,
            number=replan.number + 1,
            begin_us=state.now_us + self._within_us,
            collision=following.index if following is not None else None,
            position_mission=state.position,
            velocity_mission=state.velocity,
            acceleration_mission=(push_x / m, push_y / m, 0.0),
            setpoint_mission=progress.course.target,
            lock_ready_us=None if ready_us is None else max(ready_us, square_us),
            under_way=again and replan.trajectory is not None and not turned,
            # The planner needs the height for the tilt at the end of a mission's trajectory.
            contact_height_m=sensed.height_m if along else None,
            coasts=coasts or turned,
        )
        from_rest = following is not None and following.approach_m_s is not None
        replan = replan._replace(
            number=asked.number,
            tries=replan.tries + 1,
            request=asked,
            from_rest=from_rest,
            must_not_be_later=not turned,
        )
        return Change(outputs=(asked,), replan=replan)

    def _should_wait_for_wall(self, progress: MissionProgress, replan: Replan, state: FlightState) -> bool:
        """Return whether to delay a request until the last contact's wall is estimated.

        The wait is worthwhile if the vehicle hits that wall again next. The wait is also worthwhile if
        contacts correct the frame, because a trajectory in the old frame would begin at the wrong point.
        """
        following = progress.collision
        returns = following is not None and following.wall.name == progress.last_collision.wall.name
        since_us = state.now_us - (progress.lock.contact_end_us or 0)
        return (
            (returns or self._mission.is_anchored)
            and not replan.has_wall_estimate
            and since_us < _FELT_WITHIN_US
        )

    def _should_repeat(self, replan: Replan, now_us: int) -> bool:
        """Return whether to repeat the request, in a mission with its own trajectories.

        A request is repeated at the earliest `_AGAIN_US` after the last request, and not near the end of the
        active trajectory. The request is also repeated if the vehicle has missed the beginning of the new
        trajectory, so that none is active.
        """
        trajectory, asked = replan.trajectory, replan.request
        if asked is None or self._mission.goal_trajectory is None or now_us - asked.t_us < _AGAIN_US:
            return False
        if trajectory is None:
            return replan.answer is None and replan.tries < _TRIES
        return now_us + self._within_us + _NOT_AGAIN_US < replan.begin_us + trajectory.duration_s * 1e6

    def accept(self, replan: Replan, answer: PlanAnswer, now_us: int) -> Change:
        """Keep an answer until its trajectory begins, or record why the answer is rejected."""
        refusal = _refusal(replan, answer, now_us)
        if refusal is None:
            return Change(replan=replan._replace(answer=answer))
        return Change(outputs=(PlanTaken(now_us, answer.number, False, refusal),))

    # -- accepted answers --

    def approach(self, progress: MissionProgress, now_us: int) -> Change:
        """Return an approach from rest with the impact velocity that the planner chose, if there is room."""
        answer, following = progress.replan.answer, progress.collision
        if answer is None or not progress.replan.from_rest or following is None:
            return NO_CHANGE
        replan = progress.replan._replace(answer=None)
        assert answer.normal_m_s is not None
        assert answer.tangential_m_s is not None
        velocity = (answer.normal_m_s, answer.tangential_m_s)
        try:
            changed = msgspec.structs.replace(following, approach_m_s=velocity)
            approach = plan_approach(self._mission, changed)
        except NoApproachError as error:
            return Change(outputs=(PlanTaken(now_us, answer.number, False, str(error)),), replan=replan)
        taken = PlanTaken(now_us, answer.number, True)
        return Change(outputs=(taken,), replan=replan, approach=approach)

    def trajectory(self, progress: MissionProgress, state: FlightState) -> Change:
        """Return the trajectory of an answer if it begins now and the vehicle is close to it."""
        replan, answer = progress.replan, progress.replan.answer
        if answer is None or replan.from_rest or state.now_us < answer.begin_us:
            return NO_CHANGE
        flown = len(self._mission.collisions) if answer.collision is None else answer.collision - 1
        trajectory = Trajectory.from_plan(answer, self._mission.altitude_at(flown))
        refusal = _rejection(replan, trajectory, answer, state)
        taken = PlanTaken(state.now_us, answer.number, not refusal, refusal)
        if refusal:
            return Change(outputs=(taken,), replan=replan._replace(answer=None))
        impact_us = replan.impact_us
        if answer.impact_s is not None:
            impact_us = answer.begin_us + round(answer.impact_s * 1e6)
        replan = replan._replace(
            answer=None,
            trajectory=trajectory,
            begin_us=answer.begin_us,
            ends_leaning=bool(answer.pieces_s),
            impact_us=impact_us,
        )
        return Change(outputs=(taken,), replan=replan, course=progress.course.follow(trajectory))

    def is_late(self, replan: Replan, wall: Wall, state: FlightState) -> bool:
        if replan.impact_us is None:
            return False
        closing_m_s = -(state.velocity[0] * wall.normal[0] + state.velocity[1] * wall.normal[1])
        most_s = late_s(self._mission.vehicle.guard, wall, state.position, closing_m_s)
        return state.now_us - replan.impact_us > most_s * 1e6


def _refusal(replan: Replan, answer: PlanAnswer, now_us: int) -> str | None:
    asked = replan.request
    if asked is None or answer.number != asked.number:
        return "the plan is for an outdated state"
    if answer.problem:
        return answer.problem
    if now_us > asked.begin_us:
        return f"the plan is {(now_us - asked.begin_us) * 1e-3:.0f} ms late"
    if not _is_consistent(answer, asked, replan.from_rest):
        return "the plan does not match the request"
    return None


def _is_consistent(answer: PlanAnswer, asked: PlanRequest, from_rest: bool) -> bool:
    """Return whether an answer fits its request and is plausible; a faulty planner may send any values."""
    if answer.begin_us != asked.begin_us or answer.collision != asked.collision:
        return False
    if from_rest:
        velocity = (answer.normal_m_s, answer.tangential_m_s)
        return all(v is not None and math.isfinite(v) for v in velocity) and (answer.normal_m_s or 0.0) < 0.0
    return (
        len(answer.x_mission) == len(answer.y_mission) == 6 * max(1, len(answer.pieces_s))
        and all(map(math.isfinite, answer.pieces_s))
        and all(map(math.isfinite, (*answer.x_mission, *answer.y_mission)))
        and 0.0 < answer.duration_s < 60.0
        and (answer.impact_s is None) == (asked.collision is None)
    )


def _rejection(replan: Replan, trajectory: Trajectory, answer: PlanAnswer, state: FlightState) -> str:
    """Return the reason not to fly an answer's trajectory from the current state, or ""."""
    if _active_is_faster(replan, trajectory, answer, state):
        return "the trajectory flown is quicker"
    at = trajectory.at((state.now_us - answer.begin_us) * 1e-6)
    beside_m = math.dist(at.position[:2], state.position[:2])
    beside_m_s = math.dist(at.velocity[:2], state.velocity[:2])
    if beside_m <= _BESIDE_M and beside_m_s <= _BESIDE_M_S:
        return ""
    return (
        f"the vehicle is {beside_m:.2f} m away from the start of the trajectory, and its velocity differs by "
        f"{beside_m_s:.2f} m/s"
    )


def _active_is_faster(replan: Replan, trajectory: Trajectory, answer: PlanAnswer, state: FlightState) -> bool:
    """Return whether the vehicle follows its active trajectory and a new trajectory would end much later."""
    flown = replan.trajectory
    if flown is None or not replan.must_not_be_later:
        return False
    since_s = (state.now_us - replan.begin_us) * 1e-6
    off_m = math.dist(flown.at(since_s).position[:2], state.position[:2])
    end_us = replan.begin_us + flown.duration_s * 1e6 if replan.impact_us is None else replan.impact_us
    there_s = trajectory.duration_s if answer.impact_s is None else answer.impact_s
    return off_m < _HELD_TO_M and there_s - (end_us - answer.begin_us) * 1e-6 > _LATER_S
