"""The leaves of a tree with their keys, for inheritance, settings and comparisons."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from dart_flight.config.document import dotted, iterate_leaves

VALUES = st.none() | st.integers() | st.text(max_size=3)
TREES = st.recursive(
    VALUES,
    lambda inner: (
        st.lists(inner, min_size=1, max_size=3)
        | st.dictionaries(st.text("abc", min_size=1), inner, min_size=1, max_size=3)
    ),
    max_leaves=12,
)


def value_at(tree: Any, key: tuple[str | int, ...]) -> Any:
    for part in key:
        tree = tree[part]
    return tree


@given(TREES)
def test_every_leaf_is_at_its_key(tree: Any) -> None:
    for in_lists, inner in ((False, dict), (True, dict | list)):
        found = list(iterate_leaves(tree, in_lists=in_lists))
        assert all(value_at(tree, key) is value for key, value in found)
        assert not any(isinstance(value, inner) for _, value in found)
        assert len({dotted(key) for key, _ in found}) == len(found)


def test_a_list_is_one_leaf_unless_lists_are_entered() -> None:
    tree = {"a": {"b": [1, {"c": 2}]}, "d": {}}
    assert list(iterate_leaves(tree)) == [(("a", "b"), [1, {"c": 2}])]
    assert {dotted(k): v for k, v in iterate_leaves(tree, in_lists=True)} == {"a.b[0]": 1, "a.b[1].c": 2}
