"""The mission as a state machine: phases, triggers, and the table of transitions.

`docs/mission_phases.md` is generated from the table (`python -m tools.docs.generated`). Only `Executive`
changes the phase, and only through `TRANSITIONS`.
"""

from __future__ import annotations

from enum import StrEnum

from dart_flight.base.records import Phase


class PhaseTrigger(StrEnum):
    """Triggers of a phase transition."""

    READY = "ready"
    CONFIRMED = "confirmed by telemetry"
    ARRIVED = "arrived"
    NEXT_WAYPOINT = "a way-point is next"
    NEXT_PAUSE = "a pause is next"
    NEXT_COLLISION = "a collision is next"
    NEXT_GOAL = "the goal is next"
    MODE_SETTLED = "lock settled"
    NO_LOCK = "arrived, no lock to move"
    ONSET = "force over threshold"
    PEAK = "peak of normal force"
    STOOD_OFF = "stopped before the wall"  # in a rehearsal
    NOT_MET = "nothing met"  # after a probe
    RESTED = "rested, next approach"
    PASSED = "goal passed"
    TIMED_OUT = "goal not passed in time"
    HELD = "goal held"
    LANDED = "landed and disarmed"
    OVERRULE = "guard"
    GIVEN_UP = "not ready in time"


_AT_REST = (Phase.CLIMB, Phase.WAYPOINT, Phase.PAUSE, Phase.RECOVERY)

TRANSITIONS: dict[tuple[Phase, PhaseTrigger], Phase] = {
    (Phase.READYING, PhaseTrigger.READY): Phase.OFFBOARD,
    (Phase.OFFBOARD, PhaseTrigger.CONFIRMED): Phase.ARMING,
    (Phase.ARMING, PhaseTrigger.CONFIRMED): Phase.CLIMB,
    (Phase.CLIMB, PhaseTrigger.ARRIVED): Phase.TRANSIT,
    (Phase.TRANSIT, PhaseTrigger.ARRIVED): Phase.PREPARE,
    (Phase.PREPARE, PhaseTrigger.MODE_SETTLED): Phase.APPROACH,
    (Phase.TRANSIT, PhaseTrigger.NO_LOCK): Phase.APPROACH,
    (Phase.APPROACH, PhaseTrigger.ONSET): Phase.CONTACT,
    (Phase.APPROACH, PhaseTrigger.STOOD_OFF): Phase.RECOVERY,
    (Phase.APPROACH, PhaseTrigger.NOT_MET): Phase.RECOVERY,
    (Phase.CONTACT, PhaseTrigger.PEAK): Phase.RECOVERY,
    (Phase.RECOVERY, PhaseTrigger.ONSET): Phase.CONTACT,
    (Phase.RECOVERY, PhaseTrigger.RESTED): Phase.TRANSIT,
    (Phase.RECOVERY, PhaseTrigger.PASSED): Phase.GOAL,
    (Phase.RECOVERY, PhaseTrigger.TIMED_OUT): Phase.GOAL,
    (Phase.GOAL, PhaseTrigger.HELD): Phase.LANDING,
    (Phase.LANDING, PhaseTrigger.LANDED): Phase.DONE,
    # From rest to rest: waypoints, pauses, or a mission without collisions.
    **{(phase, PhaseTrigger.NEXT_WAYPOINT): Phase.WAYPOINT for phase in _AT_REST},
    **{(phase, PhaseTrigger.NEXT_PAUSE): Phase.PAUSE for phase in _AT_REST},
    **{(phase, PhaseTrigger.NEXT_GOAL): Phase.GOAL for phase in _AT_REST},
    (Phase.WAYPOINT, PhaseTrigger.NEXT_COLLISION): Phase.TRANSIT,
    (Phase.PAUSE, PhaseTrigger.NEXT_COLLISION): Phase.TRANSIT,
    # Exits: on the ground the mission is given up; in the air the guard takes over.
    (Phase.READYING, PhaseTrigger.GIVEN_UP): Phase.DONE,
    (Phase.OFFBOARD, PhaseTrigger.GIVEN_UP): Phase.DONE,
    (Phase.ARMING, PhaseTrigger.GIVEN_UP): Phase.DONE,
    **{(phase, PhaseTrigger.OVERRULE): Phase.OVERRULED for phase in Phase if phase is not Phase.DONE},
    (Phase.OVERRULED, PhaseTrigger.LANDED): Phase.DONE,
}

DOWN_US = 200_000  # a shorter report of landed and disarmed may be another vehicle's
ON_GROUND = frozenset({Phase.READYING, Phase.OFFBOARD, Phase.ARMING})
ALTITUDE_EXEMPT = ON_GROUND | {Phase.CLIMB, Phase.LANDING, Phase.DONE}
BETWEEN = frozenset({Phase.WAYPOINT, Phase.PAUSE})  # between collisions
TO_IMPACT = frozenset({Phase.TRANSIT, Phase.PREPARE, Phase.APPROACH})  # phases before the next collision
AT_WALL = frozenset({Phase.APPROACH, Phase.CONTACT})
WATCHING = BETWEEN | frozenset(
    {
        Phase.TRANSIT,
        Phase.PREPARE,
        Phase.APPROACH,
        Phase.CONTACT,
        Phase.RECOVERY,
        Phase.GOAL,
    }
)
