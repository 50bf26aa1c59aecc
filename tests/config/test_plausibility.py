"""Every number of a file has a lower and an upper limit; a violation is reported with its unit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from dart_flight.cli import main
from dart_flight.config.mission import load_mission
from dart_flight.config.mission_file import MissionFile
from dart_flight.config.units import unit_from_name
from dart_flight.config.vehicle import VehicleConfig, packaged
from dart_flight.lab.search.scenario import ScenarioFile
from tests.command_fixtures import Refuse

ROOT = Path(__file__).parents[2]
DUAL = (ROOT / "missions/paper_dual_collision.yaml").read_text()
CONFIG = (ROOT / "configs/dart.yaml").read_text()


def numbers(type_: object, name: str, seen: set[type]) -> Iterator[tuple[str, msgspec.inspect.FloatType]]:
    """Yield every number in a file's type with its key."""
    if isinstance(type_, msgspec.inspect.FloatType):
        yield name, type_
    elif isinstance(type_, msgspec.inspect.StructType) and type_.cls not in seen:
        seen.add(type_.cls)
        for field in type_.fields:
            yield from numbers(field.type, f"{name}.{field.encode_name}", seen)
    elif isinstance(type_, msgspec.inspect.UnionType):
        for part in type_.types:
            yield from numbers(part, name, seen)
    elif isinstance(type_, msgspec.inspect.TupleType):
        for part in type_.item_types:
            yield from numbers(part, name, seen)
    elif isinstance(type_, msgspec.inspect.DictType):
        yield from numbers(type_.value_type, name, seen)
    elif isinstance(type_, msgspec.inspect.ListType):
        yield from numbers(type_.item_type, name, seen)


@pytest.mark.parametrize("file", [VehicleConfig, MissionFile, ScenarioFile])
def test_every_number_has_a_lower_and_an_upper_limit(file: type) -> None:
    found = list(numbers(msgspec.inspect.type_info(file), "", set()))
    assert len(found) > 15
    open_ended = [
        name for name, n in found
        if (n.ge is None and n.gt is None) or (n.le is None and n.lt is None)
    ]  # fmt: skip
    assert not open_ended


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("arm_x_m: 0.", "arm_x_m: 130", "0.01 to 2 m, not"),
        ("contact_distance_m: 0.", "contact_distance_m: 20", "0 to 2 m, not"),
        ("mass_kg: 1.3", "mass_kg: 1300", "0.05 to 50 kg, not 1300"),
    ],
)
def test_a_configuration_value_out_of_range_is_refused(
    before: str, after: str, message: str, tmp_path: Path, refusal_of: Refuse
) -> None:
    assert before in CONFIG
    path = tmp_path / "dart.yaml"
    path.write_text(CONFIG.replace(before, after))
    assert message in refusal_of("check", ROOT / "missions/paper_dual_collision.yaml", "--config", path)


def test_a_mission_value_out_of_range_is_refused(tmp_path: Path, refusal_of: Refuse) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(DUAL.replace("[0.12, 0.025]", "[25, 25]"))
    line = refusal_of("check", path)
    assert "alpha_m_per_n[0]: " in line
    assert "0 to 1 m/N, not 25" in line


def run_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], *changes: tuple[str, str]
) -> tuple[int, str]:
    text = DUAL.replace("../configs/dart.yaml", str(packaged("configs", "dart.yaml")))
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    load_mission(path)
    return main(["check", str(path)]), capsys.readouterr().err


def test_the_papers_setpoint_outside_the_bounds_is_a_remark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = run_check(tmp_path, capsys)
    assert status == 0
    assert "remark" in output
    assert "0.51 m outside bounds_m" in output


def test_a_setpoint_far_outside_the_bounds_is_a_no_go(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = run_check(tmp_path, capsys, ("[0.12, 0.025]", "[0.25, 0.5]"))
    assert status == 1
    assert "NO-GO     recovery_1" in output


def test_the_setpoint_of_the_second_recovery_is_checked_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    second = "mode: rigid, alpha_m_per_n: [0.025, 0.025]"
    status, output = run_check(tmp_path, capsys, (second, second.replace("[0.025, 0.025]", "[0.9, 0.5]")))
    assert status == 1
    assert "NO-GO     recovery_2" in output
    assert "NO-GO     path" in output, "the path leaves the bounds too"


@pytest.mark.parametrize("scenario", ["dual_collision", "one_wall", "any_walls"])
def test_a_planned_mission_passes_check(scenario: str, tmp_path: Path) -> None:
    path, source = str(tmp_path / "planned.yaml"), packaged("missions", "scenarios", f"{scenario}.yaml")
    assert main(["plan", str(source), "-o", path, "--no-verify"]) == 0
    assert main(["check", path]) == 0


def test_units_are_read_from_names() -> None:
    units = {"mass_kg": "kg", "drag_per_s": "1/s", "alpha_m_per_n": "m/N", "speed_m_s": "m/s", "k": "N/m"}
    assert {name: unit_from_name(name) for name in units} == units
    assert unit_from_name("exponent") == ""
