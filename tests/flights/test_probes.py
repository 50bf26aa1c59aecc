"""Probes for unknown walls, and a mission frame that contacts correct: flights in the fast world."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from dart_flight.base.geometry import distance2
from dart_flight.base.records import (
    FrameAnchor,
    ImpactPeak,
    OdometrySample,
    Outcome,
    Phase,
    PhaseChange,
    ProbeEnd,
    Record,
    TruthContact,
    WallEstimate,
)
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import verdict_of
from dart_flight.run.fast import fly_fast
from dart_flight.run.prepare import load_flyable
from tests.shared_flights import PLAIN_GPS, SharedFlights

R = TypeVar("R", bound=Record)
FIND = packaged("missions", "find_a_wall.yaml")


def all_of(log: Log, kind: type[R]) -> list[R]:
    return [entry.record for entry in log.entries if isinstance(entry.record, kind)]


def phases(log: Log) -> list[str]:
    """Return the phases after the takeoff."""
    return [c.after.value for c in all_of(log, PhaseChange)][3:]


def find_a_wall(**changes: Any) -> Mission:
    return load_mission(FIND).replace(changes)


# --- probes -----------------------------------------------------------------------------------------------


def test_an_unknown_wall_is_found_and_hit_again_and_the_other_probe_is_skipped(
    flown: SharedFlights,
) -> None:
    mission = find_a_wall()
    verdict, log = flown("find_a_wall", 1).verdict, read_log(flown("find_a_wall", 1).log)
    assert verdict_of(log).walls == verdict.walls
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert verdict.guard == []
    assert [(c.wall, c.mode) for c in verdict.collisions] == [("north", "rigid"), ("north", "flexible")]
    assert [e.what for e in all_of(log, ProbeEnd)] == ["collision 3 skipped: contact with wall north"]
    hit = ["transit", "prepare", "approach", "contact", "recovery"]
    assert phases(log) == [*hit, "waypoint", *hit, "goal", "landing", "done"]
    # The board is 2 m away and rotated by 6 degrees: the contacts measure its position and direction.
    (board,) = mission.simulated_walls
    (north,) = verdict.walls
    assert abs(board.signed_distance(north.point_m)) < 0.02
    turned = math.degrees(math.acos(min(1.0, np.dot(board.normal, north.normal))))
    assert turned < 1.0
    assert north.truth_error_m is not None
    assert abs(north.truth_error_m) < 0.02
    assert north.truth_error_deg is not None
    assert abs(north.truth_error_deg) == pytest.approx(turned, abs=0.05)
    assert set(north.coefficients) == {"rigid", "flexible"}
    stiff, _ = north.coefficients["rigid"]["k"]
    soft, _ = north.coefficients["flexible"]["k"]
    wood = mission.vehicle.materials["wood"]
    assert stiff == pytest.approx(wood.coefficients(mission.collisions[0].mode).k, rel=0.2)
    assert soft == pytest.approx(wood.coefficients(mission.collisions[1].mode).k, rel=0.2)


def test_the_second_collision_is_beside_the_first_and_the_waypoint_a_metre_away(flown: SharedFlights) -> None:
    mission, verdict = find_a_wall(), flown("find_a_wall", 1).verdict
    log = read_log(flown("find_a_wall", 1).log)
    first, second = all_of(log, ImpactPeak)
    # `impact_along_m: 0.3` is to the right along the normal, which is +y here.
    (board,) = mission.simulated_walls
    along_m = [board.along(peak.position_mission[:2]) for peak in (first, second)]
    assert along_m[1] - along_m[0] == pytest.approx(0.3, abs=0.05)
    course = FlightArrays(log, mission)
    begin, end = (
        course.time_of(next(c.t_us for c in all_of(log, PhaseChange) if getattr(c, side) is Phase.WAYPOINT))
        for side in ("after", "before")
    )
    assert end - begin > 0.5
    at = np.array([np.interp(end, course.true.time_s, course.true.position[:, i]) for i in (0, 1)])
    assert board.signed_distance((float(at[0]), float(at[1]))) == pytest.approx(1.0, abs=0.08)
    assert distance2((float(at[0]), float(at[1])), first.position_mission[:2]) == pytest.approx(1.0, abs=0.1)
    assert len(verdict.collisions) == 2


@pytest.mark.rest
def test_a_mission_whose_probes_find_no_wall_completes_on_its_own_branch(tmp_path: Path) -> None:
    verdict = fly_fast(find_a_wall(simulated_walls={}), 1, tmp_path)
    log = read_log(str(verdict.log))
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert (verdict.collisions, verdict.guard, verdict.walls) == ([], [], [])
    assert [e.what for e in all_of(log, ProbeEnd)] == [
        "the probe for wall north ended without a contact",
        "waypoint 1 skipped: no contact with wall north",
        "collision 2 skipped: no contact with wall north",
        "the probe for wall south ended without a contact",
    ]
    search = ["transit", "prepare", "approach"]
    assert phases(log) == [*search, "recovery", *search, "recovery", "goal", "landing", "done"]
    # The vehicle stops at the end of each probe: 2.8 m to the north, 2 m to the south.
    course = FlightArrays(log, find_a_wall())
    x = course.true.position[:, 0]
    assert x.max() == pytest.approx(2.8, abs=0.1)
    assert x.min() == pytest.approx(-2.0, abs=0.1)


@pytest.mark.rest
@pytest.mark.parametrize("figures", [{}, {"position_sd_m": 0.15}], ids=["taken as known", "with a figure"])
def test_a_displaced_known_wall_is_touched_twice_at_its_true_position(
    figures: dict[str, float],
) -> None:
    probe = {"wall": "wood", "mode": "rigid", "probe": {"from_m": [0.0, 0.0], "length_m": 2.6}}
    wall = {"point_m": [1.9, 0.0], "normal": [-1.0, 0.0], "length_m": 3.0, "material": "wood"}
    mission = find_a_wall(
        collisions=[probe, probe], waypoints=[], simulated_walls={}, walls={"wood": wall | figures}
    )
    verdict = fly_fast(mission, 3, None, spreads={"wall_offset_m": 0.15})
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    assert (verdict.guard, len(verdict.collisions)) == ([], 2)
    offset_m = verdict.drawn["wall_offset_m.wood"]
    assert isinstance(offset_m, float)
    assert abs(offset_m) > 0.08
    (wood,) = verdict.walls
    assert 1.9 - wood.point_m[0] == pytest.approx(offset_m, abs=0.02)
    assert wood.truth_error_m == pytest.approx(1.9 - offset_m - wood.point_m[0], abs=0.02)


# --- anchors ----------------------------------------------------------------------------------------------


def test_contacts_correct_the_mission_frame_against_gps_drift(flown: SharedFlights) -> None:
    mission, record = anchored_mission(), anchored_log(flown)
    verdict = verdict_of(record)
    assert verdict.outcome is Outcome.COMPLETED, verdict.reason
    anchors = all_of(record, FrameAnchor)
    assert [a.wall for a in anchors] == ["wood", "acrylic", "wood", "acrylic"]
    assert [a.age_s is None for a in anchors] == [True, True, False, False]
    assert max(a.age_s or 0.0 for a in anchors) < 8.0
    for anchor in anchors:
        normal = next(w.normal for w in mission.walls if w.name == anchor.wall)
        along = anchor.moved_mission[0] * normal[1] - anchor.moved_mission[1] * normal[0]
        assert abs(along) < 1e-12, "only along the normal"
        assert anchor.sd_m < anchor.expected_sd_m
        assert anchor.sd_m < 0.03
    # The correction equals the true position error along the normal.
    course = FlightArrays(record, mission)
    for anchor, estimate in zip(anchors, all_of(record, WallEstimate), strict=True):
        axis = 0 if anchor.wall == "acrylic" else 1
        before, after = (
            position_error_m(course, course.time_of(anchor.t_us) + s, axis) for s in (-0.02, 0.02)
        )
        assert abs(after) < 0.035, anchor
        moved = anchor.moved_mission[axis]
        assert before - after == pytest.approx(moved, abs=0.01)
        assert estimate.wall == anchor.wall


def position_error_m(course: FlightArrays, at_s: float, axis: int) -> float:
    """Return the estimated minus the true position."""
    estimated, true = (
        float(np.interp(at_s, motion.time_s, motion.position[:, axis]))
        for motion in (course.estimated, course.true)
    )
    return estimated - true


def test_the_next_leg_begins_away_from_the_touched_wall(flown: SharedFlights) -> None:
    """A vehicle that hovers at its wall with PX4's integrators wound up is not at rest."""
    log = anchored_log(flown)
    course, contacts = FlightArrays(log, anchored_mission()), all_of(log, TruthContact)
    leaves = [c for c in all_of(log, PhaseChange) if c.before is Phase.RECOVERY][:2]
    for change, (axis, wall_m, back_m) in zip(leaves, ((1, -1.1, 0.4), (0, 1.65, 0.5)), strict=True):
        at_s = course.time_of(change.t_us)
        away_m = abs(np.interp(at_s, course.true.time_s, course.true.position[:, axis]) - wall_m)
        assert 0.5 * back_m < away_m < 1.5 * back_m
    assert len(contacts) == 4


