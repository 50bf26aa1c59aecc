"""How the mission responds to contacts: which contact it expects, a bounce, a peak, a hit in the noise."""

from __future__ import annotations

import msgspec
import pytest

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import (
    DetectionFloor,
    ImpactOnset,
    ImpactPeak,
    LockPermission,
    LockPhase,
    LockState,
    Mode,
    Phase,
)
from dart_flight.config.mission import load_mission
from dart_flight.core.mission.impact_response import _BOUNCES_US
from dart_flight.core.mission.replan import Replan
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import SURE_SD
from tests.core import conftest
from tests.core.conftest import ROOT, MissionInPhase, known

DUAL, SINGLE, GPS = (load_mission(ROOT / path) for path in (conftest.DUAL, conftest.SINGLE, conftest.GPS))
BOUNCES_S = _BOUNCES_US * 1e-6


def onset_at(place: Vec3, planned: bool = True) -> ImpactOnset:
    return ImpactOnset(5, 1, 5, (0.0, 9.0, 0.0), (0.0, 0.0, 0.0), place, planned)


@pytest.mark.parametrize(
    ("phase", "walls"),
    [
        (Phase.TRANSIT, (None, None)),
        (Phase.APPROACH, ("wood", "acrylic")),
        (Phase.CONTACT, ("wood", "acrylic")),
        (Phase.RECOVERY, (None, "acrylic")),  # the wooden one has an approach of its own
        (Phase.LANDING, (None, None)),
    ],
)
def test_the_expected_contact_is_with_the_next_wall(
    phase: Phase, walls: tuple[str | None, str | None]
) -> None:
    flown = MissionInPhase(DUAL, phase, now_us=round(2e6 * BOUNCES_S))
    for flown.progress.index, name in enumerate(walls):
        expected = flown.progress.expected = flown.impacts.expected(flown.progress, flown.state)
        assert (expected.wall.name if expected.wall else None) == name
        assert expected.watching is (phase is not Phase.LANDING)
        assert flown.impacts.expected(flown.progress, flown.state) is expected


@pytest.mark.parametrize(
    ("phase", "wall", "planned_now"),
    [
        (Phase.TRANSIT, 0, False),
        (Phase.APPROACH, 0, True),
        (Phase.CONTACT, 0, False),  # a second one before the peak
        (Phase.RECOVERY, 0, False),  # it has an approach of its own
        (Phase.RECOVERY, 1, True),
        (Phase.GOAL, 2, False),
    ],
)
def test_an_onset_is_planned_only_if_the_plan_has_a_contact_then(
    phase: Phase, wall: int, planned_now: bool
) -> None:
    flown = MissionInPhase(DUAL, phase, wall)
    finding = flown.impacts.on_onset(onset_at((0.0, 0.0, 1.0)), flown.progress, flown.state).finding
    assert (finding is None or finding.rule != "unplanned_hit") is planned_now


@pytest.mark.parametrize("hits", [1, 3], ids=["after a probe", "after a hit, the next wall ahead"])
@pytest.mark.parametrize(
    ("before_m", "after_s", "noted"),
    [
        (0.1, 0.5 * BOUNCES_S, True),
        (0.1, 0.99 * BOUNCES_S, True),
        (0.1, 1.01 * BOUNCES_S, False),  # too late for a bounce
        (2.0, 0.5 * BOUNCES_S, False),  # nowhere near the wall
    ],
)
def test_a_bounce_on_the_wall_just_hit_is_only_reported(
    before_m: float, after_s: float, noted: bool, hits: int
) -> None:
    flown = MissionInPhase(GPS, Phase.RECOVERY, hits, now_us=round(1e6 * after_s))
    flown.state.position = place = (0.4, -1.1 + before_m, 1.0)
    # During a bounce, no contact with the wall ahead is expected.
    expected = flown.impacts.expected(flown.progress, flown.state)
    assert (expected.wall is None) is (noted or hits == 1)
    finding = known(flown.impacts.on_onset(onset_at(place), flown.progress, flown.state).finding)
    assert finding.rule == ("unplanned_hit" if noted or hits == 1 else "wall_met_early")
    assert finding.note_only is noted


