"""Frames, rotations and walls: the only place that converts between frames.

Frames (`docs/concepts.md`):

* mission frame: right-handed, x along a configured heading, y left, z up, metres;
* NED: PX4's local world frame, north, east, down;
* FRD: the body frame, forward, right, down;
* collision frame of a wall: X outward normal, Y to the right when looking along X in a z-up frame,
  Z = X x Y (it points down at a wall).

Vectors are plain tuples of floats and quaternions are (w, x, y, z): the flight core does scalar
arithmetic, which is deterministic and, for three numbers, faster than small arrays.
"""

from __future__ import annotations

import math
from functools import cached_property

import msgspec

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
GRAVITY_M_S2 = 9.81
_SMALL_RAD = 1e-9  # below it the sine is the angle


# --- vectors ---------------------------------------------------------------------------------------


def add(a: Vec3, b: Vec3) -> Vec3:
    """Sum of two vectors of the same frame."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vec3, b: Vec3) -> Vec3:
    """Difference a - b of two vectors of the same frame."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(a: Vec3, factor: float) -> Vec3:
    """Vector times a number."""
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def dot2(a: Vec2, b: Vec2) -> float:
    """Scalar product in the horizontal plane."""
    return a[0] * b[0] + a[1] * b[1]


def norm(a: Vec3) -> float:
    """Euclidean length."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def horizontal(a: Vec3) -> float:
    """Length of the horizontal part of a mission-frame or NED vector."""
    return math.hypot(a[0], a[1])


def distance2(a: Vec2 | Vec3, b: Vec2 | Vec3) -> float:
    """Horizontal distance between two points of the same frame."""
    return math.hypot(a[0] - b[0], a[1] - b[1])


# --- rotations -------------------------------------------------------------------------------------


def quaternion_multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product a b: rotate by b first, then by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_conjugate(q: Quaternion) -> Quaternion:
    """Inverse rotation of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def quaternion_normalise(q: Quaternion) -> Quaternion:
    """Unit quaternion of the same direction.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.0 < length < math.inf:
        raise ValueError(f"not a rotation: {q}")
    return (w / length, x / length, y / length, z / length)


def rotate(q: Quaternion, v: Vec3) -> Vec3:
    """Rotate `v` by the unit quaternion `q` (for q = body to world: body vector in, world vector out)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + (y * tz - z * ty),
        vy + w * ty + (z * tx - x * tz),
        vz + w * tz + (x * ty - y * tx),
    )


def rotate_back(q: Quaternion, v: Vec3) -> Vec3:
    """The inverse of `rotate`: for q = body to world, world vector in, body vector out."""
    w, x, y, z = q
    return rotate((w, -x, -y, -z), v)


def body_up(q_frd_to_ned: Quaternion) -> Vec3:
    """The body's upward axis in NED, `rotate(q, (0, 0, -1))` without the zeros: where the thrust points."""
    w, x, y, z = q_frd_to_ned
    x2, y2 = 2.0 * x, 2.0 * y
    return (-w * y2 - z * x2, w * x2 - z * y2, (x * x2 + y * y2) - 1.0)


def quaternion_from_rotation_vector(v: Vec3) -> Quaternion:
    """Unit quaternion of a rotation by |v| radians about v."""
    angle = norm(v)
    if angle < _SMALL_RAD:
        return quaternion_normalise((1.0, 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]))
    s = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), v[0] * s, v[1] * s, v[2] * s)


