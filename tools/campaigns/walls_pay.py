"""Campaign: whether a flight with collisions is faster than the fastest one without, planned and flown.

Places, walls and tolerances of a map (docs/results/walls_pay.md) follow from its number, before anything is
planned. Both plans are flown by the same app in the same drawn world.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from dart_flight.base.summary import cause_of
from dart_flight.config.document import Document
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.search.mission_writer import mission_text
from dart_flight.lab.search.plan import Plan
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Scenario, load_scenario
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import FlightRecord
from tests.arrival import arrival_of, planned_there_s
from tools.campaigns.arrivals import WALL_SHIFT_M
from tools.campaigns.results import ROOT, causes, grouped, markdown

_FLOWN = "position"  # set of limits
# Shuttles 39, 43 and 67 are the first with four visits within 0.1 m.
MAPS = {
    "shuttle": (*range(1, 26), 39, 43, 67), "hairpin": range(1, 21), "corner": range(1, 16),
    "stop": range(1, 16), "sight": range(1, 16), "free": range(1, 11),
}  # fmt: skip


class BothFlown(msgspec.Struct, frozen=True):
    """A map flown free and, if the planner returns a hit, with the hit; a time is None without an arrival.

    Attributes:
        planned_free_s, planned_hit_s: planned arrival times, defined as for the flown times.
        problems: reasons of flights that did not complete or are uncontrolled.
    """

    returned: str
    planned_free_s: float | None
    planned_hit_s: float | None
    free_s: float | None
    hit_s: float | None
    problems: list[str]


class MapPlan(NamedTuple):
    """One plan of a map."""

    scenario: Scenario
    plan: Plan
    is_best: bool

    @property
    def mission(self) -> Mission:
        """The mission of the plan."""
        return parse_mission(
            Document(mission_text(self.scenario, self.plan, _MISSION_PATH), str(_MISSION_PATH))
        )

    @property
    def there_s(self) -> float:
        """The planned arrival time, measured as for a flight."""
        return planned_there_s(self.plan, self.scenario.goal.position_m)


_MISSION_PATH = ROOT / "missions" / "generated.yaml"


def flown_cases() -> list[dict[str, str]]:
    """Return the cases: every map."""
    return [{"kind": kind, "map": str(number)} for kind, numbers in MAPS.items() for number in numbers]


@functools.cache
def plan_map(kind: str, number: int, limits: str) -> dict[str, MapPlan]:
    """Plan a map free and with hits, without a limit of time: the plan is the same on every computer."""
    scenario = load_scenario(scenario_of(kind, number, limits))
    result = plan_quickest(scenario)
    plans = {"free": result.free, "hit": result.colliding}
    return {way: MapPlan(scenario, p, p is result.best) for way, p in plans.items() if p is not None}


def fly(point: Point, seed: int) -> BothFlown:
    """Fly a map with and without hits."""
    plans = plan_map(point.case["kind"], int(point.case["map"]), _FLOWN)
    problems: list[str] = []
    times: dict[str, float | None] = {"free": None, "hit": None}
    for way, plan in plans.items():
        if way == "free" or plan.is_best:
            times[way] = _fly_plan(plan, seed, point, problems)
    free, hit = plans.get("free"), plans.get("hit")
    return BothFlown(
        "hit" if hit and hit.is_best else "free",
        free and free.there_s,
        hit and hit.there_s,
        times["free"],
        times["hit"],
        problems,
    )


def _fly_plan(plan: MapPlan, seed: int, point: Point, problems: list[str]) -> float | None:
    mission = plan.mission
    kept: list[FlightRecord] = []
    verdict = fly_fast(mission, seed, None, spreads=point.spreads, keep_record=kept.append)
    problems += verdict.uncontrolled
    visits = [(visit.position_m, visit.within_m + WALL_SHIFT_M) for visit in plan.scenario.visits]
    arrival = arrival_of(kept[0].log, mission, visits)
    if verdict.outcome != "completed":
        problems.append(verdict.reason or verdict.outcome.value)
        return None
    if arrival is None or len(arrival.visits_us) < len(visits):
        problems.append("missed a place")
        return None
    return arrival.there_s


# -- maps ----------------------------------------------------------------------------------------------------


def scenario_of(kind: str, seed: int, limits: str) -> dict[str, Any]:
    """Return the scenario of a map, which follows from its number."""
    rng = np.random.default_rng([sorted(_MAKERS).index(kind), seed])
    tree: dict[str, Any] = {
        "version": 1,
        "name": f"{kind}-{seed}",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.2},
        "goal": {"position_m": [0.0, 0.0], "capture_radius_m": 0.15},
        "bounds_m": {"x": [-6.0, 6.0], "y": [-6.0, 6.0], "z": [0.3, 3.0]},
        "walls": {},
        "sequence": "any",
        "objective": "quickest",
        "touch_m_s": 0.6,
        "limits": {"speed_m_s": 3.16, "peak_force_n": 180.0, "motion": limits},
    }
    _MAKERS[kind](tree, rng, seed)
    return tree


def _wall(
    x: float, y: float, normal: tuple[float, float], length_m: float, surveyed: bool = False
) -> dict[str, Any]:
    """Return a wall; a `surveyed` wall is drawn within a centimetre, because the path passes it at 0.15 m."""
    wall = {"point_m": [x, y], "normal": list(normal), "length_m": length_m, "material": "acrylic"}
    return wall | ({"position_sd_m": 0.01, "yaw_sd_deg": 0.2} if surveyed else {})


def _shuttle(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Place one to four visits at two walls that face each other."""
    east, west = rng.uniform(1.0, 3.0, 2)
    within = float(np.exp(rng.uniform(math.log(0.05), math.log(0.5))))
    tree["walls"] = {"east": _wall(east, 0.0, (-1.0, 0.0), 4.0), "west": _wall(-west, 0.0, (1.0, 0.0), 4.0)}
    sides = [east, -west] * 2
    tree["visits"] = [
        {"position_m": [float(sides[k]), float(rng.uniform(-0.3, 0.3))], "within_m": within}
        for k in range(1 + seed % 4)
    ]


