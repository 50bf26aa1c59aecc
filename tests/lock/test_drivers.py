"""One suite for all lock drivers: each with its emulated hardware, alone and inside of the two wrappers."""

from __future__ import annotations

import pytest

from dart_flight.base.records import LockPhase, Mode
from dart_flight.config.vehicle import LockConfig, LockDriver, LockStartup
from dart_flight.lock.drivers import DRIVERS, Driver, DriverError, driver_names, make_driver
from dart_flight.lock.drivers.limit_switch import DriverWithLimitSwitch
from dart_flight.lock.drivers.modelled_horn import DriverWithModelledHorn
from dart_flight.lock.lock_session import LockSession
from dart_flight.lock.state_machine import describe
from tests.lock.rigs import RIGS, MakeRig, Rig

KINDS = list(RIGS)
READS_BACK = [kind for kind in KINDS if kind is not LockDriver.PX4]


class OpenSwitches:
    """A reader of limit switches that are open."""

    def read(self) -> tuple[bool, bool]:
        return False, False

    def close(self) -> None:
        """Do nothing."""


def wrapped(rig: Rig, wrapper: str) -> Driver:
    """Return the rig's driver, alone or inside of a wrapper."""
    if wrapper == "switches":
        return DriverWithLimitSwitch(rig.driver, OpenSwitches())
    if wrapper == "modelled horn":
        return DriverWithModelledHorn(rig.driver, rig.config, rig.clock_us)
    return rig.driver


def test_every_kind_of_driver_has_a_rig() -> None:
    assert set(RIGS) == set(LockDriver)


