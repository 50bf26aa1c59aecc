"""Arithmetic that a rule is written in once, for the core's numbers and for the planner's arrays.

The core decides with `float` and `math` (deterministic, bit-equal in replay), the planner judges thousands of
candidates with NumPy. A rule that both need takes an `Arithmetic` and otherwise plain operators; conditions
are joined with `&` and `|`, which mean the same for `bool` and for arrays of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

Number = Any  # float, or an array of floats: the same for all arguments of one call


class Arithmetic(NamedTuple):
    """The functions that differ between numbers and arrays.

    Attributes:
        hypot, sqrt, maximum, minimum: of numbers.
        where: (condition, value if true, value if false).
    """

    hypot: Callable[[Number, Number], Number]
    sqrt: Callable[[Number], Number]
    maximum: Callable[[Number, Number], Number]
    minimum: Callable[[Number, Number], Number]
    where: Callable[[Number, Number, Number], Number]


SCALARS = Arithmetic(math.hypot, math.sqrt, max, min, lambda condition, yes, no: yes if condition else no)
