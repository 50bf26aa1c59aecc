"""Contact requests and their answers, including missing, late and wrong answers."""

from __future__ import annotations

import math

import msgspec
import pytest

from dart_flight.base.records import (
    ContactAnswer,
    ContactEnd,
    ContactRequest,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    Mode,
    Output,
    WallEstimate,
)
from dart_flight.base.walls import Wall
from dart_flight.config.mission import load_mission
from dart_flight.core.sense.contact_recorder import _BEFORE, _MET_SD_M, ANSWER_WITHIN_US, undecided
from dart_flight.planning.contact_fit import ContactFitter
from tests.core.conftest import ROOT, HandFedCore, known, of_kind

WITHIN_S = 1e-6 * ANSWER_WITHIN_US


def hit_wood(fed: HandFedCore) -> tuple[ContactRequest, list[Output]]:
    """Hit the wooden wall; return the request and all outputs up to it."""
    fed.fly_to_wood()
    out = fed.pulse((-10.0, -16.0))
    fed.position_ned, fed.velocity_ned = (1.0, 1.0, -1.0), (0.0, 0.0, 0.0)
    while not of_kind(ContactRequest, out):
        out += fed.run(0.004)
    (request,) = of_kind(ContactRequest, out)
    return request, out


def test_a_request_starts_some_samples_before_the_onset(hand_fed: HandFedCore) -> None:
    request, out = hit_wood(hand_fed)
    (onset,), (peak,), (end,) = of_kind(ImpactOnset, out), of_kind(ImpactPeak, out), of_kind(ContactEnd, out)
    assert (request.number, request.onset, request.normal) == (1, onset, peak.normal)
    assert (known(request.wall).name, request.mode_reported) == ("wood", Mode.FLEXIBLE)
    assert sum(t_us < onset.first_us for t_us in request.sample_us) == _BEFORE
    assert request.sample_us[-1] == request.t_us >= end.t_us
    assert {len(getattr(request, name)) for name in request.__struct_fields__[-7:]} == {
        len(request.sample_us)
    }
    nx, ny = peak.normal
    top = max(x * nx + y * ny for x, y, _ in request.force_mission)
    assert top == pytest.approx(peak.normal_force_n, rel=0.05)


def test_the_normal_of_an_unplanned_contact_is_that_of_its_force(hand_fed: HandFedCore) -> None:
    hand_fed.fly_to_wood()
    out = hand_fed.pulse((10.0, 16.0)) + hand_fed.run(0.1)
    (peak,), (request,) = of_kind(ImpactPeak, out), of_kind(ContactRequest, out)
    assert request.wall is None
    assert request.normal == peak.normal
    assert math.hypot(*request.normal) == pytest.approx(1.0)


def test_an_answer_is_recorded_once(hand_fed: HandFedCore) -> None:
    request, _ = hit_wood(hand_fed)
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request)
    out = hand_fed.feed(answer)
    assert of_kind(ImpactBody, out) == [answer.body]
    assert of_kind(WallEstimate, out) == [answer.wall]
    again = hand_fed.feed(answer) + hand_fed.run(2.0 * WITHIN_S)
    assert not of_kind(ImpactBody, again)
    assert not of_kind(WallEstimate, again)


def test_a_missing_answer_leaves_mode_and_wall_undecided_after_the_timeout(hand_fed: HandFedCore) -> None:
    request, _ = hit_wood(hand_fed)
    assert not of_kind(WallEstimate, hand_fed.run(WITHIN_S))
    (estimate,) = of_kind(WallEstimate, hand_fed.run(0.008))
    assert estimate.problem == f"no answer within {1e3 * WITHIN_S:.0f} ms"
    assert (estimate.wall, estimate.mode_felt, estimate.mode_reported) == ("wood", None, Mode.FLEXIBLE)
    assert (estimate.log_odds, estimate.plane_offset_m, estimate.plane_point_mission) == (0.0, 0.0, None)
    wood = hand_fed.core.mission.vehicle.materials["wood"].coefficients(Mode.FLEXIBLE)
    assert (estimate.k_n_per_m, estimate.f_ns_per_m, estimate.mu_s_per_m) == (wood.k, wood.f, wood.mu)
    assert not of_kind(WallEstimate, hand_fed.run(2.0 * WITHIN_S))
    late = ContactFitter(hand_fed.core.mission.vehicle).answer(request)
    out = hand_fed.feed(late)
    assert not of_kind(WallEstimate, out)
    assert not of_kind(ImpactBody, out)