@pytest.mark.parametrize(
    ("hits", "place", "away"), [(4, (1.6, -0.5, 1.0), (-1.0, 0.0)), (3, (0.4, -1.1, 1.0), (0.0, 1.0))]
)
def test_the_vehicle_retreats_and_replans_after_a_bounce(hits: int, place: Vec3, away: Vec2) -> None:
    flown = MissionInPhase(GPS, Phase.RECOVERY, hits, now_us=round(0.3e6 * BOUNCES_S))
    flown.state.position = place
    flown.progress.replan = Replan(trajectory=Trajectory.level((0.0,) * 6, (0.0,) * 6, 1.0, (1.0,)))
    flown.step(onset_at(place, planned=False))
    target, retreat_m = flown.progress.course.target, GPS.vehicle.guard.retreat_m
    assert target[:2] == pytest.approx((place[0] + retreat_m * away[0], place[1] + retreat_m * away[1]))
    assert flown.progress.replan.since_us is None
    assert [finding.note_only for finding in flown.proposal.findings] == [True]


@pytest.mark.parametrize(("phase", "wall"), [(Phase.TRANSIT, 0), (Phase.RECOVERY, 1), (Phase.GOAL, 2)])
def test_a_peak_of_an_unplanned_contact_starts_no_recovery(phase: Phase, wall: int) -> None:
    flown = MissionInPhase(DUAL, phase, wall, now_us=1)
    flown.step(ImpactPeak(5, 5, 5, (0.0, 1.0), 20.0, 0.0, (0.0, 0.0, 1.0), False))
    changes = [o for o in flown.proposal.outputs if not isinstance(o, LockPermission)]
    assert (changes, flown.progress.phase, flown.progress.index) == ([], phase, wall)


@pytest.mark.parametrize(
    ("mode", "threshold_n", "rigid_n", "flexible_n", "fires"),
    [
        (Mode.FLEXIBLE, 20.0, 1.0, 500.0, True),
        (Mode.FLEXIBLE, 20.0, 500.0, 1.0, False),
        (Mode.FLEXIBLE, 20.0, 500.0, None, False),
        (Mode.FLEXIBLE, 0.1, 500.0, 500.0, False),  # configured threshold: no noise has been learned
        (Mode.RIGID, 20.0, 500.0, 1.0, True),
        (Mode.RIGID, 20.0, 1.0, 500.0, False),
    ],
)
def test_a_planned_hit_is_in_the_noise_if_the_floor_of_its_mode_is_higher(
    mode: Mode, threshold_n: float, rigid_n: float, flexible_n: float | None, fires: bool
) -> None:
    planned = msgspec.structs.replace(DUAL.collisions[0], mode=mode)
    changed = msgspec.structs.replace(DUAL, collisions=(planned, *DUAL.collisions[1:]))
    found = MissionInPhase(changed, Phase.APPROACH)
    floor = DetectionFloor(0, threshold_n, 1.0, 1.0, rigid_n, flexible_n)
    finding = found.impacts.on_detection_floor(floor, found.progress).finding
    assert (finding is not None and finding.rule == "hit_in_noise") is fires


@pytest.mark.parametrize("sd", [None, 0.05])
def test_the_lateness_limit_of_a_wall_includes_its_position_uncertainty(sd: float | None) -> None:
    """The limit grows by a number of standard deviations at the planned closing speed, 1 m/s."""
    (planned,) = SINGLE.collisions
    wall = msgspec.structs.replace(planned.wall, position_sd_m=sd)
    mission = msgspec.structs.replace(
        SINGLE, walls=(wall,), collisions=(msgspec.structs.replace(planned, wall=wall),)
    )
    late_s = mission.vehicle.guard.wall_late_s + (0.0 if sd is None else SURE_SD * sd)

    def found(since_s: float) -> list[str]:
        flown = MissionInPhase(mission, Phase.APPROACH, now_us=round((2.0 + since_s) * 1e6))
        approach = Trajectory.level((0.0,) * 6, (0.0,) * 6, 1.0, (2.0,))
        flown.progress.course = flown.progress.course.approach(approach)
        flown.state.lock = LockState(0, LockPhase.SETTLED, planned.mode)
        return flown.step()

    assert (found(late_s - 0.01), found(late_s + 0.01)) == ([], ["wall_not_met"])
