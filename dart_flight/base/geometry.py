"""Frames and rotations: the only place that converts between frames.

Frames (`docs/concepts.md`):

* mission frame: right-handed, x along a configured heading, y left, z up, metres;
* NED: PX4's local world frame, north, east, down;
* FRD: the body frame, forward, right, down;
* collision frame of a wall: X outward normal, Y to the right when looking along X, Z = X x Y. Walls are
  vertical, so Z points down.

Vectors are plain tuples of floats; quaternions are tuples (w, x, y, z). With only three numbers, scalar
arithmetic is faster than arrays, and it is deterministic. Walls, with their collision frame, are in `walls`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
GRAVITY_M_S2: Final = 9.81
_HALF_TURN_X: Quaternion = (0.0, 1.0, 0.0, 0.0)  # converts x forward, z up to x forward, z down
_Y_UP_TO_Z_UP: Quaternion = (0.5, 0.5, 0.5, 0.5)  # converts z forward, y up to x forward, z up
_SMALL_RAD: Final = 1e-9  # below this angle, sin(x) equals x


# --- vectors ---------------------------------------------------------------------------------------


def add(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scale(a: Vec3, factor: float) -> Vec3:
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def norm(a: Vec3) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def horizontal(a: Vec3) -> float:
    """Return the horizontal length of a mission-frame or NED vector."""
    return math.hypot(a[0], a[1])


def distance2(a: Vec2 | Vec3, b: Vec2 | Vec3) -> float:
    """Return the horizontal distance between two points of the same frame."""
    return math.hypot(a[0] - b[0], a[1] - b[1])


def distance_to_segment(place: Vec2, a: Vec2, b: Vec2) -> float:
    (ax, ay), (bx, by), (cx, cy) = a[:2], b[:2], place
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    share = max(0.0, min(1.0, ((cx - ax) * dx + (cy - ay) * dy) / square)) if square > 0.0 else 0.0
    return math.hypot(ax + share * dx - cx, ay + share * dy - cy)


# --- rotations -------------------------------------------------------------------------------------


def angle_between(a: Vec2, b: Vec2) -> float:
    """Return the plane angle from one direction to another, rad, counter-clockwise positive, -pi to pi."""
    return math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])


def quaternion_multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the Hamilton product a b: rotate by b first, then by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


def quaternion_normalise(q: Quaternion) -> Quaternion:
    """Scale to unit length; raise ValueError if the quaternion is zero or not finite."""
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.0 < length < math.inf:
        raise ValueError(f"the quaternion {q} is not a rotation")
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
    """Rotate by the inverse of `q` (for q = body to world: world vector in, body vector out)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (z * vy - y * vz)
    ty = 2.0 * (x * vz - z * vx)
    tz = 2.0 * (y * vx - x * vy)
    return (
        vx + w * tx + (z * ty - y * tz),
        vy + w * ty + (x * tz - z * tx),
        vz + w * tz + (y * tx - x * ty),
    )


def body_up(q_frd_to_ned: Quaternion) -> Vec3:
    """Return the direction of thrust in NED, the body's upward axis: `rotate(q, (0, 0, -1))`, simplified."""
    w, x, y, z = q_frd_to_ned
    x2, y2 = 2.0 * x, 2.0 * y
    return (-w * y2 - z * x2, w * x2 - z * y2, (x * x2 + y * y2) - 1.0)


def quaternion_from_rotation_vector(v: Vec3) -> Quaternion:
    angle = norm(v)
    if angle < _SMALL_RAD:
        return quaternion_normalise((1.0, 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]))
    s = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), v[0] * s, v[1] * s, v[2] * s)


