"""The room view's scene is the room of the file, whole or with an error, and of `--plot`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.check.mission_check import predict_flight_path
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.lab.map_model import MapKind, room_map
from dart_flight.lab.mission_map import mission_map
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.engine import Checked, EngineEvent, from_line, to_line
from dart_flight.lab.studio.objects import entry_of, key_of, object_of, objects_in_finding
from dart_flight.lab.studio.open_file import OpenFile
from dart_flight.lab.studio.scene_model import (
    Scene,
    build_scene,
    load_text,
    scene_of,
)
from tests.lab.studio.files import DUAL, FILES, MISSIONS, ROOT, name_of, one_edit, try_edit


def whole_scene(path: Path) -> tuple[Mission, Scene]:
    loaded = load_text(path.read_text("utf-8"), path)
    assert isinstance(loaded.resolved, Mission)
    return loaded.resolved, scene_of(loaded, predict_flight_path(loaded.resolved))


@pytest.mark.parametrize("path", MISSIONS, ids=name_of)
def test_a_mission_is_shown_as_plot_draws_it(path: Path) -> None:
    mission, scene = whole_scene(path)
    drawn = mission_map(mission, predict_flight_path(mission))
    known = [wall for wall in scene.walls if not wall.simulated]
    assert [wall.drawn for wall in known] == list(room_map(mission).walls)
    assert [(path.kind, len(path.points)) for path in scene.paths] == [
        (path.kind, len(path.points)) for path in drawn.paths
    ]
    if scene.predicted:
        assert [hit.number for hit in scene.hits] == [body.number for body in drawn.bodies]
    assert len([wall for wall in scene.walls if wall.simulated]) == len(mission.simulated_walls)
    assert scene.problem is None


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_handle_moves_its_object(path: Path) -> None:
    opened = OpenFile.load(path)
    for handle in build_scene(opened.text, path).handles:
        opened.edit(edits.drag(handle.id, (handle.position[0] + 0.25, handle.position[1])))
        moved = {one.id: one.position for one in build_scene(opened.text, path).handles}
        assert moved[handle.id][0] == pytest.approx(handle.position[0] + 0.25, abs=6e-4)
        opened.undo()


def test_a_hit_shows_speed_mode_force_and_setpoint() -> None:
    _, scene = whole_scene(DUAL)
    first, second = scene.hits
    assert first.text == "1 flexible\n1.12 m/s, 31 N (27 normal, 16 along)"
    assert (first.wall.name, first.setpoint is not None) == ("wood", True)
    assert second.force is not None
    assert second.velocity is not None
    assert second.force[0] < 0.0 < second.velocity[0]  # the wall pushes back


def test_an_uncertain_wall_has_a_band_of_three_standard_deviations() -> None:
    _, scene = whole_scene(ROOT / "missions" / "hairpin.yaml")
    bands = {wall.drawn.plane.name: wall.band() for wall in scene.walls}
    assert bands["end"] is None
    front = bands["partition.front"]
    assert front is not None
    middle = front[np.argsort(np.abs(front[:, 0] + 2.6))[:2], 1]
    assert np.ptp(middle) == pytest.approx(0.06)
    assert np.ptp(front[:, 1]) > 0.07  # the direction is uncertain, too


def test_a_text_with_errors_still_shows_what_loads() -> None:
    text = DUAL.read_text().replace("material: wood", "material: brick").replace("[1.0, -0.5]", "[9.0, 0.0]")
    scene = build_scene(text, DUAL)
    assert scene.problem is not None
    assert "unknown brick" in scene.problem
    assert [wall.drawn.plane.material for wall in scene.walls] == ["brick", "acrylic"]
    assert [place.id for place in scene.places] == ["start", "goal"]
    assert "goal" in {handle.id for handle in scene.handles}
    scene = build_scene(DUAL.read_text().replace("point_m: [1.65, 0.0]", "point_m: [x, 0.0]"), DUAL)
    assert [wall.id for wall in scene.walls] == ["wall/wood"]


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_scene_survives_any_edits_and_its_way_between_processes(data: st.DataObject) -> None:
    opened = OpenFile.load(data.draw(st.sampled_from(FILES)))
    for _ in range(data.draw(st.integers(1, 4))):
        try_edit(opened, data.draw(one_edit(opened)))
    scene = build_scene(opened.text, opened.path)
    event = from_line(to_line(EngineEvent(1, Checked(scene=scene))))
    assert event.what.scene.walls == scene.walls
    names = [handle.id for handle in scene.handles]
    assert len(set(names)) == len(names)
    for name in names:
        assert entry_of(opened.tree, name) is not None
        assert name.startswith("corner") or object_of(key_of(name)) == name


def test_a_scenario_shows_its_visits() -> None:
    path = ROOT / "missions" / "scenarios" / "shuttle.yaml"
    visits = [
        place for place in build_scene(path.read_text(), path).places if place.label.startswith("visit")
    ]
    assert [(visit.id, visit.radius_m) for visit in visits] == [(f"visit/{i}", 0.1) for i in range(4)]


def test_a_text_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(InputError, match="not valid YAML"):
        build_scene("walls: [", DUAL)


def test_without_a_flight_model_a_mission_shows_its_probes() -> None:
    _, scene = whole_scene(ROOT / "missions" / "find_a_wall.yaml")
    assert not scene.predicted
    assert MapKind.PROBE in {path.kind for path in scene.paths}


@pytest.mark.parametrize(
    ("item", "message", "objects"),
    [
        ("force_2", "76 N at wall acrylic", ["hit/1", "wall/acrylic"]),
        ("waypoint_3_clearance", "waypoint 3 is 0.10 m from wall a-b, minimum", ["waypoint/2", "wall/a-b"]),
        ("goal_clearance", "goal is 0.10 m from post pole, too near", ["goal", "post/pole"]),
        ("opposite_walls", "walls a-b and acrylic face each other at", ["wall/acrylic", "wall/a-b"]),
        ("wall_bounds", "wall a is to be hit", []),
        ("path", "the predicted path leads to the wall", []),
    ],
)
def test_a_finding_names_its_objects(item: str, message: str, objects: list[str]) -> None:
    assert objects_in_finding(item, message, ["acrylic", "a-b"], ["pole"]) == objects


def test_the_model_loads_neither_the_vehicle_nor_a_browser_nor_matplotlib() -> None:
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "import dart_flight.lab.studio.engine, dart_flight.lab.studio.edits\n"
        "from dart_flight.lab.studio.scene_model import build_scene\n"
        f"path = Path({str(DUAL)!r})\n"
        "assert build_scene(path.read_text(), path).walls\n"
        "bad = [m for m in sys.modules if m.split('.')[0] in ('mavsdk', 'viser', 'matplotlib')\n"
        "       or m.startswith('dart_flight.vehicle')]\n"
        "assert not bad, bad\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.mark.parametrize("path", MISSIONS, ids=name_of)
def test_the_parts_of_a_mission_with_an_error_are_where_those_of_the_mission_are(path: Path) -> None:
    loaded = load_text(path.read_text("utf-8"), path)
    scene, parts = scene_of(loaded), scene_of(loaded._replace(resolved=None))
    assert [wall.drawn for wall in parts.walls] == [wall.drawn for wall in scene.walls]
    assert [wall.id for wall in parts.walls] == [wall.id for wall in scene.walls]
    assert set(parts.places) <= set(scene.places)
    assert {"start", "goal"} <= {place.id for place in parts.places}
    assert parts.handles == [handle for handle in scene.handles if handle in parts.handles]


def test_a_loaded_text_is_the_loaded_file() -> None:
    for path in MISSIONS:
        loaded = load_text(path.read_text("utf-8"), path)
        assert loaded.resolved == load_mission(path)
