"""Missions that the core refuses to fly: `check` reports the line that ends a `dry-run` as a no-go."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from dart_flight.check.computer_load import check_core_speed
from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged

# For each case, the replacement in the single-wall mission and the expected problem.
UNFLYABLE = {
    "impact outside the bounds": (
        ("x: [-1.5, 2.2]", "x: [-1.5, 1.0]"),
        "the impact at (1.65, 0.82) is 0.65 m outside bounds_m",
    ),
    "wall at 2,000 m": (("point_m: [1.65, 0.5]", "point_m: [2000.0, 1000.0]"), "m outside bounds_m"),
    "no room for the run-up": (
        ("x: [-1.5, 2.2], y: [-1.5", "x: [-0.05, 2.2], y: [-1.5"),
        "the run-up to wall acrylic at 1.12 m/s starts at",
    ),
    "post in the run-up": (
        ("collisions:", "posts: {pole: {centre_m: [0.8, 0.4], radius_m: 0.05, material: wood}}\ncollisions:"),
        "post pole blocks the run-up",
    ),
    "wall in the way to a waypoint": (
        (
            "collisions:",
            "  screen: {point_m: [-0.6, 0.0], normal: [1.0, 0.0], length_m: 1.0, material: wood}\n"
            "waypoints: [{position_m: [-1.2, 0.0], after: 0}]\ncollisions:",
        ),
        "wall screen blocks the",
    ),
}


@pytest.fixture(params=UNFLYABLE)
def unflyable(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, str]:
    """Return the mission's path and a part of the expected message."""
    (before, after), problem = UNFLYABLE[request.param]
    text = packaged("missions", "single_wall.yaml").read_text(encoding="utf-8")
    assert before in text
    if "run-up to" in problem:
        text = text.replace("[1.65, 0.5]", "[1.0, 0.5]")  # the near wall moves the run-up behind the start
    text = text.replace(before, after, 1).replace(
        "../configs/dart.yaml", str(packaged("configs", "dart.yaml"))
    )
    path = tmp_path / "mission.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path), problem


def test_check_reports_a_no_go_once_and_skips_the_core_speed(
    unflyable: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    path, problem = unflyable
    assert main(["check", path, "--json"]) == 1
    report = msgspec.json.decode(capsys.readouterr().out)
    assert not report["go"]
    no_go = [finding["message"] for finding in report["findings"] if not finding["go"]]
    assert any(problem in says for says in no_go), no_go
    assert len(no_go) == len(set(no_go))
    (speed,) = [finding["message"] for finding in report["findings"] if finding["item"] == "core_speed"]
    assert speed.startswith("not measured because of ")
    assert speed.rpartition(" ")[2] in {finding["item"] for finding in report["findings"]}


def test_the_core_speed_check_reports_the_cores_reason(unflyable: tuple[str, str]) -> None:
    path, problem = unflyable
    assert problem in check_core_speed(load_mission(path)).message


@pytest.mark.parametrize("command", ["dry-run", "survey"])
def test_a_flight_is_refused_in_one_line(
    command: str, unflyable: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, problem = unflyable
    options = ["-o", str(tmp_path / "out.yaml")] if command == "survey" else []
    assert main([command, path, "--fast", "--log-dir", str(tmp_path / "logs"), *options]) == 2
    captured = capsys.readouterr()
    assert len(captured.err.strip().splitlines()) == 1
    assert problem in captured.err
