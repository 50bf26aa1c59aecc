"""Vehicles that extend another: their own values, which do not follow DART's, and the inherited ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dart_flight.config.document import Document, InputError, dotted, iterate_leaves
from dart_flight.config.edit import edit_values
from dart_flight.config.inherited import FOLLOWS_FROM, LOCK, Inherited, find_inherited
from dart_flight.config.vehicle import default_config_path, load_vehicle, packaged

VEHICLES = ["rigid_cage", "ring_guard_250g"]
AS_DART = {"imu.full_scale_m_s2", "imu.position_m"}  # the same flight controller in the same place


@pytest.mark.parametrize("name", VEHICLES)
def test_a_vehicle_defines_every_value_that_must_be_measured(name: str) -> None:
    path = packaged("configs", f"{name}.yaml")
    given = {dotted(key) for key, _ in iterate_leaves(Document.load(path).tree)}
    assert {key for key in FOLLOWS_FROM if key not in given} == AS_DART
    v = load_vehicle(path)
    assert {key.split(".")[1] for key in given if key.startswith("materials.")} == set(v.materials)
    assert v.airframe.mass_kg < load_vehicle(packaged("configs", "dart.yaml")).airframe.mass_kg
    body = v.simulation.contact
    assert (body.guard_out_m, body.guard_along_m) == (v.airframe.contact_distance_m, v.airframe.guard_along_m)
    assert v.simulation.battery_v == v.estimation.battery.reference_v
    assert (v.lock, v.estimation.arm_vibration, v.simulation.arm_vibration) == (None, None, None)
    assert all(material.flexible is None for material in v.materials.values())


@pytest.mark.parametrize("name", VEHICLES)
def test_calibrate_can_write_its_values_into_each_configuration(name: str) -> None:
    text = packaged("configs", f"{name}.yaml").read_text("utf-8")
    battery = ("estimation", "battery")
    keys = [
        ("thrust", "full_n"),
        ("thrust", "model_factor"),
        (*battery, "reference_v"),
        (*battery, "exponent"),
    ]
    assert edit_values(text, dict.fromkeys(keys, 1.0)).count("1.0") >= len(keys)
    assert edit_values(text, {("airframe", "inertia_kg_m2", i): 0.5 for i in range(3)}) != text


def test_the_only_vehicle_that_extends_dart_is_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "dart.yaml").write_text("version: 1\n")
    assert default_config_path().name == "dart.yaml"
    (tmp_path / "configs" / "cage.yaml").write_text("extends: dart.yaml  # DART\n")
    assert default_config_path().name == "cage.yaml"
    (tmp_path / "configs" / "stiff.yaml").write_text("# a variant\nextends: 'dart.yaml'\n")
    with pytest.raises(InputError, match=r"contains several vehicles \(cage.yaml, stiff.yaml; not dart.yaml"):
        default_config_path()
    monkeypatch.setenv("DART_FLIGHT_CONFIG", "configs/stiff.yaml")
    assert default_config_path().name == "stiff.yaml"


def test_dart_is_the_default_among_several_packaged_vehicles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkout has several vehicles, and may have other YAML files beside them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DART_FLIGHT_CONFIG", raising=False)
    shutil.copytree(packaged("configs"), tmp_path / "configs")
    (tmp_path / "configs" / "rooms.yaml").write_text("rooms: {hall: 3}\n")
    assert default_config_path().name == "dart.yaml"
    with (tmp_path / "configs" / "hexarotor.yaml").open("a") as file:
        file.write("detection: {force_threshold_n: 7.0}\n")
    with pytest.raises(InputError, match="choose one with --config"):
        default_config_path()


# --- values inherited by a user's vehicle -----------------------------------------------------------------

SIZE = "mass_kg: 0.6, contact_distance_m: 0.15, arm_x_m: 0.07, arm_y_m: 0.07"
CAGE = f"extends: dart.yaml\nairframe: {{{SIZE}}}\nlock: {{driver: none}}\n"


def find_inherited_values(
    text: str, folder: Path, name: str = "mine.yaml", *settings: str
) -> Inherited | None:
    shutil.copy(packaged("configs", "dart.yaml"), folder)
    (folder / name).write_text(text)
    return find_inherited(load_vehicle(folder / name, settings), str(folder / name), settings)


def test_contradictory_inherited_values_are_listed_apart_from_the_others(tmp_path: Path) -> None:
    found = find_inherited_values(CAGE, tmp_path)
    assert found is not None
    by_mass = found.contradictions["airframe.mass_kg 0.6 instead of 1.3"]
    assert "detection.force_threshold_n 5.5" in by_mass
    assert "materials.acrylic" in by_mass
    by_lock = found.contradictions["lock none instead of servo"]
    assert [text.split()[0] for text in by_lock] == ["estimation.arm_vibration", "simulation.arm_vibration"]
    by_size = found.contradictions["airframe.contact_distance_m 0.15 instead of 0.2"]
    assert "simulation.contact.guard_out_m 0.2" in by_size
    assert "guard.battery_v 13.2" in found.keys
    assert not any(key.startswith("airframe.mass_kg") for key in found.keys)


def test_an_explicit_value_is_not_inherited_even_if_it_equals_the_base(tmp_path: Path) -> None:
    own = f"{CAGE}detection: {{force_threshold_n: 5.5}}\n"
    found = find_inherited_values(own, tmp_path, "mine.yaml", "guard.battery_v=13.2")
    assert found is not None
    assert "force_threshold_n" not in str(found)
    assert "guard.battery_v" not in str(found)


def test_an_edited_copy_inherits_the_values_that_were_not_edited(tmp_path: Path) -> None:
    text = packaged("configs", "dart.yaml").read_text("utf-8").replace("mass_kg: 1.3", "mass_kg: 1.85")
    found = find_inherited_values(text, tmp_path)
    assert found is not None
    assert "detection.force_threshold_n 5.5" in found.contradictions["airframe.mass_kg 1.85 instead of 1.3"]
    copy = packaged("configs", "rigid_cage.yaml").read_text("utf-8").replace("mass_kg: 0.9", "mass_kg: 1.2")
    found = find_inherited_values(copy, tmp_path, "rigid_cage.yaml")
    assert found is not None
    assert found.base == "the shipped rigid_cage.yaml"
    assert "detection.force_threshold_n 4" in found.contradictions["airframe.mass_kg 1.2 instead of 0.9"]


@pytest.mark.parametrize(
    "text",
    [
        "extends: dart.yaml\npx4: {MPC_XY_P: 1.2}\n",
        "extends: dart.yaml\nlock: {driver: maestro}\n",
    ],
)
def test_a_file_without_a_value_of_the_vehicle_inherits_nothing(tmp_path: Path, text: str) -> None:
    assert find_inherited_values(text, tmp_path) is None


NEARLY = [
    ("rigid_cage", "rigid_cage.yaml", "mass_kg: 0.9 ", "mass_kg: 0.93"),
    ("rigid_cage", "my_ring.yaml", "mass_kg: 0.9 ", "mass_kg: 0.93"),
    ("ring_guard_250g", "mine.yaml", "contact_distance_m: 0.12", "contact_distance_m: 0.125"),
    ("dart", "mine.yaml", "full_n: 7.0", "full_n: 7.2"),
]


@pytest.mark.parametrize(("example", "name", "before", "after"), NEARLY)
def test_a_copy_that_hardly_differs_from_its_example_inherits_every_other_value(
    example: str, name: str, before: str, after: str, tmp_path: Path
) -> None:
    text = packaged("configs", f"{example}.yaml").read_text("utf-8")
    assert before in text
    found = find_inherited_values(text.replace(before, after, 1), tmp_path, name)
    assert found is not None
    assert found.base == f"the shipped {example}.yaml"
    assert not found.contradictions, "less than 10 %"
    given = before.split(":", maxsplit=1)[0]
    assert {"thrust.model_factor", "materials.wood"} <= {key.split()[0] for key in found.keys}
    assert not any(f".{given} " in key for key in found.keys)


def test_a_file_that_gives_its_mass_inherits_every_other_value(tmp_path: Path) -> None:
    found = find_inherited_values("extends: dart.yaml\nairframe: {mass_kg: 1.33}\n", tmp_path)
    assert found is not None
    assert not found.contradictions
    assert "airframe.contact_distance_m 0.2" in found.keys
    assert "materials.acrylic" in found.keys


UNCHANGED = {
    "the example itself": "{example}",
    "a comment": "# mine\n{example}",
    "only cameras": "{example}mocap: {{url: 'optitrack://192.0.2.1/dart'}}\n",
}


@pytest.mark.parametrize("change", UNCHANGED)
@pytest.mark.parametrize("example", ["rigid_cage", "hexarotor"])
def test_nobody_measured_an_example_that_is_used_unchanged(example: str, change: str, tmp_path: Path) -> None:
    text = packaged("configs", f"{example}.yaml").read_text("utf-8")
    found = find_inherited_values(UNCHANGED[change].format(example=text), tmp_path, f"{example}.yaml")
    assert found is not None
    assert {"airframe.mass_kg", "materials.wood"} <= {key.split()[0] for key in found.keys}
    assert not found.contradictions


def test_a_variant_of_an_example_inherits_what_the_example_does(tmp_path: Path) -> None:
    shutil.copy(packaged("configs", "rigid_cage.yaml"), tmp_path)
    found = find_inherited_values("extends: rigid_cage.yaml\npx4: {MPC_XY_P: 1.2}\n", tmp_path)
    assert found is not None
    assert found.base == "the shipped rigid_cage.yaml"
    assert "airframe.mass_kg 0.9" in found.keys


def test_a_setting_makes_a_vehicle_of_a_variant_of_dart(tmp_path: Path) -> None:
    variant = "extends: dart.yaml\npx4: {MPC_XY_P: 1.2}\n"
    found = find_inherited_values(variant, tmp_path, "mine.yaml", "airframe.mass_kg=0.9")
    assert found is not None
    assert "detection.force_threshold_n 5.5" in found.contradictions["airframe.mass_kg 0.9 instead of 1.3"]


def test_dart_inherits_nothing() -> None:
    path = packaged("configs", "dart.yaml")
    assert find_inherited(load_vehicle(path), str(path)) is None
    assert find_inherited(load_vehicle(path, ["px4.MPC_XY_P=1.2"]), str(path), ["px4.MPC_XY_P=1.2"]) is None


@pytest.mark.parametrize("distance_m", [0.2, 0.16])
def test_a_change_by_more_than_a_tenth_contradicts_what_follows_from_it(
    distance_m: float, tmp_path: Path
) -> None:
    text = packaged("configs", "rigid_cage.yaml").read_text("utf-8")
    changed = text.replace("contact_distance_m: 0.18", f"contact_distance_m: {distance_m}")
    found = find_inherited_values(changed, tmp_path)
    assert found is not None
    reason = f"airframe.contact_distance_m {distance_m:g} instead of 0.18"
    assert "airframe.guard_along_m 0.09" in found.contradictions[reason]


def test_every_inheritable_key_exists() -> None:
    """A renamed key would never be listed again."""
    tree = load_vehicle(packaged("configs", "dart.yaml")).to_dict()
    for key in {key for row in FOLLOWS_FROM.items() for key in (row[0], *row[1])} - {LOCK}:
        value = tree
        for part in key.split("."):
            value = value[part]
