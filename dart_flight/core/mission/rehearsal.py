"""The rehearsal of a mission: the same phases, but the vehicle stops before each wall."""

from __future__ import annotations

import math

from dart_flight.config.mission import Collision
from dart_flight.core.mission.approach import standoff_point
from dart_flight.core.mission.executive import Executive
from dart_flight.core.mission.phases import PhaseTrigger
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.senses import Sensed
from dart_flight.core.sense.state import FlightState


class Rehearsal(Executive):
    """Executive that stops `standoff_m` before each wall, then flies to the goal; no contact is planned."""

    def _begin_approach(self, collision: Collision) -> None:
        """Follow the approach's line, from rest to rest."""
        approach, impact = self.progress.approaches[collision.index], collision.impact_point
        assert impact is not None
        stop = standoff_point(self.mission, collision, approach.begin[:2], impact)
        speed_m_s = math.hypot(*collision.approach_velocity())
        speed_m_s = min(speed_m_s, self.mission.limits.speed_m_s)
        self.progress.course = self.progress.course.fly_to(stop, self._flying, speed_m_s)

    def _approach(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        if self._has_arrived(state):
            self._transition(PhaseTrigger.STOOD_OFF, state, p)
            self._stand_off(state)
        elif self.progress.is_late(state):
            p.add_finding("transit_timeout", "the standoff point was not reached in time")

    def _stand_off(self, state: FlightState) -> None:
        """Hold position at the standoff point, and advance to the next collision or the goal."""
        progress = self.progress
        progress.lock = progress.lock.contact_ends(state.now_us)
        progress.course = progress.course.hold(progress.course.target)
        progress.index += 1

    def _recovery(self, state: FlightState, sensed: Sensed, p: Proposal) -> None:
        """Replace the recovery with a transit: to the next wall, or to the goal."""
        following, stops = self.progress.collision, self.progress.waypoint is not None
        locked = self._move_lock(self._mode_after(following, stops), state, p)
        if stops:
            self._start_next(PhaseTrigger.RESTED, state, p)
        elif following is None:
            self.progress.course = self.progress.course.fly_to(self.mission.goal.position_m, self._flying)
            self._transition(PhaseTrigger.PASSED, state, p)
        elif following.approach_m_s is not None:
            self._transition(PhaseTrigger.RESTED, state, p)
            self._begin_transit(state, p)
        elif not self.progress.course.on_transit:
            if locked:
                here = (state.position[0], state.position[1])
                self.progress.entered_us = state.now_us
                stop = standoff_point(self.mission, following, here, following.wall.foot(here))
                self.progress.course = self.progress.course.fly_to(stop, self._flying)
        elif self._has_arrived(state):
            self._stand_off(state)
        if self.progress.is_late(state):
            p.add_finding("transit_timeout", "the standoff point was not reached in time")
