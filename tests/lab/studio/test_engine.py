"""The studio's engine checks as `check`, plans as `plan`, flies as `dry-run --fast`, and is started again."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.records import AfterImpact
from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import decide
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import load_mission, parse_mission
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.engine import (
    Checked,
    CheckQuery,
    Engine,
    EngineDied,
    EngineEvent,
    EngineReady,
    FlightsFlown,
    FlightsQuery,
    FlownOne,
    FlyProgress,
    FlyRequest,
    Planned,
    PlanQuery,
)
from dart_flight.lab.studio.engine_work import check, fly, plan
from dart_flight.lab.studio.open_file import OpenFile, StudioKind
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from tests.lab.studio.files import DUAL, FILES, ROOT, name_of, one_edit, try_edit

SQUARE = ROOT / "missions" / "square.yaml"
ONE_WALL = ROOT / "missions" / "scenarios" / "one_wall.yaml"
PATIENCE_S = 120.0
E_ = TypeVar("E_", bound=EngineEvent)


class Page:
    """An engine, and its events in order."""

    def __init__(self, path: Path, folder: Path) -> None:
        self.events: queue.Queue[EngineEvent] = queue.Queue()
        self.engine = Engine(path, self.events.put, folder)

    def wait_for(self, kind: type[E_], number: int | None = None) -> E_:
        end_s = time.monotonic() + PATIENCE_S
        while True:
            event = self.events.get(timeout=max(0.1, end_s - time.monotonic()))
            if isinstance(event, kind) and number in (None, event.number):
                return event


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    opened = Page(DUAL, tmp_path_factory.mktemp("logs"))
    yield opened
    opened.engine.close()


def checked(text: str, path: Path = DUAL) -> Checked:
    return check(CheckQuery(1, str(path), text))


def file_stage(path: Path) -> bool:
    """Return what `check` decides on a file, from its stage `file`."""
    mission = load_mission(path)
    return decide(mission, run_checks(FlightContext(mission), Stage.FILE)).go


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_each_shipped_file_is_go_on_the_page_as_on_the_command_line(path: Path) -> None:
    found = checked(path.read_text("utf-8"), path)
    assert found.go == (path.parent.name == "scenarios" or file_stage(path))
    assert found.scene is not None
    assert found.stale is None


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_the_page_shows_as_go_check_calls_go(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    opened = OpenFile.load(data.draw(st.sampled_from(FILES)))
    for _ in range(data.draw(st.integers(1, 3))):
        try_edit(opened, data.draw(one_edit(opened)))
    shown = checked(opened.text, opened.path)
    opened.save(tmp_path_factory.mktemp("saved") / "room.yaml")
    try:
        go = (
            file_stage(opened.path) if opened.kind is StudioKind.MISSION else bool(load_scenario(opened.path))
        )
        problem = ""
    except InputError as error:
        go, problem = False, error.message
    assert shown.go == go
    assert problem in shown.findings[0].message if shown.findings else not problem


def test_an_error_is_at_its_object() -> None:
    for change, wanted in (
        (("material: wood", "material: brick"), "wall/wood"),
        (("wall: acrylic", "wall: acril"), "hit/1"),
        (("position_m: [1.0, -0.5]", "position_m: [9.0, 0.0]"), "goal"),
    ):
        (finding,) = checked(DUAL.read_text().replace(*change)).findings
        assert (finding.item, finding.word, finding.object) == ("file", "error", wanted)


def test_a_no_go_is_at_its_object() -> None:
    opened = OpenFile.load(DUAL)
    opened.edit(edits.move("goal", (1.0, -1.0)))
    found = checked(opened.text)
    assert not found.go
    bad = {finding.item: finding for finding in found.findings if not finding.go}
    assert bad["goal_clearance"].objects == ["goal", "wall/wood"]
    assert bad["goal_clearance"].word == "NO-GO"


def test_a_planned_mission_whose_wall_moved_is_stale() -> None:
    opened = OpenFile.load(ROOT / "missions" / "shuttle.yaml")
    for moved, place in (("wall/north", (1.7, 0.0)), ("wall/north", (1.54, 0.0)), ("goal", (0.5, 0.0))):
        opened.edit(edits.move(moved, place))
        assert checked(opened.text, opened.path).stale is not None
        opened.undo()
    assert checked(opened.text, opened.path).stale is None


def test_a_plan_is_a_mission_beside_the_scenario() -> None:
    found = plan(PlanQuery(1, str(ONE_WALL), ONE_WALL.read_text(), None, 60.0, 3), lambda event: None)
    assert found.error is None
    assert [row.rank for row in found.plans] == [1, 2, 3]
    assert found.refused
    assert found.refused.keys() == found.advice.keys()
    mission = parse_mission(Document(found.plans[0].mission, str(ONE_WALL)))
    assert mission.collisions[0].wall.name == "acrylic"
    assert found.plans[0].paths
    for row in found.plans:
        again = checked(row.mission, ONE_WALL)
        assert row.go == again.go
        assert row.problem in {"", *(finding.message for finding in again.findings)}


def test_a_mission_whose_wall_has_moved_is_planned_again_with_its_other_keys() -> None:
    opened = OpenFile.load(DUAL)
    opened.edit(edits.move("wall/acrylic", (1.85, 0.0)))
    text = yaml.safe_dump(edits.scenario_of(opened.tree, "again"))
    row = plan(PlanQuery(1, str(DUAL), text, None, 60.0, 1), lambda event: None).plans[0]
    opened.edit(edits.use_plan(row.mission, 1))
    mission = parse_mission(Document(opened.text, str(DUAL)))
    assert [collision.wall.name for collision in mission.collisions] == ["wood", "acrylic"]
    assert mission.after_impact is AfterImpact.REPLAN
    assert "after_impact: replan\n" in opened.text
    found = checked(opened.text)
    assert found.go == row.go
    assert found.stale is None
    opened.edit(edits.move("wall/acrylic", (1.65, 0.0)))
    assert checked(opened.text).stale is not None


def test_a_scenario_without_a_plan_says_why() -> None:
    text = ONE_WALL.read_text().replace("peak_force_n: 120.0", "peak_force_n: 1.0")
    found = plan(PlanQuery(1, str(ONE_WALL), text, None, 60.0, 3), lambda event: None)
    assert not found.plans
    assert found.error is not None
    assert "peak" in found.error


def test_the_objective_of_the_page_replaces_the_scenario_s() -> None:
    text = ONE_WALL.read_text()
    found = plan(PlanQuery(1, str(ONE_WALL), text, "gentlest", 60.0, 1), lambda event: None)
    assert "objective gentlest" in found.plans[0].mission


def flown(
    text: str, request: FlyRequest, folder: Path, path: Path = DUAL
) -> tuple[FlightsFlown, list[FlownOne]]:
    landed: list[FlownOne] = []

    def emit(event: EngineEvent) -> None:
        landed.extend(event.landed if isinstance(event, FlyProgress) else [])

    return fly(FlightsQuery(1, str(path), text, request, str(folder)), emit), landed


def test_a_flight_is_that_of_the_fast_world_and_has_a_log(tmp_path: Path) -> None:
    end, (one,) = flown(DUAL.read_text(), FlyRequest(seed=3), tmp_path)
    verdict = fly_fast(load_mission(DUAL), 3, None)
    assert end.summary == "seed 3 completed"
    assert (one.outcome, one.goal_miss_m) == (verdict.outcome.value, verdict.goal_miss_m)
    assert len(one.hits) == len(verdict.collisions) == 2
    assert one.path.shape[1] == 3
    assert one.log is not None
    assert read_log(Path(one.log)).complete


@pytest.mark.parametrize(
    ("request_", "problem"),
    [
        (FlyRequest(flights=2, fault="lock-stuck"), "a fault needs a single flight"),
        (FlyRequest(fault="nonsense"), "nonsense"),
        (FlyRequest(vary=("nonsense",)), "nonsense"),
    ],
)
def test_what_cannot_be_flown_says_why(request_: FlyRequest, problem: str, tmp_path: Path) -> None:
    end, landed = flown(DUAL.read_text(), request_, tmp_path)
    assert end.error is not None
    assert problem in end.error
    assert not landed


def test_an_unwritable_folder_of_logs_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file")
    end, _ = flown(SQUARE.read_text(), FlyRequest(), tmp_path / "logs", SQUARE)
    assert end.error is not None
    assert "\n" not in end.error


def test_the_page_s_checks_come_from_a_process(page: Page) -> None:
    text = DUAL.read_text()
    numbers = [page.engine.check(text) for _ in range(20)]
    last = page.wait_for(Checked, numbers[-1])
    assert last.go
    assert last.materials == ["concrete", "acrylic", "wood"]
    assert last.modes == ["rigid", "flexible"]
    assert last.scene is not None
    assert last.scene.predicted


def test_many_flights_progress_in_worker_processes_and_are_cancelled(page: Page) -> None:
    text = SQUARE.read_text()
    page.engine.path = SQUARE
    number = page.engine.fly(text, FlyRequest(flights=2, vary=("all",), log=False))
    assert page.wait_for(FlightsFlown, number).done == 2
    number = page.engine.fly(text, FlyRequest(flights=1000, log=False))
    page.wait_for(FlyProgress, number)
    began_s = time.monotonic()
    page.engine.cancel()
    end = page.wait_for(FlightsFlown, number)
    assert time.monotonic() - began_s < 1.0
    assert end.cancelled
    assert end.summary.startswith("cancelled after")
    page.engine.path = DUAL


def test_a_plan_is_cancelled_and_the_next_one_runs(page: Page) -> None:
    page.engine.path = ONE_WALL
    first = page.engine.plan(ONE_WALL.read_text())
    second = page.engine.plan(ONE_WALL.read_text(), top=1)
    assert page.wait_for(Planned, first).cancelled
    assert len(page.wait_for(Planned, second).plans) == 1
    page.engine.path = DUAL


def test_a_process_that_dies_is_started_again_and_its_check_is_repeated(page: Page) -> None:
    process = page.engine._checker._process
    assert process is not None
    process.kill()
    number = page.engine.check(DUAL.read_text())
    died = page.wait_for(EngineDied)
    assert died.message == "the process that checks ended unexpectedly; it was started again"
    assert page.wait_for(Checked, number).go


def test_a_planner_that_dies_ends_its_plan_with_a_reason(page: Page) -> None:
    scenario = ROOT / "missions" / "scenarios" / "shuttle.yaml"
    page.engine.path = scenario
    number = page.engine.plan(scenario.read_text())
    process = page.engine._worker._process
    assert process is not None
    process.kill()
    page.wait_for(EngineDied)
    end = page.wait_for(Planned, number)
    assert end.error == "the process that plans and flies ended unexpectedly"
    assert not end.cancelled
    page.wait_for(EngineReady)
    page.engine.path = DUAL
