"""A vehicle without a lock: its only mode is rigid, and no output mentions a lock."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from dart_flight.base.records import LockCommand, LockPermission, LockState, Mode, PhaseChange, WallEstimate
from dart_flight.check.vehicle_check import evaluate_lock
from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import LockDriver, VehicleConfig, packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.core.mission.phases import TRANSITIONS, PhaseTrigger
from dart_flight.lab.report.page import flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.search.scenario import load_scenario
from dart_flight.lab.search.search import search
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable, with_driver
from dart_flight.run.replay import replay
from dart_flight.sim.draws import draw_world, parse_vary
from tests.mission_findings import check_mission
from tests.shared_flights import SharedFlights

DART = packaged("configs", "dart.yaml")
SINGLE = packaged("missions", "paper_single_wall.yaml").read_text("utf-8")
DUAL = packaged("missions", "dual_collision_replan.yaml").read_text("utf-8")
ONE_WALL = packaged("missions", "scenarios", "one_wall.yaml").read_text("utf-8")
NO_LOCK = f"extends: {DART}\nlock: {{driver: none}}\n"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    (tmp_path / "cage.yaml").write_text(NO_LOCK)
    return tmp_path


def write_without_modes(text: str, name: str = "mission.yaml") -> Path:
    """Write a mission or scenario without modes, for the vehicle without a lock."""
    for mode in ("flexible", "rigid"):
        text = text.replace(f"mode: {mode}, ", "").replace(f"transit_mode: {mode}\n", "")
    text = text.replace("../../configs/dart.yaml", "cage.yaml").replace("../configs/dart.yaml", "cage.yaml")
    assert "mode:" not in text
    Path(name).write_text(text)
    return Path(name)


@pytest.fixture
def mission(folder: Path) -> Mission:
    return load_flyable(write_without_modes(SINGLE))


def test_driver_none_and_a_missing_lock_section_describe_the_same_vehicle(folder: Path) -> None:
    whole = load_vehicle(DART)
    none = load_vehicle("cage.yaml")
    assert none == msgspec.structs.replace(whole, lock=None)
    # Drop the lock section and the flexible coefficients.
    text = DART.read_text("utf-8")
    kept, skipping = [], False
    for line in text.splitlines():
        skipping = line.startswith("lock:") or (skipping and (line.startswith(" ") or not line))
        if not skipping and not line.startswith("    flexible:"):
            kept.append(line)
    Path("bare.yaml").write_text("\n".join(kept))
    bare = load_vehicle("bare.yaml")
    assert bare.modes == none.modes == (Mode.RIGID,)
    assert whole.modes == (Mode.RIGID, Mode.FLEXIBLE)
    assert not bare.has_lock
    assert bare.materials["wood"].flexible is None
    # A log stores the same configuration.
    assert msgspec.json.decode(msgspec.json.encode(bare), type=VehicleConfig) == bare


def test_a_vehicle_with_a_lock_needs_flexible_coefficients(folder: Path) -> None:
    text = DART.read_text("utf-8")
    line = next(line for line in text.splitlines() if line.startswith("    flexible:"))
    Path("lacks.yaml").write_text(text.replace(line + "\n", "", 1))
    with pytest.raises(InputError) as error:
        load_vehicle("lacks.yaml")
    assert str(error.value).startswith("lacks.yaml:")
    assert "materials.concrete: missing key `flexible`: the vehicle has a lock" in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("approach: {normal", "mode: flexible, approach: {normal", "collisions[0].mode: "),
        ("limits:", "transit_mode: flexible\nlimits:", "transit_mode: "),
    ],
)
def test_the_flexible_mode_is_refused_in_one_line(folder: Path, old: str, new: str, where: str) -> None:
    path = write_without_modes(SINGLE)
    text = path.read_text().replace(old, new)
    path.write_text(text)
    line = 1 + text[: text.index(new)].count("\n")
    with pytest.raises(InputError) as error:
        load_mission(path)
    refusal = "this vehicle has no lock: its mode is always rigid, not flexible"
    assert str(error.value) == f"{path}:{line}: {where}{refusal}"


def test_a_vehicle_with_a_lock_needs_a_mode_for_every_collision(folder: Path) -> None:
    path = write_without_modes(SINGLE)
    with pytest.raises(InputError, match=r":\d+: collisions\[0\]: missing key mode: rigid or flexible"):
        load_mission(path, DART)


def test_a_flight_without_a_lock_hits_a_wall_and_mentions_no_lock(flown: SharedFlights) -> None:
    flight = flown("rigid_cage/single_wall", 1)
    (hit,) = flight.verdict.collisions
    assert hit.mode == "rigid"
    assert (hit.lock, hit.mode_felt, hit.mode_log_odds) == (None, None, None)
    log = read_log(flight.log)
    records = [entry.record for entry in log.entries]
    assert not [r for r in records if isinstance(r, LockCommand | LockPermission | LockState)]
    estimates = [r for r in records if isinstance(r, WallEstimate)]
    assert [(f.mode_felt, f.mode_reported, f.log_odds) for f in estimates] == [(None, Mode.RIGID, 0.0)]
    (collision,) = flown_mission(log.about, log.source).collisions
    material = load_vehicle(packaged("configs", "rigid_cage.yaml")).materials[collision.wall.material]
    assert estimates[0].k_n_per_m == pytest.approx(material.rigid.k, rel=0.2)
    phases = [r.after.value for r in records if isinstance(r, PhaseChange)]
    assert "prepare" not in phases
    assert phases.index("approach") == phases.index("transit") + 1


@pytest.mark.rest
def test_the_page_of_a_flight_without_a_lock_mentions_no_lock(flown: SharedFlights) -> None:
    page = flight_page(RecordedFlight.read(flown("rigid_cage/single_wall", 1).log))
    assert "may lock" not in page
    assert "commanded" not in page
    assert "Lock and timing" not in page
    assert "where the lock was" not in page


@pytest.mark.rest
def test_rehearsal_and_replanning_work_without_a_lock(mission: Mission) -> None:
    rehearsed = fly_fast(msgspec.structs.replace(mission, standoff_m=0.5), 1, None)
    assert (rehearsed.outcome, rehearsed.collisions) == ("completed", [])
    approach = "approach: {normal_m_s: -0.8, tangential_m_s: 0.3}, impact_point_m: [1.65, 0.2], alpha"
    dual = load_flyable(write_without_modes(DUAL.replace("rigid, alpha", f"rigid, {approach}")))
    verdict = fly_fast(dual, 1, Path("flights"))
    assert verdict.outcome == "completed"
    assert [(c.wall, c.mode, c.lock) for c in verdict.collisions] == [
        ("wood", "rigid", None),
        ("acrylic", "rigid", None),
    ]
    assert replay(read_log(str(verdict.log))).equal
    assert fly_fast(mission, 1, None, spreads=parse_vary(["all"], mission.vehicle)).outcome == "completed"


def test_check_has_no_finding_about_a_lock(mission: Mission) -> None:
    assert evaluate_lock(mission, {}) == []
    items = [finding.item for finding in check_mission(mission)]
    assert items
    assert not [item for item in items if "lock" in item or "servo" in item]


def test_a_vehicle_without_a_lock_skips_preparation_and_refuses_a_driver(mission: Mission) -> None:
    assert [after for (_, trigger), after in TRANSITIONS.items() if trigger is PhaseTrigger.NO_LOCK] == [
        "approach"
    ]
    with pytest.raises(InputError, match="no lock"):
        with_driver(mission, LockDriver.MOCK)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["lock", "status", "--config", "cage.yaml"], "this vehicle has no lock"),
        (["dry-run", "mission.yaml", "--fast", "--driver", "mock"], "this vehicle has no lock"),
        (["dry-run", "mission.yaml", "--fast", "--vary", "servo"], "this vehicle has no lock"),
        (["dry-run", "mission.yaml", "--fast", "--vary", "lock_true_mode=1"], "this vehicle has no lock"),
        (["dry-run", "mission.yaml", "--fast", "--fault", "servo-stuck"], "this vehicle has no lock"),
        (["tables", "--config", "cage.yaml"], "need a vehicle with a lock"),
        (
            ["predict", "--config", "cage.yaml", "--surface", "wood", "--mode", "flexible", "--drop", "0.1"],
            "always rigid, not flexible",
        ),
        (
            ["identify", "x.csv", "--mode", "flexible", "--config", "cage.yaml"],
            "always rigid, not flexible",
        ),
    ],
)
def test_options_of_a_lock_are_refused_in_one_line(
    mission: Mission, words: list[str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert problem in line


def test_vary_all_excludes_the_lock(mission: Mission) -> None:
    spreads = parse_vary(["all"], mission.vehicle)
    assert not {"servo", "lock_true_mode"} & set(spreads)
    assert {"contact", "mass"} < set(spreads)
    drawn = draw_world(mission, 1, spreads)
    assert not [name for name in drawn.drawn if "flexible" in name]


def test_predict_needs_no_mode(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hit = ["predict", "--surface", "acrylic", "--velocity", "-1", "0.5", "--json"]
    assert main([*hit, "--config", "cage.yaml"]) == 0
    without = json.loads(capsys.readouterr().out)
    assert main([*hit, "--config", str(DART), "--mode", "rigid"]) == 0
    assert without["peak_normal_force_n"] == json.loads(capsys.readouterr().out)["peak_normal_force_n"]


def test_the_planner_tries_only_the_modes_of_the_vehicle(folder: Path) -> None:
    path = write_without_modes(ONE_WALL.replace("  modes: [rigid, flexible]\n", ""), "scenario.yaml")
    scenario = load_scenario(path)
    assert scenario.modes == (Mode.RIGID,)
    assert load_scenario(path, DART).modes == (Mode.RIGID, Mode.FLEXIBLE)
    found = search(scenario, top=3)
    assert found.plans
    assert {c.mode for plan in found.plans for c in plan.collisions} == {Mode.RIGID}
