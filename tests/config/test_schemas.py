"""The exported schemas are those of the types, take what is shipped and refuse what the loader refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from dart_flight.config import load_vehicle
from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.scenario import load_scenario
from tools.docs.schemas import FOLDER, ROOT, comments, schemas, text_of

SHIPPED = sorted([*(ROOT / "configs").glob("*.yaml"), *(ROOT / "missions").rglob("*.yaml")])
LOADERS: dict[str, Callable[[Path], object]] = {
    "mission.json": load_mission,
    "scenario.json": load_scenario,
    "configuration.json": load_vehicle,
}


def schema_of(path: Path) -> Path:
    """The schema that the first line of a YAML file names for the editor."""
    first = path.read_text().splitlines()[0]
    match = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert match, f"{path}: {first}"
    return (path.parent / match[1]).resolve()


def validator(name: str) -> jsonschema.Draft7Validator:
    return jsonschema.Draft7Validator(json.loads((FOLDER / name).read_text()))


def test_the_committed_files_are_those_of_the_types() -> None:
    wanted = schemas()
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(wanted)
    for name, schema in wanted.items():
        assert (FOLDER / name).read_text() == text_of(schema), "run python -m tools.docs.generated"
        jsonschema.Draft7Validator.check_schema(schema)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_is_shipped_fits_the_schema_it_names(path: Path) -> None:
    schema = schema_of(path)
    assert schema.parent == FOLDER
    validator(schema.name).validate(Document.load(path).tree)
    LOADERS[schema.name](path)


WRONG: list[tuple[str, str, str, str]] = [
    ("missions/single_wall.yaml", "name: single-wall", "nam: single-wall", "unknown and missing key"),
    ("missions/single_wall.yaml", "mode: flexible", "mode: soft", "not a mode"),
    ("missions/single_wall.yaml", "normal_m_s: -1.0", "normal_m_s: 1.0", "away from the wall"),
    ("missions/single_wall.yaml", "normal: [-1.0, 0.0]", "normal: [-1.0]", "too short a list"),
    ("missions/single_wall.yaml", "normal: [-1.0, 0.0]", "normal: [-1.0, 0.0, 0.0]", "too long a list"),
    ("missions/single_wall.yaml", "version: 1", "version: 2", "another version"),
    ("missions/scenarios/one_wall.yaml", "sequence: [acrylic]", "sequence: some", "not a sequence"),
    ("missions/scenarios/one_wall.yaml", "objective: nearest", "objective: best", "not an objective"),
    ("configs/dart.yaml", "mass_kg: 1.3", "mass_kg: heavy", "not a number"),
    ("configs/dart.yaml", "model_factor: 0.4", "model_factor: 1.4", "out of range"),
    ("configs/dart.yaml", "driver: mock", "driver: magnet", "not a driver"),
]


@pytest.mark.parametrize(("shipped", "good", "bad", "why"), WRONG, ids=[row[3] for row in WRONG])
def test_schema_and_loader_refuse_the_same(
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


def test_every_key_of_mission_and_scenario_is_explained() -> None:
    for name in ("mission.json", "scenario.json"):
        schema = schemas()[name]
        for struct, key, value in keys(schema):
            reference = value.get("$ref", "").rpartition("/")[2]
            assert "description" in value or "description" in schema["$defs"].get(reference, {}), (
                f"{struct}.{key} needs a line under Attributes"
            )


def test_comments_of_the_configuration_reach_its_schema() -> None:
    described = {
        (struct, key): value.get("description")
        for struct, key, value in keys(schemas()["configuration.json"])
    }
    assert described["Airframe", "mass_kg"] == "[paper] Sec. III"
    # A comment that goes on in the next line.
    assert str(described["Detection", "sure_sigma"]).endswith("has to be over it")


def test_only_the_key_that_begins_a_line_owns_its_comment() -> None:
    found = comments("a: {b: 1}   # of a\nc:  # of c\n  # and on\n  d: 2\n")
    assert found == {("a",): "of a", ("c",): "of c and on"}