@pytest.mark.parametrize("problem", ["the planner process ended", ""])
def test_an_empty_answer_leaves_mode_and_wall_undecided_at_once(hand_fed: HandFedCore, problem: str) -> None:
    request, _ = hit_wood(hand_fed)
    (estimate,) = of_kind(
        WallEstimate, hand_fed.feed(ContactAnswer(hand_fed.t_us, request.number, problem=problem))
    )
    assert (estimate.mode_felt, estimate.problem) == (None, problem or "no estimate")
    assert not of_kind(WallEstimate, hand_fed.run(2.0 * WITHIN_S))


def test_an_answer_for_another_wall_or_contact_is_rejected(hand_fed: HandFedCore) -> None:
    request, _ = hit_wood(hand_fed)
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request)
    other = msgspec.structs.replace(answer, number=request.number + 1)
    assert not of_kind(WallEstimate, hand_fed.feed(other))
    elsewhere = msgspec.structs.replace(known(answer.wall), wall="acrylic")
    out = hand_fed.feed(msgspec.structs.replace(answer, wall=elsewhere))
    (estimate,) = of_kind(WallEstimate, out)
    assert (estimate.wall, estimate.mode_felt) == ("wood", None)


# --- the estimate without a fit ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("position_sd_m", "yaw_sd_rad", "sought", "corrected"),
    [
        (None, None, False, False),
        (0.0, 0.0, False, False),
        (0.2, None, False, True),
        (None, 0.1, False, True),
        (None, None, True, True),
    ],
)
@pytest.mark.parametrize("reported", [None, Mode.RIGID])
def test_a_contact_without_a_fit_locates_only_an_uncertain_or_sought_wall(
    position_sd_m: float | None,
    yaw_sd_rad: float | None,
    sought: bool,
    corrected: bool,
    reported: Mode | None,
) -> None:
    """The vehicle moves at (0.4, -0.7) m/s; the onset is detected 20 ms after the first force."""
    vehicle = load_mission(ROOT / "missions" / "paper_dual_collision.yaml").vehicle
    wall = Wall("north", (1.0, 2.0), (-0.6, -0.8), 4.0, "wood", position_sd_m, yaw_sd_rad, sought=sought)
    onset = ImpactOnset(5_020_000, 5_000_000, 0, (0.0, 0.0, 0.0), (0.4, -0.7, 0.1), (0.9, 1.8, 1.5), True)
    request = ContactRequest(
        t_us=5_100_000,
        number=1,
        onset=onset,
        wall=wall,
        normal=wall.normal,
        mode_reported=reported,
        frame_heading_rad=0.0,
        slow_force=(0.0, 0.0),
        noise_n=0.3,
        noise_frd_nm=(0.0, 0.0, 0.0),
    )
    found = undecided(request, wall, vehicle, "no answer")
    # Without a report, the coefficients are those of unlocked arms.
    c = vehicle.materials["wood"].coefficients(reported or Mode.FLEXIBLE)
    assert (found.k_n_per_m, found.f_ns_per_m, found.mu_s_per_m, found.nu_n) == (c.k, c.f, c.mu, c.nu)
    assert (found.mode_felt, found.mode_reported, found.log_odds) == (None, reported, 0.0)
    assert {found.k_sd, found.f_sd, found.mu_sd, found.nu_sd} == {vehicle.estimation.walls.spread}
    assert (found.t_us, found.first_us, found.problem) == (5_100_000, 5_000_000, "no answer")
    assert found.centre_mission == pytest.approx((0.9 - 0.02 * 0.4, 1.8 + 0.02 * 0.7))
    assert (found.incidence_rad, found.incidence_sigma_rad) == (0.0, yaw_sd_rad or 0.0)
    if corrected:
        assert found.plane_offset_m == pytest.approx(0.1 * 0.6 + 0.2 * 0.8)
        assert found.plane_offset_sigma_m == _MET_SD_M
        assert (found.plane_point_mission, found.plane_normal_mission) == ((0.9, 1.8), wall.normal)
        assert found.plane_normal_sigma_rad == yaw_sd_rad
    else:
        assert (found.plane_offset_m, found.plane_offset_sigma_m) == (0.0, 0.0)
        assert (found.plane_point_mission, found.plane_normal_mission) == (None, None)
        assert found.plane_normal_sigma_rad is None
