"""Flights with one fault each: the cells of the fault matrix, and random faults.

A flight counts as controlled if its log is readable and the conditions in `watched_flight` hold.
"""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Iterable
from pathlib import Path

import msgspec

from dart_flight.base.records import Outcome, Record
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.recording.reader import read_log
from dart_flight.recording.writer import FlightLog
from dart_flight.run.prepare import load_flyable, with_simulated_mocap
from dart_flight.run.program_fault import fill_disk_of
from dart_flight.sim.faults.fault_table import KINDS, Fault, FaultSite, parse_fault
from tests.watched_flight import WatchedFlight

ON_GROUND = "ground"  # phase name: the fault begins with the flight
PHASES = (ON_GROUND, "take-off", "approach", "contact", "recovery", "goal")
_MISSIONS = ("paper_dual_collision", "paper_single_wall")
# Every fault is flown at its default value; these faults also at further values.
_VALUES: dict[str, tuple[float, ...]] = {
    "delay": (100, 300, 1000, 2000), "ev-delay": (90,), "heading-reset": (90,),
    "mocap-lost": (0.1, 0.3), "mocap-flip": (180,), "mocap-late": (150,),
}  # fmt: skip
ROWS = tuple(
    row
    for name in (kind.name for kind in KINDS)
    for row in (name, *(f"{name}={value}" for value in _VALUES.get(name, ())))
)
# A motion-capture fault before take-off has no effect, because PX4 aligns itself with it.
_MOCAP_PHASES = ("take-off", "transit", "approach", "contact", "recovery", "goal")
CELLS = tuple(
    (row, phase) for row in ROWS for phase in (_MOCAP_PHASES if row.startswith("mocap-") else PHASES)
)
APP_GONE = "app gone"  # the program hung or was killed, so the flight has no reason


class FaultFlight(msgspec.Struct, frozen=True):
    """The result of one flight with a fault.

    Attributes:
        began: whether the fault occurred.
        came_of: `completed`, the rule that ended the flight, or `app gone`.
        decision_ms: time from the start of the fault to the first decision of guard or autopilot; None
            without a decision.
        excursion_m: largest distance out of the bounds.
        landing_m_s: speed at the landing.
        tilt_deg: largest tilt.
        problems: the reasons why the flight is uncontrolled.
    """

    fault: str
    began: bool
    came_of: str
    decision_ms: float | None
    excursion_m: float
    landing_m_s: float
    tilt_deg: float
    problems: list[str]


def fly_fault(mission: Mission, fault: Fault, seed: int) -> FaultFlight:
    """Fly with one fault until the vehicle is on the ground, and write and read its log.

    If the fault affects the motion capture, the forwarded poses are the only position source of PX4 in this
    flight.
    """
    if fault.kind.site is FaultSite.MOCAP:
        mission = with_simulated_mocap(mission, "udp")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        log = FlightLog(path, {"mission": mission.name})
        watched = WatchedFlight(mission, seed, fault=fault)
        faulted = watched.flight.faulted
        assert faulted is not None
        fills_disk = fault.name == "disk-full"

        def keep(record: Record, number: int) -> None:
            nonlocal fills_disk
            log.put(record, number)
            if fills_disk and faulted.began_us:
                fills_disk = False
                fill_disk_of(path)

        watched.onlookers.append(keep)
        verdict = watched.run()
        log.close()
        problems = [*watched.problems, *_log_problems(path)]
    began_us, decided_us = faulted.began_us, watched.decided_us
    came_of = (verdict.reason or "").split(":")[0] if verdict.guard else ""
    if faulted.app_silent:
        came_of = APP_GONE
    elif verdict.outcome is Outcome.COMPLETED:
        came_of = "completed"
    return FaultFlight(
        fault=fault.name,
        began=began_us is not None,
        came_of=came_of,
        decision_ms=None if began_us is None or decided_us is None else (decided_us - began_us) * 1e-3,
        excursion_m=watched.truth.excursion_m,
        landing_m_s=watched.truth.landing_m_s,
        tilt_deg=math.degrees(watched.truth.tilt_rad),
        problems=problems,
    )


def _log_problems(path: Path) -> Iterable[str]:
    try:
        named = bool(read_log(path).about.get("mission"))
    except Exception as error:
        return [f"cannot open the flight log: {error}"]
    return [] if named else ["the flight log does not name the mission"]


def matrix_cases() -> list[dict[str, str]]:
    return [{"fault": row, "phase": phase} for row, phase in CELLS]


def fly_cell(point: Point, seed: int) -> FaultFlight:
    return fly_fault(point.mission, cell_fault(point.case["fault"], point.case["phase"]), seed)


def cell_fault(row: str, phase: str) -> Fault:
    return parse_fault(row if phase == ON_GROUND else f"{row}@{phase}")


def fly_random(point: Point, number: int) -> FaultFlight:
    """Fly with a random fault; the number determines fault, value, phase, time and mission."""
    return fly_fault(*random_fault(number), number)


def random_fault(number: int) -> tuple[Mission, Fault]:
    chance = random.Random(f"faults {number}")
    kind = KINDS[number % len(KINDS)]
    value = chance.uniform(kind.low, kind.high)
    ranges = {
        "packet-loss": (1.0, 20.0), "reorder": (1.0, 50.0), "duplicate": (1.0, 50.0), "delay": (5.0, 300.0),
        "jitter": (5.0, 300.0), "ekf-jump": (-1.0, 1.0), "gust": (-8.0, 8.0), "wall-nearer": (-0.3, 0.3),
        "wall-harder": (0.5, 4.0),
    }  # fmt: skip
    if kind.name in ranges:
        value = chance.uniform(*ranges[kind.name])
    phase = chance.choice((None, "take-off", "transit", "approach", "contact", "recovery", "goal", "landing"))
    if kind.site is FaultSite.MOCAP:
        phase = phase or "take-off"
    fault = Fault(kind.name, value, phase, chance.choice((0.0, 0.0, chance.uniform(0.0, 3.0))))
    return load_flyable(packaged("missions", f"{chance.choice(_MISSIONS)}.yaml")), fault
