"""A real driver with a modelled horn that follows the pulses accepted by the hardware."""

from __future__ import annotations

import pytest

from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import Driver, DriverError
from dart_flight.lock.drivers.modelled_horn import DriverWithModelledHorn
from dart_flight.lock.state_machine import DriverReading


class ScriptedDriver:
    """A double of the driver that records its calls and fails on request."""

    def __init__(self) -> None:
        self.calls: list[object] = []
        self.fails = False

    def open(self) -> None:
        self.calls.append("open")

    def set_pulse(self, pulse_us: float) -> None:
        if self.fails:
            raise DriverError("no answer")
        self.calls.append(pulse_us)

    def release(self) -> None:
        self.calls.append("release")

    def read(self) -> DriverReading:
        return DriverReading(pulse_us=1234.0)

    def close(self) -> None:
        self.calls.append("close")


def test_every_call_is_passed_to_the_real_driver(lock_config: LockConfig) -> None:
    real = ScriptedDriver()
    driver: Driver = DriverWithModelledHorn(real, lock_config, lambda: 0)
    driver.open()
    driver.set_pulse(1500.0)
    driver.release()
    driver.close()
    assert real.calls == ["open", 1500.0, "release", "close"]
    assert driver.read().pulse_us == 1234.0


def test_the_horn_follows_only_accepted_pulses(lock_config: LockConfig) -> None:
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


def test_a_released_servo_keeps_its_position(lock_config: LockConfig) -> None:
    now = [0]
    driver = DriverWithModelledHorn(ScriptedDriver(), lock_config, lambda: now[0])
    driver.set_pulse(lock_config.servo.rigid_pulse_us)
    now[0] = 100_000
    stopped_us = driver.horn_pulse_us(now[0])
    driver.release()
    assert driver.horn_pulse_us(4_000_000) == stopped_us != lock_config.servo.rigid_pulse_us
