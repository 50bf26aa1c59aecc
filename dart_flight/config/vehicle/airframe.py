"""The vehicle as a body, its motors and its IMU, and the materials of the walls."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Annotated

import msgspec
from msgspec import Meta

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.section import Fraction, Section
from dart_flight.config.vehicle.motor_curve import MotorCurve

Drag = Annotated[float, Meta(ge=0.0, le=10.0)]
Inertia = Annotated[float, Meta(gt=0.0, le=10.0)]
Lever = Annotated[float, Meta(ge=-1.0, le=1.0)]

# The motors of an X quadrotor in PX4's order, FRD: signs of x, of y and of the yaw torque.
_QUADROTOR_X = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))


class Motor(Section, frozen=True):
    """One motor of an airframe.

    Attributes:
        x_m: position forward of the centre of mass (PX4's CA_ROTORn_PX).
        y_m: position to the right of the centre of mass (PX4's CA_ROTORn_PY).
        yaw_torque_per_thrust_m: drag torque of the propeller over its thrust, N m per N; positive for
            counter-clockwise seen from above (PX4's CA_ROTORn_KM).
    """

    x_m: Annotated[float, Meta(ge=-3.0, le=3.0)]
    y_m: Annotated[float, Meta(ge=-3.0, le=3.0)]
    yaw_torque_per_thrust_m: Annotated[float, Meta(ge=-0.5, le=0.5)]


class Airframe(Section, frozen=True, kw_only=True):
    """The vehicle as a body.

    Attributes:
        mass_kg: take-off mass, battery included.
        contact_distance_m: distance from the centre of mass to the wall's surface at the first contact.
        incidence_rigid_deg: smallest angle of incidence at which unlocked arms do not fold. At this angle and
            above, the rigid coefficients hold in both modes. Unused without a lock.
        drag_per_s: [b_x, b_y, b_z] along the mission's axes: acceleration by air drag = -b * air speed.
        inertia_kg_m2: moments of inertia about [forward, right, down]; `calibrate inertia` fits it.
        arm_x_m: distance of a motor from the centre of mass, forward.
        arm_y_m: distance of a motor from the centre of mass, sideways.
        yaw_torque_per_thrust_m: drag torque of a propeller over its thrust, N m per N.
        guard_along_m: distance from the middle of a side to each of its two guard points, which touch a wall
            first.
        guard_ring_m: radius of a ring around each propeller, for drawings; null: the guard is drawn as an
            octagon through the guard points.
        listed: 4 to 8 motors in PX4's order, for an airframe that is not an X quadrotor (arm_x_m and arm_y_m
            are then null); `calibrate airframe` prints this list.
    """

    mass_kg: Annotated[float, Meta(ge=0.05, le=50.0)]
    contact_distance_m: Annotated[float, Meta(ge=0.0, le=2.0)]
    incidence_rigid_deg: Annotated[float, Meta(ge=0.0, le=45.0)] = 15.0
    drag_per_s: tuple[Drag, Drag, Drag]
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    arm_x_m: Annotated[float, Meta(ge=0.01, le=2.0)] | None = None
    arm_y_m: Annotated[float, Meta(ge=0.01, le=2.0)] | None = None
    yaw_torque_per_thrust_m: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.016
    guard_along_m: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.13
    guard_ring_m: Annotated[float, Meta(gt=0.0, le=2.0)] | None = None
    listed: Annotated[tuple[Motor, ...], Meta(min_length=4, max_length=8)] | None = msgspec.field(
        default=None, name="motors"
    )

    def __post_init__(self) -> None:
        arms = [name for name in ("arm_x_m", "arm_y_m") if getattr(self, name) is not None]
        if self.listed is not None and arms:
            raise ValueError(
                f"{' and '.join(arms)} and motors both define the motor positions: "
                "remove one (or set it to null)"
            )
        if self.listed is None and len(arms) < 2:
            missing = "arm_y_m" if arms == ["arm_x_m"] else "arm_x_m"
            raise ValueError(
                f"missing key {missing}; if the airframe is not an X-shaped quadrotor, give `motors` instead"
            )

    @property
    def motors(self) -> tuple[Motor, ...]:
        """The motors in PX4's order."""
        if self.listed is not None:
            return self.listed
        arm_x_m, arm_y_m = self.arm_x_m or 0.0, self.arm_y_m or 0.0  # checked in __post_init__
        return tuple(
            Motor(sx * arm_x_m, sy * arm_y_m, spin * self.yaw_torque_per_thrust_m)
            for sx, sy, spin in _QUADROTOR_X
        )

    @property
    def guards_m(self) -> list[list[Vec2]]:
        """Outlines of the guards seen from above, (forward, left), m, counter-clockwise.

        They are a ring around each motor, or one octagon. A side of the octagon ends at the two points that
        touch a wall first, `guard_along_m` from its middle and `contact_distance_m` from the centre of mass.
        """
        if self.guard_ring_m is not None:
            radius_m, turns = self.guard_ring_m, [math.tau * k / 24 for k in range(24)]
            return [
                [(m.x_m + radius_m * math.cos(a), radius_m * math.sin(a) - m.y_m) for a in turns]
                for m in self.motors
            ]
        out, along = self.contact_distance_m, self.guard_along_m
        half: list[Vec2] = [(out, along), (along, out), (-along, out), (-out, along)]
        return [half + [(-x, -y) for x, y in half]]

    @property
    def corner_m(self) -> float:
        """Distance from the centre to the farthest corner of the guards, m: the reach at any heading."""
        return math.hypot(self.contact_distance_m, self.guard_along_m)

    def wall_surface(self, wall: Wall) -> Wall:
        """Return a wall's surface: the wall's plane, moved by the contact distance against the normal."""
        return wall.displaced(-self.contact_distance_m)


def effectiveness(motors: Sequence[Motor]) -> list[list[float]]:
    """Return each motor's roll, pitch and yaw torque (FRD) and lift per newton, a column per motor."""
    return [
        [-motor.y_m for motor in motors],
        [motor.x_m for motor in motors],
        [motor.yaw_torque_per_thrust_m for motor in motors],
        [1.0 for _ in motors],
    ]


Command = Annotated[float, Meta(ge=0.0, le=1.0)]
Newton = Annotated[float, Meta(ge=0.0, le=500.0)]


class Thrust(Section, frozen=True):
    """Thrust of a motor with first-order lag: full_n * (model_factor u² + (1 - model_factor) u) or a table.

    The command u is from 0 to 1.

    Attributes:
        motor_lag_s: time constant of motor and propeller.
        full_n: thrust at full command and at the battery voltage estimation.battery.reference_v.
        model_factor: fraction of the square term in the curve, PX4's THR_MDL_FAC.
        table: measured pairs [[command, newton], ...], interpolated linearly (full_n and model_factor are
            then null). Both columns increase, and the last command is 1.
    """

    motor_lag_s: Annotated[float, Meta(ge=0.0, le=1.0)]
    full_n: Annotated[float, Meta(ge=0.1, le=500.0)] | None = None
    model_factor: Fraction | None = None
    table: Annotated[tuple[tuple[Command, Newton], ...], Meta(min_length=2, max_length=200)] | None = None

    def __post_init__(self) -> None:
        given = [name for name in ("full_n", "model_factor") if getattr(self, name) is not None]
        if self.table is None:
            if len(given) < 2:
                missing = "model_factor" if given == ["full_n"] else "full_n"
                raise ValueError(f"missing key {missing}; alternatively, give the measured thrust as `table`")
            return
        if given:
            raise ValueError(
                f"{' and '.join(given)} and table both define the thrust: remove one (or set it to null)"
            )
        points = self._points()
        for (u, n), (v, m) in pairwise(points):
            if v <= u or m <= n:
                raise ValueError(
                    f"table: command and thrust must both rise from [{u:g}, {n:g}] to [{v:g}, {m:g}]"
                )
        if points[-1][0] != 1.0:
            raise ValueError(f"table: the last command is {points[-1][0]:g}: add a row for the command 1")

    def _points(self) -> tuple[tuple[float, float], ...]:
        """Return the table, with a first row of zero command and zero thrust."""
        table = self.table or ()
        return table if table and table[0] == (0.0, 0.0) else ((0.0, 0.0), *table)

    @property
    def max_thrust_n(self) -> float:
        """Thrust at full command."""
        return self.table[-1][1] if self.table is not None else self.full_n or 0.0

    @property
    def square_share(self) -> float:
        """PX4's THR_MDL_FAC: the model factor, or the best fit to the table (least squares)."""
        if self.model_factor is not None:
            return self.model_factor
        # n / most - u = factor (u^2 - u)
        bent = [(u * u - u, n / self.max_thrust_n - u) for u, n in self._points()]
        square = sum(x * x for x, _ in bent)
        return max(0.0, min(1.0, sum(x * y for x, y in bent) / square)) if square > 0.0 else 0.0

    def scaled(self, factor: float) -> Thrust:
        if self.table is not None:
            table = tuple((u, n * factor) for u, n in self.table)
            return Thrust(self.motor_lag_s, table=table)
        return Thrust(self.motor_lag_s, self.max_thrust_n * factor, self.model_factor)

    @property
    def curve(self) -> MotorCurve | None:
        """The curve from full_n and model_factor, or None if a table defines the thrust."""
        if self.full_n is None or self.model_factor is None:
            return None
        return MotorCurve(self.full_n, self.model_factor)

    def force_n(self, command: float) -> float:
        """Return the steady thrust of one motor at a command from 0 to 1, newton."""
        return self.forces_n((command,))[0]

    def forces_n(self, commands: Iterable[float]) -> list[float]:
        curve = self.curve
        if curve is not None:
            return [curve.force_n(command) for command in commands]
        points = self._points()
        return [_interpolate(points, max(0.0, min(1.0, command)), 0) for command in commands]

    def command_for(self, force_n: float) -> float:
        """Return the command, 0 to 1, for a steady thrust; commands outside this range are clipped."""
        return self.commands_for((force_n,))[0]

    def commands_for(self, forces_n: Iterable[float]) -> list[float]:
        curve = self.curve
        if curve is not None:
            return [curve.command_for(force) for force in forces_n]
        points, most = self._points(), self.max_thrust_n
        return [_interpolate(points, max(0.0, min(most, force)), 1) for force in forces_n]


def _interpolate(points: tuple[tuple[float, float], ...], x: float, given: int) -> float:
    """Return the other coordinate of a rising polyline at value `x` of coordinate `given` (0 or 1)."""
    i = max(1, bisect_left(points, x, key=itemgetter(given)))
    before, after = points[i - 1], points[i]
    share = (x - before[given]) / (after[given] - before[given])
    return before[1 - given] + share * (after[1 - given] - before[1 - given])


class Imu(Section, frozen=True):
    """Properties of the IMU.

    Attributes:
        full_scale_m_s2: largest magnitude that the accelerometer can read on each axis.
        rate_hz: rate of the samples that PX4 sends.
        tick_s: time over which one sample is averaged.
        antialias_hz: -3 dB frequency of the accelerometer's own low-pass, first order.
        position_m: position of the IMU relative to the centre of mass, [forward, right, down]. With this
            position the force estimate removes the accelerations that the vehicle's rotation causes at the
            IMU.
    """

    full_scale_m_s2: Annotated[float, Meta(ge=10.0, le=5000.0)]
    rate_hz: Annotated[float, Meta(ge=10.0, le=10000.0)]
    tick_s: Annotated[float, Meta(gt=0.0, le=0.1)]
    antialias_hz: Annotated[float, Meta(ge=1.0, le=20000.0)]
    position_m: tuple[Lever, Lever, Lever] = (0.0, 0.0, 0.0)

    @property
    def filter_lag_s(self) -> float:
        """Delay of the accelerometer's first-order low-pass."""
        return 0.5 / (math.pi * self.antialias_hz)

    @property
    def reading_lag_s(self) -> float:
        """Time from the middle of a reading to its stamp: half a tick and the filter's delay."""
        return 0.5 * self.tick_s + self.filter_lag_s


class Coefficients(Section, frozen=True):
    """Contact coefficients of one material in one mode (paper, Sec. IV-B and V-A).

    Attributes:
        k: stiffness, N/m.
        f: damping, N s/m.
        mu: friction, s/m (friction force = mu * normal force * tangential speed).
        nu: bound of the vertical contact force, N.
    """

    k: Annotated[float, Meta(ge=1.0, le=1000000.0)]
    f: Annotated[float, Meta(ge=0.0, le=10000.0)]
    mu: Annotated[float, Meta(ge=0.0, le=100.0)]
    nu: Annotated[float, Meta(ge=0.0, le=1000.0)]

    @property
    def lead_s(self) -> float:
        """Time from the onset of the force (k x + f vx = 0) until the vehicle reaches the plane, seconds.

        At the plane x is 0. The velocity is assumed constant.
        """
        return self.f / self.k

    def scaled(self, k: float, f: float, mu: float, nu: float = 1.0) -> Coefficients:
        """Return each coefficient multiplied by its factor, for a wall that differs from the table."""
        return Coefficients(self.k * k, self.f * f, self.mu * mu, self.nu * nu)


class Material(Section, frozen=True):
    """Contact coefficients of one material.

    Attributes:
        rigid: coefficients with the arms locked; a vehicle without a lock uses only these.
        flexible: coefficients with the arms unlocked; required for a vehicle with a lock.
        source: origin of the numbers; states whether they are measured or assumed.
    """

    rigid: Coefficients
    flexible: Coefficients | None = None
    source: str = ""

    def coefficients(self, mode: Mode) -> Coefficients:
        """Return the coefficients of a mode; the vehicle must have this mode, as the loader has checked."""
        if mode is Mode.RIGID:
            return self.rigid
        assert self.flexible is not None
        return self.flexible
