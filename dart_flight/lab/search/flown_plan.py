"""Simulated flights of plans in the fast world, and the choice of the plan to offer; used by `plan`.

`fly_mission` flies a mission once in the nominal world, and twenty times in drawn worlds. A drawn world
differs at random from the nominal world (docs/draws.md). `choose_flown` compares the flight times with and
without hits. The times count from take-off to landing, so they include touches of the walls before the hits.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from dart_flight.base.records import Outcome
from dart_flight.config.mission import Mission
from dart_flight.config.mission_file import DrawnFlights, FlownRecord, NominalFlight
from dart_flight.lab.search.mission_writer import planned_mission
from dart_flight.lab.search.quickest import QuickestPlan, QuickestResult
from dart_flight.lab.search.scenario import Scenario
from dart_flight.recording.about import software_version
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.many_flights import fly_fast_many, summarise
from dart_flight.sim.draws import parse_vary

DRAWN, FIRST_SEED = 20, 700_001  # campaigns and tests begin at seed 1
TOUCH_M_S = 0.6  # touch speed of the shipped missions
_DIGITS = 3

# Fly a mission with these seeds and spreads, and call back after each flight.
FlyMany = Callable[[Mission, list[int], dict[str, float], Callable[[Verdict], None]], list[Verdict]]
Done = Callable[[Verdict], None]


class FlownMission(NamedTuple):
    """A mission after its simulated flights.

    Attributes:
        record: record for the mission file.
        times_s: seed -> duration of a completed flight in a drawn world, from take-off to landing.
    """

    record: FlownRecord
    times_s: dict[int, float]


def fly_on_all_cores(
    mission: Mission, seeds: list[int], spreads: dict[str, float], done: Done
) -> list[Verdict]:
    """Fly in parallel processes, like `dry-run --fast --runs`."""
    return fly_fast_many(mission, seeds, None, done, spreads)


def fly_in_process(
    mission: Mission, seeds: list[int], spreads: dict[str, float], done: Done
) -> list[Verdict]:
    """Fly one seed after the other in this process, for scripts that cannot start processes."""
    verdicts = []
    for seed in seeds:
        verdicts.append(fly_fast(mission, seed, None, spreads=spreads))
        done(verdicts[-1])
    return verdicts


def fly_mission(
    mission: Mission, done: Done = lambda verdict: None, fly: FlyMany = fly_on_all_cores
) -> FlownMission:
    """Fly a mission once nominally. If that flight succeeds, fly the mission in twenty drawn worlds.

    Args:
        mission: the mission as loaded from its file.
        done: callback after each flight.
        fly: function that flies the seeds.

    Raises:
        RunsInterruptedError: the operator pressed Ctrl-C.
    """
    (first,) = fly(mission, [FIRST_SEED], {}, done)
    nominal = NominalFlight(
        outcome=first.outcome,
        uncontrolled=bool(first.uncontrolled),
        time_s=_rounded(first.flight_time_s),
        max_tilt_deg=_rounded(first.max_tilt_deg),
        reason="; ".join(first.uncontrolled) or first.reason,
    )
    record = FlownRecord(software_version(), mission.digest, nominal)
    if record.danger is not None:
        return FlownMission(record, {})
    seeds = list(range(FIRST_SEED, FIRST_SEED + DRAWN))
    verdicts = fly(mission, seeds, parse_vary(["all"], mission.vehicle), done)
    times_s = {
        seed: v.flight_time_s
        for seed, v in zip(seeds, verdicts, strict=True)
        if v.outcome is Outcome.COMPLETED and v.flight_time_s is not None
    }
    drawn = DrawnFlights(
        flights=DRAWN,
        first_seed=FIRST_SEED,
        completed=sum(v.outcome is Outcome.COMPLETED for v in verdicts),
        uncontrolled=sum(bool(v.uncontrolled) for v in verdicts),
        ended_by=summarise(verdicts).reasons,
        median_time_s=_rounded(statistics.median(times_s.values()) if times_s else None),
        max_tilt_deg=_rounded(max((v.max_tilt_deg or 0.0 for v in verdicts), default=None)),
    )
    return FlownMission(msgspec.structs.replace(record, drawn=drawn), times_s)


def compare(colliding: FlownMission, free: FlownMission) -> FlownRecord:
    """Return the record of the mission with hits, and add the median time that the hits save.

    The median is taken over the drawn worlds in which both missions were completed.
    """
    both = colliding.times_s.keys() & free.times_s.keys()
    saving_s = statistics.median(free.times_s[k] - colliding.times_s[k] for k in both) if both else None
    drawn = free.record.drawn
    return msgspec.structs.replace(
        colliding.record,
        free_time_s=None if drawn is None else drawn.median_time_s,
        saving_s=_rounded(saving_s),
    )


class OfferedPlan(NamedTuple):
    """The plan chosen after the flights.

    Attributes:
        plan: the plan to write, or None if no plan is offered.
        scenario: scenario of the plan, with the touches that the plan needs.
        record: record of the plan's flights.
        says: lines that report the flights and the reason for the choice.
        flown: records of all plans flown, under the keys `free`, `colliding` and `touched`.
    """

    plan: QuickestPlan | None
    scenario: Scenario
    record: FlownRecord | None
    says: list[str]
    flown: dict[str, FlownRecord]


def choose_flown(
    result: QuickestResult,
    free_only: bool,
    done: Done = lambda verdict: None,
    fly: FlyMany = fly_on_all_cores,
) -> OfferedPlan:
    """Fly the plans of a search in simulation and choose the one to offer.

    A plan with hits must succeed in simulation. A successful plan with hits is offered if it saves time from
    take-off to landing, or if the scenario demands its hits or touches. A plan that succeeds only with
    touches before the hits is offered with these touches.

    Args:
        result: result of the search.
        free_only: whether to offer the plan without a collision.
        done: callback after each flight.
        fly: function that flies the seeds of a mission.

    Raises:
        RunsInterruptedError: the operator pressed Ctrl-C.
    """
    scenario, flown, lines = result.scenario, dict[str, FlownRecord](), list[str]()
    free: FlownMission | None = None
    if result.free is not None:
        free = fly_mission(planned_mission(scenario, result.free), done, fly)
        flown["free"] = free.record
        if free.record.failure is not None:
            lines.append(f"the flight without a collision is not offered: {free.record.failure}")
    hits = None if free_only or result.best is not result.colliding else result.colliding
    if hits is not None:
        for name, wanted in _colliding_variants(scenario).items():
            mission = fly_mission(planned_mission(wanted, hits), done, fly)
            record = mission.record if free is None else compare(mission, free)
            flown[name] = record
            with_touches = (
                f" with a touch of each wall at {wanted.spec.touch_m_s:g} m/s" if name == "touched" else ""
            )
            if record.failure is not None:
                lines.append(f"the plan with collisions{with_touches} is not offered: {record.failure}")
                continue
            lines.append(f"the plan with collisions{with_touches} succeeds in simulation: {record.summary}")
            if _is_offered(record, free, scenario):
                return OfferedPlan(hits, wanted, record, lines, flown)
            break
    if (
        free is None
        or free.record.failure is not None
        or (hits is not None and not scenario.chosen_by_planner)
    ):
        lines.append("no plan is offered")
        return OfferedPlan(None, scenario, None, lines, flown)
    lines.append(f"the flight without a collision is offered: {free.record.summary}")
    return OfferedPlan(result.free, scenario, free.record, lines, flown)


def _colliding_variants(scenario: Scenario) -> dict[str, Scenario]:
    """Return name -> scenario: the scenario itself and, if it has no touches, also a copy with touches."""
    variants = {"colliding": scenario}
    if scenario.spec.touch_m_s is None:
        spec = msgspec.structs.replace(scenario.spec, touch_m_s=TOUCH_M_S)
        variants["touched"] = msgspec.structs.replace(scenario, spec=spec)
    return variants


def _is_offered(record: FlownRecord, free: FlownMission | None, scenario: Scenario) -> bool:
    """Return whether to offer a colliding plan that succeeds in simulation.

    The plan is offered if the scenario demands its hits or touches, if it saves time, or if no flight without
    a collision succeeds.
    """
    demanded = not scenario.chosen_by_planner or scenario.spec.touch_m_s is not None
    saves = record.saving_s is not None and record.saving_s > 0.0
    return demanded or saves or free is None or free.record.failure is not None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DIGITS)
