"""The source of PX4's position, and the source's consequences for a mission with walls."""

from __future__ import annotations

from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource

PLAIN_GPS = (
    "plain GPS drifts by a metre within a flight, so wall positions are wrong by a metre; a mission with "
    "walls needs RTK, motion capture or `frame: {anchored_by: touch}`"
)


def effective_source(mission: Mission, source: PositionSource) -> PositionSource:
    """Return the position source, with plain GPS replaced by `anchored` if contacts correct the frame."""
    return PositionSource.ANCHORED if source is PositionSource.PLAIN and mission.is_anchored else source


def simulated_source(mission: Mission) -> PositionSource:
    """Return the source of the embedded autopilot's position, from the vehicle's configuration."""
    return effective_source(mission, PositionSource(mission.vehicle.simulation.position_from))


def frame_problem(mission: Mission, source: PositionSource) -> str | None:
    """Return the reason why a mission's frame is not valid with a position source, or None.

    With GPS, PX4's local origin is where PX4 was powered on. The mission's frame must then be at the take-off
    point, or the mission must start at the local origin.
    """
    spec = mission.frame
    surveyed = spec.origin == "local" and (
        mission.start != (0.0, 0.0) or spec.north_m != 0.0 or spec.east_m != 0.0
    )
    if source is PositionSource.MOCAP or not surveyed:
        return None
    return (
        "with GPS, PX4's local origin is where PX4 was powered on, so surveyed coordinates do not "
        "apply; use frame: {origin: takeoff}"
    )
