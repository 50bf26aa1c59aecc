"""Draws of `--vary`: reproducible, independent of each other, and reported in log and verdict."""

import json
from pathlib import Path

import msgspec
import pytest

from dart_flight.config.document import InputError
from dart_flight.recording.reader import read_log
from dart_flight.run.prepare import load_flyable
from dart_flight.run.replay import replay
from dart_flight.sim.draws import NAMES, SPREADS, draw_world, parse_vary
from tests.command_fixtures import RunJson

ROOT = Path(__file__).parents[2]
MISSION = load_flyable(ROOT / "missions/paper_single_wall.yaml", None, ["simulation.contact.body=guards"])
VEHICLE = MISSION.vehicle


def test_all_selects_every_name_and_an_explicit_value_takes_precedence() -> None:
    parsed = parse_vary(["mass=0.2", "all"], VEHICLE)
    assert set(parsed) == set(NAMES)
    assert parsed["mass"] == 0.2
    assert parsed["contact"] == SPREADS["contact"]


@pytest.mark.parametrize("setting", ["mas", "mass=heavy", "mass=-1", "mass=nan", "all=2"])
def test_a_wrong_setting_is_named(setting: str) -> None:
    with pytest.raises(InputError, match="--vary " + setting.split("=", maxsplit=1)[0]):
        parse_vary([setting], VEHICLE)


def test_a_seed_determines_each_draw_independently_of_the_other_names() -> None:
    few = draw_world(MISSION, 3, parse_vary(["mass", "wall_yaw_deg"], VEHICLE))
    many = draw_world(MISSION, 3, parse_vary(["all"], VEHICLE))
    assert few == draw_world(MISSION, 3, parse_vary(["wall_yaw_deg", "mass"], VEHICLE))
    assert few.drawn.items() <= many.drawn.items()
    assert draw_world(MISSION, 4, parse_vary(["mass"], VEHICLE)).drawn != {"mass": few.drawn["mass"]}


def test_a_draw_does_not_change_the_mission() -> None:
    before = msgspec.json.encode(MISSION)
    world = draw_world(MISSION, 1, parse_vary(["all"], VEHICLE))
    assert msgspec.json.encode(MISSION) == before
    assert world.mission.walls != MISSION.walls
    assert world.mission.vehicle.airframe.mass_kg != MISSION.vehicle.airframe.mass_kg


def test_a_varied_flight_reports_its_draws_and_replays(run_json: RunJson, tmp_path: Path) -> None:
    words = ["dry-run", ROOT / "missions/paper_single_wall.yaml", "--fast", "--log-dir", tmp_path]
    words += ["--set", "simulation.contact.body=guards", "--vary", "all", "--seed", "2"]
    verdict, _ = run_json(*words)
    assert verdict["outcome"] == "completed"
    assert verdict["drawn"] == pytest.approx(draw_world(MISSION, 2, parse_vary(["all"], VEHICLE)).drawn)
    log = read_log(verdict["log"])
    assert json.loads(log.about["drawn"]) == pytest.approx(verdict["drawn"])
    # The truth is that of the drawn world, whose wall is oblique and has another stiffness.
    hit = verdict["collisions"][0]
    assert hit["truth"]["peak_force_n"] != hit["planned"]["peak_force_n"]
    assert replay(log).equal
