"""Planning again after a contact, as the core sees it: when to ask, and what answer to believe.

The planner itself (`dart_flight.planning.replanner`) runs outside of the core's step: a `PlanRequest` goes
out with the other outputs, a `PlanAnswer` comes in like any other input, or never does. Until an answered
trajectory begins the paper's setpoint is in force, and it stays in force where the answer is late, says that
there is none, or begins elsewhere than the vehicle is.
"""

from __future__ import annotations

import math

import msgspec

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import AfterImpact, PlanAnswer, PlanRequest, PlanTaken
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.core.mission.lock_orders import LockOrders
from dart_flight.core.mission.position_loop import PlaneMet
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import late_s
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState

_FELT_WITHIN_US = 60_000  # of a contact's end (`sense.felt`)
_AGAIN_US, _NOT_AGAIN_US = 300_000, 400_000  # along a trajectory: after the request before, before its end
_HELD_TO_M = 0.2
_TRIES = 6  # at a trajectory from a contact on
_LATER_S = 0.15  # that a new trajectory may end after the one that is flown
# Where the vehicle may be beside the beginning of a trajectory: what the loop takes out within a few tenths.
_BESIDE_M, _BESIDE_M_S = 0.08, 0.25


class ReplanRequests:
    """The requests of one flight and the trajectory that is flown; with `after_impact: setpoint` none is."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._asks = mission.after_impact is AfterImpact.REPLAN
        self._within_us = round(mission.vehicle.flying.replan_within_s * 1e6)
        self._number = self._tries = 0  # of all requests, and since the last contact
        self._felt = False  # the last contact has said what its wall is like
        self._asked: PlanRequest | None = None
        self._answer: PlanAnswer | None = None
        self._from_rest = False  # what was asked for has an approach of its own
        self._trajectory: Trajectory | None = None
        self._begin_us = 0  # of the trajectory
        self._leaned = False  # it ends as leaned as its wall wants it: in the mission's own shape
        self._quickest = True  # the trajectory is given up only for one that ends not much later
        self._impact_us: int | None = None  # when the trajectory meets the next wall

    # -- request and answer --

    def contact_begins(self) -> None:
        """What was asked or planned is over."""
        self._asked = self._answer = self._trajectory = self._impact_us = None
        self._felt = False
        self._tries = 0

    def request_once(
        self,
        hit: Collision,
        following: Collision | None,
        state: FlightState,
        sensed: Sensed,
        setpoint: Vec3,
        lock: LockOrders,
        p: Proposal,
        square_us: int = 0,
        coasts: bool = False,
    ) -> None:
        """Ask for what comes next: once after each contact, along the mission's own trajectories again and
        again, because what PX4's loop is off by takes longer to fade than they last.

        Args:
            hit: the collision that is over.
            following: the next one; None: the goal is next.
            state: of the vehicle.
            sensed: by the last input.
            setpoint: in force until the trajectory begins, mission frame, m.
            lock: says when it can be settled in the mode that comes next.
            p: takes the request.
            square_us: from when on the vehicle, which a contact has turned, is square to the wall.
            coasts: no setpoint leads anywhere, only thrust is asked for.
        """
        self._felt |= sensed.wall is not None
        again = self._is_time_again(state.now_us)
        if not self._asks or not (self._asked is None or again):
            return
        if sensed.estimate is None or sensed.in_contact:
            return
        # What was felt of a wall is worth waiting for where that wall comes again.
        # And where a contact puts the frame right: a trajectory planned in the one before begins elsewhere.
        returns = following is not None and following.wall.name == hit.wall.name
        if (
            (returns or self._mission.is_anchored)
            and not self._felt
            and state.now_us - (lock.contact_end_us or 0) < _FELT_WITHIN_US
        ):
            return
        along = following is not None and following.trajectory is not None
        self._number += 1
        self._tries += 1
        self._from_rest = following is not None and following.approach_m_s is not None
        ready_us = state.now_us if following is None else lock.ready_us(following.mode, state)
        # A wall that would be met at an angle is not flown at any longer, whatever takes its place.
        turned = self._trajectory is not None and (self._impact_us or square_us) < square_us
        m, (push_x, push_y) = self._mission.vehicle.airframe.mass_kg, sensed.estimate.push_mission
        self._asked = PlanRequest(
            state.now_us,
            self._number,
            state.now_us + self._within_us,
            following.index if following is not None else None,
            state.position,
            state.velocity,
            (push_x / m, push_y / m, 0.0),
            setpoint,
            None if ready_us is None else max(ready_us, square_us),
            again and self._trajectory is not None and not turned,
            # What it is needed for: the lean into a wall that a trajectory of the mission's leads to.
            sensed.height_m if along else None,
            coasts or turned,
        )
        self._quickest = not turned
        p.outputs.append(self._asked)

    def _is_time_again(self, now_us: int) -> bool:
        """Whether a trajectory of the mission's own has been flown for a while and is not nearly over.

        Or was not taken up, because the vehicle was not where it begins.
        """
        trajectory, asked = self._trajectory, self._asked
        if asked is None or self._mission.goal_trajectory is None or now_us - asked.t_us < _AGAIN_US:
            return False
        if trajectory is None:
            return self._answer is None and self._tries < _TRIES
        return now_us + self._within_us + _NOT_AGAIN_US < self._begin_us + trajectory.duration_s * 1e6

    def take(self, answer: PlanAnswer, now_us: int, p: Proposal) -> None:
        """An answer has come: it waits its turn, or a record says why it is not flown."""
        refusal = self._refusal(answer, now_us)
        if refusal is None:
            self._answer = answer
        else:
            p.outputs.append(PlanTaken(now_us, answer.number, False, refusal))

    def _refusal(self, answer: PlanAnswer, now_us: int) -> str | None:
        asked = self._asked
        if asked is None or answer.number != asked.number:
            return "planned for an outdated state"
        if answer.problem:
            return answer.problem
        if now_us > asked.begin_us:
            return f"{(now_us - asked.begin_us) * 1e-3:.0f} ms too late"
        if not _makes_sense(answer, asked, self._from_rest):
            return "answer does not match the request"
        return None

    def approach(self, following: Collision, now_us: int, p: Proposal) -> Trajectory | None:
        """The approach from rest at the velocity that the answer wants, once, where there is room for it."""
        answer = self._answer
        if answer is None or not self._from_rest:
            return None
        self._answer = None
        assert answer.normal_m_s is not None
        assert answer.tangential_m_s is not None
        velocity = (answer.normal_m_s, answer.tangential_m_s)
        try:
            changed = msgspec.structs.replace(following, approach_m_s=velocity)
            approach = plan_approach(self._mission, changed)
        except NoApproachError as error:
            p.outputs.append(PlanTaken(now_us, answer.number, False, str(error)))
            return None
        p.outputs.append(PlanTaken(now_us, answer.number, True))
        return approach

    # -- the trajectory --

    def trajectory_due(self, state: FlightState, p: Proposal) -> Trajectory | None:
        """The answered trajectory, once, when its time has come and the vehicle is where it begins."""
        answer = self._answer
        if answer is None or self._from_rest or state.now_us < answer.begin_us:
            return None
        self._answer = None
        collision = answer.collision
        flown = len(self._mission.collisions) if collision is None else collision - 1
        altitude_m = self._mission.altitude_at(flown)
        trajectory = Trajectory.from_plan(answer, altitude_m)
        at = trajectory.at((state.now_us - answer.begin_us) * 1e-6)
        beside_m = math.dist(at.position[:2], state.position[:2])
        beside_m_s = math.dist(at.velocity[:2], state.velocity[:2])
        if self._is_on_a_quicker(trajectory, answer, state):
            p.outputs.append(PlanTaken(state.now_us, answer.number, False, "the trajectory flown is quicker"))
            return None
        if not (beside_m <= _BESIDE_M and beside_m_s <= _BESIDE_M_S):
            where = f"vehicle is {beside_m:.2f} m and {beside_m_s:.2f} m/s off the start of the trajectory"
            p.outputs.append(PlanTaken(state.now_us, answer.number, False, where))
            return None
        p.outputs.append(PlanTaken(state.now_us, answer.number, True))
        self._trajectory, self._begin_us = trajectory, answer.begin_us
        self._leaned = bool(answer.pieces_s)
        if answer.impact_s is not None:
            self._impact_us = answer.begin_us + round(answer.impact_s * 1e6)
        return trajectory

    def _is_on_a_quicker(self, trajectory: Trajectory, answer: PlanAnswer, state: FlightState) -> bool:
        """Whether the trajectory that is flown, and held to, is there well before another one."""
        flown = self._trajectory
        if flown is None or not self._quickest:
            return False
        since_s = (state.now_us - self._begin_us) * 1e-6
        off_m = math.dist(flown.at(since_s).position[:2], state.position[:2])
        end_us = self._begin_us + flown.duration_s * 1e6 if self._impact_us is None else self._impact_us
        there_s = trajectory.duration_s if answer.impact_s is None else answer.impact_s
        return off_m < _HELD_TO_M and there_s - (end_us - answer.begin_us) * 1e-6 > _LATER_S

    @property
    def is_leaned(self) -> bool:
        """Whether the trajectory flown ends as leaned as its wall wants it: in the mission's own shape."""
        return self._trajectory is not None and self._leaned

    @property
    def trajectory_since_us(self) -> int | None:
        """Since when a trajectory is flown; None: a setpoint is."""
        return None if self._trajectory is None else self._begin_us

    def is_over(self, now_us: int) -> bool:
        """Whether a trajectory is flown to its end."""
        return self._trajectory is not None and now_us - self._begin_us >= self._trajectory.duration_s * 1e6

    def impact_in_s(self, state: FlightState) -> float:
        """Time until the trajectory that is flown meets the next wall; none: at once, as a setpoint may."""
        return -math.inf if self._impact_us is None else (self._impact_us - state.now_us) * 1e-6

    def meets_plane(self, closing_m_s: float, state: FlightState) -> PlaneMet | None:
        """When the trajectory that is flown meets the next wall; None where a setpoint is."""
        if self._impact_us is None:
            return None
        return PlaneMet(max(0.0, (self._impact_us - state.now_us) * 1e-6), -closing_m_s)

    def is_late(self, wall: Wall, state: FlightState) -> bool:
        """Whether a wall should have been met on the way that is flown."""
        if self._impact_us is None:
            return False
        closing_m_s = -(state.velocity[0] * wall.normal[0] + state.velocity[1] * wall.normal[1])
        most_s = late_s(self._mission.vehicle.guard, wall, state.position, closing_m_s)
        return state.now_us - self._impact_us > most_s * 1e6


def _makes_sense(answer: PlanAnswer, asked: PlanRequest, from_rest: bool) -> bool:
    """Whether the numbers can be flown at all: a planner that is broken must not break the flight."""
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
