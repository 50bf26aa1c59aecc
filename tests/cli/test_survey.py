"""`dart-flight survey`: displaced walls are touched, and the mission is written with the measured walls."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from tests.command_fixtures import Refuse, RunJson

DUAL = packaged("missions", "dual_collision.yaml")


def test_displaced_walls_are_measured_and_written(
    folder: Path, refusal_of: Refuse, run_json: RunJson
) -> None:
    command = ["survey", str(DUAL), "--fast", "--seed", "4", "--vary", "wall_offset_m"]
    command += ["--vary", "wall_yaw_deg", "--output", "new/mission.yaml"]
    assert "no such folder" in refusal_of(*command, "--json")
    assert not (folder / "flights").exists(), "refused before the flight"
    (folder / "new").mkdir()
    printed, _ = run_json(*command)
    assert printed["unreachable"] == {}
    assert printed["flight"]["outcome"] == "completed"
    drawn = printed["flight"]["drawn"]
    assert any(abs(drawn[f"wall_offset_m.{name}"]) > 0.05 for name in ("wood", "acrylic"))
    before, after = load_mission(DUAL), load_mission("new/mission.yaml")
    assert [wall.name for wall in after.flat_walls] == [wall.name for wall in before.flat_walls]
    for old, new in zip(before.flat_walls, after.flat_walls, strict=True):
        true = old.displaced(drawn[f"wall_offset_m.{old.name}"])
        true = true.rotated(math.radians(drawn[f"wall_yaw_deg.{old.name}"]))
        found = next(w for w in printed["walls"] if w["name"] == old.name)
        assert abs(found["truth_error_m"]) < 0.02
        assert abs(found["truth_error_deg"]) < 2.0
        cosine = true.normal[0] * new.normal[0] + true.normal[1] * new.normal[1]
        assert math.degrees(math.acos(min(1.0, cosine))) < 2.0
        assert new.position_sd_m is not None
        assert abs(true.signed_distance(new.point)) < 0.02 + 3.0 * new.position_sd_m
        assert (new.length_m, new.material) == (old.length_m, old.material)
        assert "rigid" in found["coefficients"]
    assert after.vehicle == before.vehicle
    assert [c.mode for c in after.collisions] == [c.mode for c in before.collisions]


def test_a_touch_that_is_too_slow_is_refused(refusal_of: Refuse) -> None:
    assert "0.3" in refusal_of("survey", DUAL, "--fast", "--touch-speed", "0.1")


@pytest.mark.rest
def test_a_plan_that_does_not_fit_the_measured_walls_is_reported(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = packaged("missions", "touch_and_return.yaml")
    command = ["survey", str(mission), "--fast", "--seed", "4", "--vary", "wall_offset_m=0.15"]
    assert main([*command, "-o", "new.yaml"]) == 1
    assert "cannot be flown with the measured walls; plan it again" in capsys.readouterr().err
    assert (folder / "new.yaml").exists()


@pytest.mark.rest
def test_an_unknown_room_is_mapped_and_written(folder: Path, run_json: RunJson) -> None:
    """The survey writes a closed outline, a map, and a mission whose walls match the simulated ones."""
    path = packaged("missions", "unknown_room.yaml")
    printed, _ = run_json("survey", path, "--fast", "--plot", "map.svg", "-o", "room.yaml")
    assert printed["closed"] is True
    assert (folder / "map.svg").read_text("utf-8").startswith("<?xml")
    before, after = load_mission(path), load_mission("room.yaml")
    assert len(after.flat_walls) == len(before.simulated_walls) == 5
    for found in after.flat_walls:
        true = max(
            before.simulated_walls,
            key=lambda w: w.normal[0] * found.normal[0] + w.normal[1] * found.normal[1],
        )
        assert abs(true.signed_distance(found.point)) < 0.03
        assert true.normal[0] * found.normal[0] + true.normal[1] * found.normal[1] > math.cos(
            math.radians(2.0)
        )
