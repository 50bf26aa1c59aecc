"""Height above the centre of mass at which a wall's force acts, from the torque of the contacts so far.

A wall pushes on the guards of one side, at `contact_distance_m` from the centre of mass and at some height
above it. The force times this height pitches the vehicle back, and the lever grows with the pitch. If battery
or payload shift the centre of mass by 2 cm, a hit at 3 m/s can turn the vehicle over
(docs/results/faster_hits.md).
The core estimates the height from a gentle contact. At later contacts the planner tilts the vehicle
accordingly (`planning.replanner`). The planner needs the height at the end of the contact, and the fit is not
available until later. The core therefore computes the height in closed form.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.geometry import MissionFrame, rotate_back
from dart_flight.base.records import ContactRequest

_LEAST_N: Final = 3.0  # minimum normal force of a sample that counts
_LEAST_N2: Final = 1000.0  # minimum sum of squared forces; a contact at 0.5 m/s reaches it in a few samples


class ContactHeight:
    """Estimator of the height above the centre of mass at which the walls' force acts.

    `contact_distance_m` is the distance from the centre of mass to the guards' plane.
    """

    def __init__(self, contact_distance_m: float) -> None:
        self._out_m = contact_distance_m
        self._moment = self._weight = 0.0

    @property
    def height_m(self) -> float | None:
        """Height from all contacts, metres, or None if not known."""
        return self._moment / self._weight if self._weight >= _LEAST_N2 else None

    def add(self, contact: ContactRequest) -> None:
        """Add a planned contact; ignore an unplanned contact.

        The touching side is the side of the body that faces the wall. The height is the least-squares
        solution of torque = -(height n_s + distance n_z) force. The torque is about the roll or pitch axis,
        whichever is parallel to the touching side. n_s is the component of the wall's normal along the
        outward direction of that side, and n_z the component along the body's z axis.
        """
        if contact.wall is None:
            return
        (nx, ny), (slow_x, slow_y) = contact.wall.normal, contact.slow_force
        normal_ned = MissionFrame(heading_rad=contact.frame_heading_rad).vector_to_ned((nx, ny, 0.0))
        columns = (
            *(contact.sample_us, contact.force_mission, contact.clipped),
            *(contact.torque_frd, contact.q_frd_to_ned),
        )
        for t_us, (fx, fy, _), clipped, (tx, ty, _), q in zip(*columns, strict=True):
            force_n = (fx - slow_x) * nx + (fy - slow_y) * ny
            if force_n < _LEAST_N or clipped or t_us < contact.onset.first_us:
                continue
            bx, by, bz = rotate_back(q, normal_ned)
            # The touching side is the body axis that is closest to the wall's normal.
            if abs(bx) > abs(by):
                side = -1.0 if bx > 0.0 else 1.0
                along, torque = side * bx, side * ty
            else:
                side = -1.0 if by > 0.0 else 1.0
                along, torque = side * by, -side * tx
            lever = force_n * along
            self._moment -= lever * (torque + self._out_m * force_n * bz)
            self._weight += lever * lever
