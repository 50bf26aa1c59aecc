"""A contact's request, its answer, and what the core makes of an answer that is missing, late or wrong."""

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


def of(kind: type[R], outputs: list[Output]) -> list[R]:
    return [o for o in outputs if isinstance(o, kind)]


def hit(fed: HandFedCore) -> tuple[ContactRequest, list[Output]]:
    """Hit the wooden wall; returns the request, and all outputs up to it."""
    fed.fly_to_wood()
    out = fed.pulse((-10.0, -16.0))
    fed.position_ned, fed.velocity_ned = (1.0, 1.0, -1.0), (0.0, 0.0, 0.0)
    while not of(ContactRequest, out):
        out += fed.run(0.004)
    (request,) = of(ContactRequest, out)
    return request, out


def test_a_request_has_the_contact_from_four_samples_before_it(hand_fed: HandFedCore) -> None:
    request, out = hit(hand_fed)
    (onset,), (peak,), (end,) = of(ImpactOnset, out), of(ImpactPeak, out), of(ContactEnd, out)
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
    (peak,), (request,) = of(ImpactPeak, out), of(ContactRequest, out)
    assert request.wall is None
    assert request.normal == peak.normal
    assert math.hypot(*request.normal) == pytest.approx(1.0)


def test_an_answer_becomes_the_records_that_it_carries_once(hand_fed: HandFedCore) -> None:
    request, _ = hit(hand_fed)
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
    out = hand_fed.feed(answer)
    assert of(ImpactBody, out) == [answer.body]
    assert of(WallEstimate, out) == [answer.wall]
    again = hand_fed.feed(answer) + hand_fed.run(2.0 * WITHIN_S)
    assert not of(ImpactBody, again)
    assert not of(WallEstimate, again)


def test_without_an_answer_mode_and_wall_are_undecided_after_its_time(hand_fed: HandFedCore) -> None:
    request, _ = hit(hand_fed)
    assert not of(WallEstimate, hand_fed.run(WITHIN_S))
    (felt,) = of(WallEstimate, hand_fed.run(0.008))
    assert felt.problem == "no answer within 300 ms"
    assert (felt.wall, felt.mode_felt, felt.mode_reported) == ("wood", None, Mode.FLEXIBLE)
    assert (felt.log_odds, felt.plane_offset_m, felt.plane_point_mission) == (0.0, 0.0, None)
    wood = hand_fed.core.mission.vehicle.materials["wood"].coefficients(Mode.FLEXIBLE)
    assert (felt.k_n_per_m, felt.f_ns_per_m, felt.mu_s_per_m) == (wood.k, wood.f, wood.mu)
    assert not of(WallEstimate, hand_fed.run(2.0 * WITHIN_S))
    late = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
    out = hand_fed.feed(late)
    assert not of(WallEstimate, out)
    assert not of(ImpactBody, out)


@pytest.mark.parametrize("problem", ["the planner process ended", ""])
def test_an_answer_that_says_nothing_is_undecided_at_once(hand_fed: HandFedCore, problem: str) -> None:
    request, _ = hit(hand_fed)
    (felt,) = of(WallEstimate, hand_fed.feed(ContactAnswer(hand_fed.t_us, request.number, problem=problem)))
    assert (felt.mode_felt, felt.problem) == (None, problem or "no estimate")
    assert not of(WallEstimate, hand_fed.run(2.0 * WITHIN_S))


def test_an_answer_of_another_wall_or_contact_is_not_believed(hand_fed: HandFedCore) -> None:
    request, _ = hit(hand_fed)
    answer = ContactFitter(hand_fed.core.mission.vehicle).answer(request, hand_fed.t_us)
    other = msgspec.structs.replace(answer, number=request.number + 1)
    assert not of(WallEstimate, hand_fed.feed(other))
    assert answer.wall is not None
    elsewhere = msgspec.structs.replace(answer.wall, wall="acrylic")
    out = hand_fed.feed(msgspec.structs.replace(answer, wall=elsewhere))
    (felt,) = of(WallEstimate, out)
    assert (felt.wall, felt.mode_felt) == ("wood", None)
