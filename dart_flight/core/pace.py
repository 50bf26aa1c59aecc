"""How soon the next inputs have to be stepped: near a wall as they arrive, elsewhere several together.

Waking for every sample costs more than the samples (docs/latency.md). What is decided does not depend on it,
only when: the core sees stamps and no clock.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from dart_flight.base.records import Phase
from dart_flight.config.mission import Mission
from dart_flight.core.mission.wall_uncertainty import early_m, overrun_m
from dart_flight.core.sense.state import FlightState

BATCH_S: Final = 0.02  # as often as a tick; a quarter of the silence of the IMU on which the guard acts
_LEAD_S: Final = 0.2  # so long before a wall may be met batching ends: ten times what it holds back


class Pace(Enum):
    """How the shell should step the next inputs."""

    BATCHED = auto()  # what comes within `BATCH_S`, in one batch
    IMMEDIATE = auto()  # each as it arrives, on the thread it arrives on


def pace_near_walls(mission: Mission, state: FlightState, phase: Phase) -> Pace:
    """`BATCHED` or `IMMEDIATE`, by where the vehicle is.

    `IMMEDIATE` in a contact, and wherever within 0.2 s a wall of the mission may be met, by the guard's own
    words for how early and how late that may be, whatever the phase.
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
