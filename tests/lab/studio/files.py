"""The shipped missions and scenarios, and random edits of them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from dart_flight.config.document import InputError
from dart_flight.lab.studio import edits
from dart_flight.lab.studio.open_file import Edit, OpenFile, StudioKind
from dart_flight.lab.studio.scene_model import build_scene

ROOT = Path(__file__).parents[3]
FILES = sorted((ROOT / "missions").rglob("*.yaml"))
MISSIONS = [path for path in FILES if path.parent.name != "scenarios"]
SCENARIOS = [path for path in FILES if path.parent.name == "scenarios"]
DUAL = ROOT / "missions" / "dual_collision.yaml"
_PLACES = st.floats(-3.0, 3.0).map(lambda v: round(v, 4))
_POINTS = st.tuples(_PLACES, _PLACES)


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT / "missions"))


@st.composite
def one_edit(draw: st.DrawFn, opened: OpenFile) -> Edit:
    """Draw any edit that the page offers for a file."""
    scene = build_scene(opened.text, opened.path)
    handle = draw(st.sampled_from(scene.handles))
    walls = sorted({wall.id for wall in scene.walls})
    choices: list[Any] = [
        st.builds(edits.drag, st.just(handle.id), _POINTS),
        st.builds(edits.add_wall, _POINTS, st.floats(-180, 180), st.just(2.5), st.just("acrylic")),
        st.builds(edits.add_post, _POINTS, st.just(0.2), st.just("wood")),
        st.builds(edits.set_value, st.just(("goal", "capture_radius_m")), st.sampled_from([0.1, 0.25, None])),
        st.builds(edits.set_value, st.just(("name",)), st.sampled_from(["room 2", "a.b", "1e3"])),
    ]
    if walls:
        wall = st.sampled_from(walls)
        shown = st.sampled_from([shape.drawn.plane.name for shape in scene.walls])
        choices += [
            st.builds(edits.drag, wall, _POINTS, st.floats(-math.pi, math.pi)),
            st.builds(edits.turn_wall, wall, st.sampled_from([0.0, 5.0, 90.0, -135.0])),
            st.builds(edits.rename, wall, st.sampled_from(["new", "north wall", "x2"])),
            st.builds(edits.copy_object, wall),
            st.builds(edits.delete, wall),
            st.builds(edits.add_hit, shown, st.sampled_from([None, -0.8])),
        ]
    ids = [*(place.id for place in scene.places), *(f"hit/{hit.number - 1}" for hit in scene.hits)]
    numbered = [one for one in ids if "/" in one]
    if numbered:
        choices += [st.builds(kind, st.sampled_from(numbered)) for kind in (edits.copy_object, edits.delete)]
    if scene.hits:
        keys = [("collisions", hit.number - 1, "approach", "normal_m_s") for hit in scene.hits]
        choices.append(st.builds(edits.set_value, st.sampled_from(keys), st.sampled_from([-0.5, -1.25])))
    place = edits.add_waypoint if opened.kind is StudioKind.MISSION else edits.add_visit
    edit: Edit = draw(st.one_of(*choices, st.builds(place, _POINTS)))
    return edit


def try_edit(opened: OpenFile, edit: Edit) -> bool:
    """Apply an edit, and return whether it was possible; an impossible edit changes nothing."""
    before = opened.text
    try:
        opened.edit(edit)
    except InputError:
        assert opened.text == before
        return False
    return True