def test_every_position_uses_the_mission_frame_of_its_time(flown: SharedFlights) -> None:
    log = anchored_log(flown)
    course, reader = FlightArrays(log, anchored_mission()), MissionFrameReader(anchored_mission())
    compared, moves = 0, {a.t_us for a in all_of(log, FrameAnchor)}
    position = {
        round(t, 6): p for t, p in zip(course.estimated.time_s, course.estimated.position, strict=True)
    }
    for entry in log.entries:
        reader.add(entry.record)
        if isinstance(entry.record, OdometrySample) and reader.frame is not None:
            t_us = entry.record.t_us
            if all(abs(t_us - move_us) > 4_000 for move_us in moves):  # an anchor arrives between two samples
                expected = reader.frame.point_from_ned(entry.record.position_ned)
                assert position[round(course.time_of(t_us), 6)] == pytest.approx(expected, abs=1e-9)
                in_force = course.frame_at(t_us)
                assert in_force is not None
                assert in_force.point_from_ned(entry.record.position_ned) == pytest.approx(expected, abs=1e-9)
                compared += 1
    assert compared > 1000


def test_the_position_is_accurate_at_the_last_contact_in_a_moved_frame(flown: SharedFlights) -> None:
    log = anchored_log(flown)
    course = FlightArrays(log, anchored_mission())
    last = all_of(log, TruthContact)[-1]
    at_s = course.time_of(last.end_us) + 0.5
    assert abs(position_error_m(course, at_s, 0)) < 0.08
    first, now = course.frame, course.frame_at(last.end_us + 500_000)
    assert first is not None
    assert now is not None
    assert distance2((first.north_m, first.east_m), (now.north_m, now.east_m)) > 0.05


def anchored_mission() -> Mission:
    return load_flyable(packaged("missions", "dual_collision_gps.yaml"), None, PLAIN_GPS)


def anchored_log(flown: SharedFlights) -> Log:
    return read_log(flown("dual_collision_gps", 1, settings=PLAIN_GPS).log)
