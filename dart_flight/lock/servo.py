"""The servo: pulse width for a horn angle, travel time, and a model of the horn's motion.

All code here is pure: the time, an integer in microseconds, is an argument. The configuration contains the
data of the HiTec HS-322HD (manufacturer's catalogue): 0.19 s per 60 degrees at 4.8 V, 0.15 s at 6 V, 50 Hz
frame, 900 to 2100 us. The servo has no position feedback: the command and the travel time are known, but not
the horn's position.
"""

from __future__ import annotations

import msgspec

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Servo


def mode_of(servo: Servo, horn_pulse_us: float) -> Mode | None:
    """Return the mode of a horn position, or None if neither end of the travel is within `tolerance_us`."""
    for mode in Mode:
        if abs(horn_pulse_us - servo.pulse_us(mode)) <= servo.tolerance_us:
            return mode
    return None


class ServoFaults(msgspec.Struct, frozen=True):
    """Faults of a simulated servo.

    Attributes:
        slow: factor on the duration of every travel.
        stall_fraction: point of the travel that the horn cannot cross in either direction; 0 is the flexible
            end, 1 the rigid end.
    """

    stuck: bool = False
    slow: float = 1.0
    stall_fraction: float | None = None

    def __post_init__(self) -> None:
        if not self.slow > 0.0:
            raise ValueError(f"slow is {self.slow:g}, but must be above 0")


NO_FAULTS = ServoFaults()


class ServoModel:
    """Model of the horn's true motion: the horn moves at constant speed to the commanded pulse width.

    Without pulses the horn keeps its position by gear friction. If `t_us` is before the previous `t_us`, the
    previous time counts, so time never runs backwards.
    """

    def __init__(self, servo: Servo, pulse_us: float, faults: ServoFaults = NO_FAULTS) -> None:
        self.servo = servo
        self._us_per_s = servo.us_per_deg / servo.s_per_deg
        self._horn_us = self._within_stops(pulse_us)
        self._target_us: float | None = None
        self._t_us: int | None = None
        self._faults = faults
        self._range_us = self._reachable()

    @property
    def commanded_us(self) -> float | None:
        """Pulse width at the servo's input; None without pulses."""
        return self._target_us

    def set_faults(self, t_us: int, faults: ServoFaults) -> None:
        self._advance(t_us)
        self._faults = faults
        self._range_us = self._reachable()

    def command(self, t_us: int, pulse_us: float | None) -> None:
        """Set the pulse width (us) at the servo's input; None switches the pulses off."""
        self._advance(t_us)
        self._target_us = None if pulse_us is None else self._within_stops(pulse_us)

    def pulse_at(self, t_us: int) -> float:
        """Return the horn's position, as the pulse width in us that would hold the horn there."""
        self._advance(t_us)
        return self._horn_us

    def _within_stops(self, pulse: float) -> float:
        return max(self.servo.min_pulse_us, min(self.servo.max_pulse_us, pulse))

    def _advance(self, t_us: int) -> None:
        before_us = self._t_us
        if before_us is not None and t_us <= before_us:
            return
        self._t_us = t_us
        if before_us is None or self._target_us is None or self._target_us == self._horn_us:
            return  # the horn is usually at rest
        if self._faults.stuck:
            return
        elapsed_s = (t_us - before_us) * 1e-6
        step = self._us_per_s / self._faults.slow * elapsed_s
        goal = max(self._range_us[0], min(self._range_us[1], self._target_us))
        self._horn_us += max(-step, min(step, goal - self._horn_us))

    def _reachable(self) -> tuple[float, float]:
        """Return the lowest and highest pulse width that the horn reaches without crossing a stall point."""
        low, high = self.servo.min_pulse_us, self.servo.max_pulse_us
        if self._faults.stall_fraction is None:
            return low, high
        flexible, rigid = self.servo.flexible_pulse_us, self.servo.rigid_pulse_us
        stall = flexible + self._faults.stall_fraction * (rigid - flexible)
        return (low, stall) if self._horn_us <= stall else (stall, high)