def advance_attitude(q_frd_to_ned: Quaternion, rate_frd_rad_s: Vec3, dt_s: float) -> Quaternion:
    """Attitude after `dt_s` seconds (either sign) at a constant body rate.

    The Hamilton product with `quaternion_from_rotation_vector(rate * dt)`, written out: it runs for every
    sample of the core and every millisecond of the plant, where calls and tuples cost more than the numbers.
    """
    rx, ry, rz = rate_frd_rad_s
    rx, ry, rz = rx * dt_s, ry * dt_s, rz * dt_s
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    if angle < _SMALL_RAD:
        turn = quaternion_from_rotation_vector((rx, ry, rz))
        return quaternion_multiply(q_frd_to_ned, turn)
    half = 0.5 * angle
    s, bw = math.sin(half) / angle, math.cos(half)
    bx, by, bz = rx * s, ry * s, rz * s
    aw, ax, ay, az = q_frd_to_ned
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """FRD to NED quaternion of aerospace Euler angles (yaw, then pitch, then roll)."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def yaw_ned_of(q_frd_to_ned: Quaternion) -> float:
    """Heading in radians, clockwise from north, of an FRD to NED quaternion."""
    w, x, y, z = q_frd_to_ned
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def tilt_of(q_frd_to_ned: Quaternion) -> float:
    """Angle in radians between the body's and the world's vertical."""
    _, x, y, _ = q_frd_to_ned
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    wrapped = math.fmod(angle_rad + math.pi, 2.0 * math.pi)
    if wrapped < 0.0:
        wrapped += 2.0 * math.pi
    # Adding 2 pi to a tiny negative number can round up to 2 pi itself.
    return -math.pi if wrapped >= 2.0 * math.pi else wrapped - math.pi


# --- mission frame and NED -------------------------------------------------------------------------


class MissionFrame(msgspec.Struct, frozen=True, dict=True):
    """Where the mission frame lies in PX4's local NED frame.

    Attributes:
        north_m, east_m: the mission's origin in local NED.
        down_m: local NED height of the mission's z = 0 (the ground under the take-off point).
        heading_rad: direction of the mission's x axis, clockwise from north.
    """

    north_m: float = 0.0
    east_m: float = 0.0
    down_m: float = 0.0
    heading_rad: float = 0.0

    @cached_property
    def cos_sin(self) -> Vec2:
        """Cosine and sine of the heading, kept: every vector that is converted needs them."""
        return (math.cos(self.heading_rad), math.sin(self.heading_rad))

    def vector_from_ned(self, v_ned: Vec3) -> Vec3:
        """A direction (velocity, force, acceleration) from NED to the mission frame."""
        c, s = self.cos_sin
        n, e, d = v_ned
        return (n * c + e * s, n * s - e * c, -d)

    def vector_to_ned(self, v_mission: Vec3) -> Vec3:
        """A direction from the mission frame to NED."""
        c, s = self.cos_sin
        x, y, z = v_mission
        return (x * c + y * s, x * s - y * c, -z)

    def point_from_ned(self, p_ned: Vec3) -> Vec3:
        """A position from local NED to the mission frame."""
        return self.vector_from_ned((p_ned[0] - self.north_m, p_ned[1] - self.east_m, p_ned[2] - self.down_m))

    def point_to_ned(self, p_mission: Vec3) -> Vec3:
        """A position from the mission frame to local NED."""
        n, e, d = self.vector_to_ned(p_mission)
        return (n + self.north_m, e + self.east_m, d + self.down_m)

    def yaw_from_ned(self, yaw_ned_rad: float) -> float:
        """Heading clockwise from north to mission yaw, counter-clockwise from the mission's x axis."""
        return wrap_angle(self.heading_rad - yaw_ned_rad)

    def yaw_to_ned(self, yaw_mission_rad: float) -> float:
        """Mission yaw, counter-clockwise from x, to heading clockwise from north."""
        return wrap_angle(self.heading_rad - yaw_mission_rad)


# --- walls and the collision frame -----------------------------------------------------------------


class Wall(msgspec.Struct, frozen=True):
    """A finite vertical wall, as the plane where the vehicle's *centre* is at first touch.

    Attributes:
        name: as in the mission file.
        point: a point of that plane, the middle of the wall, mission frame, metres.
        normal: outward unit normal, from the wall into free space, mission frame.
        length_m: extent along the tangent, centred on `point`.
        material: key of the materials table.
    """

    name: str
    point: Vec2
    normal: Vec2
    length_m: float
    material: str

    @property
    def tangent(self) -> Vec2:
        """Y of the collision frame: to the right when looking along the normal, z up."""
        return (self.normal[1], -self.normal[0])

    def signed_distance(self, position: Vec2 | Vec3) -> float:
        """Signed distance in metres of the vehicle's centre to the plane; negative is compression."""
        return (position[0] - self.point[0]) * self.normal[0] + (position[1] - self.point[1]) * self.normal[1]

    def along(self, position: Vec2 | Vec3) -> float:
        """Distance in metres along the tangent from the middle of the wall."""
        tx, ty = self.tangent
        return (position[0] - self.point[0]) * tx + (position[1] - self.point[1]) * ty

    def foot(self, position: Vec2 | Vec3) -> Vec2:
        """The nearest point of the wall's plane within its length."""
        reach = 0.5 * self.length_m
        along = max(-reach, min(reach, self.along(position)))
        return (self.point[0] + along * self.tangent[0], self.point[1] + along * self.tangent[1])

    def spans(self, position: Vec2 | Vec3) -> bool:
        """Whether the point lies before the wall's finite length."""
        return abs(self.along(position)) <= 0.5 * self.length_m

    def to_collision(self, v_mission: Vec3) -> Vec3:
        """A direction from the mission frame to the wall's collision frame (R dagger transposed)."""
        nx, ny = self.normal
        return (v_mission[0] * nx + v_mission[1] * ny, v_mission[0] * ny - v_mission[1] * nx, -v_mission[2])

    def from_collision(self, v_collision: Vec3) -> Vec3:
        """A direction from the wall's collision frame to the mission frame (R dagger)."""
        nx, ny = self.normal
        return (
            v_collision[0] * nx + v_collision[1] * ny,
            v_collision[0] * ny - v_collision[1] * nx,
            -v_collision[2],
        )

    def parallel_yaw(self, yaw_mission_rad: float) -> float:
        """The heading nearest to the given one at which the leading edge is parallel to the wall.

        The vehicle is four-fold symmetric, so every quarter turn will do; two perpendicular walls need
        no turn between them (`docs/concepts.md`, yaw).
        """
        facing = math.atan2(-self.normal[1], -self.normal[0])
        quarter = 0.5 * math.pi
        return wrap_angle(facing + quarter * round((yaw_mission_rad - facing) / quarter))

    def incidence(self, yaw_mission_rad: float) -> float:
        """Angle of incidence in radians, 0 to pi/4: leading edge against the wall's plane."""
        return abs(wrap_angle(yaw_mission_rad - self.parallel_yaw(yaw_mission_rad)))
