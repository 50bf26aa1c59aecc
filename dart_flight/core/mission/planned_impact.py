"""Prediction of a planned impact by the contact law."""

from __future__ import annotations

import math

from dart_flight.config.mission import Collision, Mission
from dart_flight.contact import contact_map
from dart_flight.contact.law import Onset


def impact_velocity(collision: Collision) -> tuple[float, float] | None:
    """Return the planned or else the predicted velocity (normal, tangential) at impact, m/s, collision frame.

    The result is None if the mission contains neither velocity, for example if a recovery leads to the wall.
    """
    if collision.approach_m_s is not None:
        return collision.approach_m_s
    if collision.predicted is not None:
        return (collision.predicted.normal_m_s, collision.predicted.tangential_m_s)
    return None


def expected_hit(mission: Mission, collision: Collision) -> contact_map.WallContact[float] | None:
    """Return the contact law's result for a collision, or None if the impact velocity is unknown."""
    velocity = impact_velocity(collision)
    if velocity is None or velocity[0] >= 0.0:
        return None
    vehicle = mission.vehicle
    coefficients = vehicle.materials[collision.wall.material].coefficients(collision.mode)
    return contact_map.collide(coefficients, vehicle.airframe.mass_kg, *velocity, Onset(vehicle.onset))


def describe_force(normal_n: float, friction_n: float) -> str:
    """Return the force that `limits.peak_force_n` limits, with its parts: `85 N (82 normal, 22 along)`."""
    return f"{math.hypot(normal_n, friction_n):.0f} N ({normal_n:.0f} normal, {abs(friction_n):.0f} along)"
