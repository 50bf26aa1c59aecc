"""Planning again after a contact, as the core sees it: when to ask, and what answer to believe.

The planner itself (`dart_flight.planning.replanning`) runs outside of the core's step: a `PlanRequest` goes
out with the other outputs, a `PlanAnswer` comes in like any other input, or never does. Until an answered way
begins the paper's set-point is in force, and it stays in force where the answer is late, says that there is
no way, or begins elsewhere than the vehicle is.
"""

from __future__ import annotations

import math

from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.approach import Way
from dart_flight.core.sense.state import FlightState
from dart_flight.geometry import Vec2, Vec3
from dart_flight.samples import PlanAnswer, PlanRequest, PlanTaken

# Where the vehicle may be beside the beginning of a way: what the loop takes out within a few tenths.
_BESIDE_M, _BESIDE_M_S = 0.08, 0.25


class Replanning:
    """The requests of one flight.

    Attributes:
        way: that is flown; None: a set-point is.
        begin_us: of the way.
        impact_us: when it meets the next wall; None: it leads to the goal.
        felt: whether the last contact has said what its wall is like.
    """

    def __init__(self, mission: Mission) -> None:
        self._altitude_m = mission.altitude_m
        self._within_us = round(mission.vehicle.flying.replan_within_s * 1e6)
        self._mass_kg = mission.vehicle.airframe.mass_kg
        self._number = 0
        self._asked: PlanRequest | None = None
        self._answer: PlanAnswer | None = None
        self._from_rest = False  # what was asked for has an approach of its own
        self.way: Way | None = None
        self.begin_us = 0
        self.impact_us: int | None = None
        self.felt = False

    def contact_begins(self) -> None:
        """What was asked or planned is over."""
        self._asked = self._answer = self.way = self.impact_us = None
        self.felt = False

    @property
    def asked(self) -> bool:
        """Whether the rest was asked for since the last contact."""
        return self._asked is not None

    def ask(
        self,
        following: Collision | None,
        state: FlightState,
        push_mission: tuple[float, float],
        setpoint: Vec3,
        lock_ready_us: int | None,
    ) -> PlanRequest:
        """The request for what comes next.

        Args:
            following: the next collision; None: the goal is next.
            state: of the vehicle.
            push_mission: force of thrust and drag, N.
            setpoint: in force until the way begins, mission frame, m.
            lock_ready_us: when the lock can be settled in the mode that comes next; None: never.
        """
        self._number += 1
        self._from_rest = following is not None and following.approach_m_s is not None
        m = self._mass_kg
        self._asked = PlanRequest(
            state.now_us,
            self._number,
            state.now_us + self._within_us,
            following.index if following is not None else None,
            state.position,
            state.velocity,
            (push_mission[0] / m, push_mission[1] / m, 0.0),
            setpoint,
            lock_ready_us,
        )
        return self._asked

    def take(self, answer: PlanAnswer, now_us: int) -> PlanTaken | None:
        """An answer has come; returns a record where it is not to be flown, None where it waits its turn."""
        asked = self._asked
        if asked is None or answer.number != asked.number:
            return PlanTaken(now_us, answer.number, False, "the state that it is for is no longer true")
        if answer.problem:
            return PlanTaken(now_us, answer.number, False, answer.problem)
        if now_us > asked.begin_us:
            late_ms = (now_us - asked.begin_us) * 1e-3
            return PlanTaken(now_us, answer.number, False, f"{late_ms:.0f} ms too late")
        if not _makes_sense(answer, asked, self._from_rest):
            return PlanTaken(now_us, answer.number, False, "it is no answer to what was asked")
        self._answer = answer
        return None

    def begin(self, state: FlightState) -> PlanTaken | None:
        """Take the answer that waits, once its time has come; a record of what became of it."""
        answer = self._answer
        if answer is None or self._from_rest or state.now_us < answer.begin_us:
            return None
        self._answer = None
        way = Way(answer.x_mission, answer.y_mission, answer.duration_s, self._altitude_m)
        at = way.at((state.now_us - answer.begin_us) * 1e-6)
        beside_m = math.dist(at.position[:2], state.position[:2])
        beside_m_s = math.dist(at.velocity[:2], state.velocity[:2])
        if not (beside_m <= _BESIDE_M and beside_m_s <= _BESIDE_M_S):
            where = f"the vehicle is {beside_m:.2f} m and {beside_m_s:.2f} m/s beside its beginning"
            return PlanTaken(state.now_us, answer.number, False, where)
        self.way, self.begin_us = way, answer.begin_us
        if answer.impact_s is not None:
            self.impact_us = answer.begin_us + round(answer.impact_s * 1e6)
        return PlanTaken(state.now_us, answer.number, True)

    def approach_m_s(self, now_us: int) -> tuple[Vec2 | None, PlanTaken | None]:
        """The velocity that the answer wants a collision with an approach of its own to be met with, once."""
        answer = self._answer
        if answer is None or not self._from_rest:
            return None, None
        self._answer = None
        assert answer.normal_m_s is not None
        assert answer.tangential_m_s is not None
        return (answer.normal_m_s, answer.tangential_m_s), PlanTaken(now_us, answer.number, True)

    def is_over(self, now_us: int) -> bool:
        """Whether a way is flown to its end."""
        return self.way is not None and now_us - self.begin_us >= self.way.duration_s * 1e6


def _makes_sense(answer: PlanAnswer, asked: PlanRequest, from_rest: bool) -> bool:
    """Whether the numbers can be flown at all: a planner that is broken must not break the flight."""
    if answer.begin_us != asked.begin_us or answer.collision != asked.collision:
        return False
    if from_rest:
        velocity = (answer.normal_m_s, answer.tangential_m_s)
        return all(v is not None and math.isfinite(v) for v in velocity) and (answer.normal_m_s or 0.0) < 0.0
    return (
        len(answer.x_mission) == len(answer.y_mission) == 6
        and all(map(math.isfinite, (*answer.x_mission, *answer.y_mission)))
        and 0.0 < answer.duration_s < 60.0
        and (answer.impact_s is None) == (asked.collision is None)
    )
