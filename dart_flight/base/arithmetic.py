"""Elementary functions of numbers and of arrays, for rules that are written once for both.

The core decides with `float` and `math` (deterministic, bit-equal in replay); the planner evaluates thousands
of candidates with NumPy. A rule that core and planner share accepts floats and arrays: floats give floats,
and arrays give arrays. Conditions are joined with `&` and `|`, which have the same meaning for `bool` and
arrays.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np

Number = Any  # a float or an array of floats; the arguments of one call are all of the same kind


def hypot(x: Number, y: Number) -> Number:
    return np.hypot(x, y) if _has_array(x, y) else math.hypot(x, y)


def sqrt(x: Number) -> Number:
    return np.sqrt(x) if _has_array(x) else math.sqrt(x)


def maximum(x: Number, y: Number) -> Number:
    return np.maximum(x, y) if _has_array(x, y) else max(x, y)


def minimum(x: Number, y: Number) -> Number:
    return np.minimum(x, y) if _has_array(x, y) else min(x, y)


def where(condition: Number, yes: Number, no: Number) -> Number:
    return np.where(condition, yes, no) if _has_array(condition, yes, no) else (yes if condition else no)


def sum_in_order(values: Iterable[float]) -> float:
    """Add from left to right, as `sum` did before Python 3.12: a replay must not depend on the version."""
    return functools.reduce(operator.add, values, 0.0)


def _has_array(*values: Number) -> bool:
    return any(isinstance(value, np.ndarray | np.generic) for value in values)
