"""Plan, check, picture and limit state the same force of a hit, normal force and friction together."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from rich.console import Console

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.search.mission_writer import write_mission
from dart_flight.lab.search.plan_table import plan_table, quickest_table
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from dart_flight.planning.envelope import expected_force_n
from dart_flight.planning.predicted_flight import predict_mission
from tests.lab.search.test_quickest import scenario_between_walls
from tests.mission_findings import check_mission

OBLIQUE = [{"position_m": [2.0, 1.0], "within_m": 0.05}]
GRIDS = ["scenarios", "rigid_cage/scenarios", "ring_guard_250g/scenarios"]


@pytest.mark.parametrize("planned", ["quickest", *GRIDS])
def test_one_hit_has_one_force(planned: str, tmp_path: Path) -> None:
    path = tmp_path / "planned.yaml"
    if planned == "quickest":
        scenario = scenario_between_walls(visits=OBLIQUE)
        quickest = plan_quickest(scenario)
        write_mission(scenario, quickest.best, path)
        table = quickest_table(quickest)
    else:
        scenario = load_scenario(packaged("missions", *planned.split("/"), "one_wall.yaml"))
        result = search(scenario, 1)
        write_mission(scenario, result.plans[0], path)
        table = plan_table(result)
    mission = load_mission(path, scenario.vehicle)
    collision = mission.collisions[0]
    limited_n = expected_force_n(mission, collision)
    assert limited_n is not None
    pictured = predict_mission(mission).hits[1]
    assert abs(pictured.tangential_n) > 1.0, "friction makes a difference"
    assert math.hypot(pictured.normal_n, pictured.tangential_n) == pytest.approx(limited_n, rel=0.01)
    shown = next(f.message for f in check_mission(mission) if f.item == "force_1")
    assert f"predicted {limited_n:.0f} N (" in shown
    console = Console(width=200)
    with console.capture() as capture:
        console.print(table)
    row = next(line for line in capture.get().splitlines() if collision.wall.name in line)
    stated_n = float(row[: row.index(" (")].split()[-1])
    assert stated_n == pytest.approx(limited_n, rel=0.01)
