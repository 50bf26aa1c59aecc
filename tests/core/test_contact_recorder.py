"""Contact requests and their answers, including missing, late and wrong answers."""

from __future__ import annotations

import math
from typing import TypeVar

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
    Record,
    WallEstimate,
)
from dart_flight.planning.contact_fit import ContactFitter
from tests.core.conftest import HandFedCore

R = TypeVar("R", bound=Record)
WITHIN_S = 0.3


def of_kind(kind: type[R], outputs: list[Output]) -> list[R]:
    return [o for o in outputs if isinstance(o, kind)]


def hit_wood(fed: HandFedCore) -> tuple[ContactRequest, list[Output]]:
    """Hit the wooden wall; return the request and all outputs up to it."""
    fed.fly_to_wood()
    out = fed.pulse((-10.0, -16.0))
    fed.position_ned, fed.velocity_ned = (1.0, 1.0, -1.0), (0.0, 0.0, 0.0)
    while not of_kind(ContactRequest, out):
        out += fed.run(0.004)
    (request,) = of_kind(ContactRequest, out)
    return request, out


def test_a_request_starts_four_samples_before_the_onset(hand_fed: HandFedCore) -> None:
    request, out = hit_wood(hand_fed)
    (onset,), (peak,), (end,) = of_kind(ImpactOnset, out), of_kind(ImpactPeak, out), of_kind(ContactEnd, out)
    assert (request.number, request.onset, request.normal) == (1, onset, peak.normal)
    assert request.wall is not None
    assert (request.wall.name, request.mode_reported) == ("wood", Mode.FLEXIBLE)
    assert sum(t_us < onset.first_us for t_us in request.sample_us) == 4
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
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
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
    assert estimate.problem == "no answer within 300 ms"
    assert (estimate.wall, estimate.mode_felt, estimate.mode_reported) == ("wood", None, Mode.FLEXIBLE)
    assert (estimate.log_odds, estimate.plane_offset_m, estimate.plane_point_mission) == (0.0, 0.0, None)
    wood = hand_fed.core.mission.vehicle.materials["wood"].coefficients(Mode.FLEXIBLE)
    assert (estimate.k_n_per_m, estimate.f_ns_per_m, estimate.mu_s_per_m) == (wood.k, wood.f, wood.mu)
    assert not of_kind(WallEstimate, hand_fed.run(2.0 * WITHIN_S))
    late = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
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
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
    other = msgspec.structs.replace(answer, number=request.number + 1)
    assert not of_kind(WallEstimate, hand_fed.feed(other))
    assert answer.wall is not None
    elsewhere = msgspec.structs.replace(answer.wall, wall="acrylic")
    out = hand_fed.feed(msgspec.structs.replace(answer, wall=elsewhere))
    (estimate,) = of_kind(WallEstimate, out)
    assert (estimate.wall, estimate.mode_felt) == ("wood", None)