def advance_attitude(q_frd_to_ned: Quaternion, rate_frd_rad_s: Vec3, dt_s: float) -> Quaternion:
    """Return the attitude after `dt_s` seconds, which may be negative, at a constant body rate.

    This is the Hamilton product with `quaternion_from_rotation_vector(rate * dt)`, written out for speed: the
    core calls this function for every sample, and the simulation every millisecond.
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


def integrate_rate(q_frd_to_ned: Quaternion, rate_frd_rad_s: Vec3, dt_s: float) -> Quaternion:
    """Return `advance_attitude`, normalised; repeated steps would otherwise change the length."""
    w, x, y, z = advanced = advance_attitude(q_frd_to_ned, rate_frd_rad_s, dt_s)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.0 < length < math.inf:
        return quaternion_normalise(advanced)  # raises the error
    return (w / length, x / length, y / length, z / length)


def gyroscopic_torque(inertia_kg_m2: Vec3, rate_rad_s: Vec3) -> Vec3:
    """Return w x J w about the principal axes, N m. Euler's equation is J alpha = torque - w x J w."""
    jx, jy, jz = inertia_kg_m2
    x, y, z = rate_rad_s
    return ((jz - jy) * y * z, (jx - jz) * z * x, (jy - jx) * x * y)


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Return the FRD to NED quaternion of aerospace Euler angles (yaw, then pitch, then roll)."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def quaternion_from_intrinsic_xyz(x_rad: float, y_rad: float, z_rad: float) -> Quaternion:
    """Return the rotation about x, then the new y, then the new z, as Vicon defines a body's angles."""
    about_x = quaternion_from_rotation_vector((x_rad, 0.0, 0.0))
    about_y = quaternion_from_rotation_vector((0.0, y_rad, 0.0))
    about_z = quaternion_from_rotation_vector((0.0, 0.0, z_rad))
    return quaternion_multiply(quaternion_multiply(about_x, about_y), about_z)


def quaternion_from_matrix(columns: Sequence[float]) -> Quaternion:
    """Return the quaternion of a rotation matrix, given column by column, as Qualisys (QTM) sends it.

    A matrix that is not a rotation raises ValueError.
    """
    (r11, r21, r31, r12, r22, r32, r13, r23, r33) = columns
    # Start from the largest component to avoid a division by a small number.
    squares = (1 + r11 + r22 + r33, 1 + r11 - r22 - r33, 1 - r11 + r22 - r33, 1 - r11 - r22 + r33)
    largest = max(range(4), key=squares.__getitem__)
    if not squares[largest] > 0.0:
        raise ValueError("the matrix is not a rotation")
    rows = (
        (squares[0], r32 - r23, r13 - r31, r21 - r12),
        (r32 - r23, squares[1], r12 + r21, r13 + r31),
        (r13 - r31, r12 + r21, squares[2], r23 + r32),
        (r21 - r12, r13 + r31, r23 + r32, squares[3]),
    )
    return quaternion_normalise(rows[largest])


