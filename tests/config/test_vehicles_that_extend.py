"""What the vehicles without a lock have of their own: a change of DART's figures must not change them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dart_flight.base.records import Mode
from dart_flight.config.edit import edit_values
from dart_flight.config.vehicle import default_config_path, load_vehicle, packaged

OWN = {
    "rigid_cage": (
        0.9, 0.18, 0.006, 0.08, 0.09, 8.0, 15.6, 0.2, 2.0, (2100.0, 8.8, 0.3, 3.46), 4.0, 13.2, 0.1,
    ),
    "ring_guard_250g": (
        0.25, 0.12, 0.0008, 0.055, 0.06, 2.0, 11.7, 0.06, 0.6, (1260.0, 3.6, 0.3, 0.96), 1.5, 9.9, 0.08,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_what_scales_with_the_vehicle_is_its_own(name: str) -> None:
    v = load_vehicle(packaged("configs", f"{name}.yaml"))
    acrylic = v.materials["acrylic"].of(Mode.RIGID)
    figures = (
        v.airframe.mass_kg, v.airframe.contact_distance_m, v.airframe.inertia_kg_m2[0], v.airframe.arm_x_m,
        v.airframe.guard_along_m, v.thrust.full_n, v.estimation.battery.reference_v,
        v.estimation.thrust_error_n, v.estimation.baseline_limit_n,
        (acrylic.k, acrylic.f, acrylic.mu, acrylic.nu), v.detection.force_threshold_n, v.guard.battery_v,
        v.px4.mc_rollrate_p,
    )  # fmt: skip
    assert figures == OWN[name]
    body = v.simulation.contact
    assert (body.guard_out_m, body.guard_along_m) == (v.airframe.contact_distance_m, v.airframe.guard_along_m)
    assert v.simulation.battery_v == v.estimation.battery.reference_v
    assert (v.lock, v.estimation.arm_vibration, v.simulation.arm_vibration) == (None, None, None)
    assert all(material.flexible is None for material in v.materials.values())


@pytest.mark.parametrize("name", OWN)
def test_what_calibrate_writes_has_its_place(name: str) -> None:
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


def test_beside_dart_the_only_vehicle_that_extends_it_is_meant(
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
    assert default_config_path().name == "dart.yaml", "which of two is meant is not to be guessed"
