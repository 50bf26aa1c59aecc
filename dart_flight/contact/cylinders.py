"""The contact law at upright cylinders: posts, and the edges at the ends of a wall.

A wall's surface acts on each guard separately. The foot of a guard is the guard's projection onto the
surface. A guard whose foot lies beyond the wall's end does not touch the surface. The end itself is an edge:
a cylinder of small radius whose face is tangent to the surface. A cylinder acts on the vehicle's outline,
which consists of the guards and the bars between them. The force acts at the outline's point nearest to the
axis, in the direction of the cylinder's horizontal normal. Friction acts along the horizontal tangent. The
lever arm of friction is reduced as for guards (`propeller_guards`).

A bar rests on the springs of its two guards, k/2 and f/2 each. At the fraction s of the bar's length the
stiffness is k/2 / ((1 - s)^2 + s^2): k/2 at a guard, and k in the middle, as at a wall that touches both
guards. The *share* is this stiffness divided by k. The share is fixed at the first touch and stays constant
while the bar is pressed. The depth stays continuous when the cylinder's axis enters the outline. The stored
energy, 1/2 share k x^2, therefore depends on the depth alone, and sliding adds no energy.

A surface presses only points that have reached it from outside, because other points would gain energy. A
guard may move past the wall's end and then behind the surface. This guard touches nothing until it is in
front of the surface again. While the surface presses one of a bar's guards, this guard carries the load, and
the bar touches no edge.

Several walls share these rules. A guard that entered a partition through one face cannot be pressed by the
other face, even if its depth exceeds the partition's thickness. A bar that rests on one wall touches no edge
of another wall.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import Quaternion, Vec3, add, rotate, rotate_back
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.law import Onset, normal_force
from dart_flight.contact.propeller_guards import (
    NEAR_M,
    NO_LOAD,
    BodyMotion,
    GuardLaw,
    Plane,
    PropellerGuard,
    WallLoad,
)

EDGE_RADIUS_M: Final = 0.01  # edges are rounded like a board's, because a sharp edge has no normal
_DOWN: Final = (0.0, 0.0, 1.0)  # NED


class Cylinder(NamedTuple):
    """An upright cylinder; `axis` is a point of its axis in NED, metres."""

    axis: Vec3
    radius_m: float


class Corner(NamedTuple):
    """A corner of the vehicle's outline, with the indices of all guards that have its x and y."""

    guard: PropellerGuard
    numbers: tuple[int, ...]


class NearestPoint(NamedTuple):
    """The point of an outline that is nearest to a cylinder's axis.

    Attributes:
        x_m: distance to the cylinder's face; negative inside the cylinder.
        normal: NED, horizontal, from the cylinder into the vehicle.
        share: stiffness and damping at this point, divided by the whole side's k and f.
        deflections: index and deflection per metre of depth, for each guard whose spring supports the point.
    """

    x_m: float
    normal: Vec3
    guard: PropellerGuard
    share: float
    deflections: tuple[tuple[int, float], ...]


class ContactPoint(NamedTuple):
    """A point of the vehicle that a surface may press.

    Attributes:
        normal: NED, into the vehicle.
        tangent: NED, horizontal: the Y axis of the collision frame that has this normal.
        x_m: distance to the surface; negative behind it.
        c: coefficients of this point alone.
    """

    guard: PropellerGuard
    normal: Vec3
    tangent: Vec3
    x_m: float
    c: Coefficients


def outline(guards: Sequence[PropellerGuard]) -> tuple[Corner, ...]:
    """Return the outline, clockwise seen from above; guards with the same x and y form one corner."""
    places: dict[tuple[float, float], list[int]] = {}
    for number, guard in enumerate(guards):
        places.setdefault((round(guard.at[0], 9), round(guard.at[1], 9)), []).append(number)
    corners = [Corner(guards[numbers[0]], tuple(numbers)) for numbers in places.values()]
    return tuple(sorted(corners, key=lambda one: math.atan2(one.guard.at[1], one.guard.at[0])))


