"""Campaign: flights on forwarded motion-capture poses, with systems, latencies and faults
(docs/results/motion_capture.md).
"""

from __future__ import annotations

import math
import os
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import msgspec

from dart_flight.base.records import GuardEvent, Override, TruthSample
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.planning.survey import plan_survey
from dart_flight.recording.reader import read_log
from dart_flight.run.prepare import load_flyable, with_simulated_mocap
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.faults.fault_table import parse_mission_fault
from dart_flight.sim.pipe import FULL_SPEED
from dart_flight.sim.px4.installation import ENVIRONMENT
from tools.campaigns.px4 import spread
from tools.campaigns.results import markdown

_SIMULATOR = "simulator"  # the simulator itself sends the poses to PX4
_MISSIONS = ("dual_collision", "shuttle", "survey")
_TOUCH_M_S = 0.5
# True latency and the latency that `bringup` measured (tests/px4/test_measured_latency.py), ms.
_LATENCIES = (("5", "4.6"), ("20", "16.7"), ("50", "48.7"))
_FAULTS = (
    "mocap-lost=0.3@approach", "mocap-lost=1@transit", "mocap-lost=1@recovery", "mocap-flip=90@approach",
    "mocap-flip=180@contact", "mocap-other-body@approach", "mocap-other-body@recovery",
    "mocap-late=50@approach", "mocap-late=150@transit", "mocap-slow@approach",
)  # fmt: skip


class PoseFlight(msgspec.Struct, frozen=True):
    """One flight.

    Attributes:
        rules: guard rules that fired, in order.
        uncontrolled: reasons why control was lost (`recording.uncontrolled`).
        moved_m: true horizontal distance between the places of the guard's first reaction and of the final
            rest.
    """

    outcome: str
    reason: str
    rules: list[str]
    failsafe: bool | None
    tilt_deg: float | None
    ekf_m: float | None
    miss_m: float | None
    uncontrolled: list[str]
    moved_m: float | None


def cases() -> list[dict[str, str]]:
    """Return the cases of all parts: systems and missions, latencies, faults."""
    systems = (_SIMULATOR, "optitrack", "qualisys", "vicon")
    flown = [_case("systems", m, mocap=s) for m in _MISSIONS for s in systems]
    late = [
        _case("latency", "dual_collision", delay_ms=true, measured_ms=found) for true, found in _LATENCIES
    ]
    return flown + late + [_case("faults", "dual_collision", fault=f) for f in _FAULTS]


def _case(
    part: str,
    flown: str,
    mocap: str = "optitrack",
    delay_ms: str = "10",
    measured_ms: str = "10",
    fault: str = "",
) -> dict[str, str]:
    delays = {"delay_ms": delay_ms, "measured_ms": measured_ms}
    return {"part": part, "flown": flown, "mocap": mocap, **delays, "fault": fault}


@lru_cache
def _mission(flown: str, mocap: str, delay_ms: str, measured_ms: str) -> Mission:
    delay = [f"simulation.pose_delay_s={float(delay_ms) * 1e-3:g}", f"mocap.delay_ms={measured_ms}"]
    name = "dual_collision" if flown == "survey" else flown
    mission = load_flyable(packaged("missions", f"{name}.yaml"), None, delay)
    if flown == "survey":
        mission = plan_survey(mission, _TOUCH_M_S).mission
    return with_simulated_mocap(mission, None if mocap == _SIMULATOR else mocap)


def fly(point: Point, seed: int) -> PoseFlight:
    """Fly one case on the PX4 of `--px4`."""
    case = point.case
    mission = _mission(case["flown"], case["mocap"], case["delay_ms"], case["measured_ms"])
    fault = parse_mission_fault(mission, case["fault"]) if case["fault"] else None
    with tempfile.TemporaryDirectory() as folder:
        px4 = os.environ[ENVIRONMENT]
        v = fly_px4(mission, px4, seed, Path(folder), spreads=point.spreads, fault=fault, speed=FULL_SPEED)
        moved_m = _moved_m(v.log) if v.log is not None else None
    return PoseFlight(
        outcome=v.outcome.value,
        reason=v.reason or "",
        rules=[event.rule for event in v.guard],
        failsafe=v.px4.failsafe if v.px4 else None,
        tilt_deg=v.max_tilt_deg,
        ekf_m=v.ekf_error_m,
        miss_m=v.goal_miss_m,
        uncontrolled=v.uncontrolled,
        moved_m=moved_m,
    )


def _moved_m(path: str) -> float | None:
    records = [entry.record for entry in read_log(path).entries]
    events = [r.t_us for r in records if isinstance(r, GuardEvent) and r.action is not Override.NONE]
    places = [(r.t_us, r.position_mission[:2]) for r in records if isinstance(r, TruthSample)]
    then = [place for t_us, place in places if events and t_us >= events[0]]
    return math.dist(then[0], then[-1]) if then else None


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table for each part, with median (minimum to maximum)."""
    parts: dict[str, list[JudgedRow]] = {}
    for row in rows:
        parts.setdefault(row.values["part"], []).append(row)
    tables = [_table(part, mine) for part, mine in parts.items()]
    return "\n".join(tables)


def _table(part: str, rows: Sequence[JudgedRow]) -> str:
    keys = {"systems": ("flown", "mocap"), "latency": ("delay_ms",), "faults": ("fault",)}[part]
    groups: dict[tuple[str, ...], list[PoseFlight]] = {}
    for row in rows:
        groups.setdefault(tuple(row.values[key] for key in keys), []).append(row.row)
    head = (*keys, "completed", "ended by", "failsafe", "uncontrolled", "max. tilt °", "estimate error m")
    head += ("moved after reaction m",) if part == "faults" else ("goal miss m",)
    return markdown(head, [(*key, *_figures(part, mine)) for key, mine in groups.items()])


def _figures(part: str, mine: Sequence[PoseFlight]) -> list[str]:
    ended = Counter(f.reason.partition(":")[0] for f in mine if f.outcome != "completed")
    return [
        f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}",
        ", ".join(f"`{rule}` {count}" for rule, count in ended.most_common()) or "-",
        str(sum(bool(f.failsafe) for f in mine)),
        str(sum(bool(f.uncontrolled) for f in mine)),
        spread([f.tilt_deg for f in mine], 1),
        spread([f.ekf_m for f in mine], 3),
        spread([f.moved_m if part == "faults" else f.miss_m for f in mine], 2),
    ]
