"""A model of the servo and of its controller, on the shell's time base; no hardware moves.

The modelled faults also occur in a real lock. In a dry-run the shell passes `horn_pulse_us` to the simulated
vehicle.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import DriverError
from dart_flight.lock.servo import NO_FAULTS, ServoFaults, ServoModel, mode_of
from dart_flight.lock.state_machine import DriverReading


class MockFaults(msgspec.Struct, frozen=True):
    """Faults of the modelled lock.

    Attributes:
        servo: faults of the servo itself: stuck, slow or stalled.
        unplugged: the controller does not answer; the servo keeps the last pulse.
        brown_out: the controller restarts `BROWN_OUT_S` after the start of every travel, and then outputs no
            pulses until the next command.
        switch_silent: the limit switches never close.
    """

    servo: ServoFaults = NO_FAULTS
    unplugged: bool = False
    brown_out: bool = False
    switch_silent: bool = False


class MockDriver:
    """Model of the configured servo, with the configured limit switches."""

    BROWN_OUT_S = 0.06  # time from the start of a travel until the starting current drains the capacitors

    def __init__(
        self,
        config: LockConfig,
        clock_us: Callable[[], int],
        *,
        pulse_us: float | None = None,
        faults: MockFaults | None = None,
    ) -> None:
        """`pulse_us` is the initial position of the horn, by default the flexible end."""
        self._config = config
        self._clock_us = clock_us
        self._faults = faults or MockFaults()
        start_us = config.servo.flexible_pulse_us if pulse_us is None else pulse_us
        self._servo = ServoModel(config.servo, start_us, self._faults.servo)
        self._reset_at_us: int | None = None
        self._restarted = False

    @property
    def faults(self) -> MockFaults:
        return self._faults

    def inject(self, faults: MockFaults) -> None:
        now = self._advance(self._clock_us())
        self._faults = faults
        self._servo.set_faults(now, faults.servo)

    def horn_pulse_us(self, t_us: int) -> float:
        """Return the horn's true position, as a pulse width in us, at a time of the mock's clock."""
        if self._reset_at_us is not None:
            self._advance(t_us)
        return self._servo.pulse_at(t_us)

    def open(self) -> None:
        self._require_answer()

    def set_pulse(self, pulse_us: float) -> None:
        now = self._require_answer()
        moves = abs(self._servo.pulse_at(now) - pulse_us) > self._config.servo.tolerance_us
        self._servo.command(now, pulse_us)
        self._restarted = False
        self._reset_at_us = now + round(self.BROWN_OUT_S * 1e6) if self._faults.brown_out and moves else None

    def release(self) -> None:
        self._servo.command(self._require_answer(), None)
        self._reset_at_us = None

    def read(self) -> DriverReading:
        now = self._require_answer()
        at = mode_of(self._config.servo, self._servo.pulse_at(now))
        return DriverReading(
            pulse_us=self._servo.commanded_us,
            rigid_switch=self._switch(Mode.RIGID, at),
            flexible_switch=self._switch(Mode.FLEXIBLE, at),
            errors=("the controller restarted",) if self._restarted else (),
        )

    def close(self) -> None:
        """Leave the pulses as they are."""

    def _switch(self, mode: Mode, at: Mode | None) -> bool | None:
        fitted = self._config.limit_switch
        line = None
        if fitted is not None:
            line = fitted.rigid_line if mode is Mode.RIGID else fitted.flexible_line
        if line is None:
            return None
        return at is mode and not self._faults.switch_silent

    def _require_answer(self) -> int:
        now = self._advance(self._clock_us())
        if self._faults.unplugged:
            raise DriverError("the controller does not answer (unplugged)")
        return now

    def _advance(self, t_us: int) -> int:
        if self._reset_at_us is not None and t_us >= self._reset_at_us:
            self._servo.command(self._reset_at_us, None)
            self._reset_at_us = None
            self._restarted = True
        return t_us
