"""The contact law of a point, all three components (`dart_flight.contact.law`)."""

from __future__ import annotations

from dart_flight.base.geometry import Vec3
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.law import Onset, normal_force


def contact_force(
    c: Coefficients, onset: Onset, x_m: float, velocity_collision: Vec3, vertical_sign: int = -1
) -> Vec3:
    """Return the contact force in newton in the collision frame.

    Args:
        c: coefficients of material and mode.
        onset: onset rule.
        x_m: signed distance to the plane.
        velocity_collision: m/s, collision frame.
        vertical_sign: -1 as the paper writes lz (against Z of the collision frame: up at a wall), or 1.
    """
    lx = normal_force(c, onset, x_m, velocity_collision[0])
    if lx == 0.0:
        return (0.0, 0.0, 0.0)
    return (lx, -c.mu * lx * velocity_collision[1], vertical_sign * c.nu * lx / (1.0 + lx))
