"""Definition of an uncontrolled flight, from the truth of a simulated vehicle.

A flight is uncontrolled if one of these events occurs: The vehicle leaves the mission's bounds by more than
half a metre.
    The vehicle meets the ground at more than 1.5 m/s.
    The vehicle tilts by more than 80 degrees.
    The flight does not complete and gives no reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from dart_flight.base.geometry import tilt_of
from dart_flight.base.records import TruthSample
from dart_flight.config.mission_file import BoundsSpec

OUT_M = 0.5  # allowed distance outside the bounds, for braking
_LANDING_M_S = 1.5
_TILT_DEG = 80.0
_HIGH_M, _GROUND_M = 0.2, 0.03  # above the first altitude the vehicle flies, below the second it is down


class TruthExtremes:
    """The largest excursion, tilt and landing speed of a simulated flight so far.

    Attributes:
        excursion_m: largest distance outside the bounds, sideways or upwards.
        landing_m_s: largest downward speed at the ground.
    """

    def __init__(self, bounds: BoundsSpec) -> None:
        self._bounds = bounds
        self.excursion_m = self.landing_m_s = self.tilt_rad = 0.0
        self.last: TruthSample | None = None
        self._was_high = False

    def update(self, truth: TruthSample) -> None:
        self.last = truth
        x, y, z = truth.position_mission
        self.excursion_m = max(self.excursion_m, self._bounds.excess2((x, y)), z - self._bounds.z[1])
        self.tilt_rad = max(self.tilt_rad, tilt_of(truth.q_frd_to_ned))
        self._was_high = self._was_high or z > _HIGH_M
        if self._was_high and z < _GROUND_M:
            self.landing_m_s = max(self.landing_m_s, -truth.velocity_mission[2])


def find_uncontrolled(
    truth: TruthExtremes, completed: bool, explained: bool, allowed_m: float = OUT_M, falls: bool = False
) -> Iterator[str]:
    """Yield a phrase for each reason why a flight is uncontrolled; yield nothing for a controlled flight.

    Args:
        explained: whether the reason for an incomplete flight is known.
        allowed_m: allowed distance outside the bounds.
        falls: whether the vehicle is meant to fall, for example after a kill switch.
    """
    if not completed and not explained:
        yield "not completed, for no known reason"
    if truth.excursion_m > allowed_m:
        yield f"{truth.excursion_m:.2f} m outside bounds_m, limit {allowed_m:.2f} m"
    if truth.landing_m_s > _LANDING_M_S and not falls:
        yield f"hit the ground at {truth.landing_m_s:.2f} m/s"
    if math.degrees(truth.tilt_rad) > _TILT_DEG and not falls:
        yield f"tilted by {math.degrees(truth.tilt_rad):.0f} degrees"
