"""Permission to move the lock, its predicted ready time, and the repetition of commands."""

from __future__ import annotations

import msgspec

from dart_flight.base.records import LockCommand, LockPermission, LockPhase, LockState, Mode
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.core.mission.lock_commands import _OVERDUE_US, RETRY_US, LockCommands, LockCommandState
from dart_flight.core.sense.state import FlightState
from tests.core.conftest import known

NOW_US = 10_000_000
PACKAGED = load_vehicle(packaged("configs", "dart.yaml")).lock
assert PACKAGED is not None
RELAX_US, SWITCH_US = 300_000, round(1e6 * PACKAGED.switch_time_s)


class Lock:
    """The commands of the packaged lock with their state, updated as the executive updates it."""

    def __init__(self) -> None:
        self.rules = LockCommands(msgspec.structs.replace(known(PACKAGED), relaxation_s=RELAX_US * 1e-6))
        self.memory = LockCommandState()

    def permission(self, now_us: int, in_contact: bool) -> LockPermission | None:
        changed = self.rules.permission(self.memory, now_us, in_contact)
        if changed is not None:
            self.memory = self.memory._replace(permitted=changed.permitted)
        return changed

    def ready_us(self, mode: Mode, state: FlightState) -> int | None:
        return self.rules.ready_us(self.memory, mode, state)

    def command(self, mode: Mode, state: FlightState) -> LockCommand | None:
        command = self.rules.command(self.memory, mode, state)
        if command is not None:
            self.memory = self.memory._replace(commanded=mode, commanded_us=state.now_us)
        return command

    def contact_begins(self, t_us: int) -> None:
        self.memory = self.memory.contact_begins(t_us)

    def contact_ends(self, t_us: int) -> None:
        self.memory = self.memory.contact_ends(t_us)


def state_with(
    phase: LockPhase, mode: Mode | None, now_us: int = NOW_US, commanded_us: int | None = None
) -> FlightState:
    state = FlightState()
    state.now_us = now_us
    state.update_lock(LockState(now_us, phase, mode, commanded_us=commanded_us))
    return state


def test_the_lock_may_move_except_in_contact_and_before_the_arms_relax() -> None:
    lock = Lock()
    assert lock.permission(NOW_US, True) == LockPermission(NOW_US, False)
    assert lock.permission(NOW_US + 1, False) == LockPermission(NOW_US + 1, True)
    assert lock.permission(NOW_US + 2, False) is None  # reported once
    lock.contact_begins(NOW_US + 3)
    assert lock.permission(NOW_US + 3, False) == LockPermission(NOW_US + 3, False)
    lock.contact_ends(NOW_US + 10)
    assert lock.permission(NOW_US + 9 + RELAX_US, False) is None
    after_us = NOW_US + 10 + RELAX_US
    assert lock.permission(after_us, True) is None
    assert lock.permission(after_us, False) == LockPermission(after_us, True)
    assert LockCommands(None).permission(LockCommandState(), NOW_US, False) is None


def test_the_ready_time_covers_relaxation_and_switching() -> None:
    lock = Lock()
    assert lock.ready_us(Mode.RIGID, state_with(LockPhase.SETTLED, Mode.RIGID)) == NOW_US
    assert lock.ready_us(Mode.RIGID, state_with(LockPhase.FAULT, Mode.RIGID)) is None
    # Before and during a contact, the arms relax from now on at the earliest.
    still_flexible = state_with(LockPhase.SETTLED, Mode.FLEXIBLE)
    assert lock.ready_us(Mode.RIGID, still_flexible) == NOW_US + RELAX_US + SWITCH_US
    lock.contact_ends(NOW_US - 100_000)
    assert lock.ready_us(Mode.RIGID, still_flexible) == NOW_US - 100_000 + RELAX_US + SWITCH_US
    lock.contact_ends(NOW_US - 2 * RELAX_US)
    assert lock.ready_us(Mode.RIGID, still_flexible) == NOW_US + SWITCH_US


def test_lock_travel_ends_one_switching_time_after_its_command_or_fails() -> None:
    lock, sent_us = Lock(), NOW_US - 100_000
    for now_us, ready_us in (
        (NOW_US, sent_us + SWITCH_US),
        (sent_us + SWITCH_US + _OVERDUE_US, sent_us + SWITCH_US),
        (sent_us + SWITCH_US + _OVERDUE_US + 1, None),
    ):
        travelling = state_with(LockPhase.TRAVELLING, Mode.RIGID, now_us, sent_us)
        assert lock.ready_us(Mode.RIGID, travelling) == ready_us
    since_now = state_with(LockPhase.TRAVELLING, Mode.RIGID)  # the start is unknown
    assert lock.ready_us(Mode.RIGID, since_now) == NOW_US + SWITCH_US
    other_way = state_with(LockPhase.TRAVELLING, Mode.FLEXIBLE, NOW_US, sent_us)
    assert lock.ready_us(Mode.RIGID, other_way) == NOW_US + RELAX_US + SWITCH_US


def test_the_lock_command_is_repeated_until_the_lock_moves() -> None:
    lock = Lock()

    def commands_rigid(now_us: int, phase: LockPhase = LockPhase.SETTLED, mode: Mode = Mode.FLEXIBLE) -> bool:
        command = lock.command(Mode.RIGID, state_with(phase, mode, now_us))
        assert command in (None, LockCommand(now_us, Mode.RIGID))
        return command is not None

    assert not commands_rigid(NOW_US)  # not permitted yet
    lock.permission(NOW_US, False)
    assert commands_rigid(NOW_US)
    assert not commands_rigid(NOW_US + RETRY_US - 1)
    assert commands_rigid(NOW_US + RETRY_US)
    lock.memory = lock.memory.phase_begins()
    assert not commands_rigid(NOW_US + RETRY_US + 1, LockPhase.TRAVELLING, Mode.RIGID)
    assert not commands_rigid(NOW_US + RETRY_US + 1, LockPhase.SETTLED, Mode.RIGID)
    assert commands_rigid(NOW_US + RETRY_US + 1)
    assert commands_rigid(NOW_US + 2 * RETRY_US + 1, LockPhase.TRAVELLING)  # in the other direction
    later_us = NOW_US + 2 * RETRY_US + 2
    flexible = lock.command(Mode.FLEXIBLE, state_with(LockPhase.UNKNOWN, None, later_us))
    assert flexible == LockCommand(later_us, Mode.FLEXIBLE)  # a different command is sent at once