def _hairpin(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Set a path around the end of a partition in front of a wall."""
    gap, lane, length = rng.uniform(0.4, 1.5), rng.uniform(0.36, 0.5), rng.uniform(2.5, 3.5)
    tree["start"]["position_m"], tree["goal"]["position_m"] = [-length, lane], [-length, -lane]
    # The partition ends where the vehicle's side passes at x = 0.
    tree["walls"] = {
        "north": _wall(-3.2, 0.2, (0.0, 1.0), 6.0, True),
        "south": _wall(-3.2, -0.2, (0.0, -1.0), 6.0, True),
        "end": _wall(float(gap), 0.0, (-1.0, 0.0), 4.0),
    }


def _corner(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Set a path around a corner of ninety degrees, whose outer side is flat or chamfered."""
    half, into, out = rng.uniform(0.5, 0.8), rng.uniform(1.5, 3.0), rng.uniform(1.5, 3.0)
    tree["start"]["position_m"], tree["goal"]["position_m"] = [-into - half, 0.0], [0.0, out + half]
    tree["walls"] = {
        "inner_south": _wall(-half - 2.5, half, (0.0, -1.0), 4.6, True),
        "inner_east": _wall(-half, half + 2.5, (1.0, 0.0), 4.6, True),
        "outer_east": _wall(half, 1.0, (-1.0, 0.0), 6.0),
    }
    if seed % 2:
        tree["walls"]["chamfer"] = _wall(0.55 * half, -0.55 * half, (-1.0, 1.0), 1.2)


def _stop(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Set a path to rest close in front of a wall."""
    length = rng.uniform(1.5, 4.0)
    tree["goal"]["position_m"] = [float(length), 0.0]
    tree["walls"] = {"east": _wall(float(length + rng.uniform(0.2, 0.6)), 0.0, (-1.0, 0.0), 4.0)}


def _free(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Set a straight path between walls."""
    length, left, right = rng.uniform(2.0, 4.0), *rng.uniform(0.4, 1.2, 2)
    tree["goal"]["position_m"] = [float(length), float(rng.uniform(-0.2, 0.2))]
    tree["walls"] = {
        "left": _wall(1.5, float(left), (0.0, -1.0), 5.0, True),
        "right": _wall(1.5, float(-right), (0.0, 1.0), 5.0, True),
    }


def _sight(tree: dict[str, Any], rng: np.random.Generator, seed: int) -> None:
    """Set a path towards a wall that is detected late, and back to rest in front of the wall."""
    length = rng.uniform(4.0, 5.5)
    tree["walls"] = {"east": _wall(float(length), 0.0, (-1.0, 0.0), 4.0)}
    tree["goal"]["position_m"] = [float(length - 1.2), 0.0]
    tree["sight"] = {"distance_m": 1.0}
    tree["limits"] |= {"speed_m_s": 3.69, "closing_m_s": 3.0}


_MAKERS: dict[str, Callable[[dict[str, Any], np.random.Generator, int], None]] = {
    "shuttle": _shuttle,
    "hairpin": _hairpin,
    "corner": _corner,
    "stop": _stop,
    "sight": _sight,
    "free": _free,
}


# -- page --------------------------------------------------------------------------------------------------

_NEAR = 0.1  # allowed difference between planned and flown time, relative to the planned time


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every kind of map; a gain is the median over its maps."""
    table = []
    for (kind,), flown in grouped(rows, "kind").items():
        maps = grouped((r for r in rows if r.values["kind"] == kind), "map")
        gains = [gain for found in maps.values() if (gain := _gain(found)) is not None]
        timed = [(f.planned_free_s, f.free_s) for f in flown] + [(f.planned_hit_s, f.hit_s) for f in flown]
        near = [
            abs(done / plan - 1.0) <= _NEAR for plan, done in timed if plan is not None and done is not None
        ]
        shown = ", ".join(f"{statistics.median(column):+.1%}" for column in zip(*gains, strict=True))
        table.append(
            [
                kind,
                str(len(maps)),
                str(len(flown)),
                causes(cause_of(problem) for f in flown for problem in f.problems),
                f"{sum(near)} of {len(near)}",
                shown or "-",
            ]
        )
    heads = ("kind", "maps", "pairs flown", "problems", "time within 10 %", "gain: optimum, flown")
    return markdown(heads, table)


def _gain(found: Sequence[BothFlown]) -> tuple[float, float] | None:
    """Return the share of the duration of the collision-free flight that the hit saves, planned and flown."""
    free = [f.free_s for f in found if f.free_s is not None]
    hit = [f.hit_s for f in found if f.hit_s is not None]
    planned_free_s, planned_hit_s = found[0].planned_free_s, found[0].planned_hit_s
    if not free or not hit or planned_free_s is None or planned_hit_s is None:
        return None
    return 1.0 - planned_hit_s / planned_free_s, 1.0 - statistics.median(hit) / statistics.median(free)
