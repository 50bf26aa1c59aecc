"""Limits of planned impacts, and warnings about impacts beyond the sensor's range."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.vehicle import packaged
from dart_flight.planning.envelope import expected_force_n, impact_warnings
from dart_flight.run.prepare import load_flyable
from tests.mission_findings import check_mission

SWEEP = Path(__file__).with_name("sweep_mission.yaml")


def sweep(folder: Path, speed: float, mode: str = "rigid", material: str = "acrylic") -> Path:
    text = SWEEP.read_text().replace("MODE", mode).replace("MATERIAL", material)
    text = text.replace("SPEED", f"{speed:g}").replace("x: [-4.0, 11.0]", "x: [-8.0, 11.0]")
    path = folder / "sweep.yaml"
    path.write_text(text)
    return path


def limit_to(path: Path, force_n: float) -> Path:
    path.write_text(path.read_text().replace("peak_force_n: 1000.0", f"peak_force_n: {force_n:g}"))
    return path


@pytest.mark.parametrize("name", ["paper_single_wall.yaml", "paper_dual_collision.yaml"])
def test_the_shipped_missions_cause_no_warnings(name: str) -> None:
    mission = load_flyable(packaged("missions", name))
    assert [line for line in impact_warnings(mission) if "turn the vehicle over" not in line] == []


def test_the_expected_force_follows_the_contact_law(tmp_path: Path) -> None:
    mission = load_flyable(sweep(tmp_path, 2.0))
    assert expected_force_n(mission, mission.collisions[0]) == pytest.approx(2.0 * 63.6, rel=0.01)
    dual = load_flyable(packaged("missions", "paper_dual_collision.yaml"))
    assert expected_force_n(dual, dual.collisions[1]) is None


def test_an_impact_over_the_missions_own_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"with wall will peak at 127 N, limits.peak_force_n is 120 N"):
        load_flyable(limit_to(sweep(tmp_path, 2.0), 120.0))
    load_flyable(limit_to(sweep(tmp_path, 2.0), 130.0))


FAST, OVER = "exceeds 3 m/s", "turn the vehicle over"


@pytest.mark.parametrize(
    ("speed", "material", "mode", "announced"),
    [
        (3.0, "acrylic", "rigid", [OVER]),
        (3.3, "acrylic", "rigid", ["lower bound", FAST, OVER]),
        (2.5, "wood", "rigid", [OVER]),
        (2.8, "wood", "rigid", ["lower bound", OVER]),
        (4.0, "wood", "rigid", ["position will be wrong", FAST, OVER]),
        (3.0, "acrylic", "flexible", [OVER]),
        (3.4, "acrylic", "flexible", [FAST, OVER]),
        (4.0, "acrylic", "flexible", [FAST, OVER]),
    ],
)
def test_warnings_announce_clipping_and_impacts_faster_than_any_flown(
    tmp_path: Path, speed: float, material: str, mode: str, announced: list[str]
) -> None:
    warnings = impact_warnings(load_flyable(sweep(tmp_path, speed, mode, material)))
    assert len(warnings) == len(announced), warnings
    for line, words in zip(warnings, announced, strict=True):
        assert words in line
        assert ("full scale" in line) is (words not in (FAST, OVER))


def check_findings(
    folder: Path, speed: float, mode: str, material: str = "acrylic"
) -> dict[str, CheckFinding]:
    return {f.item: f for f in check_mission(load_flyable(sweep(folder, speed, mode, material)))}


def test_check_refuses_impacts_that_px4_has_not_survived(tmp_path: Path) -> None:
    assert "speed_1" not in check_findings(tmp_path, 3.0, "flexible")
    assert not check_findings(tmp_path, 3.4, "flexible")["speed_1"].go
    lost = check_findings(tmp_path, 4.0, "rigid", "wood")["force_1"]
    assert not lost.go
    assert "position will be wrong by more than a metre" in lost.message


def test_check_remarks_on_an_impact_close_to_full_scale(tmp_path: Path) -> None:
    close = check_findings(tmp_path, 3.15, "rigid")["force_1"]
    assert (close.go, close.remark) == (True, True)
    beyond = check_findings(tmp_path, 3.5, "rigid")["force_1"]
    assert (beyond.go, beyond.remark) == (False, False)
    assert "lower bound" in beyond.message
    assert not check_findings(tmp_path, 2.5, "rigid")["force_1"].remark
