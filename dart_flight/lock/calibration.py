"""Manual calibration of the two end stops, in small steps. The caller's function moves the servo.

The cam's angles at the two ends are known: theta_0 (flexible) and theta_0 + 90 degrees (rigid). The operator
therefore calibrates only the pulse width of each end. The direction follows from the two pulse widths.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from dart_flight.base.records import Mode
from dart_flight.config.document import Key
from dart_flight.config.vehicle import LockConfig

# A servo with a range of 360 degrees needs 5.5 us per degree; a common servo needs 10.
_LEAST_US_PER_DEG = 5.0
STEP_US = 10.0  # about one degree, so that a jammed rod takes no damage
HELP = (
    "+ or - moves the pulse by 10 us, +25 or -40 moves it by that amount, and 1500 sets it to 1500 us; "
    "ok stores this position, and quit changes nothing"
)


class CalibrationError(Exception):
    """The operator's line is invalid or not allowed; nothing has moved."""


class Calibration:
    """Moves the horn in small steps and stores the pulse widths of the two ends.

    Args:
        config: servo range, and limits for the result.
        start_us: current pulse width.
        move: outputs a pulse width in us and waits for a small step to finish; may raise any exception.
    """

    ORDER = (Mode.FLEXIBLE, Mode.RIGID)

    def __init__(self, config: LockConfig, start_us: float, move: Callable[[float], None]) -> None:
        self._config = config
        self._move = move
        self.pulse_us = start_us
        self.found: dict[Mode, float] = {}

    @property
    def current_end(self) -> Mode | None:
        """End that is being calibrated, or None if both are calibrated."""
        return next((mode for mode in self.ORDER if mode not in self.found), None)

    def execute(self, line: str) -> None:
        """Execute one line from the operator: any command in `HELP` except quit.

        Raises:
            CalibrationError: the line is invalid, or the two ends are not a valid calibration.
        """
        word = line.strip().lower()
        if word == "ok":
            self._store_end()
            return
        self._walk(self._target(word))

    def result(self) -> LockConfig:
        rigid, flexible = self.found[Mode.RIGID], self.found[Mode.FLEXIBLE]
        servo = self._config.servo
        rises = (rigid > flexible) == (servo.rigid_deg > servo.flexible_deg)
        try:
            new = msgspec.structs.replace(
                servo,
                rigid_pulse_us=rigid,
                flexible_pulse_us=flexible,
                direction=1 if rises else -1,
            )
            config = msgspec.structs.replace(self._config, servo=new)
        except ValueError as error:
            raise CalibrationError(str(error)) from None
        if new.us_per_deg < _LEAST_US_PER_DEG:
            turn_deg = abs(new.rigid_deg - new.flexible_deg)
            raise CalibrationError(
                f"the ends are {abs(rigid - flexible):g} us apart, but a turn of the cam by {turn_deg:g} "
                f"degrees needs {_LEAST_US_PER_DEG * turn_deg:g} us or more: store the ends further apart"
            )
        return config

    def values(self) -> dict[Key, float]:
        """Return the keys and values for the configuration file; both ends must be calibrated."""
        servo = self.result().servo
        return {
            ("lock", "servo", "rigid_pulse_us"): servo.rigid_pulse_us,
            ("lock", "servo", "flexible_pulse_us"): servo.flexible_pulse_us,
            ("lock", "servo", "direction"): servo.direction,
        }

    def _target(self, word: str) -> float:
        if word in ("+", "-"):
            word += f"{STEP_US:g}"
        try:
            number = float(word)
        except ValueError:
            raise CalibrationError(f"{word or 'an empty line'} is not a command: {HELP}") from None
        target = self.pulse_us + number if word[0] in "+-" else number
        low, high = self._config.servo.min_pulse_us, self._config.servo.max_pulse_us
        if not low <= target <= high:
            raise CalibrationError(f"{target:g} us is outside the servo's range {low:g} to {high:g}")
        return target

    def _walk(self, target: float) -> None:
        while self.pulse_us != target:
            remaining = target - self.pulse_us
            small = abs(remaining) <= STEP_US
            following = target if small else self.pulse_us + math.copysign(STEP_US, remaining)
            self._move(following)
            self.pulse_us = following

    def _store_end(self) -> None:
        mode = self.current_end
        if mode is None:
            raise CalibrationError("the pulses of both ends are already stored")
        self.found[mode] = self.pulse_us
        if self.current_end is None:
            try:
                self.result()
            except CalibrationError:
                del self.found[mode]
                raise
