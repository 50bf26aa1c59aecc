"""Reading scenario files, and refusing invalid ones in one line with exit status 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.cli import main
from dart_flight.lab.search.scenario import load_scenario

SCENARIOS = Path(__file__).parents[3] / "missions" / "scenarios"
DUAL = SCENARIOS / "dual_collision.yaml"


def edited_scenario(tmp_path: Path, old: str, new: str) -> Path:
    text = DUAL.read_text().replace("../../configs", str(SCENARIOS.parents[1] / "configs"))
    assert old in text
    path = tmp_path / "scenario.yaml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda p: p.stem)
def test_packaged_scenarios_are_valid(path: Path) -> None:
    scenario = load_scenario(path)
    assert scenario.sequences
    assert all(v < 0.0 for v in scenario.normal_m_s)


def test_the_grid_of_the_dual_collision_is_read_completely() -> None:
    scenario = load_scenario(DUAL)
    assert len(scenario.normal_m_s) == len(scenario.tangential_m_s) == 61
    assert scenario.normal_m_s[0] == -1.525
    assert scenario.normal_m_s[-1] == -0.025
    assert scenario.alphas["wood"] == (0.025, 0.12)  # given along the mission's axes; the wall's normal is y


def test_sequence_any_gives_every_order_of_different_walls(tmp_path: Path) -> None:
    path = edited_scenario(tmp_path, "sequence: [wood, acrylic]", "sequence: any")
    assert set(load_scenario(path).sequences) == {
        ("wood",),
        ("acrylic",),
        ("wood", "acrylic"),
        ("acrylic", "wood"),
    }


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("goal: {position_m: [1.0, -0.5]", "goal: {position_m: [9.0, -0.5]", "outside bounds_m"),
        ("point_m: [1.65, 0.0], normal: [-1.0, 0.0]", "point_m: [0.0, 0.0], normal: [-1.0, 0.0]", "acrylic"),
        ("normal: [-1.0, 0.0]", "normal: [0.0, 0.0]", "has length 0"),
        ("min: -1.525, max: -0.025", "min: -0.025, max: -1.525", "empty"),
        ("material: wood", "material: wod", "did you mean wood"),
        ("max: -0.025, step: 0.025", "max: -0.025, step: 0.04", "does not divide"),
        ("max: -0.025, step: 0.025", "max: 0.475, step: 0.025", "negative velocity"),
        ("step: 0.025", "step: 0.0", "step"),
        ("step: 0.025", "step: 0.00001", "limit"),
        ("sequence: [wood, acrylic]", "sequence: [wood, acrilic]", "did you mean acrylic"),
        ("sequence: [wood, acrylic]", "sequence: []", "expected a list of 1 to 4"),
        ("sequence: [wood, acrylic]", "sequence: [wood, wood]", "twice in a row"),
        ("sequence: [wood, acrylic]", "sequence: some", "sequence"),
        ("acrylic: [0.025, 0.025]}", "}", "acrylic needs gains"),
        ("modes: [rigid, flexible]", "modes: []", "at least one mode"),
        ("modes: [rigid, flexible]", "modes: [soft]", "rigid, flexible"),
        ("objective: nearest", "objective: best", "nearest, fastest"),
        ("objective: nearest", "objektive: nearest", "did you mean objective"),
        ("objective: nearest", "uncertainty: {samples: 10}", "64"),
    ],
)
def test_an_invalid_scenario_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    path = edited_scenario(tmp_path, old, new)
    assert main(["plan", str(path)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    lines = output.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"{path}:")
    assert message in lines[0]


def test_an_infeasible_search_reports_the_decisive_constraint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = edited_scenario(tmp_path, "peak_force_n: 150.0", "peak_force_n: 6.0")
    assert main(["plan", str(path)]) == 2
    line = capsys.readouterr().err.strip()
    assert "none of 14884 candidates is feasible" in line
    assert "without the constraint peak_force" in line
    assert "raise limits.peak_force_n" in line
