"""The contact law at the propeller guards: which guards touch, and the resulting force and torque.

A vehicle touches a wall with guard points, two on each of its four sides. These points are `guard_out_m` from
the centre of mass, `guard_along_m` to either side of the middle, and `guard_height_m` above the centre of
mass. The published law for a point applies to each guard, with that guard's share of the coefficients. If
both guards of a side are at the same depth, their k/2 and f/2 sum to the k and f of the point law. A
symmetric hit therefore has the normal force, contact time and exit velocity of the point law. Friction on a
guard is -mu times the guard's normal force times the guard's own sliding velocity. The vertical force of all
guards together is -nu L/(1 + L), where L is the sum of the normal forces on the wall.

The paper specifies neither the lever arm of the friction nor the lever arm of the vertical force. Both are
parameters (`config/vehicle/simulation.py`, `ContactBody`). The friction acts at a point with a reduced lever
arm. The sliding velocity is computed at the same point, so friction only removes energy.

Unlocked arms fold: each arm rotates in the horizontal plane about a bearing in the vehicle's middle. The
arm's guard thereby moves back by a fraction of the penetration (`fold_angles`). The smaller k of unlocked
arms accounts for this movement, so the fold angles only displace the arms' motors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from dart_flight.base.geometry import Quaternion, Vec3, rotate_back
from dart_flight.config.vehicle import BodyModel, Coefficients, ContactBody
from dart_flight.contact.law import Onset, normal_force

NEAR_M: Final = 0.08  # below 5 m/s, no guard farther away from a wall is in contact


class PropellerGuard(NamedTuple):
    """One guard point, body FRD, metres from the centre of mass."""

    at: Vec3
    friction_at: Vec3  # point at which friction acts: `at`, moved horizontally towards the centre


class Plane(NamedTuple):
    """A wall's surface and the axes of the wall's collision frame, in the world frame (NED or other).

    Attributes:
        point: a point on the surface, halfway between its ends.
        normal: outward unit normal.
        tangent: Y axis of the collision frame.
        down: Z axis of the collision frame.
        half_length_m: distance from `point` to each end, along the tangent; for guards near an end, use
            `contact/cylinders.py` instead of `touch`.
    """

    point: Vec3
    normal: Vec3
    tangent: Vec3
    down: Vec3
    half_length_m: float = math.inf


class BodyMotion(NamedTuple):
    """Position and motion of the vehicle.

    Attributes:
        position, velocity: motion of the centre of mass, world frame (NED or other), m and m/s.
        q: attitude, body FRD to world.
        rate_frd: angular velocity, rad/s.
    """

    position: Vec3
    velocity: Vec3
    q: Quaternion
    rate_frd: Vec3


class GuardLaw(NamedTuple):
    """Parameters of the contact law that do not depend on material and mode.

    Attributes:
        vertical_sign: -1 if the vertical force points up, like lz in the paper; 1 if it points down.
        vertical_lever_m: lever arm of the vertical force, from the centre of mass outwards.
    """

    onset: Onset
    vertical_sign: int
    vertical_lever_m: float


class WallLoad(NamedTuple):
    """Force and torque of one wall on the guards.

    Attributes:
        force: total force, world frame, newton.
        torque: torque about the centre of mass, body FRD, N m.
        friction_n: sum of the friction forces along the tangent, signed.
        normal: outward normal of the surface with the largest force.
    """

    force: Vec3
    torque: Vec3
    normal_n: float
    friction_n: float
    normal: Vec3


NO_LOAD = WallLoad((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, (0.0, 0.0, 0.0))


def propeller_guards(body: ContactBody) -> tuple[PropellerGuard, ...]:
    """Return the eight guards of a four-fold symmetric vehicle: front, right, back, left, two each.

    A point model has two guards at the centre of mass; their forces add up to the point law's force.
    """
    if body.body is BodyModel.POINT:
        return (PropellerGuard(_CENTRE, _CENTRE),) * 2
    out, along, z = body.guard_out_m, body.guard_along_m, -body.guard_height_m
    share = body.friction_lever_share
    guards = []
    for ox, oy in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
        for side in (1.0, -1.0):
            x, y = out * ox - side * along * oy, out * oy + side * along * ox
            guards.append(PropellerGuard((x, y, z), (share * x, share * y, share * z)))
    return tuple(guards)


def touch(
    guards: Sequence[PropellerGuard], c: Coefficients, plane: Plane, motion: BodyMotion, law: GuardLaw
) -> WallLoad:
    """Return force and torque of one wall on the guards; every guard must lie between the wall's ends.

    The coefficients are those of the whole side, as in the point law. The computation uses body axes:
    rotating the wall's three directions is cheaper than rotating two levers per guard.
    """
    position, velocity, q, (wx, wy, wz) = motion
    onset = law.onset
    world = plane.normal
    nx, ny, nz = rotate_back(q, world)
    depth = _height(plane, position)
    speed = world[0] * velocity[0] + world[1] * velocity[1] + world[2] * velocity[2]
    half = Coefficients(0.5 * c.k, 0.5 * c.f, c.mu, c.nu)
    pressed = []
    for (rx, ry, rz), friction_at in guards:
        x = depth + nx * rx + ny * ry + nz * rz
        if x > NEAR_M:
            continue
        turning = nx * (wy * rz - wz * ry) + ny * (wz * rx - wx * rz) + nz * (wx * ry - wy * rx)
        force = normal_force(half, onset, x, speed + turning)
        if force > 0.0:
            pressed.append((force, (rx, ry, rz), friction_at))
    if not pressed:
        return NO_LOAD
    t, d = rotate_back(q, plane.tangent), rotate_back(q, plane.down)
    world = plane.tangent
    sliding = world[0] * velocity[0] + world[1] * velocity[1] + world[2] * velocity[2]
    total = friction = 0.0
    tx = ty = tz = 0.0
    for force, (rx, ry, rz), (fx, fy, fz) in pressed:
        slip = sliding + t[0] * (wy * fz - wz * fy) + t[1] * (wz * fx - wx * fz) + t[2] * (wx * fy - wy * fx)
        rub = -c.mu * force * slip
        total += force
        friction += rub
        tx += force * (ry * nz - rz * ny) + rub * (fy * t[2] - fz * t[1])
        ty += force * (rz * nx - rx * nz) + rub * (fz * t[0] - fx * t[2])
        tz += force * (rx * ny - ry * nx) + rub * (fx * t[1] - fy * t[0])
    lift = law.vertical_sign * c.nu * total / (1.0 + total)
    lever = -law.vertical_lever_m * lift
    n, t_world, d_world = plane.normal, plane.tangent, plane.down
    return WallLoad(
        (
            total * n[0] + friction * t_world[0] + lift * d_world[0],
            total * n[1] + friction * t_world[1] + lift * d_world[1],
            total * n[2] + friction * t_world[2] + lift * d_world[2],
        ),
        (
            tx + lever * (ny * d[2] - nz * d[1]),
            ty + lever * (nz * d[0] - nx * d[2]),
            tz + lever * (nx * d[1] - ny * d[0]),
        ),
        total,
        friction,
        n,
    )


def clearance_m(guards: Sequence[PropellerGuard], q: Quaternion, plane: Plane, position: Vec3) -> float:
    """Return the distance of the nearest guard from a wall's surface, metres; negative behind the surface.

    `q` is the attitude, body FRD to world; `position` is the centre of mass, world frame, metres.
    """
    x, y, z = rotate_back(q, plane.normal)
    return _height(plane, position) + min(x * g.at[0] + y * g.at[1] + z * g.at[2] for g in guards)


def _height(plane: Plane, position: Vec3) -> float:
    n, o = plane.normal, plane.point
    return n[0] * (position[0] - o[0]) + n[1] * (position[1] - o[1]) + n[2] * (position[2] - o[2])


def fold_angles(
    body: ContactBody, share: float, depths: Sequence[float]
) -> tuple[float, float, float, float]:
    """Return the fold angle of each arm (`arm_of`), radians, positive clockwise seen from above.

    Args:
        share: movement of an arm as a fraction of the guard's penetration.
        depths: penetration of each guard in the order of `propeller_guards`, m; 0 without contact.
    """
    angles = [0.0, 0.0, 0.0, 0.0]
    along = max(body.guard_along_m, _MIN_ARM_M)
    for i, (guard, depth) in enumerate(zip(propeller_guards(body), depths, strict=True)):
        if depth > 0.0:
            # When a side is pressed, its first guard's arm swings clockwise, the other counter-clockwise.
            turn = math.atan2(share * depth, along)
            angles[arm_of(guard.at[0], guard.at[1])] += turn if i % 2 == 0 else -turn
    return (angles[0], angles[1], angles[2], angles[3])


def arm_of(x: float, y: float) -> int:
    """Return the arm in a point's quadrant, FRD: front right 0, front left 1, back right 2, back left 3."""
    return (0 if x >= 0.0 else 2) + (0 if y >= 0.0 else 1)


_CENTRE = (0.0, 0.0, 0.0)
_MIN_ARM_M: Final = 0.05  # minimum lever, because shorter levers would give unlimited angles
