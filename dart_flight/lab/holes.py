"""Lines that describe missing parts of a recording: holes in its stamps, and the end of a log that was cut.

`inspect`, `identify` and `report` print the same lines.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.records import ImuSample
from dart_flight.recording.reader import Log

_INTERVALS, _LEAST_S = 10.0, 0.1  # minimum length of a hole, in sampling intervals and in s
_SHOWN = 3


def describe_holes(time_s: NDArray[np.float64], what: str, begin_s: float | None = None) -> list[str]:
    """Return a line for each of the longest holes between increasing stamps, and one line for all others.

    The printed times count from `begin_s`, by default the first stamp.
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


def describe_cut_end(at_s: float, where: str = "") -> str:
    """Return the line for a log that ends too early, at `at_s`; `where` is a phrase such as "in the air"."""
    return f"cut: the log ends{f' {where},' if where else ''} at {at_s:.2f} s"


def describe_missing_parts(log: Log) -> list[str]:
    """Describe the cut end and the holes of a flight log; times count from the first IMU sample."""
    time_s = log[ImuSample.topic].t_s
    lines = describe_holes(time_s, "the IMU samples", begin_s=0.0)
    if log.complete:
        return lines
    if not len(time_s):
        return ["cut: the log ends before its first IMU sample"]
    return [describe_cut_end(float(time_s[-1])), *lines]
