"""The last moment to commit to a wall: one rule for the core and the planner."""

import math

import msgspec
import numpy as np
import pytest

from dart_flight.base.records import LockPhase, LockState, Phase
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.commitment import (
    SETTLED_BEFORE_S,
    STOP_MARGIN_M,
    is_acceptable_in_either_mode,
    may_commit,
)
from dart_flight.core.mission.position_loop import PlaneImpact, least_distance_m, predict_impact
from dart_flight.core.sense.state import FlightState
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.run.fast import fly_fast
from tests.core.conftest import MissionInPhase, known

# The paper's point model: with guards, the first hit leaves a slower vehicle and the lock is in time.
STIFF = load_mission(
    packaged("missions", "dual_collision_stiff.yaml"), settings=["simulation.contact.body=point"]
)
ACRYLIC = STIFF.collisions[1]


def mission_with_limits(**limits: float) -> Mission:
    return msgspec.structs.replace(STIFF, limits=msgspec.structs.replace(STIFF.limits, **limits))


def before_the_wall() -> FlightState:
    state = FlightState()
    state.position, state.velocity = (1.2, -0.85, 1.0), (1.5, 0.2, 0.0)
    return state


@pytest.mark.parametrize(
    ("mission", "ready_s", "commits"),
    [
        (STIFF, 0.3 - SETTLED_BEFORE_S - 0.001, True),
        (STIFF, 0.3 - SETTLED_BEFORE_S + 0.001, False),
        (STIFF, math.inf, False),  # the lock is at fault
        (mission_with_limits(peak_force_n=90.0), 0.2, False),  # in time, but too hard in the rigid mode
    ],
)
def test_commitment_needs_a_lock_in_time_and_an_acceptable_hit_in_both_modes(
    mission: Mission, ready_s: float, commits: bool
) -> None:
    assert may_commit(mission, ACRYLIC, PlaneImpact(0.3, -1.6), ready_s, before_the_wall()) is commits


def test_commitment_also_checks_the_mode_that_is_not_planned() -> None:
    """The servo may be stuck, so a flexible hit is refused if a rigid one would be too hard."""
    flexible = msgspec.structs.replace(ACRYLIC, mode=ACRYLIC.mode.other)
    mission = mission_with_limits(peak_force_n=90.0)  # flexible 55 N, rigid 102 N
    assert not may_commit(mission, flexible, PlaneImpact(0.3, -1.6), 0.1, before_the_wall())


def test_scalars_and_arrays_give_the_same_acceptance() -> None:
    rng = np.random.default_rng(3)
    place = rng.uniform((1.6, -1.5), (1.7, 1.5), (200, 2))
    velocity = rng.uniform((-4.0, -1.5), (-0.1, 1.5), (200, 2))
    args = (STIFF.vehicle, STIFF.limits, STIFF.bounds, ACRYLIC.wall, (0.025, 0.025))
    together = is_acceptable_in_either_mode(
        *args, (place[:, 0], place[:, 1]), (velocity[:, 0], velocity[:, 1])
    )
    single = [
        bool(is_acceptable_in_either_mode(*args, (float(p[0]), float(p[1])), (float(v[0]), float(v[1]))))
        for p, v in zip(place, velocity, strict=True)
    ]
    assert together.tolist() == single
    assert 20 < sum(single) < 180


@pytest.mark.parametrize("beside_m", [-1.45, 1.45])
def test_a_sliding_hit_is_acceptable_only_if_its_recovery_leads_inwards(beside_m: float) -> None:
    """A large friction gain puts the setpoint far along the wall, inside or outside the bounds."""
    bounds = msgspec.structs.replace(STIFF.bounds, y=(-1.5, 1.5))
    wall = ACRYLIC.wall
    onward = wall.tangent[1]  # along y
    place = (wall.foot((1.0, beside_m))[0], beside_m)

    def is_acceptable(along_y_m_s: float, alpha_t: float) -> bool:
        velocity = (-0.5, onward * along_y_m_s)
        return bool(
            is_acceptable_in_either_mode(
                STIFF.vehicle, STIFF.limits, bounds, wall, (0.01, alpha_t), place, velocity
            )
        )

    speeds = (0.5 * np.sign(beside_m), -0.5 * np.sign(beside_m))
    assert [is_acceptable(v, 0.0) for v in speeds] == [True, True]
    assert [is_acceptable(v, 0.15) for v in speeds] == [False, True]


