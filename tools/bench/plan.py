"""Benchmarks of the planner for `make bench`.

python -m tools.bench.plan
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

import msgspec
import numpy as np

from dart_flight.lab.search.scenario import Scenario, load_scenario
from dart_flight.lab.search.search import draws_of
from dart_flight.planning.rollout import Arrivals, Rollout, Stages, new_flight, stages_for
from tools.bench.plan_stepping import Ends, step_everything

SCENARIO = Path(__file__).parents[2] / "missions" / "scenarios" / "dual_collision.yaml"


class Row(TypedDict):
    """A row of `build/bench.json`."""

    name: str
    value: float
    unit: str
    baseline: float | None
    ratio: float | None


class _Case:
    """The full enumeration of the dual collision, with every candidate rolled out to its end."""

    def __init__(self) -> None:
        self.scenario: Scenario = load_scenario(SCENARIO)
        self.normal = np.array(self.scenario.normal_m_s)[:, None]
        self.tangential = np.array(self.scenario.tangential_m_s)[None, :]
        self.count = self.normal.size * self.tangential.size * len(self.scenario.modes) ** 2

    def enumerate(self) -> list[Arrivals]:
        stages = stages_for(self.scenario, [None])[0]
        rollout = Rollout(self.scenario, self.scenario.sequences[0], new_flight(self.scenario), None)
        grid = rollout.approach(self.normal, self.tangential)
        return rollout.fly(stages, self.normal, self.tangential, grid)

    def step(self) -> list[Ends]:
        stages = self.stages()
        rollout = Rollout(self.scenario, self.scenario.sequences[0], new_flight(self.scenario), None)
        grid = rollout.approach(self.normal, self.tangential)
        return step_everything(self.scenario, stages, self.normal, self.tangential, grid)

    def stages(self) -> Stages:
        return stages_for(self.scenario, [None])[0]


def _best(function: Callable[[], object], repeats: int) -> float:
    """Return the smallest processor time of several runs, s."""
    times = []
    for _ in range(repeats):
        begin_s = time.process_time()
        function()
        times.append(time.process_time() - begin_s)
    return min(times)


def measure_enumeration() -> Row:
    """Measure the full enumeration against time stepping."""
    case = _Case()
    fast = _best(case.enumerate, 15)
    slow = _best(case.step, 2)
    return Row(
        name="plan enumeration 14884", value=fast * 1e3, unit="ms", baseline=slow * 1e3, ratio=slow / fast
    )


def measure_robust_plan() -> Row:
    """Measure a million trajectories: the grid with draws, and constraints checked in every draw."""
    scenario = load_scenario(SCENARIO)
    uncertainty = msgspec.structs.replace(scenario.uncertainty, samples=68)
    scenario = msgspec.structs.replace(scenario, uncertainty=uncertainty)
    normal = np.array(scenario.normal_m_s)[:, None]
    tangential = np.array(scenario.tangential_m_s)[None, :]
    count = 0

    def run() -> None:
        nonlocal count
        from dart_flight.planning.constraints import Constraints  # noqa: PLC0415

        draws = draws_of(scenario, 1)
        flight = new_flight(scenario)
        rollout = Rollout(scenario, scenario.sequences[0], flight, Constraints(scenario))
        grid = rollout.approach(normal, tangential)
        count = 0
        for draw, stages in zip(draws, stages_for(scenario, list(draws)), strict=True):
            rollout.fly(stages, normal, tangential, grid, draw)
            count += normal.size * tangential.size * len(scenario.modes) ** 2

    processor_s = _best(run, 2)
    return Row(name="plan robust 1e6", value=processor_s * 1e6 / count, unit="s", baseline=None, ratio=None)


def rows() -> list[Row]:
    """Return rows for `make bench`."""
    return [measure_enumeration(), measure_robust_plan()]


if __name__ == "__main__":
    for each in rows():
        print(each)
