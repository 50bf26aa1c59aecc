"""Disagreement of flights with the contact coefficients, and identification from flight logs."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest
import yaml

from dart_flight.base.records import Mode, TruthContact, World
from dart_flight.check.mission_check import check_materials
from dart_flight.cli import main
from dart_flight.config.material_history import HistoryEntry, HistoryFile, history_path
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import VehicleConfig, load_vehicle, packaged
from dart_flight.lab.report.page import beyond, comparison_page, disagreements, flight_page
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import read_log
from dart_flight.run.prepare import load_flyable
from dart_flight.run.replay import replay
from tests.lab.report.other_wall import fly_against, with_walls
from tests.shared_flights import SharedFlights

pytestmark = pytest.mark.rest  # test_identify_output.py has an unmarked identification of a flight
CONFIG = packaged("configs", "dart.yaml")


@pytest.fixture(scope="module")
def single() -> Mission:
    # The identified law is a point's, so only a point's flights give the true value of every coefficient.
    return load_flyable(
        packaged("missions", "paper_single_wall.yaml"), CONFIG, ["simulation.contact.body=point"]
    )


@pytest.fixture(scope="module")
def stiffer_wall_logs(single: Mission, flown: SharedFlights) -> list[Path]:
    """Return the log of a flight against a wall whose k is 20 % above the configured value."""

    def fly(folder: Path) -> None:
        fly_against(single, with_walls(single, k=1.2), 1, folder / "1" / "flight.mcap")

    return sorted(flown.once("stiffer-wall", fly).glob("*/flight.mcap"))


def with_entry(text: str, path: Path) -> VehicleConfig:
    """Load the shipped configuration with an identified entry in place of the material's own."""
    config = yaml.safe_load(Path(CONFIG).read_text(encoding="utf-8"))
    config["materials"].update(yaml.safe_load(text)["materials"])
    path.write_text(yaml.safe_dump(config), encoding="utf-8")
    return load_vehicle(path)


def test_a_log_of_a_stiffer_wall_replays_with_the_mission_alone(
    stiffer_wall_logs: list[Path], single: Mission
) -> None:
    """The replaying core has only the log's mission with the softer wall and makes the same decisions."""
    log = read_log(stiffer_wall_logs[0])
    replayed = replay(log)
    assert replayed.exact
    assert replayed.equal
    assert flown_mission(log.about, log.source).vehicle.materials == single.vehicle.materials
    (contact,) = [e.record for e in log.entries if isinstance(e.record, TruthContact)]
    (impact,) = RecordedFlight.read(stiffer_wall_logs[0]).impacts
    predicted_n = impact.predicted.peak_force_n
    assert predicted_n is not None
    assert contact.peak_normal_force_n > 1.05 * predicted_n


@pytest.fixture(scope="module")
def agreeing(single: Mission, flown: SharedFlights) -> list[RecordedFlight]:
    """Return flights against walls with the configured coefficients."""

    def fly(folder: Path) -> None:
        fly_against(single, single, 1, folder / "1" / "flight.mcap")

    return [RecordedFlight.read(path) for path in sorted(flown.once("believed", fly).glob("*/flight.mcap"))]


@pytest.mark.rest
def test_flights_that_agree_with_the_prediction_show_no_disagreement(agreeing: list[RecordedFlight]) -> None:
    ((material, found),) = disagreements(agreeing).items()
    assert material == "acrylic"
    assert set(found) == {"flexible, normal", "flexible, friction"}
    assert not beyond(found)


@pytest.mark.rest
def test_the_page_of_a_flight_that_agrees_recommends_no_identification(
    agreeing: list[RecordedFlight],
) -> None:
    page = flight_page(agreeing[0])
    assert "Contact coefficients" in page
    assert page.count("Prediction and measurement agree.") == 1
    assert "dart-flight identify" not in page


def test_a_stiffer_wall_is_detected_and_the_page_shows_the_command_to_run(
    stiffer_wall_logs: list[Path],
) -> None:
    flights = [RecordedFlight.read(path) for path in stiffer_wall_logs]
    found = disagreements(flights)["acrylic"]
    mean, _ = found["flexible, normal"]
    assert mean == pytest.approx(1.2**0.5 - 1.0, abs=0.03)  # peaks are proportional to the square root of k
    assert beyond(found)
    page = comparison_page(flights)
    assert "<pre>dart-flight identify LOG... --surface acrylic -o acrylic.yaml</pre>" in page


def test_identify_writes_a_materials_entry_from_flight_logs(
    stiffer_wall_logs: list[Path], single: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "acrylic.yaml"
    logs = [str(path) for path in stiffer_wall_logs]
    assert main(["identify", *logs, "--surface", "acrylic", "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["coefficients"]
    assert set(found) == {"flexible"}
    for name, truth in (("k", 1500.0), ("f", 8.5), ("mu", 5.0), ("nu", 10.0)):
        assert found["flexible"][name]["low"] <= truth <= found["flexible"][name]["high"], name
    # The interval excludes the configured value.
    assert found["flexible"]["k"]["low"] > 1250.0
    acrylic = with_entry(out.read_text(encoding="utf-8"), tmp_path / "dart.yaml").materials["acrylic"]
    assert acrylic.source
    assert acrylic.coefficients(Mode.FLEXIBLE).k == pytest.approx(1.2 * 1250.0, rel=0.03)
    # The mode that was not flown keeps its coefficients.
    assert acrylic.rigid == single.vehicle.materials["acrylic"].rigid


@pytest.mark.rest
def test_a_slippery_wall_is_detected_by_its_friction(single: Mission, tmp_path: Path) -> None:
    path = fly_against(single, with_walls(single, mu=0.5), 1, tmp_path / "flight.mcap")
    found = disagreements([RecordedFlight.read(path)])["acrylic"]
    assert abs(found["flexible, normal"][0]) < 0.05
    assert found["flexible, friction"][0] < -0.2
    assert beyond(found)


def test_identify_needs_a_surface_for_flights_against_two_walls(
    trials: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", str(trials[0]), "--json"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "--surface" in error


def test_check_warns_if_later_flights_contradict_the_applied_coefficients(tmp_path: Path) -> None:
    config, today = tmp_path / "mine.yaml", datetime.now(UTC).date().isoformat()
    config.write_text(Path(CONFIG).read_text(encoding="utf-8"), encoding="utf-8")
    single = load_flyable(packaged("missions", "paper_single_wall.yaml"), str(config), [])
    (mode,) = {c.mode for c in single.collisions}
    entry = HistoryEntry(date=today, material="acrylic", mode=mode, hits=9, coefficients={}, software="")
    history = msgspec.to_builtins(HistoryFile(1, (entry,)))
    history_path(config).write_text(yaml.safe_dump(history), encoding="utf-8")
    flights = tmp_path / "flights"

    def warning() -> tuple[bool, str]:
        (finding,) = check_materials(single, flights)
        return finding.remark, finding.message

    stiffer = with_walls(single, k=1.5)
    fly_against(single, stiffer, 1, flights / "simulated" / "flight.mcap")
    assert warning() == (False, f"acrylic: [paper] in flight, Sec. V-A; coefficients: {mode} 0 days old")
    fly_against(single, stiffer, 1, flights / "vehicle" / "flight.mcap", World.DRONE)
    remark, message = warning()
    assert remark
    assert f"the last 1 hit {mode} had 2" in message
    assert "more force than these coefficients predict (limit 5 %)" in message
