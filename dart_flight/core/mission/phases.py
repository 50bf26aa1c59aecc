"""The mission as a state machine: phases, events, and the one table that says what follows what.

`docs/mission_phases.md` is generated from the table (`python -m tools.docs.generated`). Only `Executive`
changes the phase, and only through `TRANSITIONS`.
"""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """Where the mission stands."""

    READYING = "readying"  # waiting for telemetry, lock in the transit mode
    OFFBOARD = "offboard"  # asking PX4 for offboard mode
    ARMING = "arming"
    CLIMB = "climb"
    TRANSIT = "transit"  # to the run-up point, turning parallel to the wall
    PREPARE = "prepare"  # lock to the collision's mode
    APPROACH = "approach"
    CONTACT = "contact"  # from onset to the peak of the normal force
    RECOVERY = "recovery"
    GOAL = "goal"  # holding the goal
    LANDING = "landing"
    DONE = "done"
    OVERRULED = "overruled"  # the guard flies: break off, hold, land, or silence


class Event(StrEnum):
    """What moves the mission on."""

    READY = "ready"
    CONFIRMED = "confirmed by telemetry"
    ARRIVED = "arrived"
    MODE_SETTLED = "lock settled"
    ONSET = "force over threshold"
    PEAK = "peak of normal force"
    STOOD_OFF = "stopped before the wall"  # a rehearsal
    RESTED = "rested, next approach"
    PASSED = "goal passed"
    HELD = "goal held"
    LANDED = "landed and disarmed"
    OVERRULE = "guard"
    GIVEN_UP = "not ready in time"


TRANSITIONS: dict[tuple[Phase, Event], Phase] = {
    (Phase.READYING, Event.READY): Phase.OFFBOARD,
    (Phase.OFFBOARD, Event.CONFIRMED): Phase.ARMING,
    (Phase.ARMING, Event.CONFIRMED): Phase.CLIMB,
    (Phase.CLIMB, Event.ARRIVED): Phase.TRANSIT,
    (Phase.TRANSIT, Event.ARRIVED): Phase.PREPARE,
    (Phase.PREPARE, Event.MODE_SETTLED): Phase.APPROACH,
    (Phase.APPROACH, Event.ONSET): Phase.CONTACT,
    (Phase.APPROACH, Event.STOOD_OFF): Phase.RECOVERY,
    (Phase.CONTACT, Event.PEAK): Phase.RECOVERY,
    (Phase.RECOVERY, Event.ONSET): Phase.CONTACT,
    (Phase.RECOVERY, Event.RESTED): Phase.TRANSIT,
    (Phase.RECOVERY, Event.PASSED): Phase.GOAL,
    (Phase.GOAL, Event.HELD): Phase.LANDING,
    (Phase.LANDING, Event.LANDED): Phase.DONE,
    # The ways out: on the ground the mission is given up, in the air the guard takes over.
    (Phase.READYING, Event.GIVEN_UP): Phase.DONE,
    (Phase.OFFBOARD, Event.GIVEN_UP): Phase.DONE,
    (Phase.ARMING, Event.GIVEN_UP): Phase.DONE,
    **{(phase, Event.OVERRULE): Phase.OVERRULED for phase in Phase if phase is not Phase.DONE},
    (Phase.OVERRULED, Event.LANDED): Phase.DONE,
}

ON_GROUND = frozenset({Phase.READYING, Phase.OFFBOARD, Phase.ARMING})
ALTITUDE_EXEMPT = ON_GROUND | {Phase.CLIMB, Phase.LANDING, Phase.DONE}
WATCHING = frozenset(
    {
        Phase.TRANSIT,
        Phase.PREPARE,
        Phase.APPROACH,
        Phase.CONTACT,
        Phase.RECOVERY,
        Phase.GOAL,
    }
)
