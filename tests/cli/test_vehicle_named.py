"""Every command that uses a vehicle names it on standard error and in --json."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.base.records import World
from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import packaged
from dart_flight.recording.about import describe_flight, flown_mission
from tests.command_fixtures import Refuse, RunJson

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
SCENARIO = str(packaged("missions", "scenarios", "one_wall.yaml"))
PREDICT = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1", "0"]


def write_configuration(folder: Path, name: str = "configs/dart.yaml", mass: str = "0.9") -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(packaged("configs", "dart.yaml").read_text().replace("mass_kg: 1.3", f"mass_kg: {mass}"))
    return path


@pytest.mark.parametrize(
    "command",
    [
        PREDICT,
        ["tables"],
        ["plan", SCENARIO, "--top", "1"],
        ["check", MISSION],
        ["lock", "status", "--driver", "mock"],
        ["dry-run", MISSION, "--fast", "--runs", "1"],
        pytest.param(["survey", MISSION, "--fast"], marks=pytest.mark.rest),
    ],
    ids=lambda words: words[0],
)
def test_a_command_names_its_vehicle(command: list[str], folder: Path, run_json: RunJson) -> None:
    printed, errors = run_json(*command, "--config", write_configuration(folder))
    expected = {"source": "configs/dart.yaml", "packaged": False, "mass_kg": 0.9}
    assert printed["vehicle"] == expected
    for run in printed.get("runs", []):
        assert run["vehicle"] == expected
    assert "vehicle: configs/dart.yaml, 0.9 kg" in errors


@pytest.mark.parametrize(
    ("found", "named"),
    [
        ("configs/dart.yaml", "vehicle: configs/dart.yaml, 0.9 kg"),
        ("configs/lab.yaml", "vehicle: configs/lab.yaml, 0.9 kg"),
        ("", "the packaged configuration"),
        ("mine.yaml", "note: mine.yaml"),  # not below configs/: named, because it is not used
    ],
)
def test_the_only_configuration_below_configs_is_used_and_named(
    found: str, named: str, folder: Path, run_json: RunJson
) -> None:
    (folder / "notes.yaml").write_text("shopping: [milk]\n")
    path = write_configuration(folder, found) if found else packaged("configs", "dart.yaml")
    printed, errors = run_json(*PREDICT)
    assert printed["vehicle"]["packaged"] is not found.startswith("configs/")
    assert named in errors
    assert ("not used" in errors) is (found == "mine.yaml")
    _, errors = run_json(*PREDICT, "--config", path)
    assert "not used" not in errors, "no note beside an explicit --config"


def test_two_configurations_require_an_explicit_choice(folder: Path, refusal_of: Refuse) -> None:
    write_configuration(folder, "configs/lab.yaml")
    write_configuration(folder, "configs/outdoors.yaml")
    assert "configs: contains several vehicles (lab.yaml, outdoors.yaml)" in refusal_of(*PREDICT)
    assert main([*PREDICT, "--config", "configs/outdoors.yaml"]) == 0


def test_the_vehicle_of_a_mission_overrides_the_environment_variable(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_configuration(folder.parent, f"{folder.name}-elsewhere.yaml")
    monkeypatch.setenv("DART_FLIGHT_CONFIG", str(path))
    assert main(["check", MISSION]) == 0
    assert f"note: {path}" in capsys.readouterr().err.replace("\n", "")


def test_the_log_contains_the_vehicle(folder: Path) -> None:
    write_configuration(folder)
    mission = load_mission(MISSION, "configs/dart.yaml")
    assert mission.flown_vehicle() == find_vehicle("configs/dart.yaml").source
    about = describe_flight(mission, World.FAST, 1)
    assert flown_mission(about, "x").flown_vehicle() == mission.flown_vehicle()
