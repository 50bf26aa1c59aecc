"""How far above the centre of mass a wall's force acts, from the torque of the contacts so far.

A wall pushes on the guards of a side, `contact_distance_m` ahead of the centre of mass and some height above
it. That height times the force turns the vehicle backwards, and the further it has turned, the longer the
lever: battery and payload that move the centre of mass by 2 cm are enough to turn it over at 3 m/s
(docs/results/faster_hits.md). A gentle hit tells the height, and the hits after it are leaned into
accordingly (`planning.replanner`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from dart_flight.base.geometry import MissionFrame, Vec2, rotate_back
from dart_flight.base.records import ContactEnd, ImpactOnset
from dart_flight.base.walls import Wall
from dart_flight.core.sense.detector import Events, ExpectedContact
from dart_flight.core.sense.incidence import ContactSample, ContactSampleBuffer
from dart_flight.core.sense.state import FlightState

_LEAST_N: Final = 3.0  # samples with less normal force tell nothing
_LEAST_N2: Final = 1000.0  # sum of the squared forces: a few samples of a hit of 0.5 m/s


class ContactHeight:
    """Follows the planned contacts.

    Args:
        contact_distance_m: from the centre of mass to the guards' plane.
        samples: of force and torque; whoever owns them adds each before `update`.
    """

    def __init__(self, contact_distance_m: float, samples: ContactSampleBuffer) -> None:
        self._out_m, self._samples = contact_distance_m, samples
        self._onset: ImpactOnset | None = None
        self._wall: Wall | None = None
        self._moment = self._weight = 0.0

    @property
    def height_m(self) -> float | None:
        """Of the force above the centre of mass, by all contacts; None: not known yet."""
        return self._moment / self._weight if self._weight >= _LEAST_N2 else None

    def update(self, state: FlightState, slow: Vec2, events: Events, expected: ExpectedContact) -> None:
        """What the detector made of the newest sample's force; arguments as `IncidenceEstimator.update`."""
        for event in events:
            if isinstance(event, ImpactOnset):
                self._onset, self._wall = event, expected.wall if event.planned else None
            elif isinstance(event, ContactEnd) and self._onset is not None and self._wall is not None:
                _, inside = self._samples.since(self._onset.first_us, 0)
                if state.frame is not None:
                    self._add(inside, self._wall, slow, state.frame)

    def _add(self, samples: Sequence[ContactSample], wall: Wall, slow: Vec2, frame: MissionFrame) -> None:
        """Least squares: torque about the side's axis = -(height n_s + distance n_z) times the force."""
        nx, ny = wall.normal
        normal_ned = frame.vector_to_ned((nx, ny, 0.0))
        for sample in samples:
            fx, fy, _ = sample.force.force_mission
            force_n = (fx - slow[0]) * nx + (fy - slow[1]) * ny
            if force_n < _LEAST_N or sample.force.clipped:
                continue
            bx, by, bz = rotate_back(sample.q, normal_ned)
            tx, ty, _ = sample.torque.torque_frd
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
