"""Detection of holes in a recording, where samples are missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_INTERVALS, _LEAST_S = 10.0, 0.1  # shorter holes are jitter or one or two lost samples
_SHOWN = 3


def describe_holes(time_s: NDArray[np.float64], what: str, begin_s: float | None = None) -> list[str]:
    """Return a line for each of the longest holes in a recording, and one line for the other holes.

    Args:
        time_s: stamps, increasing.
        what: name of the recorded data.
        begin_s: stamp that the lines count as 0, or None for the first stamp.
    """
    if len(time_s) < 3:
        return []
    intervals = np.diff(time_s)
    usual_s = float(np.median(intervals))
    holes = np.flatnonzero(intervals > max(_INTERVALS * usual_s, _LEAST_S))
    holes = holes[np.argsort(-intervals[holes], kind="stable")]
    zero_s = float(time_s[0]) if begin_s is None else begin_s
    lines = [f"hole of {intervals[i]:.2f} s in {what}, at {time_s[i] - zero_s:.2f} s" for i in holes[:_SHOWN]]
    if len(holes) > _SHOWN:
        rest_s = float(intervals[holes[_SHOWN:]].sum())
        lines.append(f"{len(holes) - _SHOWN} more holes in {what}, {rest_s:.2f} s in all")
    return lines
