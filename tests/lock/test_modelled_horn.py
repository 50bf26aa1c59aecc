"""A real driver with a modelled horn beside it: the horn follows what the hardware took."""

from __future__ import annotations

import pytest

from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import Driver, DriverError
from dart_flight.lock.drivers.modelled_horn import DriverWithModelledHorn
from dart_flight.lock.state_machine import DriverReading


class ScriptedDriver:
    """Keeps what it is told; fails where it is to."""

    def __init__(self) -> None:
        self.told: list[object] = []
        self.fails = False

    def open(self) -> None:
        self.told.append("open")

    def set_pulse(self, pulse_us: float) -> None:
        if self.fails:
            raise DriverError("no answer")
        self.told.append(pulse_us)

    def release(self) -> None:
        self.told.append("release")

    def read(self) -> DriverReading:
        return DriverReading(pulse_us=1234.0)

    def close(self) -> None:
        self.told.append("close")


def test_everything_is_passed_on(lock_config: LockConfig) -> None:
    real = ScriptedDriver()
    driver: Driver = DriverWithModelledHorn(real, lock_config, lambda: 0)
    driver.open()
    driver.set_pulse(1500.0)
    driver.release()
    driver.close()
    assert real.told == ["open", 1500.0, "release", "close"]
    assert driver.read().pulse_us == 1234.0


def test_the_horn_follows_the_pulses_that_were_taken(lock_config: LockConfig) -> None:
    real, servo, now = ScriptedDriver(), lock_config.servo, [0]
    driver = DriverWithModelledHorn(real, lock_config, lambda: now[0])
    assert driver.horn_pulse_us(900_000) == servo.flexible_pulse_us
    now[0] = 1_000_000
    real.fails = True
    with pytest.raises(DriverError):
        driver.set_pulse(servo.rigid_pulse_us)
    assert driver.horn_pulse_us(1_050_000) == servo.flexible_pulse_us
    real.fails = False
    driver.set_pulse(servo.rigid_pulse_us)
    between = driver.horn_pulse_us(1_100_000)
    assert min(servo.rigid_pulse_us, servo.flexible_pulse_us) < between
    assert between < max(servo.rigid_pulse_us, servo.flexible_pulse_us)
    assert driver.horn_pulse_us(3_000_000) == servo.rigid_pulse_us


def test_a_released_servo_stays_where_it_is(lock_config: LockConfig) -> None:
    now = [0]
    driver = DriverWithModelledHorn(ScriptedDriver(), lock_config, lambda: now[0])
    driver.set_pulse(lock_config.servo.rigid_pulse_us)
    now[0] = 100_000
    under_way = driver.horn_pulse_us(now[0])
    driver.release()
    assert driver.horn_pulse_us(4_000_000) == under_way != lock_config.servo.rigid_pulse_us
