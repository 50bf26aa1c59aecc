"""Retired keys, which are constants now: a file with one loads with a warning, a misspelt key is refused."""

from __future__ import annotations

import importlib
import json
import re
import warnings
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.retired_keys import RETIRED, RetiredKeyWarning, remove_retired
from dart_flight.config.section import without_defaults
from dart_flight.config.vehicle import VehicleConfig, load_vehicle

ROOT = Path(__file__).parents[2]
DART = ROOT / "configs" / "dart.yaml"
VEHICLE = load_vehicle(DART)


def write_configuration(tmp_path: Path, values: dict[str, Any]) -> Path:
    """Write a vehicle that differs from the shipped one in these keys, one per line from line 2."""
    lines = [f"extends: {DART}"]
    tree: dict[str, Any] = {}
    for key, value in values.items():
        node = tree
        *above, name = key.split(".")
        for part in above:
            node = node.setdefault(part, {})
        node[name] = value
    lines += [f"{name}: {json.dumps(part)}" for name, part in tree.items()]
    path = tmp_path / "own.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def load_with_warnings(path: Path, *settings: str) -> tuple[VehicleConfig, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        vehicle = load_vehicle(path, settings)
    assert all(warning.category is RetiredKeyWarning for warning in caught)
    return vehicle, [str(warning.message) for warning in caught]


def test_the_constants_have_the_values_of_the_table() -> None:
    for key, retired in RETIRED.items():
        module, _, name = retired.constant.rpartition(".")
        value = getattr(importlib.import_module(f"dart_flight.{module}"), name)
        for part in key.split(".")[-1:] if isinstance(value, dict) else ():
            value = value[part]
        assert value == retired.value, key
        assert type(value) is type(retired.value), key


@pytest.mark.parametrize("key", RETIRED)
def test_a_file_with_a_retired_key_loads_with_one_warning(key: str, tmp_path: Path) -> None:
    fixed = json.dumps(RETIRED[key].value)
    for value in (RETIRED[key].value, 17.5, "nonsense"):
        path = write_configuration(tmp_path, {key: value})
        vehicle, lines = load_with_warnings(path)
        assert vehicle == VEHICLE
        assert lines == [
            f"{path}:2: {key}: is ignored, because its value is now fixed at {fixed}: remove the key"
        ]
        assert load_with_warnings(DART, f"{key}={json.dumps(value)}") == (
            VEHICLE,
            [
                f"--set {key}={json.dumps(value)}: is ignored, because its value is now fixed at {fixed}: "
                "remove the key"
            ],
        )


def test_retired_keys_at_their_constants_share_one_warning(tmp_path: Path) -> None:
    """A copy of an older configuration has them all; a key with another value has its own line."""
    values = {key: retired.value for key, retired in RETIRED.items()} | {"guard.imu_stuck_s": 0.2}
    vehicle, lines = load_with_warnings(write_configuration(tmp_path, values))
    assert vehicle == VEHICLE
    shared, own = lines
    assert (
        f": {len(RETIRED) - 1} keys are ignored, because they are now fixed at these values: remove "
        in shared
    )
    assert all(key in shared for key in RETIRED if key != "guard.imu_stuck_s")
    assert own.endswith(
        "guard.imu_stuck_s: is ignored, because its value is now fixed at 0.1: remove the key"
    )


def test_a_misspelt_retired_key_is_refused(tmp_path: Path) -> None:
    for key, retired in RETIRED.items():
        with pytest.raises(InputError, match="unknown key"):
            load_vehicle(write_configuration(tmp_path, {f"{key[:-1]}x": retired.value}))


def test_retired_keys_with_other_values_have_a_warning_each(tmp_path: Path) -> None:
    vehicle, lines = load_with_warnings(write_configuration(tmp_path, dict.fromkeys(RETIRED, 17.5)))
    assert vehicle == VEHICLE
    assert [re.split(": ", line)[1] for line in lines] == list(RETIRED)


def test_no_key_of_the_configuration_is_retired() -> None:
    assert remove_retired(msgspec.to_builtins(VEHICLE)) == {}


def test_the_command_line_shows_one_warning_on_standard_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_configuration(tmp_path, {"guard.imu_stuck_s": 0.2})
    command = ["predict", "--config", str(path), "--json", "--surface", "acrylic", "--mode", "rigid"]
    assert main([*command, "--velocity", "-1.0", "0.0"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["vehicle"]["source"] == str(path)
    warning = (
        f"{path}:2: guard.imu_stuck_s: is ignored, because its value is now fixed at 0.1: remove the key"
    )
    assert [line for line in shown.err.splitlines() if "imu_stuck" in line] == [warning]


class Before(msgspec.Struct):
    mass_kg: float
    motors: tuple[int, ...] = (1, 2)


class After(Before):
    added_m: float = 0.5


@given(st.floats(0.1, 5.0), st.lists(st.integers(0, 8)).map(tuple))
def test_a_key_added_later_does_not_change_a_fingerprint(mass_kg: float, motors: tuple[int, ...]) -> None:
    before, after = Before(mass_kg, motors), After(mass_kg, motors)
    assert without_defaults({"a": [before]}) == without_defaults({"a": (after,)})
    assert without_defaults(before) != without_defaults(After(mass_kg, motors, added_m=0.6))


def test_a_changed_value_changes_the_fingerprint() -> None:
    mission = load_mission(ROOT / "missions/ring_guard_250g/square.yaml")
    heavier = load_mission(ROOT / "missions/ring_guard_250g/square.yaml", settings=["airframe.mass_kg=0.26"])
    higher = msgspec.structs.replace(mission, altitude_m=mission.altitude_m + 0.1)
    assert len({mission.digest, heavier.digest, higher.digest}) == 3
    assert msgspec.structs.replace(mission, source="elsewhere.yaml").digest == mission.digest
    same = {
        "vehicle.mocap.url": "vrpn://192.0.2.1/dart",
        "vehicle.connection.url": "serial:///dev/ttyAMA0:921600",
    }
    assert mission.replace(same).digest == mission.digest