def test_the_predicted_impact_is_where_the_course_crosses_the_plane() -> None:
    px4 = STIFF.vehicle.px4
    impact = known(predict_impact(0.5, 1.0, 0.0, -0.5, px4))
    assert impact.normal_m_s < 0.0
    assert least_distance_m(0.5, 1.0, 0.0, -0.5, px4, horizon_s=impact.after_s + 0.02) <= 0.0
    assert least_distance_m(0.5, 1.0, 0.0, -0.5, px4, horizon_s=impact.after_s - 0.02) > 0.0
    assert predict_impact(0.5, 0.0, 0.0, 0.5, px4) is None
    behind = known(predict_impact(-0.1, 1.0, 0.0, -0.5, px4))
    assert behind.after_s <= 0.01


def test_an_impact_beyond_the_horizon_is_not_predicted() -> None:
    """With these setpoints the loop barely overshoots to the plane; the horizon is two seconds."""
    px4, late = STIFF.vehicle.px4, 0
    for target_mm in np.arange(30.0, 36.0, 0.1):
        found = (0.5, 0.01, 0.0, float(1e-3 * target_mm), px4)
        impact = predict_impact(*found, horizon_s=10.0)
        soon = impact is not None and impact.after_s <= 2.0
        late += impact is not None and not soon
        assert predict_impact(*found) == (impact if soon else None)
    assert late > 0


def test_the_papers_second_impact_is_planned_and_flown() -> None:
    """-1.6 m/s with the stiffer gains; the lock settles only after the last moment to stop."""
    hit = predict_mission(STIFF).hits[2]
    assert (hit.normal_m_s, hit.tangential_m_s) == pytest.approx((-1.6, 0.25), abs=0.03)
    verdict = fly_fast(STIFF, 21, None)
    assert verdict.outcome == "completed"
    assert known(verdict.collisions[1].truth).normal_m_s == pytest.approx(-1.6, abs=0.1)


def test_the_approach_is_broken_off_if_a_mode_exceeds_the_force_limit() -> None:
    verdict = fly_fast(mission_with_limits(peak_force_n=90.0), 21, None)
    assert verdict.outcome == "aborted"
    assert verdict.guard[0].rule == "lock_late"


def findings_with_faulty_lock(away_m: float, closing_m_s: float) -> list[str]:
    """Return the findings in the recovery towards the acrylic wall, at this distance and speed."""
    flown, wall = MissionInPhase(STIFF, Phase.RECOVERY, 1), ACRYLIC.wall
    (x, y), (nx, ny) = wall.point, wall.normal
    flown.state.position = (x + away_m * nx, y + away_m * ny, 1.0)
    flown.state.velocity = (-closing_m_s * nx, -closing_m_s * ny, 0.0)
    flown.state.lock = LockState(0, LockPhase.FAULT, None)
    return flown.step()


@pytest.mark.parametrize(
    ("nearest_m", "rules"), [(STOP_MARGIN_M + 0.001, []), (STOP_MARGIN_M - 0.001, ["lock_late"])]
)
def test_a_faulty_lock_is_late_once_a_stop_ends_within_the_margin_of_the_wall(
    nearest_m: float, rules: list[str]
) -> None:
    px4, (near_m, far_m) = STIFF.vehicle.px4, (0.0, 3.0)
    for _ in range(50):
        away_m = 0.5 * (near_m + far_m)
        if least_distance_m(away_m, 1.0, 0.0, away_m, px4) < nearest_m:
            near_m = away_m
        else:
            far_m = away_m
    assert findings_with_faulty_lock(far_m, 1.0) == rules


@pytest.mark.parametrize(("closing_m_s", "rules"), [(0.1, ["lock_late"]), (0.0, []), (-0.5, [])])
def test_a_faulty_lock_is_not_late_if_the_vehicle_does_not_approach(
    closing_m_s: float, rules: list[str]
) -> None:
    assert findings_with_faulty_lock(0.5 * STOP_MARGIN_M, closing_m_s) == rules


@pytest.mark.parametrize(("closing_m_s", "after_s"), [(0.0, 1.3), (-4.0, 1.9)])
def test_impact_prediction_looks_as_far_ahead_as_the_loop_may_need(
    closing_m_s: float, after_s: float
) -> None:
    """The setpoint is 0.1 m behind the wall; a vehicle that first moves away hits the wall later."""
    impact = known(predict_impact(0.5, closing_m_s, 0.0, -0.1, STIFF.vehicle.px4))
    assert impact.after_s == pytest.approx(after_s, abs=0.03)
    assert least_distance_m(0.5, 0.0, 0.0, -0.1, STIFF.vehicle.px4) < 0.0


def test_a_vehicle_that_returns_from_behind_the_plane_hits_it_in_the_next_step() -> None:
    impact = known(predict_impact(-0.1, -0.5, 0.0, 0.3, STIFF.vehicle.px4))
    assert impact.after_s == pytest.approx(0.01)
