"""Permission and commands to move the lock.

The rods can enter their slots only with relaxed arms: not during a contact, and not before the arms have
sprung back (paper, Sec. III; `lock.relaxation_s`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

from dart_flight.base.records import LockCommand, LockPermission, LockPhase, Mode
from dart_flight.config.vehicle import LockConfig
from dart_flight.core.sense.state import FlightState

RETRY_US: Final = 1_000_000
_OVERDUE_US: Final = 50_000  # two polls of the lock; a lock that settles later than this is overdue


class LockCommandState(NamedTuple):
    """State of the commands to the lock. It does not contain the lock's own state. Times are autopilot time.

    Attributes:
        contact_begin_us, contact_end_us: times of the last contact; the end is None during a contact.
        permitted: whether the lock may move; None if not decided yet.
        commanded, commanded_us: the last commanded mode, and the time of the command in this phase.
    """

    contact_begin_us: int | None = None
    contact_end_us: int | None = None
    permitted: bool | None = None
    commanded: Mode | None = None
    commanded_us: int | None = None

    def contact_begins(self, t_us: int) -> LockCommandState:
        """Forbid lock motion from the onset of a contact."""
        return self._replace(contact_begin_us=t_us, contact_end_us=None)

    def contact_ends(self, t_us: int) -> LockCommandState:
        """Start the relaxation of the arms."""
        return self._replace(contact_end_us=t_us)

    def phase_begins(self) -> LockCommandState:
        """Allow the next command immediately, without the delay before a retry."""
        return self._replace(commanded_us=None)


class LockCommands:
    """Rules for the lock of one vehicle; without a lock there are no commands."""

    def __init__(self, lock: LockConfig | None) -> None:
        self._lock = lock
        self._relaxation_us = lock.relaxation_s * 1e6 if lock else 0.0
        self._switch_us = lock.switch_time_s * 1e6 if lock else 0.0

    def permission(self, lock: LockCommandState, now_us: int, in_contact: bool) -> LockPermission | None:
        """Return a record if the permission to move has changed."""
        end_us = lock.contact_end_us
        relaxed = end_us is not None and now_us - end_us >= self._relaxation_us
        permitted = not in_contact and (lock.contact_begin_us is None or relaxed)
        if permitted == lock.permitted or self._lock is None:
            return None
        return LockPermission(now_us, permitted)

    def ready_us(self, lock: LockCommandState, mode: Mode, state: FlightState) -> int | None:
        """Return the autopilot time at which the lock, if nothing fails, will be settled in a mode.

        Return None if the lock is in fault or overdue.
        """
        if state.lock_is_in(mode):
            return state.now_us
        if state.lock.phase is LockPhase.FAULT:
            return None
        if state.lock.phase is LockPhase.TRAVELLING and state.lock.mode is mode:
            ready_us = round((state.lock.commanded_us or state.now_us) + self._switch_us)
            return ready_us if state.now_us - ready_us <= _OVERDUE_US else None
        end_us = lock.contact_end_us if lock.contact_end_us is not None else state.now_us
        return round(max(state.now_us, end_us + self._relaxation_us) + self._switch_us)

    def command(self, lock: LockCommandState, mode: Mode, state: FlightState) -> LockCommand | None:
        """Return the command to move to a mode, or None if there is nothing to command now."""
        if state.lock_is_in(mode):
            return None
        moving = state.lock.phase is LockPhase.TRAVELLING and state.lock.mode is mode
        fresh = lock.commanded is not mode or lock.commanded_us is None
        stale = lock.commanded_us is not None and state.now_us - lock.commanded_us >= RETRY_US
        if not lock.permitted or moving or not (fresh or stale):
            return None
        return LockCommand(state.now_us, mode)
