"""In a folder made by `init`, commands run with every shipped vehicle and use the mission's vehicle."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.starter import DART, VEHICLES, first_mission
from dart_flight.vehicle.link import LinkLease, feed_name

NO_PORT = "serial:///dev/no_such_port:57600"
# Every command below loads its vehicle before it refuses the serial port.
LINKED = [["mocap", "--mocap", "udp://127.0.0.1:9763/ring"], ["monitor"], ["bringup"], ["standby"]]


@pytest.fixture(params=VEHICLES)
def vehicle(request: pytest.FixtureRequest, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Change to a folder that `init` made for a vehicle, and return the vehicle's name."""
    name: str = request.param
    assert main(["init", str(folder / "lab"), "--vehicle", name]) == 0
    monkeypatch.chdir(folder / "lab")
    return name


@pytest.mark.parametrize("words", LINKED, ids=lambda words: words[0])
def test_a_command_that_uses_no_mission_loads_none(
    words: list[str], vehicle: str, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main([*words, "--connection", NO_PORT]) == 2
    assert "/dev/no_such_port" in capsys.readouterr().err


def test_simulate_without_a_mission_simulates_the_folders_vehicle(
    vehicle: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with LinkLease(feed_name(14777), "test"):
        assert main(["simulate", "--port", "14777"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert f"vehicle: configs/{vehicle}.yaml" in lines[-2]
    assert "another vehicle already sends to this port" in lines[-1]


@pytest.mark.rest
def test_the_papers_tables_are_computed_with_a_vehicle_that_has_a_lock(vehicle: str) -> None:
    assert main(["tables", "-o", "tables.md"]) == 0


@pytest.mark.rest
def test_the_own_scenario_can_be_planned_and_the_plan_flown(vehicle: str) -> None:
    folder = Path("missions") if vehicle == DART else Path("missions") / vehicle
    scenario, planned = folder / "scenarios" / "one_wall.yaml", "planned.yaml"
    assert main(["plan", str(scenario), "--no-verify", "-o", planned]) == 0
    assert main(["dry-run", planned, "--fast"]) == 0


@pytest.mark.parametrize(
    "words", [["check"], ["monitor", "--mission"], ["bringup"], ["standby"], ["parameters"]]
)
def test_in_a_folder_with_two_vehicles_a_command_uses_its_missions_vehicle(
    words: list[str], vehicle: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(f"configs/{vehicle}.yaml", "configs/mine.yaml")
    with Path("configs/mine.yaml").open("a") as file:
        file.write("# mine\n")
    mission = first_mission(vehicle)
    mission.write_text(mission.read_text().replace(f"{vehicle}.yaml", "mine.yaml"))
    capsys.readouterr()
    assert main([*words, str(mission), "--connection", NO_PORT]) == 2
    error = capsys.readouterr().err
    assert "several vehicles" not in error
    assert "/dev/no_such_port" in error
