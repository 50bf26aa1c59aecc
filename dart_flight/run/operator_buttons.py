"""Buttons of a ground station: the effect of each button in each state of a flight and of standby.

The buttons are COMMAND_LONG `MAV_CMD_USER_1` with the button's number in param1 (docs/ground_station.md).
`FlightApp` and `Standby` carry out the effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

from dart_flight.base.records import Mode, Phase, Request
from dart_flight.vehicle.command_server import Press, Result


class Button(IntEnum):
    """Number of a button, param1 of the command."""

    LOCK_RIGID = 1
    LOCK_FLEXIBLE = 2
    CONTINUE = 3
    LAND = 4  # the vehicle leaves the wall and lands
    CHECK = 5  # param2 is the number of the mission; 0 means all missions
    FLY = 6  # param2 is the number of the mission


_MODES: Final = {Button.LOCK_RIGID: Mode.RIGID, Button.LOCK_FLEXIBLE: Mode.FLEXIBLE}


class Errand(NamedTuple):
    """Task for which standby passes the link to another process; mission numbers begin at 1."""

    fly: bool
    missions: tuple[int, ...]


class Reply(NamedTuple):
    """Answer to a press: the result, a text, and the effect that the caller carries out."""

    result: Result
    text: str
    effect: Request | Mode | Errand | None = None


def _denied(text: str) -> Reply:
    return Reply(Result.DENIED, text)


def button_of(press: Press) -> Button | None:
    """Return the button of a press, or None if the number has no button."""
    return Button(press.button) if press.button in tuple(Button) else None


CANCELLED: Final = "take-off cancelled"


def reply_before_take_off(press: Press) -> Reply:
    """Return the answer while a requested flight checks the vehicle."""
    if button_of(press) is Button.LAND:
        return Reply(Result.ACCEPTED, CANCELLED, Request.LAND)
    return Reply(Result.TEMPORARILY_REJECTED, "checking before the flight: only Land has an effect")


def reply_in_flight(press: Press, phase: Phase, lock: str) -> Reply:
    """Return the answer while a mission flies; `lock` is the state of the lock, empty without a lock."""
    button, over = button_of(press), phase is Phase.DONE
    if button is Button.CHECK:
        return Reply(Result.ACCEPTED, f"in flight: {phase}" + (f"; {lock}" if lock else ""))
    if button is Button.LAND:
        if over:
            return _denied("the flight is over")
        # If a mission that is ending normally got a second request to land, it would count as broken off.
        landing = phase is Phase.LANDING
        return Reply(Result.ACCEPTED, "landing", None if landing else Request.LAND)
    if button is Button.FLY:
        return _denied("a mission is flying")
    if button is None:
        return _denied(f"there is no button {press.button}")
    if phase is Phase.CONTACT:
        return Reply(Result.TEMPORARILY_REJECTED, "in contact: press again after the contact")
    if button is Button.CONTINUE:
        if phase is Phase.PAUSE:
            return Reply(Result.ACCEPTED, "continuing", Request.CONTINUE)
        return _denied(f"there is no pause in phase {phase}")
    return _denied("the mission moves the lock during the flight")


# --- standby -----------------------------------------------------------------------------------------------

AGAIN_S: Final = 10.0  # the second press of Fly must follow the first press within this time
# QGroundControl resends an unacknowledged command after 3.0 to 3.5 s, with confirmation 0 like a new press. A
# second press at that time may therefore be a retransmission.
_REPEATED_S: Final = (2.7, 3.8)


class StandbyState(NamedTuple):
    """The state of vehicle and missions that determines the answer to a button in standby.

    Attributes:
        missions: names of the missions, in the order of their numbers.
        travelling: mode to which the lock travels, or None while it rests.
        armed: whether the motors may turn, or None before PX4's first heartbeat.
        remote_control: whether PX4 receives the remote control.
    """

    missions: Sequence[str]
    has_lock: bool = True
    travelling: Mode | None = None
    armed: bool | None = None
    remote_control: bool = False


class StandbyButtons:
    """Buttons in standby. *Fly* needs two presses, so the first press is stored."""

    def __init__(self) -> None:
        self._asked: tuple[int, float] | None = None  # mission of the first press, and its time

    def reply(self, press: Press, state: StandbyState, now_s: float) -> Reply:
        button, asked = button_of(press), self._asked
        self._asked = None  # any other button between the two presses cancels the first
        if button is None:
            return _denied(f"there is no button {press.button}")
        if button in _MODES:
            return _reply_lock(_MODES[button], state)
        if button is Button.LAND and asked is not None:
            return Reply(Result.ACCEPTED, CANCELLED)
        if button in (Button.CONTINUE, Button.LAND):
            return _denied("no mission is flying")
        if not state.missions:
            return _denied("standby was started without missions")
        count, number = len(state.missions), press.value
        if number not in range(1, count + 1) and not (button is Button.CHECK and number == 0):
            return _denied(f"there is no mission {number}, only 1 to {count}")
        if state.armed is not False:
            return _denied("the vehicle is armed" if state.armed else "PX4 has sent no heartbeat yet")
        if button is Button.CHECK:
            chosen = (number,) if number else tuple(range(1, count + 1))
            return Reply(Result.ACCEPTED, "checking", Errand(False, chosen))
        if not state.remote_control:
            return _denied("PX4 receives no remote control")
        name = state.missions[number - 1]
        if asked is not None and asked[0] == number:
            after_s = now_s - asked[1]
            repeated = press.repeated or _REPEATED_S[0] <= after_s <= _REPEATED_S[1]
            if after_s <= AGAIN_S and not repeated:
                return Reply(Result.ACCEPTED, f"check and fly {name}", Errand(True, (number,)))
        self._asked = (number, now_s)
        return Reply(Result.ACCEPTED, f"fly {name}? press again within {AGAIN_S:.0f} s")


def _reply_lock(mode: Mode, state: StandbyState) -> Reply:
    if not state.has_lock:
        return _denied("this vehicle has no lock")
    if state.travelling not in (None, mode):
        return Reply(Result.TEMPORARILY_REJECTED, f"the lock is moving to {state.travelling}")
    return Reply(Result.ACCEPTED, f"moving to {mode}", mode)


# --- the transmitter's switch ------------------------------------------------------------------------------

_HIGH_US, _LOW_US = 1700, 1300
_PULSES_US: Final = range(800, 2201)
_HELD_S, _GAP_S = 0.5, 2.0


class RcSwitch:
    """The transmitter's switch for the lock: high is rigid, low is flexible.

    The middle position has no effect. After the start, or after a gap in the pulses, the first position also
    has no effect. The lock moves when the switch has changed and has held its new position.
    """

    def __init__(self) -> None:
        self._position: Mode | None = None  # last position that had an effect
        self._candidate: tuple[Mode, float] | None = None
        self._seen_s: float | None = None

    def update(self, pulse_us: int, now_s: float) -> Mode | None:
        """Process the channel's next pulse; return the mode to which the lock must move."""
        if pulse_us not in _PULSES_US:
            return None
        if self._seen_s is None or now_s - self._seen_s > _GAP_S:
            self._position = self._candidate = None
        self._seen_s = now_s
        position = Mode.RIGID if pulse_us >= _HIGH_US else Mode.FLEXIBLE if pulse_us <= _LOW_US else None
        if position is None or position is self._position:
            self._candidate = None
        elif self._position is None:
            self._position = position
        elif self._candidate is None or self._candidate[0] is not position:
            self._candidate = (position, now_s)
        elif now_s - self._candidate[1] >= _HELD_S:
            self._position, self._candidate = position, None
            return position
        return None
