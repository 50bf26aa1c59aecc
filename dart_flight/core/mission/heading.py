"""The return to the desired heading after a contact, as fast as PX4's yaw control permits.

An oblique wall rotates the vehicle. The motors correct the yaw slowly, because only their drag torque acts
about the vertical axis. If the heading command is a large step, PX4 overshoots, because its integrator winds
up while the torque is at its limit. The next contact is then oblique again. The commanded heading is
therefore limited in two ways. First, the command stays so close to the actual heading that PX4 requests no
more than the available torque. Second, the vehicle rotates so slowly that this torque can stop the rotation
in time.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import wrap_angle
from dart_flight.config.vehicle import VehicleConfig

_MOST_TORQUE: Final = 0.15  # normalised torque that PX4 reserves for yaw when motors saturate
# Fractions of the yaw torque: `_SURE` is available in any flight, `_BRAKING` is assumed for braking.
_SURE: Final = 0.85
_BRAKING: Final = 0.5
_STEP_S: Final = 0.02
_MOST_STEPS: Final = 200


class Heading(NamedTuple):
    """The heading of a flight; mission frame, rad.

    Attributes:
        yaw: desired heading, after rate limiting.
        before: desired heading before the first contact.
        asked: heading to command while the vehicle returns to `yaw` after a contact; otherwise None.
        integral: estimate of what PX4's yaw integrator has accumulated since the contact, normalised torque.
    """

    yaw: float = 0.0
    yaw_us: int = 0
    before: float = 0.0
    asked: float | None = None
    integral: float = 0.0
    integral_us: int = 0

    @property
    def commanded(self) -> float:
        return self.yaw if self.asked is None else self.asked

    def turn(self, wanted: float, now_us: int, most_rad_s: float) -> Heading:
        most = most_rad_s * (now_us - self.yaw_us) * 1e-6
        turned = wrap_angle(self.yaw + max(-most, min(most, wrap_angle(wanted - self.yaw))))
        return self._replace(yaw=turned, yaw_us=now_us)


class HeadingControl:
    """PX4's yaw control with a vehicle's parameters."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        motors, px4 = vehicle.airframe.motors, vehicle.px4
        drag_m = sum_in_order(abs(motor.yaw_torque_per_thrust_m) for motor in motors)
        most_nm = _MOST_TORQUE * vehicle.thrust.max_thrust_n * drag_m
        self._most_rad_s2 = most_nm / vehicle.airframe.inertia_kg_m2[2]
        self._per_s, self._p, self._i = px4.mc_yaw_p, px4.mc_yawrate_p, px4.mc_yawrate_i

    def lead(self, heading: Heading, yaw: float, rate: float, now_us: int) -> Heading:
        """Return the heading with a new command, corrected for the state of PX4's integrator.

        `yaw` and `rate` are the current values in the mission frame, rad and rad/s.
        """
        torque = self._torque(wrap_angle(heading.yaw - yaw), rate)
        off_rad_s = (torque - heading.integral) / self._p
        integral = heading.integral + self._i * off_rad_s * (now_us - heading.integral_us) * 1e-6
        asked = wrap_angle(yaw + (rate + off_rad_s) / self._per_s)
        return heading._replace(asked=asked, integral=integral, integral_us=now_us)

    def time_to_s(self, off: float, rate: float, within: float) -> float:
        """Return the time after which the heading error stays below `within`, rad.

        `off` is the heading minus the desired heading, rad; `rate` is in rad/s.
        """
        off, last = wrap_angle(off), 0
        for step in range(_MOST_STEPS):
            if abs(off) > within:
                last = step + 1
            rate += _STEP_S * _SURE * self._most_rad_s2 * self._torque(-off, rate) / _MOST_TORQUE
            off = wrap_angle(off + _STEP_S * rate)
        return last * _STEP_S

    def _torque(self, to: float, rate: float) -> float:
        """Return the normalised torque that rotates the vehicle by `to` (rad) and brakes in time."""
        braking = _BRAKING * self._most_rad_s2
        linear = braking / self._per_s**2
        wanted = self._per_s * to
        if abs(to) > linear:
            wanted = math.copysign(math.sqrt(2.0 * braking * (abs(to) - 0.5 * linear)), to)
        return max(-_MOST_TORQUE, min(_MOST_TORQUE, self._p * (wanted - rate)))