def nearest_point(
    corners: Sequence[Corner], q: Quaternion, position: Vec3, cylinder: Cylinder
) -> NearestPoint:
    """Return the point of an outline that is nearest to a cylinder, or deepest inside it.

    `q` is the attitude, body FRD to NED; `position` is the centre of mass, NED, metres.
    """
    ax, ay = cylinder.axis[0] - position[0], cylinder.axis[1] - position[1]
    places = [rotate(q, corner.guard.at) for corner in corners]
    turn = 1.0 if q[1] * q[1] + q[2] * q[2] < 0.5 else -1.0  # reversed outline if upside down
    least, number, fraction, inside = math.inf, 0, 0.0, len(corners) > 2
    for i, (bx, by, _) in enumerate(places):
        cx, cy, _ = places[(i + 1) % len(places)]
        ex, ey, wx, wy = cx - bx, cy - by, ax - bx, ay - by
        square = ex * ex + ey * ey
        s = min(1.0, max(0.0, (wx * ex + wy * ey) / square)) if square > 0.0 else 0.0
        dx, dy = wx - s * ex, wy - s * ey
        inside = inside and turn * (ex * wy - ey * wx) > 0.0
        if dx * dx + dy * dy < least:
            least, number, fraction = dx * dx + dy * dy, i, s
    first, second = corners[number], corners[(number + 1) % len(corners)]
    (bx, by, _), (cx, cy, _) = places[number], places[(number + 1) % len(corners)]
    distance = math.sqrt(least)
    if 0.0 < fraction < 1.0:
        length = turn * math.hypot(cx - bx, cy - by)
        normal = ((by - cy) / length, (cx - bx) / length, 0.0)
    else:
        px, py = (bx, by) if fraction == 0.0 else (cx, cy)
        normal = _direction(px - ax, py - ay)
    x = (-distance if inside else distance) - cylinder.radius_m
    share, deflections = _bar_load(first, second, fraction)
    guard = PropellerGuard(
        _interpolate(first.guard.at, second.guard.at, fraction),
        _interpolate(first.guard.friction_at, second.guard.friction_at, fraction),
    )
    return NearestPoint(x, normal, guard, share, deflections)


class CylinderContact:
    """A cylinder that the outline may touch, and the state of its contact.

    Attributes:
        coefficients: coefficients for the whole side of the vehicle; None if not set.
        share: fraction of k and f that acts, fixed at the first touch; None if the outline is not pressed.
        stood_in: whether the outline is inside the cylinder without being pressed. The reason is that a guard
            carried the load first, or that the outline did not come from outside.
    """

    def __init__(self, cylinder: Cylinder) -> None:
        self.cylinder = cylinder
        self.coefficients: Coefficients | None = None
        self.share: float | None = None
        self.stood_in = False

    def point(self, near: NearestPoint, c: Coefficients, borne: bool) -> ContactPoint | None:
        """Return the contact point at the outline's nearest point, or None if the cylinder cannot press it.

        `c` holds for the vehicle's whole side. `borne` means that guards already carry the load at this
        point.
        """
        if near.x_m > 0.0:
            self.stood_in = False
        elif borne:
            self.stood_in = True
        if borne or self.stood_in:
            self.share = None
            return None
        if near.x_m > NEAR_M:
            return None
        nx, ny, _ = near.normal
        own = _scaled(c, near.share if self.share is None else self.share)
        return ContactPoint(near.guard, near.normal, (-ny, nx, 0.0), near.x_m, own)

    def settle(self, near: NearestPoint, force_n: float) -> None:
        """Fix `share` when the first force acts; reset it when the outline is clear of the cylinder."""
        if force_n > 0.0:
            self.share = near.share if self.share is None else self.share
        elif near.x_m > 0.0:
            self.share = None


