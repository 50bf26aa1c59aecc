"""Holes in the stamps of a recording: where samples are missing, and for how long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_INTERVALS, _LEAST_S = 10.0, 0.1  # shorter ones are jitter, or a sample or two that were lost
_SHOWN = 3


def describe_holes(time_s: NDArray[np.float64], what: str, begin_s: float | None = None) -> list[str]:
    """Return a line for each hole in a recording, the longest first, and one for the rest of them.

    Args:
        time_s: stamps, increasing.
        what: was recorded, in words.
        begin_s: stamp from which the lines count; None: the first.
    """
    if len(time_s) < 3:
        return []
    intervals = np.diff(time_s)
    usual_s = float(np.median(intervals))
    holes = np.flatnonzero(intervals > max(_INTERVALS * usual_s, _LEAST_S))
    holes = holes[np.argsort(-intervals[holes], kind="stable")]
    zero_s = float(time_s[0]) if begin_s is None else begin_s
    lines = [
        f"hole of {intervals[i]:.2f} s in {what}, from {time_s[i] - zero_s:.2f} s on" for i in holes[:_SHOWN]
    ]
    if len(holes) > _SHOWN:
        rest_s = float(intervals[holes[_SHOWN:]].sum())
        lines.append(f"{len(holes) - _SHOWN} more holes in {what}, {rest_s:.2f} s in all")
    return lines
