"""One hit of a body: what the guards make of an impact that is not straight, not level or not central.

The point law has a closed form, the body has none: the contact is integrated (`body.touch`), with the
vehicle hovering and its motors as they were. What a hit off the centre costs is how fast the vehicle turns
afterwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from dart_flight.base.geometry import (
    GRAVITY_M_S2,
    Quaternion,
    Vec3,
    advance_attitude,
    body_up,
    gyroscopic_torque,
    norm,
    quaternion_from_euler,
    quaternion_normalise,
    rotate,
    scale,
    subtract,
)
from dart_flight.base.records import Mode
from dart_flight.config.vehicle import Coefficients, ContactBody, VehicleConfig
from dart_flight.contact.body import Guard, Plane, Touch, guards_of, touch
from dart_flight.contact.law import Onset, coefficients_in_force

# A wall across the vehicle's way, world axes [into the wall, to the right, down].
_WALL = Plane((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
_STEP_S = 0.0005
_LONGEST_S = 0.6
_APART_M = 0.002  # all guards further than this from the wall: the contact is over


class BodyHit(NamedTuple):
    """What is left of a hit when no guard touches any more.

    Attributes:
        rate_frd: how fast the vehicle turns, body FRD, rad/s; it flew into the wall nose first.
        normal_out_m_s, tangential_out_m_s: velocity of the centre of mass, collision frame.
        peak_normal_n: largest sum of the normal forces.
        peak_torque_nm: largest torque about the centre of mass.
    """

    rate_frd: Vec3
    normal_out_m_s: float
    tangential_out_m_s: float
    peak_normal_n: float
    peak_torque_nm: float

    @property
    def turning_deg_s(self) -> float:
        """Size of the rate, degrees per second."""
        return math.degrees(norm(self.rate_frd))


class _Motion(NamedTuple):
    """Position and velocity in world axes, attitude, rate in body axes."""

    p: Vec3
    v: Vec3
    q: Quaternion
    w: Vec3


def body_hit(
    vehicle: VehicleConfig,
    material: str,
    mode: Mode,
    normal_m_s: float,
    tangential_m_s: float,
    incidence_rad: float = 0.0,
    onset: Onset | None = None,
) -> BodyHit:
    """Integrate one hit of the configured body.

    Args:
        vehicle: mass, inertia, materials, `simulation.contact`.
        material: of the wall.
        mode: of the arms.
        normal_m_s: into the wall, negative.
        tangential_m_s: along the wall.
        incidence_rad: of the vehicle's side against the wall; positive: the right guard is first.
        onset: rule; None: as configured.

    Raises:
        KeyError: the material is not in the vehicle's table.
    """
    body = vehicle.simulation.contact
    c = coefficients_in_force(vehicle, material, mode, incidence_rad)
    law = _Law(vehicle, body, guards_of(body), c, onset or Onset(vehicle.onset))
    m = _Motion(
        (0.0, 0.0, 0.0),
        (-normal_m_s, -tangential_m_s, 0.0),
        quaternion_from_euler(0.0, 0.0, -incidence_rad),
        (0.0, 0.0, 0.0),
    )
    # The onset may come before the foremost guard is on the plane: by f/k times its speed, by the rule `lcp`.
    lead_m = -normal_m_s * c.f / c.k
    m = m._replace(p=(-max(law.reach(m)) - lead_m - _APART_M, 0.0, 0.0))
    peak = torque = t_s = 0.0
    while t_s < _LONGEST_S:
        m, felt = law.step(m)
        peak, torque = max(peak, felt.normal_n), max(torque, norm(felt.torque))
        t_s += _STEP_S
        if peak > 0.0 and felt.normal_n == 0.0 and max(law.reach(m)) + m.p[0] < -_APART_M:
            break
    return BodyHit(m.w, -m.v[0], -m.v[1], peak, torque)


class _Law(NamedTuple):
    vehicle: VehicleConfig
    body: ContactBody
    guards: tuple[Guard, ...]
    coefficients: Coefficients
    onset: Onset

    def reach(self, m: _Motion) -> list[float]:
        """How far each guard is in front of the centre of mass, metres towards the wall."""
        return [rotate(m.q, guard.at)[0] for guard in self.guards]

    def step(self, m: _Motion) -> tuple[_Motion, Touch]:
        """One step by the midpoint rule."""
        a, b, _ = self._accelerations(m)
        mid = _moved(m, a, b, 0.5 * _STEP_S, m.v, m.w)
        a, b, felt = self._accelerations(mid)
        return _moved(m, a, b, _STEP_S, mid.v, mid.w), felt

    def _accelerations(self, m: _Motion) -> tuple[Vec3, Vec3, Touch]:
        felt = touch(
            self.guards,
            m.q,
            self.coefficients,
            self.onset,
            _WALL,
            m.p,
            m.v,
            m.w,
            self.vehicle.vertical_force_sign,
            self.body.vertical_lever_m,
        )
        mass = self.vehicle.airframe.mass_kg
        up = scale(body_up(m.q), GRAVITY_M_S2)
        f = felt.force
        a = (f[0] / mass + up[0], f[1] / mass + up[1], f[2] / mass + up[2] + GRAVITY_M_S2)
        ix, iy, iz = self.vehicle.airframe.inertia_kg_m2
        roll, pitch, yaw = subtract(felt.torque, gyroscopic_torque((ix, iy, iz), m.w))
        return a, (roll / ix, pitch / iy, yaw / iz), felt


def _moved(m: _Motion, a: Vec3, b: Vec3, h: float, v: Vec3, w: Vec3) -> _Motion:
    """`h` seconds on with these accelerations and mean velocities."""
    return _Motion(
        (m.p[0] + h * v[0], m.p[1] + h * v[1], m.p[2] + h * v[2]),
        (m.v[0] + h * a[0], m.v[1] + h * a[1], m.v[2] + h * a[2]),
        quaternion_normalise(advance_attitude(m.q, w, h)),
        (m.w[0] + h * b[0], m.w[1] + h * b[1], m.w[2] + h * b[2]),
    )
