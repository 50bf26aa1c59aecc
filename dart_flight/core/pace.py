"""The pace at which the shell passes inputs to the core.

Near a wall, the core processes each input as it arrives. Elsewhere, the core processes several inputs
together, because waking up for a sample takes longer than processing the sample (docs/latency.md). The pace
affects only the time of decisions, not their result, because the core uses stamps and no clock.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from dart_flight.base.records import Phase
from dart_flight.config.mission import Mission
from dart_flight.core.mission.wall_uncertainty import early_m, overrun_m
from dart_flight.core.sense.state import FlightState

BATCH_S: Final = 0.02  # the tick's period; the guard acts after four times this time without IMU samples
_LEAD_S: Final = 0.2  # batching ends this long before a possible impact: ten times a batch's delay


class Pace(Enum):
    """Pace at which the shell should pass the next inputs to the core."""

    BATCHED = auto()  # all inputs that arrive within `BATCH_S`, in one batch
    IMMEDIATE = auto()  # each input as it arrives, on the receiving thread


def pace_near_walls(mission: Mission, state: FlightState, phase: Phase) -> Pace:
    """Return `BATCHED` or `IMMEDIATE`, depending on the vehicle's position.

    The pace is `IMMEDIATE` during a contact, and while the vehicle may reach a wall within 0.2 s. The
    second condition includes the guard's tolerances for early and late contacts.
    """
    if phase is Phase.CONTACT:
        return Pace.IMMEDIATE
    place, velocity, guard = state.position, state.velocity, mission.vehicle.guard
    for wall in mission.walls:
        n = wall.normal
        closing_m_s = max(0.0, -(velocity[0] * n[0] + velocity[1] * n[1]))
        ahead_m = early_m(guard, wall, place) + _LEAD_S * closing_m_s
        if -overrun_m(guard, wall, place) < wall.signed_distance(place) < ahead_m:
            return Pace.IMMEDIATE
    return Pace.BATCHED