@pytest.mark.parametrize("wrapper", ["", "switches", "modelled horn"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_hardware_puts_out_each_commanded_pulse_until_the_driver_releases_it(
    make_rig: MakeRig, kind: LockDriver, wrapper: str
) -> None:
    rig = make_rig(kind)
    driver = wrapped(rig, wrapper)
    assert isinstance(driver, Driver)
    for _ in range(2):  # opening moves nothing
        driver.open()
        assert (rig.output_us(), driver.read().pulse_us) == (None, None)
    for pulse_us in (1980.0, 1020.25, 1500.0):
        driver.set_pulse(pulse_us)
        assert rig.output_us() == pytest.approx(pulse_us, abs=1e-6)
        assert driver.read().pulse_us == pulse_us
    assert driver.read().rigid_switch is (False if wrapper == "switches" else None)
    driver.close()
    assert rig.output_us() == pytest.approx(1500.0)  # closing keeps the pulses
    driver.open()
    if rig.READS_BACK:
        driver.release()
        driver.release()
        assert (rig.output_us(), driver.read().pulse_us) == (None, None)
    else:
        with pytest.raises(DriverError, match="cannot switch off the pulses"):
            driver.release()


@pytest.mark.parametrize("kind", KINDS)
def test_each_toggle_moves_the_servo_and_settles_after_its_travel_time(
    make_rig: MakeRig, kind: LockDriver
) -> None:
    rig = make_rig(kind)
    assert rig.begin().mode is Mode.FLEXIBLE
    for mode in (Mode.RIGID, Mode.FLEXIBLE, Mode.RIGID):
        started_us = rig.t_us
        state = rig.travel(mode)
        assert (state.phase, state.mode, state.feedback) == (LockPhase.SETTLED, mode, False)
        assert rig.horn() is mode
        assert (state.commanded_us, describe(state)) == (started_us, f"{mode}: settled (no feedback)")
        assert state.settled_us is not None
        # The catalogue's 0.285 s and a margin of 0.03 s, at the next poll.
        assert 315_000 <= state.settled_us - started_us <= 335_000


@pytest.mark.parametrize("kind", READS_BACK)
def test_a_pulse_that_the_hardware_loses_is_a_fault(make_rig: MakeRig, kind: LockDriver) -> None:
    rig = make_rig(kind)
    rig.begin()
    rig.travel(Mode.RIGID, 0.1)
    rig.lose_pulse()
    rig.run(0.1)
    assert rig.fault == "the controller lost the pulse"


@pytest.mark.parametrize("kind", KINDS)
def test_hardware_that_goes_away_is_a_fault_until_it_is_back(make_rig: MakeRig, kind: LockDriver) -> None:
    rig = make_rig(kind)
    rig.begin()
    rig.disconnect()
    with pytest.raises(DriverError) as caught:
        rig.driver.set_pulse(1500.0)
    assert "\n" not in str(caught.value)
    rig.travel(Mode.RIGID, 0.1)
    assert rig.fault
    assert rig.horn() is Mode.FLEXIBLE
    rig.reconnect()
    state = rig.travel(Mode.RIGID)
    assert (state.phase, state.mode, rig.horn()) == (LockPhase.SETTLED, Mode.RIGID, Mode.RIGID)


@pytest.mark.parametrize("kind", [LockDriver.MAESTRO, LockDriver.PWM])
def test_missing_hardware_is_named_with_its_key_by_every_call(make_rig: MakeRig, kind: LockDriver) -> None:
    rig = make_rig(kind)
    message, key = rig.MISSING
    rig.disconnect()
    fresh = rig.make_driver()
    for call in (fresh.open, fresh.read, fresh.release, lambda: fresh.set_pulse(1500.0)):
        with pytest.raises(DriverError, match=message) as caught:
            call()
        assert caught.value.key == key


@pytest.mark.parametrize("kind", [LockDriver.MAESTRO, LockDriver.PWM])
def test_another_process_adopts_the_present_pulse(make_rig: MakeRig, kind: LockDriver) -> None:
    rig = make_rig(kind, startup=LockStartup.ADOPT)
    rig.session.start()
    assert rig.session.state.reason == "the servo's position is unknown: its pulses are off"
    rig.begin()
    rig.travel(Mode.RIGID)
    rig.driver.close()
    restarted = LockSession(rig.config, rig.make_driver(), rig.clock_us)
    restarted.start()
    assert (restarted.state.phase, restarted.state.mode) == (LockPhase.TRAVELLING, Mode.RIGID)
    restarted.driver.close()


# --- the table --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kind for kind, entry in DRIVERS.items() if entry.needs])
def test_a_missing_argument_of_a_driver_is_reported(kind: LockDriver, lock_config: LockConfig) -> None:
    with pytest.raises(ValueError, match=f"the {kind.value} driver needs {DRIVERS[kind].needs[0]}"):
        make_driver(lock_config, kind)


@pytest.mark.parametrize("phrase", ["mock", "px4 or mock", "maestro, pwm or mock"])
def test_driver_names_are_joined_into_a_phrase(phrase: str) -> None:
    chosen = [DRIVERS[kind] for kind in LockDriver if kind.value in phrase]
    assert driver_names(chosen.__contains__) == phrase


# --- the modelled horn ------------------------------------------------------------------------------------


def test_the_modelled_horn_follows_only_pulses_that_the_hardware_accepts(make_rig: MakeRig) -> None:
    rig = make_rig(LockDriver.PX4)
    servo = rig.config.servo
    driver = DriverWithModelledHorn(rig.driver, rig.config, rig.clock_us)
    assert driver.horn_pulse_us(rig.t_us) == servo.flexible_pulse_us
    rig.disconnect()
    with pytest.raises(DriverError):
        driver.set_pulse(servo.rigid_pulse_us)
    rig.t_us += 50_000
    assert driver.horn_pulse_us(rig.t_us) == servo.flexible_pulse_us
    rig.reconnect()
    driver.set_pulse(servo.rigid_pulse_us)
    for later_us in (100_000, 3_000_000):
        rig.t_us += later_us
        assert driver.horn_pulse_us(rig.t_us) == rig.horn_us()  # the double of the real servo
    assert rig.horn() is Mode.RIGID


def test_a_released_servo_keeps_its_position(make_rig: MakeRig) -> None:
    rig = make_rig(LockDriver.MOCK)
    driver = DriverWithModelledHorn(rig.driver, rig.config, rig.clock_us)
    driver.set_pulse(rig.config.servo.rigid_pulse_us)
    rig.t_us += 100_000
    stopped_us = driver.horn_pulse_us(rig.t_us)
    driver.release()
    assert driver.horn_pulse_us(rig.t_us + 4_000_000) == stopped_us != rig.config.servo.rigid_pulse_us