def rotation_angle(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the rotation from one attitude to another, 0 to pi, rad."""
    w, x, y, z = quaternion_multiply(quaternion_conjugate(a), b)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def yaw_ned_of(q_frd_to_ned: Quaternion) -> float:
    """Return the heading of an FRD to NED quaternion, radians clockwise from north."""
    w, x, y, z = q_frd_to_ned
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def tilt_of(q_frd_to_ned: Quaternion) -> float:
    """Return the angle between the body's and the world's vertical axis, rad."""
    _, x, y, _ = q_frd_to_ned
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))


def wrap_angle(angle_rad: float) -> float:
    """Wrap to [-pi, pi)."""
    wrapped = math.fmod(angle_rad + math.pi, 2.0 * math.pi)
    if wrapped < 0.0:
        wrapped += 2.0 * math.pi
    # Adding 2 pi to a tiny negative number can round up to 2 pi itself.
    return -math.pi if wrapped >= 2.0 * math.pi else wrapped - math.pi


def wrap_deg(angle_deg: float) -> float:
    """Wrap to [-180, 180)."""
    return math.degrees(wrap_angle(math.radians(angle_deg)))


# --- the frame of a mission ---------------------------------------------------------------------------


class MissionFrame:
    """Position and direction of the mission frame in PX4's local NED frame; immutable.

    In names, `vector_` means a direction (velocity, force, acceleration), and `point_` means a position. A
    mission yaw is counter-clockwise from x; a NED heading is clockwise from north.

    Attributes:
        north_m, east_m: the mission's origin in local NED.
        down_m: local NED down coordinate of the mission's z = 0 (the ground at the take-off point).
        heading_rad: direction of the mission's x axis, clockwise from north.
    """

    def __init__(
        self, north_m: float = 0.0, east_m: float = 0.0, down_m: float = 0.0, heading_rad: float = 0.0
    ) -> None:
        self.north_m, self.east_m, self.down_m, self.heading_rad = north_m, east_m, down_m, heading_rad
        self.cos, self.sin = math.cos(heading_rad), math.sin(heading_rad)

    def vector_from_ned(self, v_ned: Vec3) -> Vec3:
        c, s = self.cos, self.sin
        n, e, d = v_ned
        return (n * c + e * s, n * s - e * c, -d)

    def vector_to_ned(self, v_mission: Vec3) -> Vec3:
        c, s = self.cos, self.sin
        x, y, z = v_mission
        return (x * c + y * s, x * s - y * c, -z)

    def point_from_ned(self, p_ned: Vec3) -> Vec3:
        c, s = self.cos, self.sin
        n, e = p_ned[0] - self.north_m, p_ned[1] - self.east_m
        return (n * c + e * s, n * s - e * c, -(p_ned[2] - self.down_m))

    def point_to_ned(self, p_mission: Vec3) -> Vec3:
        c, s = self.cos, self.sin
        x, y, z = p_mission
        return (x * c + y * s + self.north_m, x * s - y * c + self.east_m, -z + self.down_m)

    def displaced(self, x_m: float, y_m: float) -> MissionFrame:
        """Return the frame with its origin displaced along its own axes."""
        north, east, _ = self.point_to_ned((x_m, y_m, 0.0))
        return MissionFrame(north, east, self.down_m, self.heading_rad)

    def yaw_from_ned(self, yaw_ned_rad: float) -> float:
        return wrap_angle(self.heading_rad - yaw_ned_rad)

    def yaw_to_ned(self, yaw_mission_rad: float) -> float:
        return wrap_angle(self.heading_rad - yaw_mission_rad)


class RoomFrame:
    """Conversion between the axes of a motion-capture room and PX4's local NED (docs/motion_capture.md).

    The axes of a marker body follow the same convention as the room's: x forward and z up, or z forward and
    y up. The room and local NED have the same origin.

    Args:
        y_up: whether the room's y axis points up; if not, the z axis points up.
        heading_rad: direction of the room's x axis, or of its z axis if y is up, clockwise from north.
        body_offset_m: position of the vehicle's centre in the axes of the marker body.
        body_yaw_rad: direction of the vehicle's nose in the marker body, counter-clockwise from the body's
            forward axis.
    """

    def __init__(
        self, y_up: bool, heading_rad: float, body_offset_m: Vec3 = (0.0, 0.0, 0.0), body_yaw_rad: float = 0.0
    ) -> None:
        to_z_up = _Y_UP_TO_Z_UP if y_up else IDENTITY
        north = (math.cos(0.5 * heading_rad), 0.0, 0.0, math.sin(0.5 * heading_rad))
        self._room_to_ned = quaternion_multiply(quaternion_multiply(north, _HALF_TURN_X), to_z_up)
        nose = (math.cos(0.5 * body_yaw_rad), 0.0, 0.0, math.sin(0.5 * body_yaw_rad))
        frd_to_z_up = quaternion_multiply(nose, _HALF_TURN_X)
        self._frd_to_body = quaternion_multiply(quaternion_conjugate(to_z_up), frd_to_z_up)
        self._offset = body_offset_m

    def pose_to_ned(self, position_room: Vec3, q_body_to_room: Quaternion) -> tuple[Vec3, Quaternion]:
        """Convert a pose of the marker body to the vehicle's position (NED) and attitude (FRD to NED)."""
        centre = add(position_room, rotate(q_body_to_room, self._offset))
        q_frd_to_room = quaternion_multiply(q_body_to_room, self._frd_to_body)
        return rotate(self._room_to_ned, centre), quaternion_multiply(self._room_to_ned, q_frd_to_room)

    def pose_from_ned(self, position_ned: Vec3, q_frd_to_ned: Quaternion) -> tuple[Vec3, Quaternion]:
        """Convert the vehicle's position and attitude to the marker body's pose in the room."""
        q_frd_to_room = quaternion_multiply(quaternion_conjugate(self._room_to_ned), q_frd_to_ned)
        q_body_to_room = quaternion_multiply(q_frd_to_room, quaternion_conjugate(self._frd_to_body))
        centre = rotate_back(self._room_to_ned, position_ned)
        return subtract(centre, rotate(q_body_to_room, self._offset)), q_body_to_room


def attitude_in(frame: MissionFrame, q_frd_to_ned: Quaternion) -> Quaternion:
    """Return the attitude for viewers: the rotation from the vehicle frame to the mission frame.

    The vehicle frame is forward, left, up. A half turn about x converts FRD to this frame, and another half
    turn converts NED to a frame with z up. The heading is a rotation about z.
    """
    half = 0.5 * frame.heading_rad
    flip = (0.0, 1.0, 0.0, 0.0)
    turn = quaternion_multiply((math.cos(half), 0.0, 0.0, math.sin(half)), flip)
    return quaternion_multiply(quaternion_multiply(turn, q_frd_to_ned), flip)
