"""The driver for PX4's own output: actuator values, parameters, and commands that fail to be sent."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.config.vehicle import LockConfig, LockDriver
from dart_flight.lock.drivers import ActuatorLink, DriverError
from dart_flight.lock.drivers.px4_output import (
    Px4Driver,
    actuator_pulse_us,
    actuator_value,
    parameter_problems,
    required_parameters,
)
from tests.lock.rigs import MakeRig, Vary


def test_a_pulse_is_sent_as_an_actuator_value(make_rig: MakeRig) -> None:
    rig = make_rig(LockDriver.PX4, px4={"actuator_index": 3})
    for pulse_us in (1980.0, 1020.0):
        rig.driver.set_pulse(pulse_us)
    assert [index for index, _ in rig.sent] == [3, 3]
    assert [value for _, value in rig.sent] == pytest.approx([0.8, -0.8])


@given(pulse=st.floats(900.0, 2100.0))
def test_the_actuator_value_is_invertible(lock_config: LockConfig, pulse: float) -> None:
    value = actuator_value(lock_config, pulse)
    assert -1.0 <= value <= 1.0
    assert actuator_pulse_us(lock_config, value) == pytest.approx(pulse, abs=1e-9)


@pytest.mark.parametrize(
    ("error", "message"),
    [(TimeoutError("no answer"), "no answer"), (TypeError("no session"), "TypeError: no session")],
)
def test_a_command_that_is_not_sent_or_impossible_is_a_driver_error(
    lock_config: LockConfig, error: Exception, message: str
) -> None:
    def fail(index: int, value: float) -> None:
        raise error

    driver = Px4Driver(lock_config, ActuatorLink(fail, None))
    with pytest.raises(DriverError, match=f"PX4 actuator 1: .*{message}"):
        driver.set_pulse(1500.0)
    assert driver.read().pulse_us is None
    with pytest.raises(DriverError, match="outside PX4's output range"):
        driver.set_pulse(2500.0)


CORRECT = {
    "PWM_AUX_FUNC1": 301.0,
    "COM_PREARM_MODE": 2.0,
    "PWM_AUX_MIN1": 900.0,
    "PWM_AUX_MAX1": 2100.0,
    "PWM_AUX_DIS1": 1020.0,
    "PWM_AUX_TIM0": 50.0,
    "PWM_AUX_REV": 0.0,
}


def test_the_required_parameters_follow_the_configured_output(vary: Vary) -> None:
    assert {p.name: float(p.value) for p in required_parameters(vary())} == CORRECT
    other = vary(px4={"bank": "MAIN", "pin": 5, "timer": 1, "actuator_index": 6})
    assert required_parameters(other)[0].name == "PWM_MAIN_FUNC5"
    assert required_parameters(other)[0].value == 306


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("PWM_AUX_FUNC1", 0.0, "PWM_AUX_FUNC1 is 0, must be 301"),
        ("COM_PREARM_MODE", 1.0, "COM_PREARM_MODE is 1, must be 2"),
        ("PWM_AUX_REV", 5.0, "PWM_AUX_REV is 5, must have bit 0x1 clear"),
        ("PWM_AUX_TIM0", 400.0, "PWM_AUX_TIM0 is 400, must be 50"),
    ],
)
def test_a_wrong_or_missing_parameter_is_reported(vary: Vary, name: str, value: float, expected: str) -> None:
    assert parameter_problems(vary(), CORRECT) == []
    problems = parameter_problems(vary(), {**CORRECT, name: value})
    assert len(problems) == 1
    assert problems[0].startswith(expected)
    missing = {k: v for k, v in CORRECT.items() if k != name}
    assert parameter_problems(vary(), missing)[0].startswith(f"{name} is not on this vehicle")


def test_the_output_of_another_pin_may_be_reversed(vary: Vary) -> None:
    assert parameter_problems(vary(), {**CORRECT, "PWM_AUX_REV": 6.0}) == []
