"""Plans of scenarios with `sight`, made once for all tests because they take seconds."""

from __future__ import annotations

import hashlib
import pickle
from pathlib import Path

import msgspec

from dart_flight.lab.search.plan import SearchResult
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Scenario
from tests.shared_flights import SharedFlights

PLAN = "plan.pickle"


def limited_sight_plan(flown: SharedFlights, scenario: Scenario) -> SearchResult:
    """Return the plan of a scenario; the place of its file does not matter."""

    def plan(folder: Path) -> None:
        (folder / PLAN).write_bytes(pickle.dumps(plan_quickest(scenario)))

    name = hashlib.sha256(msgspec.json.encode((scenario.spec, scenario.vehicle))).hexdigest()
    result: SearchResult = pickle.loads((flown.once(f"plan-{name}", plan) / PLAN).read_bytes())
    return msgspec.structs.replace(result, scenario=scenario)
