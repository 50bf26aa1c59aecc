"""The mission of a batch: the series' mission with several hits on one wall, each from rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.lab.identify.next_hits import ModeFit, NextHit, NextHitLimits, next_hits
from dart_flight.lab.series.series_file import SeriesSettings
from dart_flight.lab.series.status import SeriesStatus, hit_limits
from dart_flight.run.prepare import refuse_unflyable

_HOLD_S: Final = 1.0  # rest before each approach, in which PX4's velocity settles
_ALPHA: Final = (0.025, 0.025)  # gains of a recovery that leads away from the wall, m/N
_SLOWER: Final = 0.85  # factor on the largest speed if a batch does not fit into the room
HitChoice = Callable[[Mapping[Mode, ModeFit], NextHitLimits, int], list[NextHit]]
_REPLACED: Final = ("predicted", "flown", "goal_trajectory", "collisions", "waypoints", "after_impact")


class SeriesBatch(NamedTuple):
    """A planned batch: its hits in the order of flight, the keys of its mission, and the mission."""

    hits: list[NextHit]
    tree: dict[str, Any]
    mission: Mission


def plan_batch(
    settings: SeriesSettings,
    mission: Mission,
    status: SeriesStatus,
    name: str,
    choose: HitChoice = next_hits,
) -> SeriesBatch:
    """Return the next batch; if the room is too small for a run-up, all hits become slower.

    Modes whose aims are reached are left out, unless all are reached. `choose` chooses the hits.

    Raises:
        FlightError: no hit is below the force limit, or the room has no space for any.
    """
    limits = hit_limits(settings, mission)
    fits = {mode: status.modes[mode.value].fit for mode in settings.modes}
    missing = {mode: fit for mode, fit in fits.items() if status.modes[mode.value].more_hits != 0}
    refusal = (
        f"no hit at {limits.slowest_m_s:g} m/s or more stays below {limits.peak_n:.0f} N (0.8 of the force "
        "limit) by the upper end of the interval: reduce speeds_m_s in series.yaml"
    )
    while limits.fastest_m_s >= limits.slowest_m_s:
        hits = choose(missing or fits, limits, settings.hits_per_flight)
        if not hits:
            break
        tree = batch_tree(mission, settings.wall, hits, name, settings.peak_force_n)
        try:
            planned = parse_mission(Document.from_tree(tree), mission.vehicle_as_written())
            refuse_unflyable(planned)
            return SeriesBatch(hits, tree, planned)
        except InputError as error:
            refusal = f"no batch fits into the room: {error.message}"
        limits = limits._replace(fastest_m_s=_SLOWER * limits.fastest_m_s)
    raise FlightError(refusal)


def batch_tree(
    mission: Mission, wall: str, hits: Sequence[NextHit], name: str, peak_force_n: float
) -> dict[str, Any]:
    """Return the keys of a mission that hits one wall, with a retreat and a hold between two hits.

    Frame, bounds, walls and limits are those of `mission`. The vehicle waits at the mission's start between
    two hits. Each hit has a limit of the measured peak, so that an unexpectedly hard hit ends the batch.
    """
    assert mission.written is not None
    known = {one.name: one for one in mission.flat_walls}
    if wall not in known:
        raise InputError(f"no wall {wall!r} in the mission; it has {', '.join(known)}", key=("wall",))
    limit_n = min(peak_force_n, mission.limits.peak_force_n)
    collisions = [
        {
            "wall": wall,
            "mode": hit.mode.value,
            "approach": {
                "normal_m_s": round(hit.normal_m_s, 3),
                "tangential_m_s": round(hit.tangential_m_s, 3),
            },
            "impact_along_m": _along_m(mission, known[wall], hit),
            "alpha_wall_m_per_n": list(_ALPHA),
            "peak_limit_n": round(min(hit.highest_n, limit_n), 1),
        }
        for hit in hits
    ]
    waypoints = [
        {"after": i, "position_m": list(mission.start), "hold_s": _HOLD_S} for i in range(1, len(hits) + 1)
    ]
    kept = {key: value for key, value in mission.written.tree.items() if key not in _REPLACED}
    goal = {**kept["goal"], "position_m": list(mission.start)}
    return {**kept, "name": name, "goal": goal, "collisions": collisions, "waypoints": waypoints}


def _along_m(mission: Mission, wall: Wall, hit: NextHit) -> float:
    """Return the impact point along the wall, m from its middle: opposite the start, as far as it fits."""
    reach = max(0.0, 0.5 * wall.length_m - mission.vehicle.airframe.contact_distance_m - 0.1)
    run_up_m = wall.signed_distance(mission.start)
    drift_m = run_up_m * hit.tangential_m_s / -hit.normal_m_s if hit.normal_m_s else 0.0
    along = wall.along(mission.start) + 0.5 * drift_m
    return round(math.copysign(min(abs(along), reach), along), 3)
