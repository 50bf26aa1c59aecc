"""The checks of probes, of walls that a probe finds in flight, and of contacts that correct the frame."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import Mode
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.probes import Probe
from dart_flight.contact import contact_map
from dart_flight.contact.law import Onset
from dart_flight.core.mission.anchors import has_same_normal
from dart_flight.core.mission.approach import NoApproachError, plan_approach
from dart_flight.core.mission.course import ARRIVED_S
from dart_flight.core.mission.trajectories import transit_time_s
from dart_flight.core.mission.wall_uncertainty import SURE_SD, position_margin_m

_REST_S, _RECOVERY_S = 1.5, 1.5  # assumed times from a contact to rest and from a contact to the next wall
_LEAST_FLEXIBLE_M_S = 0.3  # minimum speed; at a lower speed, the force of flexible arms is below the noise


def check_probe(mission: Mission, collision: Collision, probe: Probe) -> Iterator[CheckFinding]:
    """Check that a probe's contact is detectable, stays below the force limit and reaches the wall."""
    wall, item = collision.wall, f"probe_{collision.index}"
    (bx, by), (ex, ey) = probe.begin, probe.end
    length_m = math.hypot(ex - bx, ey - by)
    way = f"the vehicle probes for wall {wall.name} from ({bx:.2f}, {by:.2f}) to ({ex:.2f}, {ey:.2f})"
    if collision.mode is Mode.FLEXIBLE and probe.speed_m_s < _LEAST_FLEXIBLE_M_S:
        message = (
            f"{way} at {probe.speed_m_s:g} m/s: too slow to detect a contact with flexible arms; probe "
            "rigid or "
        )
        yield CheckFinding(item, False, f"{message}at {_LEAST_FLEXIBLE_M_S:g} m/s")
        return
    force_n, limit_n = _largest_force_n(mission, collision, probe), mission.limits.peak_force_n
    surface = f"on {wall.material}" if wall.material_known else "on the stiffest known material"
    message = f"{way} at {probe.speed_m_s:g} m/s, at most {force_n:.0f} N {surface}"
    if force_n > limit_n:
        yield CheckFinding(item, False, f"{message}, limits.peak_force_n is {limit_n:g} N")
        return
    if not wall.sought and collision.impact_point is not None:
        reach_m = length_m - math.dist(probe.begin, collision.impact_point)
        margin_m = float(position_margin_m(wall, collision.impact_point))
        if reach_m < margin_m:
            message += (
                f"; the probe ends {reach_m:.2f} m behind the planned wall, but the wall may be "
                f"{margin_m:.2f} m farther away ({SURE_SD:g} standard deviations)"
            )
            yield CheckFinding(item, True, message, remark=True)
            return
    yield CheckFinding(item, True, f"{message}, limit {limit_n:g} N")


def _largest_force_n(mission: Mission, collision: Collision, probe: Probe) -> float:
    """Return the peak normal force of a perpendicular contact in the probe's mode, N.

    If the wall's material is unknown, the result is the largest force over all materials of the vehicle.
    """
    vehicle, wall = mission.vehicle, collision.wall
    names = [wall.material] if wall.material_known else list(vehicle.materials)
    mass_kg, onset = vehicle.airframe.mass_kg, Onset(vehicle.onset)
    hits = (
        contact_map.collide(
            vehicle.materials[name].coefficients(collision.mode), mass_kg, -probe.speed_m_s, 0.0, onset
        )
        for name in names
    )
    return max(float(hit.peak_normal_force_n) for hit in hits)


def check_located_wall(collision: Collision) -> Iterator[CheckFinding]:
    """Describe a collision with a wall that a probe locates in flight."""
    assert collision.approach_m_s is not None
    message = (
        f"a probe locates wall {collision.wall.name}; the vehicle then checks the space for the run-up, and "
        f"hits the wall at {math.hypot(*collision.approach_m_s):.2f} m/s"
    )
    yield CheckFinding(f"approach_{collision.index}", True, message)


def check_anchors(mission: Mission) -> Iterator[CheckFinding]:
    """If the frame drifts, check that contacts correct it along each wall's normal before the hit."""
    if not mission.is_anchored:
        return
    touched: list[Collision] = []
    times = _hit_times_s(mission)
    for collision in mission.collisions:
        item = f"anchor_{collision.index}"
        by = [c for c in touched if has_same_normal(c.wall.normal, collision.wall.normal)]
        if collision.probe is None and by:
            age_s = times[collision.index] - times[by[-1].index]
            sd_m = age_s * mission.vehicle.estimation.position_drift_m_s
            message = (
                f"collision {by[-1].index} corrects the frame along the normal of wall {collision.wall.name} "
                f"about {age_s:.0f} s before the impact on this wall; at the impact, the wall's position is "
                f"known to {sd_m:.2f} m (1 sd)"
            )
            yield CheckFinding(item, True, message, figures={"age_s": age_s, "sd_m": sd_m})
        elif collision.probe is None:
            message = (
                "no earlier contact corrects the frame along the normal of wall "
                f"{collision.wall.name}: touch this wall or a parallel wall first"
            )
            yield CheckFinding(item, False, message)
        if not collision.wall.sought:
            touched.append(collision)


def _hit_times_s(mission: Mission) -> dict[int, float]:
    """Return the approximate time of each collision by index, seconds from the start of the first run-up."""
    times, now_s = {}, 0.0
    flying = mission.vehicle.flying
    here: Vec2 | None = None
    for collision in mission.collisions:
        lock = mission.vehicle.lock
        switch_s = 0.0 if lock is None else lock.switch_time_s
        if collision.approach_m_s is None:
            now_s += _RECOVERY_S
        else:
            try:
                approach = plan_approach(mission, collision)
            except NoApproachError:  # the check `check_collisions` reports this error
                return dict.fromkeys((c.index for c in mission.collisions), math.nan)
            way_m = 0.0 if here is None else math.dist(here, approach.begin[:2])
            transit_s = transit_time_s(
                way_m, flying.transit_speed_m_s, flying.acceleration_m_s2, flying.jerk_m_s3
            )
            met_s = approach.duration_s
            if collision.probe is not None:
                assert collision.impact_point is not None
                way_to_m = math.dist(approach.begin[:2], collision.impact_point)
                met_s = way_to_m / collision.probe.speed_m_s + 0.5
            now_s += (_REST_S if here is not None else 0.0) + transit_s + ARRIVED_S + switch_s + met_s
        times[collision.index] = now_s
        if collision.impact_point is not None:
            back_m = collision.probe.back_m if collision.probe is not None else 0.0
            (x, y), (nx, ny) = collision.impact_point, collision.wall.normal
            here = (x + back_m * nx, y + back_m * ny)
    return times
