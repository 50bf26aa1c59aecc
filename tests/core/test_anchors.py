"""Uncertainty of the mission frame between contacts, and updates of the walls by contacts."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import MissionFrame, Vec2, distance2
from dart_flight.base.records import OdometrySample, Phase, PhaseChange, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.anchors import START_SD_M, WALL_SD_M, Anchor, FrameAnchors
from dart_flight.core.mission.executive import _RUN_UP_US
from dart_flight.core.mission.wall_uncertainty import (
    _MIN_CLOSING_M_S,
    _SURE_DIRECTION_RAD,
    SURE_SD,
    EstimatedWalls,
    early_m,
    end_margin_m,
    late_s,
    overrun_m,
    position_margin_m,
)
from tests.core.conftest import GPS, HandFedCore, MissionInPhase, known

DRIFTING = load_mission(packaged("missions", "dual_collision_gps.yaml"))
DRIFT_M_S, RUN_UP_S = 0.03, 1e-6 * _RUN_UP_US
S = 1_000_000
angles = st.floats(-math.pi, math.pi)
places = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))


def unit(angle: float) -> Vec2:
    return (math.cos(angle), math.sin(angle))


contacts = st.lists(st.tuples(angles, st.integers(0, 60), st.floats(0.005, 0.2)), max_size=6)


def anchors_of(contacts_found: list[tuple[float, int, float]]) -> FrameAnchors:
    one = FrameAnchors(DRIFT_M_S)
    for angle, at_s, sd in sorted(contacts_found, key=lambda c: c[1]):
        one.add(Anchor(unit(angle), at_s * S, sd))
    return one


# --- age --------------------------------------------------------------------------------------------------


def test_the_start_uncertainty_is_isotropic_and_grows_by_drift() -> None:
    one = FrameAnchors(DRIFT_M_S)
    one.begin(5 * S)
    for angle in (0.0, 1.0, 2.5):
        assert one.sd_m(unit(angle), 5 * S) == pytest.approx(START_SD_M)
        assert one.sd_m(unit(angle), 15 * S) == pytest.approx(math.hypot(START_SD_M, 10 * DRIFT_M_S))
        assert one.age_s(unit(angle), 15 * S) is None


def test_a_contact_reduces_uncertainty_only_along_its_normal_and_ages() -> None:
    one = FrameAnchors(DRIFT_M_S)
    one.add(Anchor((1.0, 0.0), 10 * S, 0.02))
    assert one.sd_m((1.0, 0.0), 10 * S) == pytest.approx(0.02, rel=0.01)
    assert one.sd_m((1.0, 0.0), 18 * S) == pytest.approx(math.hypot(0.02, 8 * DRIFT_M_S), rel=0.15)
    assert one.sd_m((0.0, 1.0), 18 * S) == pytest.approx(math.hypot(START_SD_M, 18 * DRIFT_M_S))
    assert one.age_s((-1.0, 0.0), 18 * S) == pytest.approx(8.0)
    assert one.age_s((0.0, 1.0), 18 * S) is None


@given(contacts_found=contacts, angle=angles, now_s=st.integers(60, 120), later_s=st.integers(0, 60))
@settings(deadline=None)
def test_uncertainty_never_decreases_with_age(
    contacts_found: list[tuple[float, int, float]], angle: float, now_s: int, later_s: int
) -> None:
    one = anchors_of(contacts_found)
    assert one.sd_m(unit(angle), (now_s + later_s) * S) >= one.sd_m(unit(angle), now_s * S) - 1e-12


@given(contacts_found=contacts, angle=angles, now_s=st.integers(60, 120))
@settings(deadline=None)
def test_the_sign_of_a_normal_has_no_effect(
    contacts_found: list[tuple[float, int, float]], angle: float, now_s: int
) -> None:
    nx, ny = unit(angle)
    turned = anchors_of([(a + math.pi, at_s, sd) for a, at_s, sd in contacts_found])
    expected = pytest.approx(anchors_of(contacts_found).sd_m((nx, ny), now_s * S), rel=1e-9)
    assert anchors_of(contacts_found).sd_m((-nx, -ny), now_s * S) == expected
    assert turned.sd_m((nx, ny), now_s * S) == expected


@given(contacts_found=contacts, angle=angles, now_s=st.integers(60, 120), measured_m=st.floats(0.005, 2.0))
@settings(deadline=None)
def test_a_contact_never_increases_the_uncertainty_along_its_normal(
    contacts_found: list[tuple[float, int, float]], angle: float, now_s: int, measured_m: float
) -> None:
    """Prior and measurement are combined by their variances, as the executive combines them."""
    one, normal = anchors_of(contacts_found), unit(angle)
    before = one.sd_m(normal, now_s * S)
    after = before * measured_m / math.hypot(before, measured_m)
    one.add(Anchor(normal, now_s * S, after))
    assert one.sd_m(normal, now_s * S) <= before + 1e-12
    assert one.age_s(normal, now_s * S) == 0.0


@given(contacts_found=contacts, angle=angles, start_s=st.integers(0, 5))
@settings(deadline=None)
def test_the_planner_reproduces_the_cores_uncertainty_from_its_records(
    contacts_found: list[tuple[float, int, float]], angle: float, start_s: int
) -> None:
    core, planner = FrameAnchors(DRIFT_M_S), FrameAnchors(DRIFT_M_S)
    core.begin(start_s * S)
    for at, (one, at_s, measured_m) in enumerate(sorted(contacts_found, key=lambda c: c[1])):
        wall = msgspec.structs.replace(WOOD, normal=unit(one))
        estimate = wall_estimate(None, None, 0.1, t_us=(10 + at_s) * S, plane_offset_sigma_m=measured_m)
        planner.add_recorded(core.correct_frame(wall, estimate, (10 + at_s) * S + at))
    if contacts_found:
        assert planner.sd_m(unit(angle), 90 * S) == pytest.approx(core.sd_m(unit(angle), 90 * S), rel=1e-12)
        assert planner.age_s(unit(angle), 90 * S) == core.age_s(unit(angle), 90 * S)


@given(angle=angles, offset_m=st.floats(-0.2, 0.2))
def test_a_correction_moves_the_frame_along_the_walls_normal_only(angle: float, offset_m: float) -> None:
    frame = FrameAnchors(DRIFT_M_S)
    frame.begin(0)
    wall = msgspec.structs.replace(WOOD, normal=unit(angle))
    found = frame.correct_frame(wall, wall_estimate(None, None, offset_m, t_us=9 * S), 9 * S)
    share = found.expected_sd_m**2 / (found.expected_sd_m**2 + WALL_SD_M**2 + 0.012**2)
    assert found.moved_mission == pytest.approx([share * offset_m * n for n in unit(angle)], abs=1e-12)


# --- walls ------------------------------------------------------------------------------------------------

WOOD = Wall("wood", (2.0, 0.0), (-1.0, 0.0), 4.0, "wood")


def wall_estimate(
    place: Vec2 | None, normal: Vec2 | None, offset_m: float = 0.0, **changes: object
) -> WallEstimate:
    """Return the estimate of the wooden wall from one contact."""
    one = WallEstimate(
        t_us=S,
        first_us=S,
        wall="wood",
        mode_reported=None,
        mode_felt=None,
        log_odds=0.0,
        k_n_per_m=5500.0,
        f_ns_per_m=15.0,
        mu_s_per_m=0.3,
        nu_n=0.5,
        k_sd=0.1,
        f_sd=0.1,
        mu_sd=0.1,
        nu_sd=0.1,
        incidence_rad=0.0,
        incidence_sigma_rad=0.01,
        plane_offset_m=offset_m,
        plane_offset_sigma_m=0.012,
        plane_point_mission=place,
        plane_normal_mission=normal,
        plane_normal_sigma_rad=0.02,
    )
    return msgspec.structs.replace(one, **changes)


@pytest.mark.parametrize(("place_sd", "yaw_sd"), [(None, None), (0.1, None), (0.1, 0.05), (None, 0.05)])
def test_a_walls_position_is_that_of_its_latest_contact(place_sd: float | None, yaw_sd: float | None) -> None:
    wall = msgspec.structs.replace(WOOD, position_sd_m=place_sd, yaw_sd_rad=yaw_sd)
    walls = EstimatedWalls()
    assert not walls.is_measured("wood")
    for x in (2.3, 2.31, 2.29):
        expected = walls.known_wall(wall)
        walls.add_estimate(wall_estimate((x, 0.0), (-1.0, 0.0), expected.signed_distance((x, 0.0))), wall)
        assert walls.known_wall(wall).point == pytest.approx((x, 0.0))
        written = place_sd is not None or yaw_sd is not None
        assert walls.known_wall(wall).position_sd_m == (pytest.approx(0.012) if written else None)
    for incomplete in (
        wall_estimate(None, None),
        wall_estimate((2.1, 0.0), None),
        wall_estimate(None, (-1.0, 0.0)),
    ):
        walls.add_estimate(incomplete, wall)
    assert walls.known_wall(wall).point == pytest.approx((2.29, 0.0)), (
        "an incomplete estimate must not move the wall"
    )
    assert walls.is_measured("wood")


@pytest.mark.parametrize(("sd_m", "after_m"), [(0.1, 0.012), (0.01, 0.01), (None, None)])
def test_a_contact_without_a_place_moves_its_wall_by_the_offset(
    sd_m: float | None, after_m: float | None
) -> None:
    """It never makes the position less certain."""
    wall, walls = msgspec.structs.replace(WOOD, position_sd_m=sd_m), EstimatedWalls()
    walls.add_estimate(wall_estimate(None, None, 0.07), wall)
    assert walls.known_wall(wall).point == pytest.approx((1.93, 0.0))
    assert walls.known_wall(wall).position_sd_m == after_m


def test_a_contact_corrects_only_an_uncertain_wall_direction() -> None:
    normal = WOOD.rotated(0.1).normal
    for yaw_sd, expected in ((None, WOOD.normal), (0.1, normal)):
        wall = msgspec.structs.replace(WOOD, position_sd_m=0.1, yaw_sd_rad=yaw_sd)
        walls = EstimatedWalls()
        walls.add_estimate(wall_estimate((2.1, 1.0), normal), wall)
        now = walls.known_wall(wall)
        assert now.normal == pytest.approx(expected)
        assert now.signed_distance((2.1, 1.0)) == pytest.approx(0.0, abs=1e-12)
        assert now.yaw_sd_rad == (None if yaw_sd is None else 0.02)
        assert walls.rotation(wall) == pytest.approx(0.1)
        unsure = wall_estimate((2.1, 1.0), WOOD.normal, plane_normal_sigma_rad=2.0 * _SURE_DIRECTION_RAD)
        walls.add_estimate(unsure, wall)
        assert walls.rotation(wall) == pytest.approx(0.1)  # an uncertain contact does not change it


def test_a_probed_wall_gets_its_position_and_material_from_the_contact() -> None:
    wall = msgspec.structs.replace(WOOD, sought=True, material_known=False, yaw_sd_rad=0.26)
    walls = EstimatedWalls()
    assert walls.known_walls((), 0) == ()
    walls.add_estimate(wall_estimate((1.2, 0.4), WOOD.rotated(-0.2).normal, material="acrylic"), wall)
    (now,) = walls.known_walls((), 0)
    assert now.point == pytest.approx((1.2, 0.4))
    assert now.normal == pytest.approx(WOOD.rotated(-0.2).normal)
    assert (now.material, now.material_known, now.sought) == ("acrylic", True, False)
    assert (now.position_sd_m, now.yaw_sd_rad) == (0.012, 0.02)


@given(shift=places, contact_point=places, angle=angles, heading=angles)
@settings(deadline=None)
def test_a_frame_displacement_keeps_measured_walls_in_place(
    shift: Vec2, contact_point: Vec2, angle: float, heading: float
) -> None:
    wall = msgspec.structs.replace(WOOD, sought=True, yaw_sd_rad=0.26)
    walls, frame = EstimatedWalls(), MissionFrame(0.3, -0.2, 0.0, heading)
    walls.add_estimate(wall_estimate(contact_point, unit(angle)), wall)
    before = walls.known_wall(wall)
    walls.move_frame(shift)
    after, moved = walls.known_wall(wall), frame.displaced(*shift)
    # A point of the plane in NED also lies on the plane in the new frame.
    for away in (-1.0, 0.0, 1.0):
        (px, py), (tx, ty) = before.point, before.tangent
        there = frame.point_to_ned((px + away * tx, py + away * ty, 1.0))
        x, y, z = moved.point_from_ned(there)
        assert after.signed_distance((x, y)) == pytest.approx(0.0, abs=1e-9)
        assert z == pytest.approx(1.0)
    assert after.normal == before.normal
    other = msgspec.structs.replace(WOOD, name="other")
    assert walls.known_wall(other) == other  # walls without a contact keep their mission position


@given(shift=places, heading=angles)
@settings(deadline=None)
def test_a_displaced_frame_moves_its_origin_along_its_own_axes(shift: Vec2, heading: float) -> None:
    frame = MissionFrame(0.3, -0.2, 0.1, heading)
    moved = frame.displaced(*shift)
    assert frame.point_from_ned((moved.north_m, moved.east_m, 0.0))[:2] == pytest.approx(shift, abs=1e-9)
    assert distance2((moved.north_m, moved.east_m), (0.3, -0.2)) == pytest.approx(
        math.hypot(*shift), abs=1e-9
    )


def test_wall_uncertainty_grows_with_the_age_of_its_anchor() -> None:
    anchors = FrameAnchors(DRIFT_M_S)
    walls = EstimatedWalls(anchors)
    assert walls.known_wall(WOOD) == EstimatedWalls().known_wall(WOOD, 0) == WOOD
    start = walls.known_wall(WOOD, 0).position_sd_m
    assert start == pytest.approx(START_SD_M)
    anchors.add(Anchor((1.0, 0.0), 0, 0.02))
    fresh, old = (walls.known_wall(WOOD, t * S).position_sd_m for t in (0, 8))
    assert fresh is not None
    assert old is not None
    assert fresh < 0.021
    assert old > 0.2
    own = msgspec.structs.replace(WOOD, position_sd_m=0.1)
    assert walls.known_wall(own, 0).position_sd_m == pytest.approx(math.hypot(0.1, fresh))


@pytest.mark.parametrize(
    ("place_sd_m", "yaw_sd_rad", "along_m", "sd_m"),
    [
        (None, None, 1.5, 0.0),
        (0.1, None, 1.5, 0.1),
        (None, 0.07, 0.0, 0.0),
        (None, 0.07, 1.5, 1.5 * math.tan(0.07)),
        (0.03, 0.07, -1.0, math.hypot(0.03, math.tan(0.07))),
    ],
)
def test_standard_deviations_of_a_wall_at_the_contact_widen_every_tolerance(
    place_sd_m: float | None, yaw_sd_rad: float | None, along_m: float, sd_m: float
) -> None:
    changes = {"position_sd_m": place_sd_m, "yaw_sd_rad": yaw_sd_rad, "half_vehicle_m": 0.2}
    wall, guard, most_m = msgspec.structs.replace(WOOD, **changes), DRIFTING.vehicle.guard, SURE_SD * sd_m
    place = (WOOD.point[0] + along_m * WOOD.tangent[0], WOOD.point[1] + along_m * WOOD.tangent[1])
    assert position_margin_m(wall, place) == pytest.approx(most_m)
    both = position_margin_m(wall, (np.full(2, place[0]), np.full(2, place[1])))
    assert both == pytest.approx([most_m] * 2)
    assert end_margin_m(wall, place) == pytest.approx(0.2 + most_m)
    assert overrun_m(guard, wall, place) == pytest.approx(guard.wall_overrun_m + most_m)
    assert early_m(guard, wall, place) == pytest.approx(guard.wall_early_m + most_m)
    for closing_m_s, least_m_s in ((1.5, 1.5), (0.5 * _MIN_CLOSING_M_S, _MIN_CLOSING_M_S)):
        late = late_s(guard, wall, place, closing_m_s)
        assert late == pytest.approx(guard.wall_late_s + most_m / least_m_s)


@pytest.mark.parametrize(("along_m", "sd_m"), [(0.0, 0.012), (1.5, math.hypot(0.012, 1.5 * math.tan(0.02)))])
def test_wall_centre_uncertainty_grows_with_the_distance_of_the_contact(along_m: float, sd_m: float) -> None:
    wall = msgspec.structs.replace(WOOD, position_sd_m=0.1, yaw_sd_rad=0.05)
    walls, (tx, ty) = EstimatedWalls(), WOOD.tangent
    contact_point = (WOOD.point[0] + along_m * tx, WOOD.point[1] + along_m * ty)
    walls.add_estimate(wall_estimate(contact_point, WOOD.normal), wall)
    assert walls.known_wall(wall).position_sd_m == pytest.approx(sd_m)


@pytest.mark.parametrize("sought", [True, False])
def test_a_contact_with_a_probed_wall_does_not_correct_the_frame(sought: bool) -> None:
    known = {wall.name: msgspec.structs.replace(wall, sought=sought) for wall in DRIFTING.walls}
    hits = tuple(msgspec.structs.replace(one, wall=known[one.wall.name]) for one in DRIFTING.collisions)
    mission = msgspec.structs.replace(DRIFTING, walls=tuple(known.values()), collisions=hits)
    flown, wall = MissionInPhase(mission, Phase.RECOVERY, 1), mission.walls[0]
    (x, y), (nx, ny) = wall.point, wall.normal
    flown.step(wall=wall_estimate((x + 0.05 * nx, y + 0.05 * ny), (nx, ny), 0.05, wall=wall.name))
    assert (flown.proposal.frame is None) is sought
    assert flown.progress.replan.has_wall_estimate, "a plan must not wait for it any longer"


# --- in flight --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("armed_by_hand", [False, True])
def test_the_drift_counts_from_take_off(armed_by_hand: bool) -> None:
    c = HandFedCore(GPS)
    c.run(5.0)  # on the ground
    c.set_status(armed=armed_by_hand)
    c.enter_climb()
    (climb_us,) = (o.t_us for o in c.outputs if isinstance(o, PhaseChange) and o.after is Phase.CLIMB)
    wood, walls = c.core.mission.walls[0], c.progress.walls
    drift_m_s = c.core.mission.vehicle.estimation.position_drift_m_s
    for after_s in (0, 10):
        sd_m = walls.known_wall(wood, climb_us + after_s * S).position_sd_m
        assert sd_m == pytest.approx(math.hypot(START_SD_M, after_s * drift_m_s))


def test_a_leg_after_a_correction_starts_at_the_vehicle_in_the_corrected_frame() -> None:
    """The step of the correction starts no leg, because the vehicle's position is still in the old frame."""
    flown, rest_ned = MissionInPhase(DRIFTING, Phase.RECOVERY, 1), (0.4, 0.55, -1.0)
    progress, state = flown.progress, flown.state
    state.update_odometry(OdometrySample(9 * S, 9 * S, rest_ned, (0.0, 0.0, 0.0)))
    progress.course = progress.course.hold(state.position)
    flown.step(wall=wall_estimate(None, None, 0.2, t_us=8 * S))
    assert (progress.phase, progress.index) == (Phase.RECOVERY, 1)
    frame = known(flown.proposal.frame)
    state.anchor(frame)
    flown.step()
    assert progress.phase is Phase.TRANSIT
    begin = known(progress.course.trajectory).begin
    assert frame.point_to_ned(begin) == pytest.approx(rest_ned)
    assert begin[1] == pytest.approx(-0.55 - 0.2, abs=0.01)


