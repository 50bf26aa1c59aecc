"""Sums that a replay on another version of Python repeats bit for bit."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dart_flight
from dart_flight.base.arithmetic import sum_in_order

PACKAGE = Path(dart_flight.__file__).parent


@given(st.lists(st.floats(-1e6, 1e6)))
def test_values_are_added_from_left_to_right(values: list[float]) -> None:
    added = 0.0
    for value in values:
        added += value
    assert sum_in_order(values) == added


@pytest.mark.parametrize("room", ["base", "contact", "core", "planning"])
def test_floats_of_a_flight_are_added_in_order(room: str) -> None:
    """The built-in `sum` rounds otherwise since Python 3.12; it may count, which is exact."""
    for path in (PACKAGE / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "sum":
                (counted,) = node.args
                assert isinstance(counted, ast.GeneratorExp), f"{path}:{node.lineno}"
                assert isinstance(counted.elt, ast.Compare | ast.BoolOp), f"{path}:{node.lineno}"
