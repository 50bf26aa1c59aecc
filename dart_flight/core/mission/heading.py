"""Bringing the heading back after a contact as quickly as PX4's yaw control can, and how long that takes.

A wall that stands askew turns the vehicle, and motors turn it back only by their drag: slowly. PX4's own way
to a far heading overshoots, as its integral fills while the torque is at its limit, and the next wall is met
askew again. So the heading asked for is never further off than the torque can follow, and the rate that it
asks for is one from which the same torque still stops in time.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import wrap_angle
from dart_flight.config.vehicle import VehicleConfig

_MOST_TORQUE: Final = 0.15  # normalised: what PX4 keeps for yaw where motors are at their limits
# Of the torque: what a flight is sure to have, and what it brakes with; the rest is for errors and delay.
_SURE: Final = 0.85
_BRAKING: Final = 0.5
_STEP_S: Final = 0.02
_MOST_STEPS: Final = 200


class HeadingControl:
    """PX4's yaw control with a vehicle's parameters.

    Args:
        vehicle: motors, inertia, parameters.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        motors, px4 = vehicle.airframe.motors, vehicle.px4
        drag_m = sum(abs(motor.yaw_torque_per_thrust_m) for motor in motors)
        most_nm = _MOST_TORQUE * vehicle.thrust.max_thrust_n * drag_m
        self._most_rad_s2 = most_nm / vehicle.airframe.inertia_kg_m2[2]
        self._per_s, self._p, self._i = px4.mc_yaw_p, px4.mc_yawrate_p, px4.mc_yawrate_i
        self._integral, self._last_us = 0.0, 0

    def begin(self, now_us: int) -> None:
        """From here on the heading is asked for."""
        self._integral, self._last_us = 0.0, now_us

    def setpoint(self, wanted: float, yaw: float, rate: float, now_us: int) -> float:
        """The heading to ask for now; rad and rad/s, mission frame.

        Args:
            wanted: heading.
            yaw, rate: at present.
            now_us: since `begin` what PX4's integral has gathered is known, and taken off.
        """
        torque = self._torque(wrap_angle(wanted - yaw), rate)
        off_rad_s = (torque - self._integral) / self._p
        self._integral += self._i * off_rad_s * (now_us - self._last_us) * 1e-6
        self._last_us = now_us
        return wrap_angle(yaw + (rate + off_rad_s) / self._per_s)

    def time_to_s(self, off: float, rate: float, within: float) -> float:
        """Time from which on the heading will be within an angle of the wanted one.

        Args:
            off: heading less the wanted one, rad.
            rate: of the heading, rad/s.
            within: rad.
        """
        off, last = wrap_angle(off), 0
        for step in range(_MOST_STEPS):
            if abs(off) > within:
                last = step + 1
            rate += _STEP_S * _SURE * self._most_rad_s2 * self._torque(-off, rate) / _MOST_TORQUE
            off = wrap_angle(off + _STEP_S * rate)
        return last * _STEP_S

    def _torque(self, to: float, rate: float) -> float:
        """Normalised torque towards a heading so far away, from which a part of the torque stops in time."""
        braking = _BRAKING * self._most_rad_s2
        linear = braking / self._per_s**2
        wanted = self._per_s * to
        if abs(to) > linear:
            wanted = math.copysign(math.sqrt(2.0 * braking * (abs(to) - 0.5 * linear)), to)
        return max(-_MOST_TORQUE, min(_MOST_TORQUE, self._p * (wanted - rate)))
