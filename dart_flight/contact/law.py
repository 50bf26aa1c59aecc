"""The contact law (paper, Sec. IV-B) as a force; the simulated vehicle and all predictions use it.

All quantities are in the wall's collision frame (`base/walls.py`). x is the signed distance of the vehicle's
centre to the plane of first touch, negative in compression. The centre lies on this plane when the vehicle
first touches the wall.

    0 <= lx  complementary to  w = lx + k x + f vx >= 0      ->  lx = max(0, -(k x + f vx))
    ly = -mu lx vy
    lz = -nu lx / (1 + lx)                                    (lx in newton)
"""

from __future__ import annotations

import math
from enum import StrEnum

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Coefficients, VehicleConfig


class Onset(StrEnum):
    """Rule that determines when the force of a contact begins.

    `lcp` is the complementarity condition as published: the force begins when k x + f vx < 0, slightly before
    the vehicle reaches the plane. `touch` also requires x < 0.
    """

    LCP = "lcp"
    TOUCH = "touch"


def normal_force(c: Coefficients, onset: Onset, x_m: float, vx_m_s: float) -> float:
    """Return the solution of the scalar complementarity problem, newton, >= 0."""
    force = -(c.k * x_m + c.f * vx_m_s)
    if force <= 0.0 or (onset is Onset.TOUCH and x_m >= 0.0):
        return 0.0
    return force


def coefficients_in_force(
    vehicle: VehicleConfig, material: str, mode: Mode, incidence_rad: float = 0.0
) -> Coefficients:
    """Return the coefficients of a material for a lock state and an angle of incidence.

    If the angle is at or above `airframe.incidence_rigid_deg`, the arms cannot fold. The rigid coefficients
    then hold even if the lock is open (paper, Sec. IV-B). A material that is not in the vehicle's table
    raises KeyError.
    """
    table = vehicle.materials[material]
    folds = abs(incidence_rad) < math.radians(vehicle.airframe.incidence_rigid_deg)
    return table.coefficients(mode if folds else Mode.RIGID)
