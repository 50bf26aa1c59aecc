"""Feed-forward that keeps PX4's velocity loop from reacting to a contact.

While a wall stops the vehicle, PX4 still follows its last setpoint. PX4 reacts to the lost speed by tilting
the vehicle into the wall. PX4's D term opposes acceleration: if the wall pushes back harder, the D term
increases this tilt. At 1 m/s and `MPC_XY_VEL_D_ACC` 0.2 the D term causes more than half of the tilt after an
impact (docs/results/body.md). From onset to peak the setpoint therefore repeats the measured motion, and PX4
does not push. The feed-forward also cancels the D term's response to the contact. This part of the
feed-forward is also added to the recovery setpoint, until the D term's filter has decayed.
"""

from __future__ import annotations

import math
from typing import Final

from dart_flight.base.geometry import GRAVITY_M_S2, Vec3
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.senses import Sensed

_FADED_M_S2: Final = 0.02
_LARGEST_M_S2: Final = 5.0  # limit of the feed-forward, in case a stale setpoint stays active
# The measured motion is commanded for at most this time from the onset, because PX4 keeps following an old
# setpoint.
LONGEST_S: Final = 0.25


# Used fraction of the tilt that balances a vehicle which does not rotate (docs/results/faster_hits.md).
_BALANCED: Final = 0.9
_MOST_LEAN: Final = 0.3  # limit of the tilt's tangent
_AGAINST_PLAN: Final = 1.3  # factor on a tilt into the wall that must overcome a planned tilt off the wall


def balancing_acceleration_m_s2(height_m: float | None, out_m: float, planned: Mode | None = None) -> float:
    """Return the acceleration to add, away from the wall, so that the impact rotates the vehicle less.

    A tilt into the wall by `height_m / out_m` radians brings the propeller guards level with the centre of
    mass. This tilt accelerates the vehicle into the wall, so the result is negative for a positive height.

    Args:
        height_m: height above the centre of mass at which the wall's force acts; None if unknown.
        out_m: horizontal distance of the propeller guards from the centre of mass.
        planned: mode of the arms if the impact ends a trajectory of the mission; None if the impact is
            replanned. With rigid arms, a mission's trajectory tilts the vehicle farther away from the wall
            than a replanned trajectory does.
    """
    if height_m is None:
        return 0.0
    if planned is Mode.RIGID and height_m > 0.0:
        height_m *= _AGAINST_PLAN
    return -max(-_MOST_LEAN, min(_MOST_LEAN, _BALANCED * height_m / out_m)) * GRAVITY_M_S2


class ContactFeedforward:
    """Filter of the contact's acceleration that copies the filter of PX4's D term."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._per_newton = 1.0 / vehicle.airframe.mass_kg
        self._gain, self._cutoff_hz = vehicle.px4.mpc_xy_vel_d_acc, vehicle.px4.mpc_veld_lp
        self._filtered = (0.0, 0.0)
        self._last_us: int | None = None

    def update(self, sensed: Sensed) -> None:
        """Filter one input's force estimate, which must not be None."""
        estimate = sensed.estimate
        assert estimate is not None
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
        """Acceleration that cancels the D term, mission frame, m/s2, or None without a recent contact."""
        x, y = self._gain * self._filtered[0], self._gain * self._filtered[1]
        size = math.hypot(x, y)
        if size == 0.0:
            return None
        keep = min(1.0, _LARGEST_M_S2 / size)
        return (keep * x, keep * y, 0.0)
