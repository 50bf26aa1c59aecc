"""Campaign: single hits along planned trajectories at increasing speed, and the causes that end them.

A flight (docs/results/faster_hits.md) starts from rest, hits a wall at a given velocity, rebounds, and comes
to rest 2 m in front of the wall. The mission's limits are raised so that no flight ends because of its force
or speed. A flight is *recovered* if it completed and was truly at rest at the goal.
"""

from __future__ import annotations

import functools
import math
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.geometry import distance2, norm, tilt_of
from dart_flight.base.records import Mode, Outcome, Phase, PhaseChange, Record, TruthContact, TruthSample
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import VehicleConfig, load_vehicle, packaged
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.search.mission_writer import trajectory_keys
from dart_flight.lab.search.optimal_trajectory import (
    Hit,
    HitLimits,
    Part,
    Problem,
    Visit,
    solve,
)
from dart_flight.lab.search.plan import MotionLimits
from dart_flight.recording.reader import read_log
from dart_flight.recording.uncontrolled import TruthExtremes, find_uncontrolled
from dart_flight.recording.verdict import Verdict
from dart_flight.run.px4_flight import fly_px4
from dart_flight.sim.draws import draw_world
from dart_flight.sim.px4.installation import ENVIRONMENT
from tests.watched_flight import WatchedFlight, place_walls, rule_of
from tools.campaigns.results import NoResultError, causes, grouped, markdown, median_and_most, rate

_FRICTION_RATIO = 0.5  # the law of friction is assumed valid up to this ratio of friction to normal force
_WALL_M, _BACK_M = 3.0, 2.0
_MOTION = (5.0, 8.0, 30.0)  # acceleration m/s2, jerk m/s3, tilt degrees
_TILT_US = 1_000_000  # interval after the hit in which the largest tilt counts
_NEAR_M, _STILL_M_S = 0.25, 0.3


class FastHit(msgspec.Struct, frozen=True):
    """One flight; `closing_m_s` and `exit_m_s` are true speeds along the true normal, None without a hit."""

    outcome: str
    rule: str
    problems: list[str]
    recovered: bool
    closing_m_s: float | None
    exit_m_s: float | None
    peak_n: float | None
    clipped: bool
    tilt_deg: float


@functools.cache
def shipped_vehicle() -> VehicleConfig:
    """Return the vehicle of the shipped missions."""
    return load_vehicle(packaged("configs", "dart.yaml"))


@functools.cache
def mission_of(mode: str, normal_m_s: float, tangential_m_s: float, touch_m_s: float | None) -> Mission:
    """Return a flight from rest into a wall at given speeds, and back to rest.

    Raises:
        NoResultError: the planner finds no trajectory.
    """
    vehicle = shipped_vehicle()
    wall = Wall("wall", (_WALL_M, 0.0), (-1.0, 0.0), 8.0, "acrylic", half_vehicle_m=0.2)
    room_m = 1.0 + 0.6 * normal_m_s + normal_m_s**2 / 8.0
    start, goal = (_WALL_M - room_m, -tangential_m_s), (_WALL_M - _BACK_M, 0.0)
    speed_m_s = math.hypot(normal_m_s, tangential_m_s) + 0.3
    peak_n = shipped_vehicle().detection.force_threshold_n
    hits = HitLimits(1000.0, None, None, _FRICTION_RATIO, peak_n)
    along = math.copysign(tangential_m_s, wall.tangent[1])  # towards positive y
    hit = Hit(wall, Mode(mode), Visit(wall.point, 0.04), velocity_m_s=(-normal_m_s, along))
    before: tuple[Hit | Visit, ...] = ()
    if touch_m_s is not None:
        before = (
            Hit(wall, Mode(mode), Visit(wall.point, 0.04), velocity_m_s=(-touch_m_s, 0.0)),
            Visit(start, 0.3),
        )
    found = solve(
        Problem(
            vehicle,
            start,
            goal,
            (*(Part(event, ()) for event in (*before, hit)), Part(None, ())),
            MotionLimits(speed_m_s, *_MOTION),
            hits,
            vehicle.flying.replan_within_s,
        )
    )
    if found is None:
        raise NoResultError(f"no trajectory at {normal_m_s} and {tangential_m_s} m/s, {mode}")
    tree: dict[str, Any] = {
        "version": 1,
        "name": "faster_hit",
        "start": {"position_m": start, "altitude_m": 1.0},
        "goal": {"position_m": goal, "capture_radius_m": 0.15, "hold_s": 1.0},
        "bounds_m": {"x": (start[0] - 1.5, _WALL_M + 1.0), "y": (-4.0, 4.0), "z": (0.3, 2.5)},
        "walls": {
            wall.name: {
                "point_m": wall.point,
                "normal": wall.normal,
                "length_m": wall.length_m,
                "material": wall.material,
            }
        },
        "limits": {
            "speed_m_s": speed_m_s + 0.7,
            "acceleration_m_s2": _MOTION[0],
            "jerk_m_s3": _MOTION[1],
            "peak_force_n": 1000.0,
        },
    }
    keys = trajectory_keys(vehicle, {wall.name: wall}, found)
    return load_mission(msgspec.to_builtins(tree | keys), vehicle)


