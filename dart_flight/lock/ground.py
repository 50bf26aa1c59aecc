"""Operation of the lock on the ground, in real time, for the command `dart-flight lock`.

The operator stands beside the vehicle and sees the arms. Locking is therefore permitted. At the start the
lock adopts its current position and is not homed.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

import msgspec

from dart_flight.base.records import LockPhase, LockState, Mode
from dart_flight.config.vehicle import LockConfig, LockDriver, LockStartup
from dart_flight.lock.calibration import Calibration
from dart_flight.lock.drivers import ActuatorLink, Driver, owned_driver
from dart_flight.lock.drivers.mock import MockDriver
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.persistence import LastCommand

POLL_S = 0.02
CALIBRATION_STEP_S = 0.04  # duration of a small step: two frames of the servo


def clock_us() -> int:
    return time.monotonic_ns() // 1000


@contextlib.contextmanager
def ground_driver(
    config: LockConfig, last: LastCommand | None, link: ActuatorLink | None = None, *, lasting: bool = False
) -> Iterator[Driver]:
    """Within the context, own the servo and return the configured driver, as `owned_driver` does.

    If the last command went to the mock, the mock's horn starts at the commanded end.
    """
    if config.driver is LockDriver.MOCK:
        known = last is not None and last.driver is LockDriver.MOCK
        yield MockDriver(
            config, clock_us, pulse_us=config.servo.pulse_us(last.mode) if known and last else None
        )
        return
    with owned_driver(config, clock_us=clock_us, link=link, lasting=lasting) as driver:
        yield driver


class GroundLock:
    """A lock session in real time; every call blocks until the travel is over or has timed out."""

    def __init__(
        self,
        config: LockConfig,
        driver: Driver,
        on_change: Callable[[LockState], None] = lambda state: None,
    ) -> None:
        adopting = msgspec.structs.replace(config, startup=LockStartup.ADOPT)
        self.session = LockSession(adopting, driver, clock_us, on_change)
        self.session.permit(True)

    def read_state(self) -> LockState:
        """Determine the lock's state without moving it."""
        self.session.start()
        return self._settle()

    def move(self, mode: Mode, *, release: bool = False) -> LockState:
        self.session.command(mode)
        state = self._settle()
        if release and state.phase is LockPhase.SETTLED:
            self.session.release()
        return self.session.state

    def _settle(self) -> LockState:
        while self.session.state.phase is LockPhase.TRAVELLING:
            time.sleep(POLL_S)
            self.session.poll()
        return self.session.state


def calibration(config: LockConfig, driver: Driver) -> Calibration:
    """Return a calibration that starts at the servo's current pulse or, without pulses, at mid-range."""
    reading = driver.read()

    def move(pulse_us: float) -> None:
        driver.set_pulse(pulse_us)
        time.sleep(CALIBRATION_STEP_S)

    middle_us = 0.5 * (config.servo.min_pulse_us + config.servo.max_pulse_us)
    return Calibration(config, middle_us if reading.pulse_us is None else reading.pulse_us, move)
