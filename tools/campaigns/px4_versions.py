"""Campaign: shipped missions on several versions of PX4 (docs/results/px4_versions.md)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from dart_flight.base.summary import cause_of
from dart_flight.config.parameter_file import PositionSource
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.px4 import Px4Flight, spread
from tools.campaigns.results import causes, markdown

_DUAL = ("dual_collision", "dual_collision_replan", "paper_dual_collision")


def cases() -> list[dict[str, str]]:
    """Return a case for every PX4."""
    folders = os.environ.get(ENVIRONMENT, "").split(os.pathsep)
    return [{"px4": folder, "position_from": PositionSource.MOCAP.value} for folder in folders]


_HEADS = ("PX4", "completed", "failsafes, resets", "tilt °", "estimate off m", "peak: measured / true",
          "second hit of the dual collision m/s", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a row of medians (least to most) for every version."""
    versions: dict[str, list[tuple[str, Px4Flight]]] = {}
    for r in rows:
        versions.setdefault(r.row.version or "unknown", []).append((Path(r.mission).stem, r.row))
    table = []
    for version, flown in versions.items():
        mine = [flight for _, flight in flown]
        second = [f.hits[1].normal_m_s for name, f in flown if name in _DUAL and len(f.hits) > 1]
        cells = [
            f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
            f"{sum(bool(f.failsafe) for f in mine)}, {sum(f.resets or 0 for f in mine)}",
            spread([f.tilt_deg for f in mine], 0),
            spread([f.ekf_m for f in mine], 3),
            spread([hit.peak_ratio for f in mine for hit in f.hits], 2),
            spread(second, 2),
            causes(cause_of(f.reason) for f in mine if f.outcome != "completed"),
        ]
        table.append([version, *cells])
    return markdown(_HEADS, table)
