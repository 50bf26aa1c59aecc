"""The mission as a state machine: phases, events, and the one table that says what follows what.

`docs/mission_phases.md` is generated from the table (`python -m tools.docs.generated`). Only `Executive`
changes the phase, and only through `TRANSITIONS`.
"""

from __future__ import annotations

from enum import StrEnum

from dart_flight.samples import Phase


class Cue(StrEnum):
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
    TIMED_OUT = "goal not passed in time"
    HELD = "goal held"
    LANDED = "landed and disarmed"
    OVERRULE = "guard"
    GIVEN_UP = "not ready in time"


TRANSITIONS: dict[tuple[Phase, Cue], Phase] = {
    (Phase.READYING, Cue.READY): Phase.OFFBOARD,
    (Phase.OFFBOARD, Cue.CONFIRMED): Phase.ARMING,
    (Phase.ARMING, Cue.CONFIRMED): Phase.CLIMB,
    (Phase.CLIMB, Cue.ARRIVED): Phase.TRANSIT,
    (Phase.TRANSIT, Cue.ARRIVED): Phase.PREPARE,
    (Phase.PREPARE, Cue.MODE_SETTLED): Phase.APPROACH,
    (Phase.APPROACH, Cue.ONSET): Phase.CONTACT,
    (Phase.APPROACH, Cue.STOOD_OFF): Phase.RECOVERY,
    (Phase.CONTACT, Cue.PEAK): Phase.RECOVERY,
    (Phase.RECOVERY, Cue.ONSET): Phase.CONTACT,
    (Phase.RECOVERY, Cue.RESTED): Phase.TRANSIT,
    (Phase.RECOVERY, Cue.PASSED): Phase.GOAL,
    (Phase.RECOVERY, Cue.TIMED_OUT): Phase.GOAL,
    (Phase.GOAL, Cue.HELD): Phase.LANDING,
    (Phase.LANDING, Cue.LANDED): Phase.DONE,
    # The ways out: on the ground the mission is given up, in the air the guard takes over.
    (Phase.READYING, Cue.GIVEN_UP): Phase.DONE,
    (Phase.OFFBOARD, Cue.GIVEN_UP): Phase.DONE,
    (Phase.ARMING, Cue.GIVEN_UP): Phase.DONE,
    **{(phase, Cue.OVERRULE): Phase.OVERRULED for phase in Phase if phase is not Phase.DONE},
    (Phase.OVERRULED, Cue.LANDED): Phase.DONE,
}

DOWN_US = 200_000  # one report of landed and disarmed may be another vehicle's on the same link
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
