"""The studio's engine checks as `check`, plans as `plan`, flies as `dry-run --fast`, and is started again."""

from __future__ import annotations

import queue
import subprocess
import sys
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
from dart_flight.config.mission import Mission, load_mission, parse_mission
from dart_flight.lab.search.scenario import parse_scenario
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.engine import (
    AllFlown,
    Checked,
    Engine,
    EngineEvent,
    EngineRequest,
    Failed,
    FlownOne,
    FlyRequest,
    Planned,
    Progress,
)
from dart_flight.lab.studio.engine_work import answer, check, plan
from dart_flight.lab.studio.open_file import OpenFile, StudioKind
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from tests.lab.studio.files import DUAL, FILES, ROOT, name_of, one_edit, try_edit

SQUARE = ROOT / "missions" / "square.yaml"
ONE_WALL = ROOT / "missions" / "scenarios" / "one_wall.yaml"
PATIENCE_S = 120.0
W = TypeVar("W")


class Page:
    """An engine, and its events in order."""

    def __init__(self, folder: Path) -> None:
        self.events: queue.Queue[EngineEvent] = queue.Queue()
        self.engine = Engine(self.events.put, folder)

    def wait_for(self, kind: type[W], number: int) -> W:
        end_s = time.monotonic() + PATIENCE_S
        while True:
            event = self.events.get(timeout=max(0.1, end_s - time.monotonic()))
            if isinstance(event.what, kind) and event.number == number:
                return event.what


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    opened = Page(tmp_path_factory.mktemp("logs"))
    yield opened
    opened.engine.close()


def ignore(progress: Progress) -> None:
    """Ignore the progress of a request."""


def checked(text: str, path: Path = DUAL) -> Checked:
    return check(text, str(path), ignore)


def file_stage(mission: Mission) -> bool:
    """Return what `check` decides on a file, from its stage `file`."""
    return decide(mission, run_checks(FlightContext(mission), Stage.FILE)).go


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_each_shipped_file_is_go_on_the_page_as_on_the_command_line(path: Path) -> None:
    found = checked(path.read_text("utf-8"), path)
    assert found.go == (path.parent.name == "scenarios" or file_stage(load_mission(path)))
    assert found.scene is not None
    assert found.stale is None


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_the_page_shows_as_go_check_calls_go(data: st.DataObject) -> None:
    opened = OpenFile.load(data.draw(st.sampled_from(FILES)))
    for _ in range(data.draw(st.integers(1, 3))):
        try_edit(opened, data.draw(one_edit(opened)))
    shown = checked(opened.text, opened.path)
    document, go, problem = Document(opened.text, str(opened.path)), True, ""
    try:
        if opened.kind is StudioKind.MISSION:
            go = file_stage(parse_mission(document))
        else:
            parse_scenario(document)
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
        assert (finding.item, finding.go, finding.objects) == ("file", False, [wanted])


def test_a_no_go_is_at_its_object() -> None:
    opened = OpenFile.load(DUAL)
    opened.edit(edits.move("goal", (1.0, -1.0)))
    found = checked(opened.text)
    assert not found.go
    bad = {finding.item: finding for finding in found.findings if not finding.go}
    assert bad["goal_clearance"].objects == ["goal", "wall/wood"]


def test_a_planned_mission_whose_wall_moved_is_stale() -> None:
    opened = OpenFile.load(ROOT / "missions" / "shuttle.yaml")
    for moved, place in (("wall/north", (1.7, 0.0)), ("wall/north", (1.54, 0.0)), ("goal", (0.5, 0.0))):
        opened.edit(edits.move(moved, place))
        assert checked(opened.text, opened.path).stale is not None
        opened.undo()
    assert checked(opened.text, opened.path).stale is None


def test_a_plan_is_a_mission_beside_the_scenario() -> None:
    found = plan(ONE_WALL.read_text(), str(ONE_WALL), ignore, None, 60.0)
    assert [row.rank for row in found.plans] == [*range(1, 11), 0][: len(found.plans)]
    assert found.refused
    mission = parse_mission(Document(found.plans[0].mission, str(ONE_WALL)))
    assert mission.collisions[0].wall.name == "acrylic"
    assert found.plans[0].paths
    for row in found.plans[:3]:
        again = checked(row.mission, ONE_WALL)
        assert again.go == (not row.problem)
        assert row.problem in {"", *(f"no-go: {finding.message}" for finding in again.findings)}


