"""How far above the centre of mass a wall's force acts, from the torque of the contacts so far.

A wall pushes on the guards of a side, `contact_distance_m` ahead of the centre of mass and some height above
it. That height times the force turns the vehicle backwards, and the further it has turned, the longer the
lever: battery and payload that move the centre of mass by 2 cm are enough to turn it over at 3 m/s
(docs/results/faster_hits.md). A gentle hit tells the height, and the hits after it are leaned into
accordingly (`planning.replanner`). A plan needs it at the contact's end, so the core does not wait for the
fit of the contact: the height has a closed form.
"""

from __future__ import annotations

from typing import Final

from dart_flight.base.geometry import MissionFrame, rotate_back
from dart_flight.base.records import ContactRequest

_LEAST_N: Final = 3.0  # samples with less normal force tell nothing
_LEAST_N2: Final = 1000.0  # sum of the squared forces: a few samples of a hit of 0.5 m/s


class ContactHeight:
    """Height of the walls' force above the centre of mass.

    Args:
        contact_distance_m: from the centre of mass to the guards' plane.
    """

    def __init__(self, contact_distance_m: float) -> None:
        self._out_m = contact_distance_m
        self._moment = self._weight = 0.0

    @property
    def height_m(self) -> float | None:
        """Of the force above the centre of mass, by all contacts; None: not known yet."""
        return self._moment / self._weight if self._weight >= _LEAST_N2 else None

    def add(self, contact: ContactRequest) -> None:
        """Take a contact, if it was planned.

        Least squares: torque about the side's axis = -(height n_s + distance n_z) times the force.
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
            # The side that touches is the body axis that points into the wall the most.
            if abs(bx) > abs(by):
                side = -1.0 if bx > 0.0 else 1.0
                along, torque = side * bx, side * ty
            else:
                side = -1.0 if by > 0.0 else 1.0
                along, torque = side * by, -side * tx
            lever = force_n * along
            self._moment -= lever * (torque + self._out_m * force_n * bz)
            self._weight += lever * lever
