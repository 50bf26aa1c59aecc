"""Construction of setpoints from a reference, a set of free horizontal axes, and an added acceleration.

On a free axis the setpoint is the measured motion, so that PX4 does not push along this axis. Only the
acceleration still comes from the reference.
"""

from __future__ import annotations

from typing import NamedTuple

from dart_flight.base.geometry import MissionFrame, Vec2, Vec3
from dart_flight.base.records import Setpoint


class SetpointTrigger(NamedTuple):
    """The input that triggers a setpoint: its stamp, its receipt, and whether it is the peak of an impact."""

    t_us: int
    received_us: int
    recovery: bool = False


class Reference(NamedTuple):
    """Position, velocity and acceleration to command, mission frame.

    Without a velocity, PX4 treats the position as a step. PX4 accepts an acceleration only with a velocity.
    """

    position: Vec3
    velocity: Vec3 | None = None
    acceleration: Vec3 = (0.0, 0.0, 0.0)


class FreeAxes(NamedTuple):
    """Horizontal directions in which the setpoint is the measured motion, so that PX4 does not push.

    Attributes:
        along: unit vectors of the free directions, mission frame: none, the normal of a wall, or both axes.
        position, velocity: measured motion, extrapolated to the time at which PX4 executes the setpoint.
    """

    along: tuple[Vec2, ...]
    position: Vec3
    velocity: Vec3


BOTH: tuple[Vec2, ...] = ((1.0, 0.0), (0.0, 1.0))


def make_setpoint(
    frame: MissionFrame,
    trigger: SetpointTrigger,
    reference: Reference,
    yaw: float,
    free: FreeAxes | None = None,
    added: Vec3 | None = None,
) -> Setpoint:
    """Return the setpoint of a reference, in PX4's local frame.

    Args:
        yaw: heading, mission frame, rad.
        added: acceleration in addition to the reference's, mission frame, m/s2.
    """
    position, velocity, acceleration = reference
    if free is not None:
        velocity = (0.0, 0.0, 0.0) if velocity is None else velocity
        for nx, ny in free.along:
            off = (free.position[0] - position[0]) * nx + (free.position[1] - position[1]) * ny
            off_m_s = (free.velocity[0] - velocity[0]) * nx + (free.velocity[1] - velocity[1]) * ny
            position = (position[0] + off * nx, position[1] + off * ny, position[2])
            velocity = (velocity[0] + off_m_s * nx, velocity[1] + off_m_s * ny, velocity[2])
    elif velocity is None and added is not None:
        velocity = (0.0, 0.0, 0.0)
    if added is not None:
        (ax, ay, az), (bx, by, bz) = acceleration, added
        acceleration = (ax + bx, ay + by, az + bz)
    return Setpoint(
        t_us=trigger.t_us,
        trigger_received_us=trigger.received_us,
        position_ned=frame.point_to_ned(position),
        yaw_ned_rad=frame.yaw_to_ned(yaw),
        velocity_ned=None if velocity is None else frame.vector_to_ned(velocity),
        acceleration_ned=None if velocity is None else frame.vector_to_ned(acceleration),
        recovery=trigger.recovery,
    )
