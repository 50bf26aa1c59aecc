"""Entries of a YAML file are changed, added and removed; everything else keeps its bytes."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.config.document import Document
from dart_flight.config.edit import update_text

ROOT = Path(__file__).parents[2]
FILES = sorted([*ROOT.glob("missions/**/*.yaml"), *ROOT.glob("configs/**/*.yaml")])
WALLS = """walls:                       # as measured on Monday
  # of the hall
  wood:    {x: 1.0, y: 2.0}  # oak
  # bought
  acrylic: {x: 3.0, y: 4.0}
hits:
  - {wall: wood}  # first
  - wall: acrylic
    speed: 1.0  # slow
"""
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**6), 10**6)
    | st.floats(-1e6, 1e6).map(lambda x: float(f"{x:.9g}"))
    | st.sampled_from(["wood", "a: b", "yes", "1e3", "é #", "", " x", "[", "null", "- a", "two\nlines"])
    | st.text(max_size=5)
)
KEYS = st.sampled_from("abcdefgh")
TREES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abcdefgh"), inner, max_size=4)
    ),
    max_leaves=12,
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_without_a_change_a_shipped_file_keeps_every_byte(path: Path) -> None:
    text = path.read_text("utf-8")
    assert update_text(text, copy.deepcopy(Document(text, "").tree)) == text


def _changed(change: str) -> dict[str, Any]:
    tree: dict[str, Any] = copy.deepcopy(Document(WALLS, "").tree)
    exec(change, {"walls": tree["walls"], "hits": tree["hits"], "tree": tree})
    return tree


@pytest.mark.parametrize(
    ("change", "old", "new"),
    [
        ("walls['wood']['x'] = 1.25", "{x: 1.0, y: 2.0}  # oak", "{x: 1.25, y: 2.0}  # oak"),
        ("walls['wood']['z'] = [0.0, 1.0]", "y: 2.0}  #", "y: 2.0, z: [0.0, 1.0]}  #"),
        ("del walls['wood']['x']", "{x: 1.0, y: 2.0}  #", "{y: 2.0}          #"),
        # The comment above an entry goes with the entry.
        ("del walls['acrylic']", "  # bought\n  acrylic: {x: 3.0, y: 4.0}\n", ""),
        ("walls['cork'] = {'x': 5.0}", "y: 4.0}\n", "y: 4.0}\n  cork: {x: 5.0}\n"),
        ("walls['oak'] = walls.pop('acrylic')", "  acrylic:", "  oak:"),
        ("hits[1]['speed'] = 11.5", "1.0  # slow", "11.5  # slow"),
        ("hits[1]['mode'] = 'rigid'", "# slow\n", "# slow\n    mode: rigid\n"),
        ("hits.append({'wall': 'wood'})", "# slow\n", "# slow\n  - {wall: wood}\n"),
        ("del hits[0]", "  - {wall: wood}  # first\n", ""),
        ("hits.clear()", WALLS[WALLS.index("hits:") :], "hits: []\n"),
        ("tree['goals'] = {'a': {'x': 1}}", "# slow\n", "# slow\ngoals:\n  a: {x: 1}\n"),
        ("tree['name'] = 'a: b'", "# slow\n", '# slow\nname: "a: b"\n'),
    ],
)
def test_a_change_of_an_entry_changes_only_its_bytes(change: str, old: str, new: str) -> None:
    assert WALLS.count(old) == 1
    assert update_text(WALLS, _changed(change)) == WALLS.replace(old, new)


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(KEYS, TREES, min_size=1, max_size=5), st.data())
def test_the_text_always_has_the_wanted_values(before: dict[str, Any], data: st.DataObject) -> None:
    """Also if one text is edited several times, and from blocks to braces and back."""
    text = WALLS
    for wanted in (
        before,
        *data.draw(st.lists(st.just(before) | st.dictionaries(st.just("a"), TREES), max_size=3)),
    ):
        text = update_text(text, wanted)
        assert Document(text, "").tree == wanted
