"""Legs that depend on measured walls, and the path of a probe."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.records import ImpactPeak, LockPhase, LockState, Phase, ProbeEnd
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.probes import resolve_place
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import plan_approach
from dart_flight.core.mission.executive import _LEFT_SHARE, _NOTHING_MET_S, _REST_AFTER_US, _REST_TIMEOUT_US
from dart_flight.core.mission.legs import skip_reason, update_collision, update_mission, update_waypoint
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls
from tests.core.conftest import MissionInPhase, known, of_kind
from tests.core.test_anchors import wall_estimate

FIND = load_mission(packaged("missions", "find_a_wall.yaml"))
AWAY = FIND.waypoints[0]
HERE = (0.3, -0.4)


def walls_after_contact(name: str, place: Vec2 = (1.9, 0.1), normal: Vec2 = (-0.8, 0.6)) -> EstimatedWalls:
    walls = EstimatedWalls()
    wall = next(c.wall for c in FIND.collisions if c.wall.name == name)
    walls.add_estimate(wall_estimate(place, normal, wall=name), wall)
    return walls


def test_legs_with_a_contact_condition_are_skipped_if_it_fails() -> None:
    probe, again, other = FIND.collisions
    for leg, walls, reason in (
        (probe, EstimatedWalls(), None),
        (again, EstimatedWalls(), "no contact with wall north"),
        (again, walls_after_contact("north"), None),
        (other, EstimatedWalls(), None),
        (other, walls_after_contact("north"), "contact with wall north"),
        (AWAY, EstimatedWalls(), "no contact with wall north"),
        (AWAY, walls_after_contact("north"), None),
        (AWAY, walls_after_contact("south"), "no contact with wall north"),
    ):
        assert skip_reason(leg, walls) == reason
    conditional = msgspec.structs.replace(probe, if_met="south")
    assert skip_reason(conditional, walls_after_contact("north")) == "no contact with wall south"
    assert skip_reason(conditional, walls_after_contact("south")) is None


def test_skipped_legs_are_recorded_and_the_flight_continues_with_the_next_leg() -> None:
    flown = MissionInPhase(FIND, Phase.RECOVERY, 1, _REST_TIMEOUT_US + 1)
    assert flown.step() == []
    reason = "skipped: no contact with wall north"
    assert [o.what for o in of_kind(ProbeEnd, flown.proposal.outputs)] == [
        f"{AWAY.name} {reason}",
        f"collision 2 {reason}",
    ]
    assert (flown.progress.stops, flown.progress.index) == (1, 2)
    assert known(flown.progress.collision).wall == FIND.collisions[2].wall


def test_a_hit_and_a_waypoint_follow_the_measured_wall() -> None:
    walls = walls_after_contact("north")
    hit = update_collision(FIND.collisions[1], walls, 0, HERE)
    assert (hit.wall.point, hit.wall.sought) == ((1.9, 0.1), False)
    assert hit.impact_point is not None
    assert hit.wall.signed_distance(hit.impact_point) == pytest.approx(0.0, abs=1e-12)
    assert hit.wall.along(hit.impact_point) == pytest.approx(0.3)
    waypoint = update_waypoint(AWAY, walls)
    assert waypoint.position is not None
    assert waypoint.position[:2] == pytest.approx((1.9 - 0.8, 0.1 + 0.6))
    assert waypoint.position[2] == 1.0
    unknown = EstimatedWalls()
    assert update_collision(FIND.collisions[1], unknown, 0, HERE) == FIND.collisions[1]
    assert update_waypoint(AWAY, unknown) == AWAY


@pytest.mark.parametrize("from_here", [True, False])
def test_a_probe_may_begin_where_the_vehicle_rests(from_here: bool) -> None:
    probe = known(FIND.collisions[0].probe)
    one = msgspec.structs.replace(
        FIND.collisions[0], probe=msgspec.structs.replace(probe, from_here=from_here)
    )
    now = known(update_collision(one, EstimatedWalls(), 0, HERE).probe)
    assert now.begin == (HERE if from_here else probe.begin)
    approach, before = (tuple(e - b for b, e in zip(p.begin, p.end, strict=True)) for p in (now, probe))
    assert approach == pytest.approx(before, abs=1e-12)


@pytest.mark.parametrize("from_here", [True, False])
def test_the_flight_to_a_probe_ends_where_the_probe_begins(from_here: bool) -> None:
    first = FIND.collisions[0]
    probe = msgspec.structs.replace(known(first.probe), from_here=from_here)
    flown = MissionInPhase(FIND, Phase.PAUSE)
    flown.progress.collisions[0] = collision = msgspec.structs.replace(first, probe=probe)
    flown.progress.course = flown.progress.course.hold(HERE)
    assert flown.start_next_leg() == []
    begin = HERE if from_here else probe.begin
    assert flown.progress.course.target[:2] == begin
    assert flown.progress.approaches[collision.index].begin[:2] == pytest.approx(begin)


def test_a_probe_retreats_along_the_normal_of_the_wall_that_it_met() -> None:
    flown, probe = MissionInPhase(FIND, Phase.CONTACT), FIND.collisions[0].probe
    assert probe is not None
    flown.step(ImpactPeak(5, 5, 5, (-0.8, 0.6), 20.0, 3.0, (1.9, 0.1, 1.0), True))
    assert flown.progress.phase is Phase.RECOVERY
    place = (1.9 - 0.8 * probe.back_m, 0.1 + 0.6 * probe.back_m, FIND.altitude_m)
    assert flown.progress.course.target == pytest.approx(place)


def test_an_updated_mission_contains_the_measured_walls() -> None:
    now = update_mission(FIND, walls_after_contact("north"), 0, HERE)
    assert [wall.name for wall in now.walls] == ["north"]
    assert [w.index for w in now.waypoints] == [1]
    assert now.start == HERE
    before = update_mission(FIND, EstimatedWalls(), 0, HERE)
    assert (before.walls, before.waypoints) == ((), ())


@given(away_m=st.floats(0.1, 3.0), along_m=st.floats(-2.0, 2.0))
@settings(deadline=None)
def test_a_place_at_a_wall_has_its_distance_from_the_wall_and_along_it(away_m: float, along_m: float) -> None:
    wall = FIND.simulated_walls[0]
    place = resolve_place(wall, msgspec.structs.replace(known(AWAY.at_wall), away_m=away_m, along_m=along_m))
    assert wall.signed_distance(place) == pytest.approx(away_m, abs=1e-9)
    assert wall.along(place) == pytest.approx(along_m, abs=1e-9)


# --- path of a probe ------------------------------------------------------------------------------------


def mission_with_probe(angle: float, length_m: float, speed_m_s: float) -> Mission:
    first: dict[str, Any] = {
        "wall": "north",
        "mode": "rigid",
        "probe": {
            "from_m": [0.1, -0.2],
            "direction": [math.cos(angle), math.sin(angle)],
            "length_m": length_m,
            "speed_m_s": speed_m_s,
        },
    }
    return FIND.replace({"collisions": [first], "waypoints": [], "simulated_walls": {}})


@given(angle=st.floats(-3.14, 3.14), length_m=st.floats(0.05, 2.2), speed_m_s=st.floats(0.1, 3.0))
@settings(max_examples=60, deadline=None)
def test_a_probe_flies_straight_from_rest_to_rest_within_its_speed(
    angle: float, length_m: float, speed_m_s: float
) -> None:
    mission = mission_with_probe(angle, length_m, speed_m_s)
    (collision,) = mission.collisions
    assert collision.probe is not None
    approach = plan_approach(mission, collision)
    path = [approach.at(approach.duration_s * k / 200) for k in range(201)]
    assert path[0].position == pytest.approx((0.1, -0.2, 1.0), abs=1e-9)
    assert path[-1].position[:2] == pytest.approx(collision.probe.end, abs=2e-3)
    for end in (path[0], path[-1]):
        assert math.hypot(*end.velocity) == pytest.approx(0.0, abs=1e-6)
    speeds = np.array([math.hypot(*one.velocity) for one in path])
    assert speeds.max() <= speed_m_s * (1.0 + 1e-9)
    most = mission.vehicle.flying.acceleration_m_s2
    assert max(math.hypot(*one.acceleration) for one in path) <= most * (1.0 + 1e-6)
    distances_m = [distance2(one.position[:2], (0.1, -0.2)) for one in path]
    assert all(b >= a - 1e-9 for a, b in itertools.pairwise(distances_m))
    ux, uy = math.cos(angle), math.sin(angle)
    assert all(abs((p[0] - 0.1) * uy - (p[1] + 0.2) * ux) < 1e-9 for p in (one.position for one in path))


def test_a_long_probe_reaches_its_speed() -> None:
    mission = mission_with_probe(0.0, 2.0, 0.5)
    approach = plan_approach(mission, mission.collisions[0])
    assert approach.at(0.5 * approach.duration_s).velocity == pytest.approx((0.5, 0.0, 0.0))


def test_a_probe_without_a_contact_ends_at_the_vehicle() -> None:
    flown, level, duration_s = MissionInPhase(FIND, Phase.APPROACH), (0.0,) * 6, 8.8
    progress, state = flown.progress, flown.state
    progress.course = progress.course.approach(Trajectory.level(level, level, 1.0, (duration_s,)))
    state.position, state.lock = (2.7, 0.1, 1.0), LockState(0, LockPhase.SETTLED, FIND.collisions[0].mode)
    state.now_us = round((duration_s + _NOTHING_MET_S) * 1e6)
    flown.step()
    assert progress.phase is Phase.APPROACH
    state.now_us += 1
    flown.step()
    assert (progress.phase, progress.index) == (Phase.RECOVERY, 1)
    assert progress.course.target[:2] == state.position[:2]
    assert progress.lock.contact_end_us == state.now_us, "the lock must be free to move"
    assert [o.what for o in of_kind(ProbeEnd, flown.proposal.outputs)] == [
        "the probe for wall north ended without a contact"
    ]


@pytest.mark.parametrize(
    ("left_share", "continues"), [(_LEFT_SHARE - 0.01, True), (_LEFT_SHARE + 0.01, False)]
)
def test_a_leg_after_a_probe_begins_only_after_half_of_the_retreat(
    left_share: float, continues: bool
) -> None:
    """A vehicle that rests at the wall still leans on PX4's integrators after a slow contact."""
    flown, probe = MissionInPhase(FIND, Phase.RECOVERY, 1, _REST_AFTER_US + 1), FIND.collisions[0].probe
    assert probe is not None
    flown.state.position = (2.0, 0.0, 1.0)
    flown.progress.course = flown.progress.course.hold((2.0 - left_share * probe.back_m, 0.0))
    flown.step()
    assert (flown.progress.phase is not Phase.RECOVERY) == continues
