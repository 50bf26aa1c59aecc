"""Probes, and hits of walls that are found or anchored in flight: what can be judged on the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dart_flight.base.records import Mode
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.probes import Probe
from dart_flight.contact import contact_map
from dart_flight.contact.law import Onset
from dart_flight.core.mission.anchors import SAME_NORMAL
from dart_flight.core.mission.wall_uncertainty import SURE_SD, position_margin_m

_LEAST_FLEXIBLE_M_S = 0.3  # slower, flexible arms push too little to be told from noise


def check_probe(mission: Mission, collision: Collision, probe: Probe) -> Iterator[CheckFinding]:
    """Whether a probe's hit is felt and borne, and the probe long enough for a wall of the mission."""
    wall, item = collision.wall, f"probe_{collision.index}"
    (bx, by), (ex, ey) = probe.begin, probe.end
    length_m = math.hypot(ex - bx, ey - by)
    way = f"wall {wall.name} is looked for from ({bx:.2f}, {by:.2f}) to ({ex:.2f}, {ey:.2f})"
    if collision.mode is Mode.FLEXIBLE and probe.speed_m_s < _LEAST_FLEXIBLE_M_S:
        says = f"{way} at {probe.speed_m_s:g} m/s: too gentle to be felt with flexible arms; rigid, or "
        yield CheckFinding(item, False, f"{says}{_LEAST_FLEXIBLE_M_S:g} m/s")
        return
    force_n, limit_n = _largest_force_n(mission, collision, probe), mission.limits.peak_force_n
    surface = f"on {wall.material}" if wall.material_known else "on the stiffest surface of the table"
    says = f"{way} at {probe.speed_m_s:g} m/s, at most {force_n:.0f} N {surface}"
    if force_n > limit_n:
        yield CheckFinding(item, False, f"{says}, over limits.peak_force_n {limit_n:g}")
        return
    if not wall.sought and collision.impact_point is not None:
        reach_m = length_m - math.dist(probe.begin, collision.impact_point)
        margin_m = float(position_margin_m(wall, collision.impact_point))
        if reach_m < margin_m:
            says += f"; it ends {reach_m:.2f} m behind the plane, which may stand {margin_m:.2f} m further "
            yield CheckFinding(item, True, f"{says}({SURE_SD:g} sd)", remark=True)
            return
    yield CheckFinding(item, True, f"{says}, limit {limit_n:g} N")


def _largest_force_n(mission: Mission, collision: Collision, probe: Probe) -> float:
    """Of a square hit in the probe's mode: on the wall's material, else on any of the table."""
    vehicle, wall = mission.vehicle, collision.wall
    names = [wall.material] if wall.material_known else list(vehicle.materials)
    mass_kg, onset = vehicle.airframe.mass_kg, Onset(vehicle.onset)
    hits = (
        contact_map.collide(vehicle.materials[name].of(collision.mode), mass_kg, -probe.speed_m_s, 0.0, onset)
        for name in names
    )
    return max(float(hit.peak_normal_force_n) for hit in hits)


def check_found(collision: Collision) -> Iterator[CheckFinding]:
    """A hit of a wall that a probe looks for."""
    assert collision.approach_m_s is not None
    says = f"wall {collision.wall.name} is hit at {math.hypot(*collision.approach_m_s):.2f} m/s once a probe "
    says += "has found it; room for the run-up is judged then"
    yield CheckFinding(f"approach_{collision.index}", True, says)


def check_anchors(mission: Mission) -> Iterator[CheckFinding]:
    """Whether walls that are hit where the frame drifts, or parallel ones, have been touched before."""
    if not mission.is_anchored:
        return
    touched: list[Collision] = []
    for collision in mission.collisions:
        item, (nx, ny) = f"anchor_{collision.index}", collision.wall.normal
        by = [c for c in touched if abs(c.wall.normal[0] * nx + c.wall.normal[1] * ny) >= SAME_NORMAL]
        if collision.probe is None and by:
            says = f"collision {by[-1].index} puts the frame right along {collision.wall.name}'s normal"
            yield CheckFinding(item, True, f"{says} before it is hit")
        elif collision.probe is None:
            says = (
                f"wall {collision.wall.name} is hit without a probe before that puts the frame right along "
            )
            yield CheckFinding(item, False, f"{says}its normal: touch it, or a parallel wall, first")
        if not collision.wall.sought:
            touched.append(collision)
