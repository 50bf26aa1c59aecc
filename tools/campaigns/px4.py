"""Campaign: missions on a real PX4, with true hits, estimate and goal (docs/results/px4.md)."""

from __future__ import annotations

import os
import statistics
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.summary import cause_of
from dart_flight.config.parameter_file import PositionSource
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.results import causes, markdown


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


def parameter_files(folder: Path, line: str | None) -> tuple[Path, ...]:
    """Write a file of one parameter; without a line there is no file, because an empty one is refused."""
    if not line:
        return ()
    file = folder / "case.params"
    file.write_text(f"{line}\n")
    return (file,)


def fly(point: Point, seed: int) -> Px4Flight:
    """Fly the mission of a point on the PX4 of `--px4`."""
    source = PositionSource(point.case["position_from"])
    with tempfile.TemporaryDirectory() as folder:
        px4 = point.case.get("px4", os.environ[ENVIRONMENT])
        files = parameter_files(Path(folder), point.case.get("parameter"))
        v = fly_px4(
            point.mission, px4, seed, Path(folder) / "log",
            position_from=source, spreads=point.spreads, parameter_files=files,
        )  # fmt: skip
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


_HEADS = ("mission", "position from", "completed", "tilt °", "estimate off m", "last hit m/s",
          "its peak: measured / true", "detected after ms", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return PX4's versions, and a row of medians (least to most) for every mission and position source."""
    groups: dict[tuple[str, ...], list[Px4Flight]] = {}
    for r in rows:
        groups.setdefault((Path(r.mission).stem, r.values["position_from"]), []).append(r.row)
    table = markdown(_HEADS, [[*key, *_cells(mine)] for key, mine in groups.items()])
    return f"{versions_of(r.row.version for r in rows)}\n\n{table}"


def versions_of(versions: Iterable[str | None]) -> str:
    """Return the sentence that names the versions of PX4."""
    return f"PX4: {', '.join(sorted({version or 'unknown' for version in versions}))}."


def _cells(mine: Sequence[Px4Flight]) -> list[str]:
    last = [f.hits[-1] for f in mine if f.hits]
    return [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        spread([f.tilt_deg for f in mine], 0),
        spread([f.ekf_m for f in mine], 3),
        spread([hit.normal_m_s for hit in last], 2),
        spread([hit.peak_ratio for hit in last], 2),
        spread([hit.detection_ms for hit in last], 0),
        causes(cause_of(f.reason) for f in mine if f.outcome != "completed"),
    ]


def spread(values: Sequence[float | None], digits: int) -> str:
    """Return median, minimum and maximum of the known values."""
    known = sorted(v for v in values if v is not None)
    if not known:
        return "-"
    low, high = (f"{v:.{digits}f}" for v in (known[0], known[-1]))
    return f"{statistics.median(known):.{digits}f} ({low} to {high})"
