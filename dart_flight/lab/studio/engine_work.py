"""What the processes behind a studio page do: they check, plan and fly texts (`engine`).

A process reads requests as lines of JSON and answers one after the other.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Outcome
from dart_flight.base.summary import cause_of
from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding, decide
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.map_model import MapKind
from dart_flight.lab.mission_map import mission_map
from dart_flight.lab.search.mission_writer import RefusedPlanError, mission_text, planned_mission
from dart_flight.lab.search.plan import Plan, SearchResult
from dart_flight.lab.search.plan_table import describe_free, describe_quickest
from dart_flight.lab.search.quickest import plan_quickest
from dart_flight.lab.search.scenario import Objective, Scenario, parse_scenario
from dart_flight.lab.search.search import ADVICE, search
from dart_flight.lab.studio.engine import (
    AnyQuery,
    Checked,
    CheckQuery,
    EngineEvent,
    EngineReady,
    Finding,
    FlightsFlown,
    FlightsQuery,
    FlownOne,
    FlyProgress,
    Planned,
    PlanProgress,
    PlanQuery,
    PlanRow,
)
from dart_flight.lab.studio.flights import fly_one
from dart_flight.lab.studio.objects import object_of, objects_in_finding
from dart_flight.lab.studio.scene_model import LoadedFile, encode_scene, load_text, scene_of
from dart_flight.planning.predicted_flight import PredictedFlight
from dart_flight.run.prepare import refuse_unflyable, with_simulated_mocap
from dart_flight.run.workers import Failure, Interrupt, usable_cores, work
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import parse_mission_fault

Send = Callable[[EngineEvent], None]

_PROGRESS_S = 0.2  # interval of progress events
_OFF_WALL_M, _MOVED_M = 0.03, 0.05  # distances of a planned impact, from its wall and from the predicted one


# --- checks ---------------------------------------------------------------------------------------------


def check(request: CheckQuery) -> Checked:
    """Load a text as its file would load, run the checks of stage `file`, and build the scene."""
    try:
        loaded = load_text(request.text, Path(request.path))
    except InputError as error:
        return Checked(request.number, findings=[_finding_of(error)])
    found = Checked(
        request.number,
        materials=list(loaded.vehicle.materials),
        modes=[mode.value for mode in loaded.vehicle.modes],
    )
    if loaded.error is not None:
        found.scene, found.findings = scene_of(loaded), [_finding_of(loaded.error)]
        if any("trajectory" in str(part) for part in loaded.error.key):
            found.stale = f"the plan does not fit the room any more: {loaded.error.message}"
        return found
    if isinstance(loaded.resolved, Mission):
        _check_mission(found, loaded, loaded.resolved)
    else:
        found.go, found.scene = True, scene_of(loaded)
    return found


def _check_mission(found: Checked, loaded: LoadedFile, mission: Mission) -> None:
    context = FlightContext(mission)
    run_checks(context, Stage.FILE)
    report = decide(mission, context.found)
    tree = loaded.document.tree
    walls, posts = [*tree.get("walls", {}), *tree.get("simulated_walls", {})], list(tree.get("posts", {}))
    found.go = report.go
    found.findings = [_as_finding(finding, walls, posts) for finding in report.findings]
    found.scene = scene_of(loaded, context.planned)
    found.stale = stale_plan(mission, context.planned)


def _as_finding(finding: CheckFinding, walls: list[str], posts: list[str]) -> Finding:
    word = "remark" if finding.remark else "go" if finding.go else "NO-GO"
    objects = objects_in_finding(finding.item, finding.message, walls, posts)
    return Finding(finding.item, finding.go, word, finding.message, objects[0] if objects else "", objects)


def _finding_of(error: InputError) -> Finding:
    found = object_of(error.key)
    return Finding("file", False, "error", error.one_line(), found, [found] if found else [])


def stale_plan(mission: Mission, planned: PredictedFlight | None) -> str | None:
    """Return why the plan in a mission no longer fits its room, or None."""
    for collision in mission.collisions:
        if collision.predicted is None:
            continue
        place, hit = (
            collision.predicted.position_m,
            None if planned is None else planned.hits.get(collision.index),
        )
        off_m = abs(collision.wall.signed_distance(place))
        moved_m = 0.0 if hit is None else math.dist(hit.position, place)
        if off_m > _OFF_WALL_M or moved_m > _MOVED_M:
            away_m = max(off_m, moved_m)
            return f"collision {collision.index} is {away_m:.2f} m from where it was planned: plan again"
    if mission.flown is not None and mission.flown.digest != mission.digest:
        return "mission or vehicle has changed since `plan` flew it in simulation"
    return None


# --- plans ----------------------------------------------------------------------------------------------


def plan(request: PlanQuery, emit: Send) -> Planned:
    """Search a scenario as `plan` does; each plan becomes the text of a mission beside the scenario."""
    last_s = 0.0

    def progress(done: int, of: int | None) -> None:
        nonlocal last_s
        if time.monotonic() - last_s > _PROGRESS_S:
            last_s = time.monotonic()
            emit(PlanProgress(request.number, done, of, "searching"))

    try:
        document = Document(request.text, request.path)
        if request.objective is not None:
            document.tree["objective"] = request.objective
        scenario = parse_scenario(document)
        if scenario.objective is Objective.QUICKEST:
            result = plan_quickest(scenario, request.within_s, progress)
            says = describe_quickest(result)
        else:
            result = search(scenario, request.top, progress=progress)
            says = describe_free(result.free_time, result.best)
    except InputError as error:
        return Planned(request.number, error=error.one_line())
    rows = [_plan_row(result, one) for one in result.plans]
    return Planned(
        request.number,
        [row for row in rows if row.rank],
        {reason.value: count for reason, count in result.refused.items()},
        {reason.value: ADVICE[reason] for reason in result.refused},
        next((row for row in rows if not row.rank), None),
        says,
    )


def _plan_row(result: SearchResult, one: Plan) -> PlanRow:
    scenario, text, refused = result.scenario, "", None
    paths, go, problem = list[Array](), False, ""
    try:
        text = mission_text(scenario, one, Path(scenario.source))
        context = FlightContext(planned_mission(scenario, one, text))
        paths = _predicted_lines(context.mission, context.planned)
        bad = [finding.message for finding in run_checks(context, Stage.FILE) if not finding.go]
        go, problem = not bad, "".join(bad[:1])
    except RefusedPlanError as error:
        text, refused = "", error.reason
    time_s = one.time_to_goal_s if one.time_to_rest_s is None else one.time_to_rest_s
    hits = [f"{hit.wall} {hit.mode.value} {-hit.normal_m_s:.2f} m/s" for hit in one.collisions]
    return PlanRow(
        one.rank if one.collisions else 0,
        ", ".join(hits) or "no collision",
        dict(_values_of(scenario, one)),
        paths,
        text,
        refused,
        time_s,
        one.saving_s,
        go,
        problem,
    )


def _values_of(scenario: Scenario, one: Plan) -> Iterator[tuple[str, str]]:
    if scenario.objective is not Objective.QUICKEST:
        yield "goal miss", f"{one.goal_miss_m:.3f} m"
    yield "goal at", f"{one.time_to_goal_s:.2f} s"
    if one.saving_s is not None:
        yield "saving", f"{one.saving_s:.2f} s"
    if one.collisions:
        yield "peak force", f"{one.peak_force_n:.0f} N"
    if one.expected_miss_m is not None and one.worst_miss_m is not None:
        yield "mean miss", f"{one.expected_miss_m:.3f} m"
        yield "worst miss", f"{one.worst_miss_m:.3f} m"
        yield "draws failed", f"{one.failed_draws or 0.0:.0%}"


def _predicted_lines(mission: Mission, planned: PredictedFlight | None) -> list[Array]:
    shown = mission_map(mission, planned).paths
    return [path.points for path in shown if path.kind is MapKind.PREDICTED and path.points.shape[1] == 3]


# --- flights --------------------------------------------------------------------------------------------


def fly(request: FlightsQuery, emit: Send) -> FlightsFlown:
    """Fly a mission in the fast world: one flight here, several in worker processes."""
    wanted = request.fly
    try:
        mission = parse_mission(Document(request.text, request.path))
        refuse_unflyable(mission)
        mission = with_simulated_mocap(mission, None)
        spreads = parse_vary(wanted.vary, mission.vehicle)
        if wanted.fault is not None and wanted.flights > 1:
            raise InputError("a fault needs a single flight")
        fault = None if wanted.fault is None else parse_mission_fault(mission, wanted.fault)
        log_dir = Path(request.log_dir) if wanted.log else None
        one = partial(fly_one, mission, spreads, fault, log_dir)
        return _fly_all(request, emit, one)
    except (InputError, FlightError, OSError) as error:
        return FlightsFlown(
            request.number, error=error.one_line() if isinstance(error, InputError) else str(error)
        )


def _fly_all(request: FlightsQuery, emit: Send, one: partial[FlownOne]) -> FlightsFlown:
    seeds = range(request.fly.seed, request.fly.seed + request.fly.flights)
    flown, waiting, last_s, error = list[FlownOne](), list[FlownOne](), time.monotonic(), None

    def report() -> None:
        completed = sum(flight.outcome == Outcome.COMPLETED.value for flight in flown)
        emit(FlyProgress(request.number, len(flown), len(seeds), completed, waiting))
        waiting.clear()

    emit(FlyProgress(request.number, 0, len(seeds), 0))
    with contextlib.ExitStack() as held:
        if len(seeds) == 1:
            landings: Iterator[tuple[int, FlownOne | Failure]] = iter([(seeds[0], one(seeds[0]))])
        else:
            pool = work(one, seeds, min(usable_cores(), len(seeds)), Interrupt())
            landings = held.enter_context(contextlib.closing(pool))
        for seed, result in landings:
            if isinstance(result, Failure):
                error = f"seed {seed}: {result.what}"
                break
            flown.append(result)
            waiting.append(result)
            if time.monotonic() - last_s > _PROGRESS_S:
                last_s = time.monotonic()
                report()
    report()
    return _end_of_flights(request, flown, error)


def _end_of_flights(request: FlightsQuery, flown: list[FlownOne], error: str | None) -> FlightsFlown:
    reasons = dict[str, int]()
    for flight in flown:
        if flight.reason is not None:
            cause = cause_of(flight.reason)
            reasons[cause] = reasons.get(cause, 0) + 1
    completed = sum(flight.outcome == Outcome.COMPLETED.value for flight in flown)
    if len(flown) == 1:
        reason = "" if flown[0].reason is None else f": {flown[0].reason}"
        says = f"seed {flown[0].seed} {flown[0].outcome}{reason}"
    else:
        says = f"{completed} of {len(flown)} flights completed"
        says += "".join(f", {cause} {n}" for cause, n in sorted(reasons.items(), key=lambda item: -item[1]))
    return FlightsFlown(request.number, len(flown), completed, reasons, says, error)


# --- the process ----------------------------------------------------------------------------------------


class Emit:
    """Writer of events as lines of JSON."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._encoder = msgspec.json.Encoder(enc_hook=encode_scene)

    def __call__(self, event: EngineEvent) -> None:
        self._stream.write(self._encoder.encode(event) + b"\n")
        self._stream.flush()


def serve(requests: BinaryIO, emit: Send) -> None:
    """Answer requests until their stream ends."""
    emit(EngineReady())
    for line in requests:
        if line.strip():
            emit(_answer(msgspec.json.decode(line, type=AnyQuery), emit))


def _answer(request: AnyQuery, emit: Send) -> EngineEvent:
    try:
        if isinstance(request, CheckQuery):
            return check(request)
        return plan(request, emit) if isinstance(request, PlanQuery) else fly(request, emit)
    except Exception as error:  # a defect must not end the process: the page shows it in one line
        says = f"{type(error).__name__}: {error}"
        if isinstance(request, CheckQuery):
            return Checked(request.number, findings=[Finding("file", False, "error", says)])
        kind = Planned if isinstance(request, PlanQuery) else FlightsFlown
        return kind(request.number, error=says)
