"""Every command that uses a vehicle names it on standard error and in --json."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dart_flight.base.records import World
from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.provenance import find_vehicle
from dart_flight.config.vehicle import packaged
from dart_flight.recording.about import describe_flight, flown_mission

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
SCENARIO = str(packaged("missions", "scenarios", "one_wall.yaml"))
PREDICT = ["predict", "--surface", "acrylic", "--mode", "rigid", "--velocity", "-1", "0"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder without a configuration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    monkeypatch.setenv("DART_FLIGHT_STATE_DIR", str(tmp_path / "state"))
    return tmp_path


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
def test_a_command_names_its_vehicle(
    command: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_configuration(folder)
    assert main([*command, "--config", str(path), "--json"]) == 0
    streams = capsys.readouterr()
    printed = json.loads(streams.out)
    expected = {"source": "configs/dart.yaml", "packaged": False, "mass_kg": 0.9}
    assert printed["vehicle"] == expected
    for run in printed.get("runs", []):
        assert run["vehicle"] == expected
    assert "vehicle: configs/dart.yaml, 0.9 kg" in streams.err


def test_the_configuration_of_the_working_folder_is_used(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_configuration(folder)
    assert main([*PREDICT, "--json"]) == 0
    streams = capsys.readouterr()
    assert json.loads(streams.out)["vehicle"]["mass_kg"] == 0.9
    assert "not used" not in streams.err


def test_the_packaged_configuration_is_used_if_there_is_no_other(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "notes.yaml").write_text("shopping: [milk]\n")
    assert main([*PREDICT, "--json"]) == 0
    streams = capsys.readouterr()
    vehicle = json.loads(streams.out)["vehicle"]
    assert vehicle["packaged"] is True
    assert "the packaged configuration" in streams.err
    assert "not used" not in streams.err


def test_the_only_configuration_of_the_folder_is_used_and_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_configuration(folder, "configs/lab.yaml")
    assert main(PREDICT) == 0
    assert "vehicle: configs/lab.yaml" in capsys.readouterr().err


def test_two_configurations_require_an_explicit_choice(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_configuration(folder, "configs/lab.yaml")
    write_configuration(folder, "configs/outdoors.yaml")
    assert main(PREDICT) == 2
    assert "configs: contains several vehicles (lab.yaml, outdoors.yaml)" in capsys.readouterr().err
    assert main([*PREDICT, "--config", "configs/outdoors.yaml"]) == 0


def test_an_unused_configuration_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_configuration(folder, "mine.yaml")
    assert main(PREDICT) == 0
    assert "note: mine.yaml" in capsys.readouterr().err
    assert main([*PREDICT, "--config", str(packaged("configs", "dart.yaml"))]) == 0
    assert "not used" not in capsys.readouterr().err, "no note beside an explicit --config"


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
