"""Draws of `--vary`: reproducible, independent of each other, and reported in log and verdict."""

import json
from pathlib import Path

import msgspec
import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.recording.reader import read_log
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from dart_flight.run.replay import replay
from dart_flight.sim.draws import NAMES, SPREADS, draw_world, parse_vary

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


def test_a_varied_flight_reports_its_draws_and_replays(tmp_path: Path) -> None:
    verdict = fly_fast(MISSION, 2, tmp_path, spreads=parse_vary(["all"], VEHICLE))
    assert verdict.outcome == "completed"
    log = read_log(str(verdict.log))
    assert json.loads(log.about["drawn"]) == pytest.approx(verdict.drawn)
    truth = verdict.collisions[0].truth
    assert truth is not None
    # The truth is that of the drawn world, whose wall is oblique and has another stiffness.
    assert truth.peak_force_n != verdict.collisions[0].planned.peak_force_n
    assert replay(log).equal


def test_vary_and_set_work_on_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = [
        "dry-run",
        str(ROOT / "missions/paper_single_wall.yaml"),
        "--fast",
        "--json",
        "--log-dir",
        str(tmp_path),
    ]
    status = main(
        [*arguments, "--set", "simulation.contact.body=guards", "--vary", "mass=0.1", "--seed", "5"]
    )
    verdict = json.loads(capsys.readouterr().out)
    assert status == 0
    assert list(verdict["drawn"]) == ["mass"]
    assert main([*arguments, "--vary", "mas"]) == 2
    assert "did you mean mass?" in capsys.readouterr().err
    assert main([*arguments, "--set", "simulatio.contact.body=guards"]) == 2
    assert "did you mean simulation?" in capsys.readouterr().err
