"""Not to fight a contact: what PX4's velocity loop would make of it, taken out.

While a wall stops the vehicle PX4 goes on with its last setpoint. It sees the speed that is gone and leans
into the wall, and its D term, which opposes acceleration, leans further the harder the wall pushes back: at
1 m/s and `MPC_XY_VEL_D_ACC` 0.2 by more than half of the tilt that follows a hit (docs/results/body.md). So
from the onset to the peak the setpoint is what the vehicle does anyway, and what the D term makes of the
contact is fed forward with the opposite sign, also with the recovery setpoint, until PX4's filter has
forgotten the contact.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.senses import Sensed

_FADED_M_S2: Final = 0.02
_LARGEST_M_S2: Final = 5.0  # fed forward; also bounds what a hanging setpoint could do
# From the onset on; PX4 keeps the last setpoint of a program that hangs, and this one leads away.
LONGEST_S: Final = 0.25


# Of the lean that would balance a vehicle that does not turn (docs/results/faster_hits.md).
_BALANCED: Final = 0.9
_MOST_LEAN: Final = 0.3  # tangent of the angle
_AGAINST_PLAN: Final = 1.3  # times as much into a wall, where the plan leans off it


def balancing_m_s2(height_m: float | None, out_m: float, planned: Mode | None = None) -> float:
    """Push off a wall at a hit, beside the planned one, m/s2, so that the hit turns the vehicle less.

    Leaning into it by the guards' height over their distance has them level with the centre of mass.

    Args:
        height_m: of the wall's force above the centre of mass; None: not known.
        out_m: distance of the guards.
        planned: mode of a hit at the end of the plan's own trajectory, which for rigid arms leans off it;
            None: of one that has been planned anew, which leans less.
    """
    if height_m is None:
        return 0.0
    if planned is Mode.RIGID and height_m > 0.0:
        height_m *= _AGAINST_PLAN
    return -max(-_MOST_LEAN, min(_MOST_LEAN, _BALANCED * height_m / out_m)) * GRAVITY_M_S2


class ContactFeedforward:
    """The contact's acceleration as PX4's D term has it."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._per_newton = 1.0 / vehicle.airframe.mass_kg
        self._gain, self._cutoff_hz = vehicle.px4.mpc_xy_vel_d_acc, vehicle.px4.mpc_veld_lp
        self._filtered = (0.0, 0.0)
        self._last_us: int | None = None

    def update(self, sensed: Sensed) -> None:
        """Take what one input has taught."""
        estimate = sensed.estimate
        if estimate is None:
            return
        last, self._last_us = self._last_us, estimate.t_us
        x, y = self._filtered
        if last is None or not (sensed.in_contact or x or y):
            return
        share = 1.0 - math.exp(-2.0 * math.pi * self._cutoff_hz * (estimate.t_us - last) * 1e-6)
        fx, fy, _ = estimate.force_mission if sensed.in_contact else (0.0, 0.0, 0.0)
        x += share * (fx * self._per_newton - x)
        y += share * (fy * self._per_newton - y)
        faded = not sensed.in_contact and math.hypot(x, y) < _FADED_M_S2
        self._filtered = (0.0, 0.0) if faded else (x, y)

    @property
    def feed_forward(self) -> Vec3 | None:
        """Acceleration against the D term, mission frame, m/s2; None where no contact was."""
        x, y = self._gain * self._filtered[0], self._gain * self._filtered[1]
        size = math.hypot(x, y)
        if size == 0.0:
            return None
        keep = min(1.0, _LARGEST_M_S2 / size)
        return (keep * x, keep * y, 0.0)