def _case_mission(case: Mapping[str, str]) -> Mission:
    touch = float(case["touch_m_s"]) if case["touch_m_s"] else None
    return mission_of(case["mode"], float(case["normal_m_s"]), float(case["tangential_m_s"]), touch)


def fly(point: Point, seed: int) -> FastHit:
    """Fly in the fast world until landing."""
    mission, incidence = _case_mission(point.case), point.case["incidence_deg"]
    spreads = point.spreads if incidence == "drawn" else {**point.spreads, "wall_yaw_deg": 0.0}
    world = draw_world(mission, seed, spreads)
    if incidence != "drawn":
        world = place_walls(world, {}, {"wall": float(incidence)})
    watched = WatchedFlight(mission, seed, world)
    records: list[Record] = []
    watched.onlookers.append(lambda record, number: records.append(record))
    verdict = watched.run()
    return _summarise(mission, verdict, records, watched.problems)


def fly_on_px4(point: Point, seed: int) -> FastHit:
    """Fly with a real PX4; the truth comes from the flight's log."""
    mission = _case_mission(point.case)
    with tempfile.TemporaryDirectory() as folder:
        verdict = fly_px4(mission, os.environ[ENVIRONMENT], seed, Path(folder), spreads=point.spreads)
        assert verdict.log is not None
        records = [entry.record for entry in read_log(verdict.log).entries]
    truth = TruthExtremes(mission.bounds)
    for record in records:
        if isinstance(record, TruthSample):
            truth.update(record)
    completed = verdict.outcome is Outcome.COMPLETED
    problems = list(find_uncontrolled(truth, completed, bool(verdict.reason)))
    return _summarise(mission, verdict, records, problems)


def _summarise(mission: Mission, verdict: Verdict, records: Iterable[Any], problems: list[str]) -> FastHit:
    kept = [r for r in records if isinstance(r, TruthContact | TruthSample | PhaseChange)]
    hit_us = next(
        (
            r.t_us
            for r in kept
            if isinstance(r, PhaseChange)
            and r.after is Phase.CONTACT
            and r.collision == len(mission.collisions)
        ),
        math.inf,
    )
    hit = next((r for r in kept if isinstance(r, TruthContact) and r.end_us > hit_us), None)
    landing_us = next(
        (r.t_us for r in kept if isinstance(r, PhaseChange) and r.after is Phase.LANDING), -math.inf
    )
    samples = [r for r in kept if isinstance(r, TruthSample)]
    tilts = [tilt_of(r.q_frd_to_ned) for r in samples if 0 <= r.t_us - hit_us <= _TILT_US]
    last = [r for r in samples if r.t_us <= landing_us][-1:]
    rests = any(
        distance2(r.position_mission, mission.goal.position_m) < _NEAR_M
        and norm(r.velocity_mission) < _STILL_M_S
        for r in last
    )
    return FastHit(
        verdict.outcome.value,
        rule_of(verdict),
        problems,
        verdict.outcome is Outcome.COMPLETED and hit is not None and rests,
        None if hit is None else -hit.normal_in_m_s,
        None if hit is None else hit.normal_out_m_s,
        None if hit is None else hit.peak_normal_force_n,
        any(c.clipped for c in verdict.collisions),
        math.degrees(max(tilts, default=0.0)),
    )


_HEADS = ("mode", "closing m/s", "touch", "recovered (95 %)", "uncontrolled", "tilt °: median, most",
          "peak N: median, most", "ended by")  # fmt: skip


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a row for every case."""
    keys = ("mode", "normal_m_s", "tangential_m_s", "incidence_deg", "touch_m_s")
    return markdown(
        _HEADS, [[*_case_cells(*key), *_cells(mine)] for key, mine in grouped(rows, *keys).items()]
    )


def _case_cells(mode: str, normal: str, tangential: str, incidence: str, touch: str) -> tuple[str, str, str]:
    sliding = "" if tangential == "0" else f", {tangential} along"
    turned = "" if incidence == "drawn" else f", {incidence}°"
    return mode, f"{normal}{sliding}{turned}", "yes" if touch else "no"


def _cells(mine: Sequence[FastHit]) -> list[str]:
    hit = [f for f in mine if f.closing_m_s]
    return [
        rate(sum(f.recovered for f in mine), len(mine)),
        str(sum(bool(f.problems) for f in mine)),
        median_and_most(f.tilt_deg for f in hit),
        median_and_most(f.peak_n for f in hit),
        causes(f.rule or f.outcome for f in mine if f.outcome != "completed"),
    ]