def test_a_planned_trajectory_is_kept_although_its_wall_was_touched() -> None:
    """Its trajectory was planned for the wall of the mission file."""
    loaded = load_mission(packaged("missions", "touch_and_return.yaml"))
    planned = [hit for hit in loaded.to_dict()["collisions"] if hit.get("trajectory")][:1]
    mission = loaded.replace(
        {"collisions": planned, "waypoints": [], "goal_trajectory": None, "frame.anchored_by": "touch"}
    )
    flown, (hit,) = MissionInPhase(mission, Phase.PAUSE), mission.collisions
    progress = flown.progress
    approach = progress.approaches[1]
    progress.walls.add_estimate(wall_estimate((2.1, 0.0), (-1.0, 0.0), wall="east"), hit.wall)
    assert flown.start_next_leg() == []
    assert progress.phase is Phase.TRANSIT
    assert progress.collision is hit
    assert progress.approaches[1] is approach
    assert progress.course.target == (0.0, 0.0, 1.0)


def test_a_run_up_allows_for_the_drift_until_the_impact() -> None:
    wall, drift_m_s = DRIFTING.collisions[2].wall, DRIFTING.vehicle.estimation.position_drift_m_s

    def run_up_distance_m(now_s: float) -> float:
        flown = MissionInPhase(DRIFTING, Phase.PAUSE, 2, round(now_s * S))
        flown.progress.course = flown.progress.course.hold((0.4, 0.2))
        assert flown.start_next_leg() == []
        return wall.signed_distance(flown.progress.course.target)

    early, late = (START_SD_M, drift_m_s * (1.0 + RUN_UP_S)), (START_SD_M, drift_m_s * (10.0 + RUN_UP_S))
    more_m = SURE_SD * (math.hypot(*late) - math.hypot(*early))
    assert run_up_distance_m(10.0) - run_up_distance_m(1.0) == pytest.approx(more_m, abs=1e-10)
