"""A real driver, together with a model of the servo's horn.

This driver is for a simulated vehicle with a real servo on the bench. The modelled horn moves the simulated
arms, because an analogue servo does not report its position.
"""

from __future__ import annotations

from collections.abc import Callable

from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import Driver
from dart_flight.lock.servo import ServoModel
from dart_flight.lock.state_machine import DriverReading


class DriverWithModelledHorn:
    """Passes every call to a real driver; the modelled horn follows each accepted pulse width.

    Before the first command the horn is at the flexible end, as in the mock.
    """

    def __init__(self, driver: Driver, config: LockConfig, clock_us: Callable[[], int]) -> None:
        self._driver, self._clock_us = driver, clock_us
        self._servo = ServoModel(config.servo, config.servo.flexible_pulse_us)

    def horn_pulse_us(self, t_us: int) -> float:
        return self._servo.pulse_at(t_us)

    def open(self) -> None:
        self._driver.open()

    def set_pulse(self, pulse_us: float) -> None:
        """Pass the pulse on; a pulse that the hardware rejects does not move the horn."""
        self._driver.set_pulse(pulse_us)
        self._servo.command(self._clock_us(), pulse_us)

    def release(self) -> None:
        self._driver.release()
        self._servo.command(self._clock_us(), None)

    def read(self) -> DriverReading:
        return self._driver.read()

    def close(self) -> None:
        self._driver.close()
