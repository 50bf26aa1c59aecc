"""Messages name the value that is probably wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dart_flight.config.document import InputError
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import load_vehicle, packaged

CAGE = "extends: rigid_cage.yaml\n"


@pytest.mark.parametrize(
    ("text", "settings", "blamed"),
    [
        (f"{CAGE}airframe: {{mass_kg: 9.0}}\n", [], "mine.yaml:2: airframe.mass_kg"),
        (f"{CAGE}thrust: {{full_n: 1.0}}\n", [], "mine.yaml:2: thrust.full_n"),
        (f"{CAGE}airframe: {{mass_kg: 9.0}}\nthrust: {{full_n: 7.5}}\n", [], "mine.yaml:2: airframe.mass_kg"),
        (CAGE, ["airframe.mass_kg=9.0"], "--set airframe.mass_kg=9.0"),
        (CAGE, ["thrust.full_n=1.0"], "--set thrust.full_n=1.0"),
    ],
)
def test_a_vehicle_that_cannot_hover_blames_its_own_value(
    text: str, settings: list[str], blamed: str, tmp_path: Path
) -> None:
    for name in ("dart.yaml", "rigid_cage.yaml"):
        shutil.copy(packaged("configs", name), tmp_path)
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        load_vehicle(tmp_path / "mine.yaml", settings)
    assert blamed in str(error.value)
    assert "(thrust.full_n)" in str(error.value)
    assert "(airframe.mass_kg), limit 80 %" in str(error.value)


@pytest.mark.parametrize("vehicle", ["dart", "rigid_cage", "ring_guard_250g"])
def test_an_impact_on_the_surface_of_a_wall_names_the_contact_distance(vehicle: str) -> None:
    config = load_vehicle(packaged("configs", f"{vehicle}.yaml"))
    contact_m = config.airframe.contact_distance_m
    folder = [] if vehicle == "dart" else [vehicle]
    name = "paper_single_wall.yaml" if vehicle == "dart" else "single_wall.yaml"
    mission = load_mission(packaged("missions", *folder, name), config)
    point = mission.collisions[0].impact_point
    assert point is not None
    key = "collisions[0].impact_point_m"
    with pytest.raises(InputError, match=f"contact_distance_m is {contact_m:g} m.*given_at: surface"):
        mission.replace({key: [point[0] - contact_m, point[1]]})
    with pytest.raises(InputError) as error:
        mission.replace({key: [point[0] - contact_m - 0.1, point[1]]})
    assert "given_at" not in str(error.value)
