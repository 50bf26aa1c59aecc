"""Simulated flights of plans in the fast world, and the choice of the plan to offer; used by `plan`.

`fly_mission` first flies a mission once in the nominal world, then up to twenty times in drawn worlds. Drawn
worlds differ at random from the nominal world (docs/draws.md). `PlanChoice` compares the flight times with
and without hits. The times count from take-off to landing, so they include touches of walls before the hits.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec

from dart_flight.base.records import Outcome
from dart_flight.config.mission import Mission
from dart_flight.config.mission_file import DrawnFlights, FlownRecord, NominalFlight
from dart_flight.lab.search.mission_writer import RefusedPlanError, planned_mission
from dart_flight.lab.search.plan import Plan, SearchResult
from dart_flight.lab.search.scenario import Scenario
from dart_flight.recording.about import software_version
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.many_flights import fly_fast_many, summarise
from dart_flight.sim.draws import parse_vary

DRAWN, FIRST_SEED = 20, 700_001  # `FIRST_SEED` is far from the seeds of campaigns and tests
TOUCH_M_S = 0.6  # touch speed of the shipped missions
LEAST_SAVING = 0.01  # minimum predicted saving, relative to the duration of the collision-free flight
_DIGITS = 3

# Fly a mission with these seeds and spreads, and call back after each flight.
FlyMany = Callable[[Mission, list[int], dict[str, float], Callable[[Verdict], None]], list[Verdict]]
Done = Callable[[Verdict], None]


class FlightWatch:
    """Callbacks during the simulated flights of plans; this base class ignores them."""

    def begin(self, plan: str) -> None:
        """Announce the flights in drawn worlds; `plan` names the plan, such as `the plan with collisions`."""

    def landed(self, flown: int, failed: int) -> None:
        """Receive the number of flights in drawn worlds so far, and how many of them did not complete."""

    def report(self, line: str) -> None:
        """Report a result as soon as it is known."""


_NO_WATCH = FlightWatch()


class FlownMission(NamedTuple):
    """A mission after its simulated flights.

    Attributes:
        record: record for the mission file.
        times_s: seed -> duration of a completed flight in a drawn world, from take-off to landing.
    """

    record: FlownRecord
    times_s: dict[int, float]


def fly_on_all_cores(
    mission: Mission,
    seeds: list[int],
    spreads: dict[str, float],
    done: Done,
    announce: Callable[[int], None] = lambda under_way: None,
) -> list[Verdict]:
    """Fly in parallel processes, like `dry-run --fast --runs`; an `Interrupt` calls `announce`."""
    return fly_fast_many(mission, seeds, None, done, spreads, announce)


def fly_in_process(
    mission: Mission, seeds: list[int], spreads: dict[str, float], done: Done
) -> list[Verdict]:
    """Fly one seed after the other in this process, for scripts that cannot start processes."""
    verdicts = []
    for seed in seeds:
        verdicts.append(fly_fast(mission, seed, None, spreads=spreads))
        done(verdicts[-1])
    return verdicts


class _DecidedError(Exception):
    """The plan has failed, whatever the results of the remaining flights."""


def fly_mission(
    mission: Mission,
    watch: FlightWatch = _NO_WATCH,
    fly: FlyMany = fly_on_all_cores,
    name: str = "the plan",
) -> FlownMission:
    """Fly a mission once nominally. If that flight succeeds, fly the mission in twenty drawn worlds.

    As soon as the flights of the first seeds decide that the plan fails, the remaining flights are skipped.
    `name` is the plan's name in messages. Ctrl-C raises `RunsInterruptedError`.
    """
    (first,) = fly(mission, [FIRST_SEED], {}, lambda verdict: None)
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
    watch.report(f"{name}: the nominal flight completes{_duration(nominal.time_s)}")
    seeds = list(range(FIRST_SEED, FIRST_SEED + DRAWN))
    landed: dict[int, Verdict] = {}

    def done(verdict: Verdict) -> None:
        assert verdict.seed is not None
        landed[verdict.seed] = verdict
        watch.landed(len(landed), sum(v.outcome is not Outcome.COMPLETED for v in landed.values()))
        # Only the first seeds decide, so that the order in which flights land has no influence.
        if _with_drawn(record, _first(landed, seeds), len(seeds)).failure is not None:
            raise _DecidedError

    watch.begin(name)
    with contextlib.suppress(_DecidedError):
        fly(mission, seeds, parse_vary(["all"], mission.vehicle), done)
    verdicts = _first(landed, seeds)
    times_s = {
        seed: v.flight_time_s
        for seed, v in zip(seeds, verdicts, strict=False)
        if v.outcome is Outcome.COMPLETED and v.flight_time_s is not None
    }
    return FlownMission(_with_drawn(record, verdicts, len(verdicts)), times_s)


def _first(landed: dict[int, Verdict], seeds: list[int]) -> list[Verdict]:
    """Return the verdicts of the first seeds, up to the first seed whose flight has not landed."""
    return [landed[seed] for seed in itertools.takewhile(landed.__contains__, seeds)]


def _with_drawn(record: FlownRecord, verdicts: list[Verdict], flights: int) -> FlownRecord:
    """Return the record with the flights in drawn worlds; flights without a verdict count as completed."""
    times_s = [
        v.flight_time_s for v in verdicts if v.outcome is Outcome.COMPLETED and v.flight_time_s is not None
    ]
    drawn = DrawnFlights(
        flights=flights,
        first_seed=FIRST_SEED,
        completed=flights - sum(v.outcome is not Outcome.COMPLETED for v in verdicts),
        uncontrolled=sum(bool(v.uncontrolled) for v in verdicts),
        ended_by=summarise(verdicts).reasons,
        median_time_s=_rounded(statistics.median(times_s) if times_s else None),
        max_tilt_deg=_rounded(max((v.max_tilt_deg or 0.0 for v in verdicts), default=None)),
    )
    return msgspec.structs.replace(record, drawn=drawn)


def _duration(time_s: float | None) -> str:
    return "" if time_s is None else f", {time_s:.1f} s from take-off to landing"


def compare(colliding: FlownMission, free: FlownMission) -> FlownRecord:
    """Return the record of the mission with hits, with the median time that the hits save.

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
        scenario: the plan's scenario, with the touches that the plan needs.
        record: record of the plan's flights.
        messages: lines that report the flights and the reason for the choice.
        flown: records of all plans flown, under the keys `free`, `colliding` and `touched`.
        refused: reasons why plans were not flown, under the same keys.
    """

    plan: Plan | None
    scenario: Scenario
    record: FlownRecord | None
    messages: list[str]
    flown: dict[str, FlownRecord]
    refused: dict[str, str]


class _Candidate(NamedTuple):
    """A plan of a search, with the scenario that defines the touches of its mission.

    Attributes:
        key: `free`, `colliding` or `touched`.
        name: name of the plan in messages.
    """

    key: str
    name: str
    scenario: Scenario
    plan: Plan


class PlanChoice:
    """The choice between the plans of a search, by their simulated flights.

    With `free_only`, only the plan without a collision is offered. `messages`, `flown` and `refused` are
    those of `OfferedPlan`, for the plans flown or refused so far.
    """

    def __init__(self, result: SearchResult, free_only: bool, watch: FlightWatch = _NO_WATCH) -> None:
        self.messages, self.flown, self.refused = list[str](), dict[str, FlownRecord](), dict[str, str]()
        self._result, self._watch = result, watch
        scenario = result.scenario
        hits = None if free_only or result.best is not result.colliding else result.colliding
        self._hits = [] if hits is None else list(_colliding(scenario, hits))
        name = "the flight without a collision"
        self._free = None if result.free is None else _Candidate("free", name, scenario, result.free)

    def run(self, fly: FlyMany = fly_on_all_cores) -> OfferedPlan:
        """Fly the plans in simulation and return the plan to offer.

        A plan with hits must succeed in simulation. It must also save time from take-off to landing, or the
        scenario must demand its hits or touches. A plan that succeeds only with touches before the hits is
        offered with these touches. A plan whose mission is refused is not flown. A plan whose hits are
        optional and hardly save time is not flown either.
        """
        free = None if self._free is None else self._fly(self._free, fly)
        if free is not None and free.record.failure is not None:
            self._say(f"the flight without a collision is not offered: {free.record.failure}")
            free = None
        for hits in [] if free is not None and self._saves_too_little() else self._hits:
            flown = self._fly(hits, fly)
            if flown is None:
                continue
            record = flown.record if free is None else compare(flown, free)
            self.flown[hits.key] = record
            if record.failure is not None:
                self._say(f"{hits.name} is not offered: {record.failure}")
                continue
            self._say(f"{hits.name} succeeds in simulation: {record.summary}")
            saves = record.saving_s is not None and record.saving_s > 0.0
            if _is_demanded(self._result.scenario) or saves or free is None:
                return self._offer(hits, record)
            break
        if free is None or self._free is None or not self._is_free_allowed:
            self._say("no plan is offered")
            return self._offer(None, None)
        self._say(f"the flight without a collision is offered: {free.record.summary}")
        return self._offer(self._free, free.record)

    def skip(self, reason: str) -> OfferedPlan:
        """Return the plan to offer if no plan is flown: the first plan whose mission is not refused.

        `reason` is the reason for the missing flights.
        """
        for one in (*self._hits, *([self._free] if self._free and self._is_free_allowed else [])):
            if self._mission(one) is not None:
                self._say(reason)
                return self._offer(one, None)
        self._say("no plan is offered")
        return self._offer(None, None)

    @property
    def _is_free_allowed(self) -> bool:
        return not self._hits or self._result.scenario.chosen_by_planner

    def _offer(self, one: _Candidate | None, record: FlownRecord | None) -> OfferedPlan:
        plan, scenario = (None, self._result.scenario) if one is None else (one.plan, one.scenario)
        return OfferedPlan(plan, scenario, record, self.messages, self.flown, self.refused)

    def _say(self, line: str) -> None:
        self.messages.append(line)
        self._watch.report(line)

    def _mission(self, one: _Candidate) -> Mission | None:
        try:
            return planned_mission(one.scenario, one.plan)
        except RefusedPlanError as error:
            self.refused[one.key] = error.reason
            self._say(f"{one.name} is refused: {error.reason}")
            return None

    def _fly(self, one: _Candidate, fly: FlyMany) -> FlownMission | None:
        mission = self._mission(one)
        if mission is None:
            return None
        flown = fly_mission(mission, self._watch, fly, one.name)
        self.flown[one.key] = flown.record
        return flown

    def _saves_too_little(self) -> bool:
        """Return whether the hits are optional and predicted to save less than `LEAST_SAVING`."""
        saving_s, free = self._result.saving_s, self._result.free
        if not self._hits or saving_s is None or free is None or _is_demanded(self._result.scenario):
            return False
        if saving_s >= LEAST_SAVING * free.time_to_goal_s:
            return False
        self._say(
            f"the plan with collisions is not flown: it is predicted to save {saving_s:.2f} s of "
            f"{free.time_to_goal_s:.2f} s, less than {LEAST_SAVING:.0%}"
        )
        return True


def _colliding(scenario: Scenario, hits: Plan) -> Iterator[_Candidate]:
    """Yield the plan with hits and, if the scenario has no touches, also the plan with touches."""
    name = "the plan with collisions"
    yield _Candidate("colliding", name, scenario, hits)
    if scenario.spec.touch_m_s is None:
        spec = msgspec.structs.replace(scenario.spec, touch_m_s=TOUCH_M_S)
        name += f" with a touch of each wall at {TOUCH_M_S:g} m/s"
        yield _Candidate("touched", name, msgspec.structs.replace(scenario, spec=spec), hits)


def _is_demanded(scenario: Scenario) -> bool:
    return not scenario.chosen_by_planner or scenario.spec.touch_m_s is not None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DIGITS)
