"""The missions that use collisions, and the fastest free flights of their scenarios."""

from __future__ import annotations

from typing import NamedTuple

from dart_flight.base.geometry import Vec2
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.search.mission_writer import planned_mission
from dart_flight.lab.search.plan import Plan
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Scenario, load_scenario
from tests.arrival import planned_there_s

COLLIDING, FREE = "colliding", "free"
USING_COLLISIONS = ("shuttle", "touch_and_return", "hairpin", "limited_sight")
WALL_SHIFT_M = 0.03  # added to the tolerance of a place at a wall, because a drawn wall moves the place


class BothWays(NamedTuple):
    """A mission as shipped, and the fastest flight of its scenario without a collision.

    Attributes:
        missions, plans: missions and plans, by `COLLIDING` and `FREE`.
    """

    scenario: Scenario
    missions: dict[str, Mission]
    plans: dict[str, Plan]

    @property
    def visits(self) -> list[tuple[Vec2, float]]:
        """The places that both flights must visit, each with its tolerance."""
        return [(visit.position_m, visit.within_m + WALL_SHIFT_M) for visit in self.scenario.visits]

    def planned_s(self, way: str) -> float:
        """Return the planned arrival time, by the rule of `arrival_of`."""
        return planned_there_s(self.plans[way], self.scenario.goal.position_m)


def both_ways(name: str) -> BothWays:
    """Return one of the missions that use collisions, and plan its free flight."""
    scenario = load_scenario(packaged("missions", "scenarios", f"{name}.yaml"))
    result = plan_quickest(scenario)
    assert result.free is not None
    assert result.colliding is not None
    shipped = load_mission(packaged("missions", f"{name}.yaml"))
    return BothWays(
        scenario,
        {COLLIDING: shipped, FREE: planned_mission(scenario, result.free)},
        {COLLIDING: result.colliding, FREE: result.free},
    )
