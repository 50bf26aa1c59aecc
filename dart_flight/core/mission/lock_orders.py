"""When the lock may move, and the orders to move it.

The rods can enter their slots only with the arms relaxed: never during a contact, nor before the arms have
sprung back (paper, Sec. III; `lock.relaxation_s`).
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.records import LockCommand, LockPermission, LockPhase, Mode
from dart_flight.config.vehicle import LockConfig
from dart_flight.core.mission.proposal import Proposal
from dart_flight.core.sense.state import FlightState

RETRY_US: Final = 1_000_000
_OVERDUE_US: Final = 50_000  # two polls of the lock


class LockOrders:
    """Permission and commands of one flight; without a lock there are none.

    Attributes:
        contact_end_us: end of the last contact; None while there is one, or before the first.
    """

    def __init__(self, lock: LockConfig | None) -> None:
        self._lock = lock
        self._relaxation_us = lock.relaxation_s * 1e6 if lock else 0.0
        self._switch_us = lock.switch_time_s * 1e6 if lock else 0.0
        self._impact_us: int | None = None
        self.contact_end_us: int | None = None
        self._permitted: bool | None = None
        self._ordered: Mode | None = None
        self._ordered_us: int | None = None

    def contact_begins(self, t_us: int) -> None:
        """An impact: from now on the lock may not move."""
        self._impact_us, self.contact_end_us = t_us, None

    def contact_ends(self, t_us: int) -> None:
        """The force is gone; the arms spring back."""
        self.contact_end_us = t_us

    def permission(self, now_us: int, in_contact: bool) -> LockPermission | None:
        """A record where it has changed whether the lock may move."""
        relaxed = self.contact_end_us is not None and now_us - self.contact_end_us >= self._relaxation_us
        permitted = not in_contact and (self._impact_us is None or relaxed)
        if permitted == self._permitted or self._lock is None:
            return None
        self._permitted = permitted
        return LockPermission(now_us, permitted)

    def ready_us(self, mode: Mode, state: FlightState) -> int | None:
        """When the lock will be settled in a mode if nothing fails, autopilot time.

        None: it is at fault, or should have been settled by now.
        """
        if state.lock_is_in(mode):
            return state.now_us
        if state.lock.phase is LockPhase.FAULT:
            return None
        if state.lock.phase is LockPhase.TRAVELLING and state.lock.mode is mode:
            ready_us = round((state.lock.commanded_us or state.now_us) + self._switch_us)
            return ready_us if state.now_us - ready_us <= _OVERDUE_US else None
        end_us = self.contact_end_us if self.contact_end_us is not None else state.now_us
        return round(max(state.now_us, end_us + self._relaxation_us) + self._switch_us)

    def phase_begins(self) -> None:
        """An order may be given anew in a new phase, without waiting for the last one's retry."""
        self._ordered_us = None

    def move_to(self, mode: Mode, state: FlightState, p: Proposal) -> bool:
        """Move the lock where it is not there yet and may move; True once it is settled in `mode`."""
        order = self.command_mode(mode, state)
        if order is not None:
            p.outputs.append(order)
        return state.lock_is_in(mode)

    def command_mode(self, mode: Mode, state: FlightState) -> LockCommand | None:
        """The command to go to a mode where the lock is not there, may move, and was not told just now."""
        if state.lock_is_in(mode):
            return None
        moving = state.lock.phase is LockPhase.TRAVELLING and state.lock.mode is mode
        fresh = self._ordered is not mode or self._ordered_us is None
        stale = self._ordered_us is not None and state.now_us - self._ordered_us >= RETRY_US
        if not self._permitted or moving or not (fresh or stale):
            return None
        self._ordered, self._ordered_us = mode, state.now_us
        return LockCommand(state.now_us, mode)
