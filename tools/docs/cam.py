"""Kinematics of the four-face cam that moves the locking rods (paper, Sec. III-B, eq. 1).

    l = R_cam - r cos(theta),    theta_0 <= theta <= theta_0 + 90 degrees

l is the translation of the rods. With theta_0 = 0 they are retracted at theta_0 (arms flexible) and inserted
into the arms' slots at theta_0 + 90 degrees (arms rigid). The paper gives the law without sizes, so the
configuration contains them. Angles are degrees, lengths millimetres, as in the configuration.
"""

from __future__ import annotations

import math

from dart_flight.config.vehicle import Cam

RANGE_DEG = 90.0
_SLACK_DEG = 1e-9  # tolerance for rounding of computed angles


def limits_deg(cam: Cam) -> tuple[float, float]:
    """Return the cam's lowest and highest angle, theta_0 and theta_0 + 90 degrees."""
    return cam.theta0_deg, cam.theta0_deg + RANGE_DEG


def rod_mm(cam: Cam, theta_deg: float) -> float:
    """Return the rod translation l in mm at a cam angle.

    Raises:
        ValueError: the angle is outside the cam's range.
    """
    low, high = limits_deg(cam)
    if not low - _SLACK_DEG <= theta_deg <= high + _SLACK_DEG:
        raise ValueError(f"cam angle {theta_deg:g} degrees is outside {low:g} to {high:g}")
    return cam.r_cam_mm - cam.r_mm * math.cos(math.radians(theta_deg))
