"""Records for the plots of a flight: small sets of numbers.

The records are published as JSON. Their schemas are made in the same way as the schemas of the flight log.
"""

from __future__ import annotations

from typing import ClassVar

from dart_flight.base.records import Record


class VehicleState(Record, frozen=True, gc=False):
    """Pose (as estimated by PX4), phase, arms and battery of the vehicle."""

    topic: ClassVar[str] = "/flight/state"
    t_us: int
    x_m: float  # along the mission's heading
    y_m: float  # to the left of the mission's heading
    height_m: float  # above the take-off point
    speed_m_s: float
    tilt_deg: float
    phase: str
    arms: str  # rigid, flexible, travelling, fault or unknown, from the lock's reported state
    horn_share: float  # position of the lock servo: 0 if flexible, 1 if rigid or without a lock
    battery_v: float | None
    battery_remaining: float | None


class ForceState(Record, frozen=True, gc=False):
    """Estimated external force on the vehicle, newton: the strongest estimate in a period of 20 ms."""

    topic: ClassVar[str] = "/flight/force"
    t_us: int
    force_n: float  # magnitude
    normal_n: float  # component along the outward normal of the nearest wall
    along_n: float  # component along this wall, positive to the right when looking out of the wall
    up_n: float
    clipped: bool


class TrueForce(Record, frozen=True, gc=False):
    """True force of the walls on the simulated vehicle, newton: the strongest in a period of 20 ms."""

    topic: ClassVar[str] = "/flight/true_force"
    t_us: int
    force_n: float  # magnitude
    normal_n: float  # component along the outward normal of the nearest wall
    along_n: float  # component along this wall, positive to the right when looking out of the wall
    up_n: float


SCALARS: tuple[type[Record], ...] = (VehicleState, ForceState, TrueForce)
