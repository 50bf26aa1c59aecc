"""PX4's own servo output: MAV_CMD_DO_SET_ACTUATOR through a function of the shell.

PX4 acknowledges the command whether or not a servo is connected. Before arming, PX4 moves the output only if
COM_PREARM_MODE permits this. `required_parameters` lists the parameters and values that the servo needs.
`parameter_problems` compares this list with the values on the vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.config.link_url import endpoint_of
from dart_flight.config.parameter_file import show_value
from dart_flight.config.vehicle import LockConfig
from dart_flight.lock.drivers import ActuatorLink, DriverError
from dart_flight.lock.persistence import ServoDevice
from dart_flight.lock.state_machine import DriverReading

ACTUATOR_SET_1 = 301  # PX4's output function "Peripheral via Actuator Set 1"
PREARM_ALWAYS = 2
SERVO_RATE_HZ = 50


class RequiredParameter(msgspec.Struct, frozen=True):
    """One PX4 parameter with the value that the servo needs.

    Attributes:
        name: PX4's name.
        value: required value; if `mask` is set, the required value of the masked bits.
        why: consequence if the parameter has another value.
        mask: bits that matter, or None for all.
    """

    name: str
    value: int
    why: str
    mask: int | None = None

    def is_satisfied_by(self, actual: float) -> bool:
        return (round(actual) if self.mask is None else round(actual) & self.mask) == self.value


def required_parameters(config: LockConfig) -> tuple[RequiredParameter, ...]:
    """Return the PX4 parameters (v1.14 and later) that the servo needs to move as calibrated."""
    px4 = config.px4
    bank, pin = f"PWM_{px4.bank}", px4.pin
    function = ACTUATOR_SET_1 + px4.actuator_index - 1
    flexible = round(config.servo.flexible_pulse_us)
    return (
        RequiredParameter(
            f"{bank}_FUNC{pin}",
            function,
            f"with another value, actuator {px4.actuator_index} has no output pin",
        ),
        RequiredParameter(
            "COM_PREARM_MODE", PREARM_ALWAYS, "with another value, the servo moves only when PX4 is armed"
        ),
        RequiredParameter(
            f"{bank}_MIN{pin}", round(px4.min_pulse_us), "PX4 outputs this pulse for the actuator value -1"
        ),
        RequiredParameter(
            f"{bank}_MAX{pin}", round(px4.max_pulse_us), "PX4 outputs this pulse for the actuator value 1"
        ),
        RequiredParameter(
            f"{bank}_DIS{pin}", flexible, "with another value, the servo leaves the flexible end at boot"
        ),
        RequiredParameter(
            f"{bank}_TIM{px4.timer}", SERVO_RATE_HZ, "an analogue servo needs a frame rate of 50 Hz"
        ),
        RequiredParameter(
            f"{bank}_REV", 0, "with another value, the output is reversed", mask=1 << (pin - 1)
        ),
    )


def parameter_problems(config: LockConfig, actual: Mapping[str, float]) -> list[str]:
    """Return one line for each PX4 parameter that is missing or has a value that the servo cannot use."""
    problems = []
    for required in required_parameters(config):
        if required.name not in actual:
            shown = "not on this vehicle"
        elif not required.is_satisfied_by(actual[required.name]):
            shown = show_value(actual[required.name])
        else:
            continue
        wanted = f"be {required.value}" if required.mask is None else f"have bit {required.mask:#x} clear"
        problems.append(f"{required.name} is {shown}, must {wanted}: {required.why}")
    return problems


def actuator_value(config: LockConfig, pulse_us: float) -> float:
    """Return the actuator value, -1 to 1, for which PX4 outputs pulses of `pulse_us`.

    Raises:
        ValueError: the pulse is outside PX4's output range.
    """
    low, high = config.px4.min_pulse_us, config.px4.max_pulse_us
    if not low <= pulse_us <= high:
        raise ValueError(f"{pulse_us:g} us is outside PX4's output range {low:g} to {high:g}")
    return 2.0 * (pulse_us - low) / (high - low) - 1.0


def actuator_pulse_us(config: LockConfig, value: float) -> float:
    """Return PX4's output pulse width in us at an actuator value; the inverse of `actuator_value`."""
    low, high = config.px4.min_pulse_us, config.px4.max_pulse_us
    return low + 0.5 * (max(-1.0, min(1.0, value)) + 1.0) * (high - low)


class Px4Driver:
    """The lock's servo on an output of PX4. PX4 reports no position, so a reading is the last command."""

    def __init__(self, config: LockConfig, link: ActuatorLink) -> None:
        self._config, self._link = config, link
        self._sent_us: float | None = None

    def device(self) -> ServoDevice | None:
        """Return the link to the autopilot; None for an autopilot that this process simulates."""
        url = self._link.url
        key = None if url is None else f"px4-{endpoint_of(url).key}"
        return None if key is None else ServoDevice(key, f"an output of PX4 on {url}")

    def open(self) -> None:
        """Do nothing; the shell has the connection."""

    def set_pulse(self, pulse_us: float) -> None:
        try:
            value = actuator_value(self._config, pulse_us)
            self._link.set_actuator(self._config.px4.actuator_index, value)
        except Exception as error:
            # The shell's function may raise any exception; the lock has then not moved.
            expected = isinstance(error, FlightError | OSError | ValueError)
            what = str(error) if expected else f"the command was not sent: {type(error).__name__}: {error}"
            raise DriverError(f"PX4 actuator {self._config.px4.actuator_index}: {what}") from error
        self._sent_us = pulse_us

    def release(self) -> None:
        """Raise `DriverError`, because PX4 has no command that switches an output's pulses off."""
        raise DriverError("PX4 cannot switch off the pulses of an output")

    def read(self) -> DriverReading:
        return DriverReading(pulse_us=self._sent_us)

    def close(self) -> None:
        """Leave the output as it is."""
