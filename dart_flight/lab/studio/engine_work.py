"""What the processes behind a studio page do: they check, plan and fly texts (`engine`)."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dart_flight.base.errors import FlightError
from dart_flight.base.geometry import Vec3
from dart_flight.base.records import Record, TruthSample
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
    READY,
    AllFlown,
    Checked,
    EngineEvent,
    EngineRequest,
    Failed,
    Finding,
    FlownOne,
    FlyRequest,
    Planned,
    PlanRow,
    Progress,
    from_line,
    to_line,
)
from dart_flight.lab.studio.objects import object_of, objects_in_finding
from dart_flight.lab.studio.scene_model import LoadedFile, load_text, scene_of
from dart_flight.planning.predicted_flight import PredictedFlight
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import refuse_unflyable, with_simulated_mocap
from dart_flight.run.workers import Failure, FinishedItem, Interrupt, attempt, usable_cores, work
from dart_flight.sim.draws import parse_vary
from dart_flight.sim.faults.fault_table import Fault, parse_mission_fault

Report = Callable[[Progress], None]

_TOP = 10  # plans that are shown
_PROGRESS_S = 0.2  # interval of progress events
_OFF_WALL_M, _MOVED_M = 0.03, 0.05  # distances of a planned impact, from its wall and from the predicted one
_PATH_STEP_US = 50_000  # interval of the points of a flight's line


# --- checks ---------------------------------------------------------------------------------------------


def check(text: str, path: str, report: Report) -> Checked:
    """Load a text as its file would load, run the checks of stage `file`, and build the scene."""
    try:
        loaded = load_text(text, Path(path))
    except InputError as error:
        return Checked(findings=[_finding_of(error)])
    found = Checked(
        materials=list(loaded.vehicle.materials), modes=[mode.value for mode in loaded.vehicle.modes]
    )
    if isinstance(loaded.resolved, Mission):
        _check_mission(found, loaded, loaded.resolved)
        return found
    found.go, found.scene = loaded.error is None, scene_of(loaded)
    if loaded.error is not None:
        found.findings = [_finding_of(loaded.error)]
        if any("trajectory" in str(part) for part in loaded.error.key):
            found.stale = f"the plan does not fit the room any more: {loaded.error.message}"
    return found


def _check_mission(found: Checked, loaded: LoadedFile, mission: Mission) -> None:
    context = FlightContext(mission)
    run_checks(context, Stage.FILE)
    decision = decide(mission, context.found)
    tree = loaded.document.tree
    walls, posts = [*tree.get("walls", {}), *tree.get("simulated_walls", {})], list(tree.get("posts", {}))

    def shown(one: CheckFinding) -> Finding:
        objects = objects_in_finding(one.item, one.message, walls, posts)
        return Finding(one.item, one.go, one.remark, one.message, objects)

    found.go, found.findings = decision.go, [shown(one) for one in decision.findings]
    found.scene = scene_of(loaded, context.planned)
    found.stale = stale_plan(mission, context.planned)


def _finding_of(error: InputError) -> Finding:
    return Finding("file", False, False, error.one_line(), [one for one in [object_of(error.key)] if one])


def stale_plan(mission: Mission, planned: PredictedFlight | None) -> str | None:
    """Return why the plan in a mission no longer fits its room, or None."""
    for collision in mission.collisions:
        if collision.predicted is None:
            continue
        place = collision.predicted.position_m
        hit = None if planned is None else planned.hits.get(collision.index)
        off_m = abs(collision.wall.signed_distance(place))
        moved_m = 0.0 if hit is None else math.dist(hit.position, place)
        if off_m > _OFF_WALL_M or moved_m > _MOVED_M:
            away_m = max(off_m, moved_m)
            return f"collision {collision.index} is {away_m:.2f} m from where it was planned: plan again"
    if mission.flown is not None and mission.flown.digest != mission.digest:
        return "mission or vehicle has changed since `plan` flew it in simulation"
    return None


# --- plans ----------------------------------------------------------------------------------------------


def plan(text: str, path: str, report: Report, objective: str | None, within_s: float) -> Planned:
    """Search a scenario as `plan` does; each plan becomes the text of a mission beside the scenario."""
    last_s = 0.0

    def progress(done: int, of: int | None) -> None:
        nonlocal last_s
        if time.monotonic() - last_s > _PROGRESS_S:
            last_s = time.monotonic()
            report(Progress(done, of))

    document = Document(text, path)
    if objective is not None:
        document.tree["objective"] = objective
    scenario = parse_scenario(document)
    if scenario.objective is Objective.QUICKEST:
        result = plan_quickest(scenario, within_s, progress)
        summary = describe_quickest(result)
    else:
        result = search(scenario, _TOP, progress=progress)
        summary = describe_free(result.free_time, result.best)
    rows = sorted((_plan_row(result, one) for one in result.plans), key=lambda row: row.rank or math.inf)
    refused = {reason.value: (count, ADVICE[reason]) for reason, count in result.refused.items()}
    return Planned(rows, refused, summary)


def _plan_row(result: SearchResult, one: Plan) -> PlanRow:
    scenario, text, paths = result.scenario, "", list[Array]()
    try:
        text = mission_text(scenario, one, Path(scenario.source))
        context = FlightContext(planned_mission(scenario, one, text))
        paths = _predicted_lines(context.mission, context.planned)
        problem = next((f"no-go: {f.message}" for f in run_checks(context, Stage.FILE) if not f.go), "")
    except RefusedPlanError as error:
        text, problem = "", f"refused: {error.reason}"
    hits = [f"{hit.wall} {hit.mode.value} {-hit.normal_m_s:.2f} m/s" for hit in one.collisions]
    return PlanRow(
        one.rank if one.collisions else 0,
        ", ".join(hits) or "no collision",
        dict(_values_of(scenario, one)),
        paths,
        text,
        problem,
        one.time_to_goal_s if one.time_to_rest_s is None else one.time_to_rest_s,
        one.saving_s,
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


def fly(text: str, path: str, report: Report, wanted: FlyRequest, log_dir: str) -> AllFlown:
    """Fly a mission in the fast world: one flight here, several in worker processes."""
    mission = parse_mission(Document(text, path))
    refuse_unflyable(mission)
    mission = with_simulated_mocap(mission, None)
    spreads = parse_vary(wanted.vary, mission.vehicle)
    if wanted.fault is not None and wanted.flights > 1:
        raise InputError("a fault needs a single flight")
    fault = None if wanted.fault is None else parse_mission_fault(mission, wanted.fault)
    one = partial(fly_one, mission, spreads, fault, Path(log_dir) if wanted.log else None)
    seeds = range(wanted.seed, wanted.seed + wanted.flights)
    done, landed, last_s = 0, list[FlownOne](), time.monotonic()
    report(Progress(0, len(seeds)))
    with contextlib.closing(_landings(one, seeds)) as landings:
        for seed, result in landings:
            if isinstance(result, Failure):
                if isinstance(result.error, InputError | FlightError):
                    raise result.error
                raise FlightError(f"seed {seed}: {result.what}")
            done += 1
            landed.append(result)
            if done == len(seeds) or time.monotonic() - last_s > _PROGRESS_S:
                last_s = time.monotonic()
                report(Progress(done, len(seeds), landed))
                landed.clear()
    return AllFlown()


def _landings(one: Callable[[int], FlownOne], seeds: range) -> Generator[FinishedItem[int, FlownOne]]:
    if len(seeds) == 1:
        yield FinishedItem(seeds[0], attempt(one, seeds[0]))
    else:
        yield from work(one, seeds, min(usable_cores(), len(seeds)), Interrupt())


def fly_one(
    mission: Mission, spreads: Mapping[str, float], fault: Fault | None, log_dir: Path | None, seed: int
) -> FlownOne:
    """Fly one seed in this process, and return the outcome with the true path."""
    points, next_us = list[Vec3](), 0

    def follow(record: Record) -> None:
        nonlocal next_us
        if isinstance(record, TruthSample) and record.t_us >= next_us:
            next_us = record.t_us + _PATH_STEP_US
            points.append(record.position_mission)

    verdict: Verdict = fly_fast(mission, seed, log_dir, follow, fault=fault, spreads=spreads)
    reason = "; ".join(verdict.uncontrolled) or verdict.reason
    return FlownOne(seed, verdict.outcome.value, reason, np.array(points).reshape(-1, 3), verdict.log)


# --- the process ----------------------------------------------------------------------------------------


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests, one line each, until their stream ends."""

    def emit(line: bytes) -> None:
        answers.write(line)
        answers.flush()

    emit(READY)
    for line in requests:
        if line.strip():
            request: EngineRequest = from_line(line)

            def report(what: Any, number: int = request.number) -> None:
                emit(to_line(EngineEvent(number, what)) + b"\n")

            report(answer(request, report))


_TASKS: dict[str, Callable[..., Checked | Planned | AllFlown]] = {"check": check, "plan": plan, "fly": fly}


def answer(request: EngineRequest, report: Report) -> Checked | Planned | AllFlown | Failed:
    """Return the result of a request, or why there is none."""
    try:
        return _TASKS[request.task](request.text, request.path, report, *request.options)
    except InputError as error:
        return Failed(error.one_line())
    except (FlightError, OSError) as error:
        return Failed(str(error))
    except Exception as error:  # a defect must not end the process: the page shows it in one line
        return Failed(f"{type(error).__name__}: {error}")