class PostContact:
    """A free-standing cylinder (post), and its contact with the outline.

    `depths` is the deflection of each guard at the last call of `touch`, metres.
    """

    def __init__(self, cylinder: Cylinder, guards: Sequence[PropellerGuard]) -> None:
        self.contact = CylinderContact(cylinder)
        self.depths = [0.0] * len(guards)
        self._corners = outline(guards)

    def nearest(self, q: Quaternion, position: Vec3) -> NearestPoint:
        return nearest_point(self._corners, q, position, self.contact.cylinder)

    def touch(self, c: Coefficients, motion: BodyMotion, law: GuardLaw) -> WallLoad:
        """Return force and torque on the vehicle; `c` holds for the vehicle's whole side."""
        near = self.nearest(motion.q, motion.position)
        point = self.contact.point(near, c, False)
        self.depths = [0.0] * len(self.depths)
        if point is None:
            return NO_LOAD
        total, forces = _press([point], motion, law)
        self.contact.settle(near, forces[0])
        _update_deflections(self.depths, near, forces[0])
        return total


class WallWithEnds:
    """A wall's surface near its ends: the surface touches each guard, and its two edges touch the outline.

    Attributes:
        edges: edges at the left and the right end, looking along the normal.
        beside: indices of the guards that are behind the surface but did not pass through it.
        bearing: indices of the guards that the wall pressed at the last call of `touch`.
        depths: deflection of each guard at the last call of `touch`, metres.
    """

    def __init__(
        self, plane: Plane, guards: Sequence[PropellerGuard], edge_radius_m: float = EDGE_RADIUS_M
    ) -> None:
        self.plane, self._guards = plane, guards
        self._corners = outline(guards)
        (px, py, pz), (nx, ny, nz), (tx, ty, tz) = plane.point, plane.normal, plane.tangent
        self._edge_radius_m = r = edge_radius_m
        self.edges = tuple(
            CylinderContact(Cylinder((px - r * nx + a * tx, py - r * ny + a * ty, pz - r * nz + a * tz), r))
            for a in (-plane.half_length_m, plane.half_length_m)
        )
        self.beside: set[int] = set()
        self.bearing: set[int] = set()
        self.depths = [0.0] * len(guards)

    @property
    def is_plain(self) -> bool:
        """Whether no contact state is stored. The wall, away from its ends, then acts like a plane."""
        return not self.beside and all(one.share is None and not one.stood_in for one in self.edges)

    @property
    def coefficients(self) -> Coefficients | None:
        """Coefficients of the edge that presses the outline, or None if neither edge does."""
        return next((edge.coefficients for edge in self.edges if edge.share is not None), None)

    def displaced(self, away_m: float) -> WallWithEnds:
        """Return a copy of the wall, displaced along its normal and without the contact state."""
        p, n = self.plane.point, self.plane.normal
        point = (p[0] + away_m * n[0], p[1] + away_m * n[1], p[2] + away_m * n[2])
        return WallWithEnds(self.plane._replace(point=point), self._guards, self._edge_radius_m)

    def reset_contacts(self, q: Quaternion, position: Vec3) -> None:
        """Reset the contact state; assume that guards behind the surface have not passed through it."""
        self.beside = {i for i, h, _ in self._foot_points(q, position) if h < 0.0}
        self.bearing = set()
        for edge, near in self.nearest(q, position):
            edge.share, edge.stood_in = None, near.x_m < 0.0

    def holds(self, number: int, q: Quaternion, position: Vec3) -> bool:
        """Return whether a guard has entered the wall from the front, or is loaded by the wall."""
        if number in self.bearing or number in self.beside:
            return number in self.bearing
        height, along = self._foot_point(number, q, position)
        return height < 0.0 and abs(along) <= self.plane.half_length_m

    def may_touch(
        self, q: Quaternion, position: Vec3, within_m: float, faces: Sequence[WallWithEnds] = ()
    ) -> bool:
        """Return whether the wall can press a point of the vehicle that moves by at most `within_m`.

        If not, update the stored contact state as `touch` would, with the same `faces`.
        """

        def held(number: int) -> bool:
            return any(face is not self and face.holds(number, q, position) for face in faces)

        end = self.plane.half_length_m + within_m
        feet = list(self._foot_points(q, position))
        if any(
            abs(along) <= end
            and height <= within_m
            and not (i in self.beside and (height < -within_m or held(i)))
            for i, height, along in feet
        ) or any(near.x_m <= within_m for _, near in self.nearest(q, position)):
            return True
        for i, height, along in feet:
            self._note_side(i, height, along, held)
        self.bearing = set()
        for edge in self.edges:
            edge.share, edge.stood_in = None, False
        return False

    def nearest(self, q: Quaternion, position: Vec3) -> Iterator[tuple[CylinderContact, NearestPoint]]:
        for edge in self.edges:
            yield edge, nearest_point(self._corners, q, position, edge.cylinder)

    def _note_side(self, i: int, height: float, along: float, held: Callable[[int], bool]) -> None:
        """Update `beside` for a guard; a guard that another face holds stays in `beside`."""
        if height > 0.0:
            if i in self.beside and not held(i):
                self.beside.discard(i)
        elif abs(along) > self.plane.half_length_m:
            self.beside.add(i)

    def touch(
        self, c: Coefficients, motion: BodyMotion, law: GuardLaw, faces: Sequence[WallWithEnds] = ()
    ) -> WallLoad:
        """Return force and torque on the vehicle; `motion` is in NED.

        While every guard stays between the wall's ends, the result equals `propeller_guards.touch`, up to
        rounding.

        Args:
            c: coefficients for the surface; an edge has its own.
            faces: the walls near the vehicle; this wall may be one of them.
        """
        plane, n = self.plane, self.plane.normal

        def held(number: int) -> bool:
            return any(face is not self and face.holds(number, motion.q, motion.position) for face in faces)

        half = _scaled(c, 0.5)
        points: list[ContactPoint] = []
        pressed: set[int] = set()
        self.depths = [0.0] * len(self._guards)
        for i, height, along in self._foot_points(motion.q, motion.position):
            self._note_side(i, height, along, held)
            if abs(along) > plane.half_length_m or height > NEAR_M or i in self.beside:
                continue
            point = ContactPoint(self._guards[i], n, plane.tangent, height, half)
            if _force(point, motion, law.onset) > 0.0:
                points.append(point)
                pressed.add(i)
                self.depths[i] = max(0.0, -height)
        loaded = []
        for edge, near in sorted(
            self.nearest(motion.q, motion.position), key=lambda one: one[0].share is None
        ):
            numbers = {number for number, _ in near.deflections}
            borne = not pressed.isdisjoint(numbers) or (near.x_m <= NEAR_M and any(map(held, numbers)))
            edge_point = edge.point(near, edge.coefficients or c, borne)
            if edge_point is None:
                continue
            force = _force(edge_point, motion, law.onset)
            edge.settle(near, force)
            if force > 0.0:
                points.append(edge_point)
                pressed |= numbers  # a bar that is wider than the wall rests on the first edge only
                loaded.append((near, force))
        self.bearing = pressed
        for near, force in loaded:
            _update_deflections(self.depths, near, force)
        if not points:
            return NO_LOAD
        return _press(points, motion, law)[0]

    def _foot_points(self, q: Quaternion, position: Vec3) -> Iterator[tuple[int, float, float]]:
        """Yield each guard's index, distance in front of the surface, and offset from the wall's middle."""
        o = self.plane.point
        offset = (position[0] - o[0], position[1] - o[1], position[2] - o[2])
        n, t = rotate_back(q, self.plane.normal), rotate_back(q, self.plane.tangent)
        height, along = _dot(self.plane.normal, offset), _dot(self.plane.tangent, offset)
        for i, guard in enumerate(self._guards):
            yield i, height + _dot(n, guard.at), along + _dot(t, guard.at)

    def _foot_point(self, number: int, q: Quaternion, position: Vec3) -> tuple[float, float]:
        x, y, z = add(position, rotate(q, self._guards[number].at))
        px, py, pz = self.plane.point
        offset = (x - px, y - py, z - pz)
        return _dot(self.plane.normal, offset), _dot(self.plane.tangent, offset)


