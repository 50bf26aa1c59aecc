"""The vehicle as a body, its motors and its IMU, and the materials that it meets."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated

import msgspec
from msgspec import Meta

from dart_flight.config.section import Fraction, Section
from dart_flight.samples import Mode

Drag = Annotated[float, Meta(ge=0.0, le=10.0)]
Inertia = Annotated[float, Meta(gt=0.0, le=10.0)]
Lever = Annotated[float, Meta(ge=-1.0, le=1.0)]

# Motors in PX4's order for a quadrotor in X, FRD: sign of x, sign of y, direction of the yaw torque.
MOTORS: tuple[tuple[int, int, int], ...] = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))


class Motor(msgspec.Struct, frozen=True):
    """One motor of an airframe.

    Attributes:
        x_m, y_m: position, FRD, metres from the centre of mass.
        yaw_m: yaw torque in N m per newton of thrust; positive for a propeller that turns counter-clockwise
            seen from above (PX4's CA_ROTORn_KM).
    """

    x_m: float
    y_m: float
    yaw_m: float


class Airframe(Section, frozen=True):
    """The vehicle as a body.

    Attributes:
        mass_kg: of the vehicle as it flies, battery included.
        contact_distance_m: from the centre of mass to the wall's plane at the first contact.
        incidence_rigid_deg: from this angle of incidence on the arms cannot fold: rigid values in both modes.
        drag_per_s: [b_x, b_y, b_z] along the mission's axes: acceleration by air drag = -b * air speed.
        inertia_kg_m2: about [forward, right, down]; `calibrate inertia` fits it.
        arm_x_m: motor to centre of mass, forward.
        arm_y_m: motor to centre of mass, sideways.
        yaw_torque_per_thrust_m: drag torque of a propeller over its thrust, N m per N.
        guard_along_m: from the middle of a side to either of the two points that touch a wall first.
    """

    mass_kg: Annotated[float, Meta(ge=0.05, le=50.0)]
    contact_distance_m: Annotated[float, Meta(ge=0.0, le=2.0)]
    incidence_rigid_deg: Annotated[float, Meta(ge=0.0, le=45.0)]
    drag_per_s: tuple[Drag, Drag, Drag]
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    arm_x_m: Annotated[float, Meta(ge=0.01, le=2.0)]
    arm_y_m: Annotated[float, Meta(ge=0.01, le=2.0)]
    yaw_torque_per_thrust_m: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.016
    guard_along_m: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.13

    @property
    def motors(self) -> tuple[Motor, ...]:
        """The four motors in PX4's order for a quadrotor in X."""
        return tuple(
            Motor(sx * self.arm_x_m, sy * self.arm_y_m, spin * self.yaw_torque_per_thrust_m)
            for sx, sy, spin in MOTORS
        )


class Thrust(Section, frozen=True):
    """Thrust of one motor: full_n * (factor u² + (1 - factor) u), u from 0 to 1, with first-order lag.

    Attributes:
        full_n: at full command, at the voltage estimation.battery.reference_v.
        model_factor: share of the square term, PX4's THR_MDL_FAC.
        motor_lag_s: time constant of motor and propeller.
    """

    full_n: Annotated[float, Meta(ge=0.1, le=500.0)]
    model_factor: Fraction
    motor_lag_s: Annotated[float, Meta(ge=0.0, le=1.0)]

    def force_n(self, command: float) -> float:
        """Steady thrust in newton of one motor at a command from 0 to 1."""
        return self.forces_n((command,))[0]

    def forces_n(self, commands: Iterable[float]) -> list[float]:
        """Steady thrust in newton of each motor: the plant asks for all four at once, every millisecond."""
        full, square = self.full_n, self.model_factor
        linear = 1.0 - square
        forces = []
        for command in commands:
            u = 0.0 if command < 0.0 else 1.0 if command > 1.0 else command
            forces.append(full * (square * u * u + linear * u))
        return forces

    def command_for(self, force_n: float) -> float:
        """The command from 0 to 1 that gives a steady thrust; saturates."""
        return self.commands_for((force_n,))[0]

    def commands_for(self, forces_n: Iterable[float]) -> list[float]:
        """The command of each motor for a steady thrust in newton."""
        full, a = self.full_n, self.model_factor
        relative = [max(0.0, min(1.0, force / full)) for force in forces_n]
        if a < 1e-6:
            return relative
        b = 1.0 - a
        return [float((-b + (b * b + 4.0 * a * share) ** 0.5) / (2.0 * a)) for share in relative]


class Imu(Section, frozen=True):
    """What the IMU can read.

    Attributes:
        full_scale_m_s2: largest reading of the accelerometer on each axis, either sign.
        rate_hz: of the samples that PX4 sends.
        tick_s: time over which one sample is averaged.
        antialias_hz: -3 dB frequency of the accelerometer's own low-pass, first order.
        position_m: [forward, right, down] of the centre of mass; what turning adds there is taken off.
    """

    full_scale_m_s2: Annotated[float, Meta(ge=10.0, le=5000.0)]
    rate_hz: Annotated[float, Meta(ge=10.0, le=10000.0)]
    tick_s: Annotated[float, Meta(gt=0.0, le=0.1)]
    antialias_hz: Annotated[float, Meta(ge=1.0, le=20000.0)]
    position_m: tuple[Lever, Lever, Lever] = (0.0, 0.0, 0.0)

    @property
    def filter_lag_s(self) -> float:
        """How far the accelerometer's own low-pass is behind: the delay of a first-order filter."""
        return 0.5 / (math.pi * self.antialias_hz)

    @property
    def reading_lag_s(self) -> float:
        """How far before its stamp the middle of a reading lies: half a tick and the filter's lag."""
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


class Material(Section, frozen=True):
    """Contact coefficients of one material.

    Attributes:
        rigid: with the arms locked.
        flexible: with the arms free.
        source: where the numbers come from, and whether they are measured or assumed.
    """

    rigid: Coefficients
    flexible: Coefficients
    source: str = ""

    def of(self, mode: Mode) -> Coefficients:
        """The coefficients of a mode."""
        return self.rigid if mode is Mode.RIGID else self.flexible