def test_a_mission_whose_wall_has_moved_is_planned_again_with_its_other_keys() -> None:
    opened = OpenFile.load(DUAL)
    opened.edit(edits.move("wall/acrylic", (1.85, 0.0)))
    text = yaml.safe_dump(edits.scenario_of(opened.tree, "again"))
    row = plan(text, str(DUAL), ignore, None, 60.0).plans[0]
    opened.edit(edits.use_plan(row.mission, 1))
    mission = parse_mission(Document(opened.text, str(DUAL)))
    assert [collision.wall.name for collision in mission.collisions] == ["wood", "acrylic"]
    assert mission.after_impact is AfterImpact.REPLAN
    assert "after_impact: replan\n" in opened.text
    found = checked(opened.text)
    assert found.go == (not row.problem)
    assert found.stale is None
    opened.edit(edits.move("wall/acrylic", (1.65, 0.0)))
    assert checked(opened.text).stale is not None


def test_a_scenario_without_a_plan_says_why() -> None:
    text = ONE_WALL.read_text().replace("peak_force_n: 120.0", "peak_force_n: 1.0")
    found = answer(EngineRequest(1, "plan", text, str(ONE_WALL), (None, 60.0)), ignore)
    assert isinstance(found, Failed)
    assert "peak" in found.message


def test_the_objective_of_the_page_replaces_the_scenario_s() -> None:
    found = plan(ONE_WALL.read_text(), str(ONE_WALL), ignore, "gentlest", 60.0)
    assert "objective gentlest" in found.plans[0].mission


def flown(
    text: str, request: FlyRequest, folder: Path, path: Path = DUAL
) -> tuple[AllFlown | Failed, list[FlownOne]]:
    landed: list[FlownOne] = []
    wanted = EngineRequest(1, "fly", text, str(path), (request, str(folder)))
    end = answer(wanted, lambda progress: landed.extend(progress.landed))
    assert isinstance(end, AllFlown | Failed)
    return end, landed


def test_a_flight_is_that_of_the_fast_world_and_has_a_log(tmp_path: Path) -> None:
    end, (one,) = flown(DUAL.read_text(), FlyRequest(seed=3), tmp_path)
    verdict = fly_fast(load_mission(DUAL), 3, None)
    assert isinstance(end, AllFlown)
    assert (one.seed, one.outcome, one.reason) == (3, verdict.outcome.value, verdict.reason)
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
    assert isinstance(end, Failed)
    assert problem in end.message
    assert not landed


def test_an_unwritable_folder_of_logs_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file")
    end, _ = flown(SQUARE.read_text(), FlyRequest(), tmp_path / "logs", SQUARE)
    assert isinstance(end, Failed)
    assert "\n" not in end.message


def test_the_page_s_checks_come_from_a_process(page: Page) -> None:
    text = DUAL.read_text()
    numbers = [page.engine.check(text, DUAL) for _ in range(20)]
    last = page.wait_for(Checked, numbers[-1])
    assert last.go
    assert last.materials == ["concrete", "acrylic", "wood"]
    assert last.modes == ["rigid", "flexible"]
    assert last.scene is not None
    assert last.scene.predicted


def test_many_flights_progress_in_worker_processes_and_are_cancelled(page: Page) -> None:
    text = SQUARE.read_text()
    number = page.engine.fly(text, SQUARE, FlyRequest(flights=2, vary=("all",), log=False))
    assert page.wait_for(AllFlown, number) == AllFlown()
    number = page.engine.fly(text, SQUARE, FlyRequest(flights=1000, log=False))
    page.wait_for(Progress, number)
    page.engine.cancel()
    assert page.wait_for(Failed, number).cancelled


def test_a_plan_is_cancelled_and_the_next_one_runs(page: Page) -> None:
    first = page.engine.plan(ONE_WALL.read_text(), ONE_WALL)
    second = page.engine.plan(ONE_WALL.read_text(), ONE_WALL)
    assert page.wait_for(Failed, first).cancelled
    assert page.wait_for(Planned, second).plans


def test_a_process_that_dies_is_started_again(page: Page) -> None:
    number = page.engine.check(DUAL.read_text(), DUAL)
    page.wait_for(Checked, number)
    process = page.engine._checker._process
    assert process is not None
    process.kill()
    died = page.wait_for(Failed, 0)
    assert died.message == "the process that checks ended unexpectedly; it was started again"
    number = page.engine.check(DUAL.read_text(), DUAL)
    assert page.wait_for(Checked, number).go


def test_a_planner_that_dies_ends_its_plan_with_a_reason(page: Page) -> None:
    scenario = ROOT / "missions" / "scenarios" / "shuttle.yaml"
    number = page.engine.plan(scenario.read_text(), scenario)
    process = page.engine._worker._process
    assert process is not None
    process.kill()
    end = page.wait_for(Failed, number)
    assert end.message.startswith("the process that plans and flies ended unexpectedly")
    assert not end.cancelled
    number = page.engine.plan(ONE_WALL.read_text(), ONE_WALL)
    assert page.wait_for(Planned, number).plans


def test_a_process_whose_page_has_ended_exits_silently() -> None:
    command = [sys.executable, "-m", "dart_flight.lab.studio.engine_process"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