def _force(point: ContactPoint, motion: BodyMotion, onset: Onset) -> float:
    n = rotate_back(motion.q, point.normal)
    closing = _dot(point.normal, motion.velocity) + _dot(n, _cross(motion.rate_frd, point.guard.at))
    return normal_force(point.c, onset, point.x_m, closing)


def _press(points: Sequence[ContactPoint], motion: BodyMotion, law: GuardLaw) -> tuple[WallLoad, list[float]]:
    forces = [_force(point, motion, law.onset) for point in points]
    total = sum_in_order(forces)
    if not total > 0.0:
        return NO_LOAD, forces
    force = torque = (0.0, 0.0, 0.0)
    friction = 0.0
    _, velocity, q, rate_frd = motion
    down = rotate_back(q, _DOWN)
    for point, push in zip(points, forces, strict=True):
        (nx, ny, nz), (tx, ty, tz) = point.normal, point.tangent
        n, t = rotate_back(q, point.normal), rotate_back(q, point.tangent)
        slip = _dot(point.tangent, velocity) + _dot(t, _cross(rate_frd, point.guard.friction_at))
        rub = -point.c.mu * push * slip
        lift = law.vertical_sign * point.c.nu * push / (1.0 + total)
        friction += rub
        force = (
            force[0] + push * nx + rub * tx,
            force[1] + push * ny + rub * ty,
            force[2] + push * nz + rub * tz + lift,
        )
        pushed, rubbed, lifted = (
            _cross(point.guard.at, n),
            _cross(point.guard.friction_at, t),
            _cross(n, down),
        )
        lever = -law.vertical_lever_m * lift
        torque = (
            torque[0] + push * pushed[0] + rub * rubbed[0] + lever * lifted[0],
            torque[1] + push * pushed[1] + rub * rubbed[1] + lever * lifted[1],
            torque[2] + push * pushed[2] + rub * rubbed[2] + lever * lifted[2],
        )
    strongest = points[max(range(len(points)), key=forces.__getitem__)]
    return WallLoad(force, torque, total, friction, strongest.normal), forces


def _bar_load(first: Corner, second: Corner, s: float) -> tuple[float, tuple[tuple[int, float], ...]]:
    """Return the share of k and f at a point of a bar, and each guard's deflection per metre of depth."""
    loads = [(first, 1.0 - s), (second, s)]
    share = 0.5 / sum_in_order(load * load / len(corner.numbers) for corner, load in loads)
    return share, tuple(
        (number, 2.0 * share * load / len(corner.numbers))
        for corner, load in loads
        if load > 0.0
        for number in corner.numbers
    )


def _update_deflections(depths: list[float], near: NearestPoint, force_n: float) -> None:
    if force_n > 0.0 and near.x_m < 0.0:
        for number, per_depth in near.deflections:
            depths[number] = max(depths[number], -near.x_m * per_depth)


def _scaled(c: Coefficients, share: float) -> Coefficients:
    return Coefficients(share * c.k, share * c.f, c.mu, c.nu)


def _interpolate(a: Vec3, b: Vec3, s: float) -> Vec3:
    return (a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2]))


def _direction(x: float, y: float) -> Vec3:
    length = math.hypot(x, y)
    return (x / length, y / length, 0.0) if length > 0.0 else (1.0, 0.0, 0.0)


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
