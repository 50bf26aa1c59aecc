"""Motor outputs as PX4 reports them: the output type, its scale, and throttle 0 to 1.

ACTUATOR_OUTPUT_STATUS and the topic `actuator_outputs` of PX4's logs carry the raw values of the output
driver, but do not name the driver. The live link and the log reader use this module to determine the scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dart_flight.base.records import MOTOR_FULL_US, MOTOR_STOP_US

SHORTEST_PULSE_US, LONGEST_PULSE_US = 800.0, 2200.0  # pulse widths of an armed PWM output lie between these
_STOPPED = 1.0  # UAVCAN_EC_MIN: output to a motor that is armed but stands still


class OutputScale(msgspec.Struct, frozen=True):
    """Raw values of an output type at throttle 0 (`stop`) and 1 (`full`)."""

    name: str
    stop: float
    full: float
    unit: str = ""

    def describe(self) -> str:
        return f"{self.name} {self.stop:g} to {self.full:g}{self.unit}".lstrip()

    def throttle(self, raw: float) -> float:
        if raw <= self.stop:
            return 0.0
        return 1.0 if raw >= self.full else (raw - self.stop) / (self.full - self.stop)


PWM = OutputScale("PWM", MOTOR_STOP_US, MOTOR_FULL_US, " us")
DSHOT = OutputScale("DShot", 0.0, 1999.0)
UAVCAN = OutputScale("UAVCAN", 0.0, 8191.0)
SHARE = OutputScale("", 0.0, 1.0)  # a simulation logs throttles from 0 to 1


def identify_scale(lowest: float, highest: float) -> OutputScale | None:
    """Infer the scale from the smallest value above 0 and the largest value of all motors.

    Return None if no value is above 0, or if a value exceeds every scale.
    """
    if highest <= 0.0 or highest > UAVCAN.full:
        return None
    if highest <= SHARE.full:
        return SHARE
    if highest > LONGEST_PULSE_US:
        return UAVCAN
    return DSHOT if lowest < SHORTEST_PULSE_US else PWM


class MotorOutputDecoder:
    """Converter of the first `motors` raw outputs to throttles.

    The scale follows from the smallest and the largest value since the start. The scale is None until an
    output has exceeded 0. Before take-off, the outputs of an armed vehicle pass through small values, which
    distinguish DShot from PWM. UAVCAN is recognised once a motor passes a quarter of full throttle. Before
    that, UAVCAN values are read as DShot.
    """

    def __init__(self, motors: int) -> None:
        self._motors = motors
        self._lowest, self._highest = UAVCAN.full, 0.0
        self._has_turned = False
        self.scale: OutputScale | None = None

    def decode(self, outputs: Sequence[float | None], airborne: bool) -> tuple[float, ...] | str:
        """Return the throttle of each motor, or why these outputs cannot belong to the motors.

        In `outputs`, None stands for an output without a value.
        """
        raw = [value for value in outputs[: self._motors] if value is not None]
        if len(raw) < self._motors:
            return f"only {len(raw)} outputs have a value, but the vehicle has {self._motors} motors"
        low, high = min(raw), max(raw)
        if high > UAVCAN.full:
            return f"the output value {high:g} exceeds every known type (PWM, DShot, UAVCAN)"
        if high > self._highest or _STOPPED < low < self._lowest:
            self._learn(raw)
        scale = self.scale
        if scale is not None and high > scale.stop:
            self._has_turned = self._has_turned or high > max(scale.stop, _STOPPED)
            return tuple([scale.throttle(value) for value in raw])
        if airborne and not self._has_turned:
            return "all outputs are idle in flight, so the motors are on another output bank"
        return (0.0,) * self._motors

    def _learn(self, raw: Sequence[float]) -> None:
        turning = [value for value in raw if value > _STOPPED]
        if turning:
            self._lowest = min(self._lowest, *turning)
            self._highest = max(self._highest, *turning)
            self.scale = identify_scale(self._lowest, self._highest)
