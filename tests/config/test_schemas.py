"""The exported schemas: they accept the shipped files and refuse what the loader refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from dart_flight.config.document import Document, InputError
from dart_flight.config.file_kinds import EXTENDS
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.lab.search.scenario import load_scenario

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "schemas"  # tests/docs/test_pages.py compares them with the types

EVERY = sorted([*(ROOT / "configs").glob("*.yaml"), *(ROOT / "missions").rglob("*.yaml")])
# An extending configuration lacks keys that the schema requires.
EXTENDING = [path for path in EVERY if EXTENDS in Document.load(path).tree]
SHIPPED = [path for path in EVERY if path not in EXTENDING]
LOADERS: dict[str, Callable[[Path], object]] = {
    "mission.json": load_mission,
    "scenario.json": load_scenario,
    "configuration.json": load_vehicle,
}


def schema_of(path: Path) -> Path:
    """Return the schema that the first line of a YAML file names for the editor."""
    first = path.read_text().splitlines()[0]
    match = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert match, f"{path}: {first}"
    return (path.parent / match[1]).resolve()


def validator(name: str) -> jsonschema.Draft7Validator:
    return jsonschema.Draft7Validator(json.loads((FOLDER / name).read_text()))


def test_the_committed_schemas_are_valid() -> None:
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(LOADERS)
    for path in FOLDER.iterdir():
        jsonschema.Draft7Validator.check_schema(json.loads(path.read_text()))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_shipped_file_matches_the_schema_that_it_names(path: Path) -> None:
    schema = schema_of(path)
    assert schema.parent == FOLDER
    validator(schema.name).validate(Document.load(path).tree)
    LOADERS[schema.name](path)


@pytest.mark.parametrize("path", EXTENDING, ids=lambda path: str(path.relative_to(ROOT)))
def test_an_extending_configuration_differs_from_its_base_only_in_its_keys(path: Path) -> None:
    tree = Document.load(path).tree
    base = to_plain(load_vehicle(path.parent / tree.pop(EXTENDS)))
    extended = to_plain(load_vehicle(path))
    for section, keys in tree.items():
        if keys == {"driver": "none"}:  # removes the whole section
            base[section] = None
        else:
            merge_into(base[section], keys)
    assert extended == base


def to_plain(vehicle: VehicleConfig) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(vehicle))
    return found


def merge_into(section: dict[str, Any], keys: dict[str, Any]) -> None:
    for key, value in keys.items():
        if isinstance(value, dict):
            merge_into(section[key], value)
        else:
            section[key] = value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("extends: {base}\npx4: {MPC_XY_P: fast}\n", "own.yaml:2: px4.MPC_XY_P: expected a number, got text"),
        (
            "extends: {base}\npx5: {MPC_XY_P: 1.0}\n",
            "own.yaml:2: px5.MPC_XY_P: unknown key, did you mean px4?",
        ),
        ("extends: own.yaml\n", "own.yaml:1: extends: a configuration cannot extend itself"),
        ("extends: missing.yaml\n", "missing.yaml: cannot read"),
        ("extends: [1]\n", "own.yaml:1: extends: expected the name of a configuration file"),
    ],
)
def test_a_mistake_in_an_extending_configuration_is_reported_with_its_line(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text.replace("{base}", str(ROOT / "configs" / "dart.yaml")))
    with pytest.raises(InputError) as caught:
        load_vehicle(path)
    assert message in caught.value.one_line()


WRONG: list[tuple[str, str, str, str]] = [
    (
        "missions/paper_single_wall.yaml",
        "name: paper-single-wall",
        "nam: single-wall",
        "unknown and missing key",
    ),
    ("missions/paper_single_wall.yaml", "mode: flexible", "mode: soft", "not a mode"),
    ("missions/paper_single_wall.yaml", "normal_m_s: -1.0", "normal_m_s: 1.0", "away from the wall"),
    ("missions/paper_single_wall.yaml", "normal: [-1.0, 0.0]", "normal: [-1.0]", "too short a list"),
    ("missions/paper_single_wall.yaml", "normal: [-1.0, 0.0]", "normal: [-1.0, 0.0, 0.0]", "too long a list"),
    ("missions/paper_single_wall.yaml", "version: 1", "version: 2", "another version"),
    ("missions/scenarios/one_wall.yaml", "sequence: [acrylic]", "sequence: some", "not a sequence"),
    ("missions/scenarios/one_wall.yaml", "objective: nearest", "objective: best", "not an objective"),
    ("configs/dart.yaml", "mass_kg: 1.3", "mass_kg: heavy", "not a number"),
    ("configs/dart.yaml", "model_factor: 0.4", "model_factor: 1.4", "out of range"),
    ("configs/dart.yaml", "driver: mock", "driver: magnet", "not a driver"),
]


@pytest.mark.parametrize(("shipped", "good", "bad", "why"), WRONG, ids=[row[3] for row in WRONG])
def test_schema_and_loader_refuse_the_same_mistakes(
    tmp_path: Path, shipped: str, good: str, bad: str, why: str
) -> None:
    text = (ROOT / shipped).read_text()
    assert good in text
    path = tmp_path / "wrong.yaml"
    path.write_text(re.sub(r"^vehicle: .*$", f"vehicle: {ROOT}/configs/dart.yaml", text, flags=re.M))
    name = schema_of(ROOT / shipped).name
    LOADERS[name](path)
    path.write_text(path.read_text().replace(good, bad, 1))
    with pytest.raises(InputError):
        LOADERS[name](path)
    assert list(validator(name).iter_errors(Document.load(path).tree)), why


def keys(schema: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for struct, definition in schema["$defs"].items():
        for name, value in definition.get("properties", {}).items():
            yield struct, name, value


def has_description(schema: dict[str, Any], value: dict[str, Any]) -> bool:
    """Whether a key has a description, or its section has."""
    for option in (value, *value.get("anyOf", [])):
        section = option.get("$ref", "").rpartition("/")[2]
        if option.get("description") or schema["$defs"].get(section, {}).get("description"):
            return True
    return False


@pytest.mark.parametrize("name", sorted(LOADERS))
def test_every_key_of_a_schema_has_a_description(name: str) -> None:
    schema = json.loads((FOLDER / name).read_text())
    for struct, key, value in keys(schema):
        assert has_description(schema, value), f"{struct}.{key} needs a line under Attributes"


def test_the_description_of_a_key_takes_precedence_over_that_of_its_section() -> None:
    schema = json.loads((FOLDER / "configuration.json").read_text())
    # Both keys have the same type.
    estimated, simulated = (
        schema["$defs"][section]["properties"]["arm_vibration"]["description"]
        for section in ("Estimation", "Simulation")
    )
    assert estimated.endswith("null: not removed.")
    assert "simulated IMU" in simulated
