"""Campaign: missions on a real PX4, with true hits, estimate and goal (docs/results/px4.md)."""

from __future__ import annotations

import os
import statistics
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.parameter_file import PositionSource
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import markdown


class Px4Hit(msgspec.Struct, frozen=True):
    """One collision: true velocity, true peak, ratio of measured to true peak, and detection latency."""

    normal_m_s: float | None
    peak_n: float | None
    peak_ratio: float | None
    detection_ms: float | None


class Px4Flight(msgspec.Struct, frozen=True):
    """One flight; `version` is PX4's own report."""

    version: str | None
    outcome: str
    reason: str
    failsafe: bool | None
    resets: int | None
    tilt_deg: float | None
    ekf_m: float | None
    miss_m: float | None
    final_m: float | None
    hits: list[Px4Hit]


def hit_of(c: Any) -> Px4Hit:
    """Return the figures of a collision in a verdict."""
    normal_m_s, peak_n = (c.truth.normal_m_s, c.truth.peak_force_n) if c.truth else (None, None)
    measured_n = c.measured.peak_force_n
    ratio = measured_n / peak_n if peak_n and measured_n else None
    return Px4Hit(normal_m_s, peak_n, ratio, c.detection_latency_ms)


def fly(point: Point, seed: int) -> Px4Flight:
    """Fly the mission of a point on the PX4 of `--px4`."""
    source = PositionSource(point.case["position_from"])
    with tempfile.TemporaryDirectory() as folder:
        px4 = os.environ[ENVIRONMENT]
        v = fly_px4(point.mission, px4, seed, Path(folder), position_from=source, spreads=point.spreads)
    return Px4Flight(
        version=v.px4.version if v.px4 else None,
        outcome=v.outcome.value,
        reason=v.reason or "",
        failsafe=v.px4.failsafe if v.px4 else None,
        resets=v.px4.ekf_resets if v.px4 else None,
        tilt_deg=v.max_tilt_deg,
        ekf_m=v.ekf_error_m,
        miss_m=v.goal_miss_m,
        final_m=v.final_error_m,
        hits=[hit_of(c) for c in v.collisions],
    )


_FIGURES: dict[str, tuple[Callable[[Px4Flight], float | None], int]] = {
    "max. tilt °": (lambda f: f.tilt_deg, 1),
    "estimate error m": (lambda f: f.ekf_m, 3),
    "goal miss m": (lambda f: f.miss_m, 2),
    "final error m": (lambda f: f.final_m, 3),
}
_OF_HIT: dict[str, tuple[Callable[[Px4Hit], float | None], int]] = {
    "normal m/s": (lambda h: h.normal_m_s, 3),
    "peak N": (lambda h: h.peak_n, 1),
    "measured / true": (lambda h: h.peak_ratio, 3),
    "detection ms": (lambda h: h.detection_ms, 1),
}


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table of median (minimum to maximum), with a column for every mission and position source."""
    groups: dict[str, list[Px4Flight]] = {}
    for r in rows:
        mission = Path(r.mission).stem
        groups.setdefault(f"{mission}, {r.values['position_from']}, {r.row.version}", []).append(r.row)
    hits = max(len(f.hits) for mine in groups.values() for f in mine)
    names = ["completed", "ended by", "failsafes, resets", *_FIGURES]
    names += [f"hit {i + 1}: {name}" for i in range(hits) for name in _OF_HIT]
    columns = [_column(mine, hits) for mine in groups.values()]
    return markdown(("", *groups), zip(names, *columns, strict=True))


def _column(mine: Sequence[Px4Flight], hits: int) -> list[str]:
    ended = Counter(f.reason.partition(":")[0] for f in mine if f.outcome != "completed")
    cells = [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        ", ".join(f"`{rule}` {count}" for rule, count in ended.most_common()) or "-",
        f"{sum(bool(f.failsafe) for f in mine)}, {sum(f.resets or 0 for f in mine)}",
    ]
    cells += [spread([pick(f) for f in mine], digits) for pick, digits in _FIGURES.values()]
    for i in range(hits):
        flown = [f.hits[i] for f in mine if len(f.hits) > i]
        cells += [spread([pick(h) for h in flown], digits) for pick, digits in _OF_HIT.values()]
    return cells


def spread(values: Sequence[float | None], digits: int) -> str:
    """Return median, minimum and maximum of the known values."""
    known = sorted(v for v in values if v is not None)
    if not known:
        return "-"
    low, high = (f"{v:.{digits}f}" for v in (known[0], known[-1]))
    return f"{statistics.median(known):.{digits}f} ({low} to {high})"
