"""The edits of the studio change the values that they name, and what refers to them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from dart_flight.config.document import Document, InputError
from dart_flight.config.mission import parse_mission
from dart_flight.lab.search.scenario import Objective, Scenario, parse_scenario
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.fields import fields_of
from dart_flight.lab.studio.open_file import Edit, OpenFile
from tests.lab.studio.files import DUAL, ROOT

SQUARE = ROOT / "missions" / "square.yaml"
HAIRPIN = ROOT / "missions" / "hairpin.yaml"
SCENARIO = ROOT / "missions" / "scenarios" / "dual_collision.yaml"


def after(path: Any, *made: Edit) -> dict[str, Any]:
    opened = OpenFile.load(path)
    for edit in made:
        opened.edit(edit)
    return opened.tree


def test_a_drag_is_rounded_and_a_typed_value_is_not() -> None:
    assert after(DUAL, edits.drag("goal", (0.98765, -0.00012)))["goal"]["position_m"] == [0.988, 0.0]
    assert after(DUAL, edits.move("goal", (0.98765, -0.00012)))["goal"]["position_m"] == [0.98765, -0.00012]


def test_a_drag_turns_a_wall_to_a_tenth_of_a_degree() -> None:
    wall = after(DUAL, edits.drag("wall/acrylic", (1.65, 0.3), math.radians(175.04)))["walls"]["acrylic"]
    assert wall["point_m"] == [1.65, 0.3]
    assert math.degrees(math.atan2(*wall["normal"][::-1])) == pytest.approx(175.0, abs=1e-6)


def test_a_drag_that_does_not_turn_keeps_the_normal_as_written() -> None:
    scenario = ROOT / "missions" / "scenarios" / "any_walls.yaml"
    board = after(scenario, edits.drag("wall/board", (-0.8, 0.9), -0.25 * math.pi))["walls"]["board"]
    assert board["normal"] == [1.0, -1.0]


def test_a_quarter_turn_gives_an_exact_normal() -> None:
    assert after(DUAL, edits.turn_wall("wall/wood", 180.0))["walls"]["wood"]["normal"] == [-1.0, 0.0]


def test_gains_per_axis_become_gains_of_the_wall_when_it_turns_obliquely() -> None:
    tree = after(DUAL, edits.turn_wall("wall/wood", 85.0))
    hit = tree["collisions"][0]
    assert hit["alpha_wall_m_per_n"] == [0.025, 0.12]
    assert "alpha_m_per_n" not in hit
    assert tree["collisions"][1]["alpha_m_per_n"] == [0.025, 0.025]
    parse_mission(Document(OpenFile.load(DUAL).text, str(DUAL)))
    scenario = after(SCENARIO, edits.turn_wall("wall/wood", 85.0))
    assert scenario["alpha_wall_m_per_n"] == {"wood": [0.025, 0.12]}
    assert scenario["alpha_m_per_n"] == {"acrylic": [0.025, 0.025]}


def test_a_turned_wall_loads() -> None:
    for name in ("wood", "acrylic"):
        opened = OpenFile.load(DUAL)
        opened.edit(edits.turn_wall(f"wall/{name}", {"wood": 85.0, "acrylic": 175.0}[name]))
        parse_mission(Document(opened.text, str(DUAL)))


def test_corners_move_two_limits() -> None:
    assert after(DUAL, edits.drag("corner/2", (2.5, 2.25)))["bounds_m"]["x"] == [-2.0, 2.5]
    assert after(DUAL, edits.drag("corner/0", (-2.5, -1.75)))["bounds_m"]["y"] == [-1.75, 2.0]


def test_renaming_a_wall_follows_every_mention() -> None:
    tree = after(DUAL, edits.rename("wall/wood", "oak"))
    assert list(tree["walls"]) == ["oak", "acrylic"]
    assert tree["collisions"][0]["wall"] == "oak"
    tree = after(HAIRPIN, edits.rename("wall/partition", "board"))
    assert {hit["wall"] for hit in tree["collisions"]} <= {"board.front", "board.back", "end"}
    tree = after(SCENARIO, edits.rename("wall/acrylic", "glass"))
    assert tree["sequence"] == ["wood", "glass"]
    assert "glass" in tree["alpha_m_per_n"]


def test_a_name_is_taken_once() -> None:
    with pytest.raises(InputError, match="already has the name acrylic"):
        after(DUAL, edits.rename("wall/wood", "acrylic"))


def test_a_copied_wall_stands_beside_under_a_free_name() -> None:
    walls = after(DUAL, edits.copy_object("wall/acrylic"), edits.copy_object("wall/acrylic"))["walls"]
    assert list(walls) == ["wood", "acrylic", "acrylic2", "acrylic3"]
    assert walls["acrylic2"]["point_m"] == [1.15, 0.0]


def test_deleting_a_wall_deletes_its_hits() -> None:
    tree = after(DUAL, edits.delete("wall/acrylic"))
    assert list(tree["walls"]) == ["wood"]
    assert [hit["wall"] for hit in tree["collisions"]] == ["wood"]
    tree = after(SCENARIO, edits.delete("wall/acrylic"))
    assert tree["sequence"] == ["wood"]
    assert list(tree["alpha_m_per_n"]) == ["wood"]


def test_waypoints_stay_between_the_same_hits() -> None:
    shuttle = ROOT / "missions" / "shuttle.yaml"
    before = [w.get("after", 0) for w in OpenFile.load(shuttle).tree["waypoints"]]
    fewer = [w.get("after", 0) for w in after(shuttle, edits.delete("hit/0"))["waypoints"]]
    more = [w.get("after", 0) for w in after(shuttle, edits.copy_object("hit/0"))["waypoints"]]
    assert fewer == [n - 1 for n in before]
    assert more == [n + 1 for n in before]


def test_hits_are_added() -> None:
    tree = after(DUAL, edits.add_hit("wood", -0.7))
    assert tree["collisions"][2]["approach"] == {"normal_m_s": -0.7, "tangential_m_s": 0.0}
    assert after(SCENARIO, edits.add_hit("wood"))["sequence"] == ["wood", "acrylic", "wood"]


def test_each_field_of_each_object_sets_its_value() -> None:
    for path, object_id in ((DUAL, "wall/wood"), (DUAL, "hit/0"), (DUAL, "corner/0"), (SQUARE, "waypoint/0")):
        opened = OpenFile.load(path)
        fields = fields_of(opened.tree, object_id, ["wood", "acrylic"], ["rigid", "flexible"])
        for i, field in enumerate(fields):
            if field.label == "name":
                continue
            other = 2.0 if isinstance(field.value, float) else field.options[-1]
            opened.edit(field.edit(other))
            assert fields_of(opened.tree, object_id, ["wood", "acrylic"], ["rigid"])[i].value == other
            opened.undo()


def test_waypoints_and_visits_are_added_where_they_are_flown() -> None:
    assert after(SQUARE, edits.add_waypoint((1.0, 1.0)))["waypoints"][-1] == {"position_m": [1.0, 1.0]}
    assert after(DUAL, edits.add_waypoint((0.5, 0.5)))["waypoints"] == [
        {"after": 2, "position_m": [0.5, 0.5]}
    ]
    visits = after(SCENARIO, edits.add_visit((0.5, 0.5)))["visits"]
    assert visits == [{"position_m": [0.5, 0.5], "within_m": 0.1}]


def test_start_and_goal_cannot_be_deleted() -> None:
    with pytest.raises(InputError, match="the goal cannot be copied or deleted"):
        edits.delete("goal")


def test_a_value_is_set_and_removed() -> None:
    key = ("walls", "acrylic", "position_sd_m")
    assert after(DUAL, edits.set_value(key, 0.02))["walls"]["acrylic"]["position_sd_m"] == 0.02
    assert "hold_s" not in after(DUAL, edits.set_value(("goal", "hold_s"), None))["goal"]
    assert after(DUAL, edits.set_value(("tolerance", "place_m"), 0.3))["tolerance"] == {"place_m": 0.3}
    with pytest.raises(InputError, match="does not exist"):
        after(DUAL, edits.set_value(("collisions", 7, "mode"), "rigid"))


def scenario_from(path: Path, *made: Edit) -> Scenario:
    return parse_scenario(Document.from_tree(edits.scenario_of(after(path, *made), "again"), str(path)))


def test_a_scenario_from_a_mission_hits_the_same_walls() -> None:
    parsed = scenario_from(DUAL)
    assert parsed.sequences == (("wood", "acrylic"),)
    assert parsed.objective is Objective.NEAREST
    assert parsed.alphas == {"wood": (0.025, 0.12), "acrylic": (0.025, 0.025)}


def test_a_scenario_from_a_mission_with_trajectories_keeps_hits_and_touches() -> None:
    parsed = scenario_from(ROOT / "missions" / "shuttle.yaml")
    assert parsed.sequences == (("north", "south", "north", "south"),)
    assert parsed.objective is Objective.QUICKEST
    assert parsed.spec.touch_m_s == 0.6


def test_a_scenario_from_a_mission_without_a_hit_visits_its_waypoints() -> None:
    bare = [edits.delete("hit/1"), edits.delete("hit/0")]
    parsed = scenario_from(DUAL, *bare, edits.add_waypoint((0.5, 0.5)), edits.add_waypoint((0.0, 0.0)))
    assert [visit.position_m for visit in parsed.visits] == [(0.5, 0.5)]  # not the rest at the start
    assert parsed.chosen_by_planner
