"""A lock's driver and state machine in one object, for a thread that may block.

Each call also executes the actions that the state machine returns. The lock command, the campaign and the
tests use `LockSession`. The flight app may use `LockSession` in the lock's thread, or step the state machine
directly.
"""

from __future__ import annotations

from collections.abc import Callable

from dart_flight.base.records import LockCommand, LockPermission, LockState, Mode
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import Driver, DriverError
from dart_flight.lock.state_machine import Action, CommandRefused, LockStateMachine, PulsesOff, SetPulse


class LockSession:
    """Steps the state machine of a lock and executes the actions with the driver.

    `clock_us` returns the core's time in microseconds. `on_change` receives every new lock state, in order.
    The commands return a `CommandRefused` if the state machine refuses them. No method raises `DriverError`:
    if the driver fails, the phase of the lock becomes `fault`.
    """

    def __init__(
        self,
        config: LockConfig,
        driver: Driver,
        clock_us: Callable[[], int],
        on_change: Callable[[LockState], None] = lambda state: None,
    ) -> None:
        self.machine = LockStateMachine(config, clock_us())
        self.driver = driver
        self._clock_us = clock_us
        self._on_change = on_change
        self._shown = self.machine.state

    @property
    def state(self) -> LockState:
        return self.machine.state

    def start(self) -> CommandRefused | None:
        """Home the lock or adopt the current position, as configured."""
        asked_us = self._clock_us()
        try:
            self.driver.open()
            reading = self.driver.read()
        except DriverError as error:
            self.machine.driver_failed(asked_us, str(error))
            self._show()
            return None
        return self._execute(self.machine.start(asked_us, reading))

    def command(self, mode: Mode) -> CommandRefused | None:
        return self._execute(self.machine.command(self._clock_us(), mode))

    def obey(self, order: LockCommand | LockPermission) -> None:
        """Carry out an order of the core."""
        if isinstance(order, LockCommand):
            self.command(order.mode)
        else:
            self.permit(order.permitted)

    def permit(self, permitted: bool) -> None:
        self._execute(self.machine.permit(self._clock_us(), permitted))

    def release(self) -> CommandRefused | None:
        return self._execute(self.machine.release(self._clock_us()))

    def poll(self) -> LockState:
        """Read the driver and update the state; call this every 20 to 50 ms, even if the servo is at rest."""
        asked_us = self._clock_us()
        try:
            reading = self.driver.read()
        except DriverError as error:
            self.machine.driver_failed(asked_us, str(error))
        else:
            self.machine.reading(asked_us, reading)
        self._show()
        self.machine.step(self._clock_us())
        self._show()
        return self.machine.state

    def _execute(self, actions: list[Action]) -> CommandRefused | None:
        refused = None
        self._show()
        for action in actions:
            try:
                if isinstance(action, SetPulse):
                    self.driver.set_pulse(action.pulse_us)
                    self.machine.confirm_sent(self._clock_us(), action.pulse_us)
                elif isinstance(action, PulsesOff):
                    self.driver.release()
                else:
                    refused = action
            except DriverError as error:
                self.machine.driver_failed(self._clock_us(), str(error))
        self._show()
        return refused

    def _show(self) -> None:
        if self.machine.state is not self._shown:
            self._shown = self.machine.state
            self._on_change(self._shown)
