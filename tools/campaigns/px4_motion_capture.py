"""Campaign: flights on forwarded motion-capture poses, with systems and latencies
(docs/results/motion_capture.md). The campaign px4_pose_faults flies the cases of `fault_cases`.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import msgspec

from dart_flight.base.records import GuardEvent, Override, TruthSample
from dart_flight.base.summary import cause_of
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
from tools.campaigns.results import causes, grouped, markdown, median_and_most

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
    """Return the cases: missions with each system, and latencies."""
    systems = (_SIMULATOR, "optitrack", "qualisys", "vicon")
    flown = [_case("systems", m, mocap=s) for m in _MISSIONS for s in systems]
    late = [
        _case("latency", "dual_collision", delay_ms=true, measured_ms=found) for true, found in _LATENCIES
    ]
    return flown + late


def fault_cases() -> list[dict[str, str]]:
    """Return the cases of px4_pose_faults."""
    return [_case("faults", "dual_collision", fault=f) for f in _FAULTS]


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
    """Return the worst figures of each mission and system, and the estimate's error at each latency."""
    systems = [r for r in rows if r.values["part"] == "systems"]
    worst: dict[str, dict[str, str]] = {}
    for (flown, system), mine in grouped(systems, "flown", "mocap").items():
        figures = zip(("tilt_deg", "ekf_m", "miss_m"), (1, 3, 2), strict=True)
        worst.setdefault(flown, {})[system] = "/".join(_most(mine, *figure) for figure in figures)
    heads = dict.fromkeys(r.values["mocap"] for r in systems)
    late = [
        [*key, _completed(mine), median_and_most((f.ekf_m for f in mine), 3)]
        for key, mine in grouped(
            [r for r in rows if r.values["part"] == "latency"], "delay_ms", "measured_ms"
        ).items()
    ]
    flights = [r.row for r in rows]
    return "\n".join(
        [
            markdown(("mission", *heads), [[name, *cells.values()] for name, cells in worst.items()]),
            markdown(("latency ms", "measured ms", "completed", "estimate off m: median, most"), late),
            f"{_completed(flights)} completed; {sum(bool(f.uncontrolled) for f in flights)} uncontrolled, "
            f"{sum(bool(f.failsafe) for f in flights)} with a failsafe.",
        ]
    )


def fault_page(rows: Sequence[JudgedRow]) -> str:
    """Return a row for every fault."""
    heads = ("fault", "ended by", "tilt °", "estimate off m", "moved m: median, most", "uncontrolled")
    return markdown(
        heads,
        [
            [
                fault,
                causes(cause_of(f.reason) or f.outcome for f in mine),
                _most(mine, "tilt_deg", 0),
                _most(mine, "ekf_m", 2),
                median_and_most((f.moved_m for f in mine), 2),
                str(sum(bool(f.uncontrolled) for f in mine)),
            ]
            for (fault,), mine in grouped(rows, "fault").items()
        ],
    )


def _most(mine: Sequence[PoseFlight], name: str, digits: int) -> str:
    known = [value for f in mine if (value := getattr(f, name)) is not None]
    return f"{max(known):.{digits}f}" if known else "-"


def _completed(mine: Sequence[PoseFlight]) -> str:
    return f"{sum(f.outcome == 'completed' for f in mine)} of {len(mine)}"
