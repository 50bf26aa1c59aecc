"""Impacts of a flight: each holds the records of its own contact, also after unplanned contacts."""

from __future__ import annotations

import math
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dart_flight
from dart_flight.base.records import (
    ContactEnd,
    ContactSide,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    Phase,
    PhaseChange,
    Record,
    Setpoint,
    TruthContact,
)
from dart_flight.config.mission import load_mission
from dart_flight.recording.flown_impact import CollisionVerdict, Velocities
from dart_flight.recording.verdict import VerdictBuilder

MISSION = load_mission(dart_flight.packaged("missions", "dual_collision.yaml"))
APART_US = 2_000_000
M_S = st.floats(-3.0, 3.0).map(lambda v: round(v, 6))
PEAK_N = st.none() | st.floats(1.0, 150.0)


class DrawnContact(NamedTuple):
    """One contact, of a planned collision or with something else."""

    is_planned: bool
    velocity: tuple[float, float]
    peak_n: float | None
    incidence_deg: float | None
    contact_ms: int
    out: tuple[float, float]
    is_recovered: bool
    truth_after_ms: int | None  # from the true onset to the detection; None: no true contact


contacts = st.lists(
    st.builds(
        DrawnContact,
        st.booleans(),
        st.tuples(M_S, M_S),
        PEAK_N,
        st.none() | st.floats(-40.0, 40.0),
        st.integers(5, 200),
        st.tuples(M_S, M_S),
        st.booleans(),
        st.none() | st.integers(0, 50),
    ),
    max_size=5,
)


def lock_phase(number: int) -> LockPhase:
    return LockPhase.SETTLED if number % 3 else LockPhase.TRAVELLING


def records_of(drawn: list[DrawnContact]) -> list[Record]:
    """Return the records of a flight whose planned contacts belong to the collisions in order."""
    still = OdometrySample(1000, 1000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    found: list[Record] = [still, PhaseChange(1000, Phase.READYING, Phase.OFFBOARD, "")]
    frame, planned = MISSION.frame_at(still.position_ned), 0
    for number, contact in enumerate(drawn, 1):
        t_us, wall = number * APART_US, MISSION.collisions[min(planned, 1)].wall
        velocity = wall.from_collision((*contact.velocity, 0.0))
        mode = Mode.RIGID if number % 2 else Mode.FLEXIBLE
        found.append(LockState(t_us - 1000, lock_phase(number), mode))
        found.append(ImpactOnset(t_us, t_us - 4000, t_us, (0.0,) * 3, velocity, (0.1, 0.2, 1.0)))
        if contact.is_planned and planned < len(MISSION.collisions):
            planned += 1
            found.append(PhaseChange(t_us, Phase.APPROACH, Phase.CONTACT, "", planned))
        if contact.peak_n is not None:
            at = (t_us + 2000, t_us + 3000, t_us + 3000)
            found.append(
                ImpactPeak(*at, wall.normal, contact.peak_n, 0.5 * contact.peak_n, (0.1, 0.2, 1.0), True)
            )
        if contact.incidence_deg is not None:
            yaw = math.radians(contact.incidence_deg)
            found.append(ImpactBody(t_us, t_us, ContactSide.LEFT, 0.0, yaw, 0.01, (0.0,) * 3, float(number)))
        if contact.is_recovered:
            place = frame.point_to_ned((float(number), 0.5, 1.0))
            elsewhere = Setpoint(t_us + 5000, t_us, still.position_ned, 0.0, recovery=True)
            found += [Setpoint(t_us + 4000, t_us, place, 0.0, recovery=True), elsewhere]
        end_us = t_us - 4000 + 1000 * contact.contact_ms
        found.append(ContactEnd(end_us, t_us - 4000))
        out = frame.vector_to_ned(wall.from_collision((*contact.out, 0.0)))
        found.append(OdometrySample(end_us + 100, end_us, still.position_ned, out))
        if contact.truth_after_ms is not None:
            begin_us = t_us - 1000 * contact.truth_after_ms
            found.append(
                TruthContact(
                    begin_us, t_us + 1000, wall.name, mode, -1.0, 0.2, 0.5, 0.1, 30.0, 5.0, (0.0,) * 3
                )
            )
    return found


@settings(max_examples=200, deadline=None)
@given(contacts)
def test_each_impact_holds_the_records_of_its_own_contact(drawn: list[DrawnContact]) -> None:
    builder = VerdictBuilder(MISSION)
    for record in records_of(drawn):
        builder.add(record)
    planned = [(n, contact) for n, contact in enumerate(drawn, 1) if contact.is_planned][
        : len(MISSION.collisions)
    ]
    impacts = builder.impacts()
    assert [impact.index for impact in impacts] == list(range(1, len(planned) + 1))
    for impact, (number, contact) in zip(impacts, planned, strict=True):
        assert impact.t_us == impact.onset.t_us == number * APART_US
        measured = impact.measured
        assert (measured.normal_m_s, measured.tangential_m_s) == pytest.approx(contact.velocity, abs=1e-9)
        assert (measured.normal_out_m_s, measured.tangential_out_m_s) == pytest.approx(contact.out, abs=1e-9)
        assert measured.peak_force_n == contact.peak_n
        assert impact.clipped is (contact.peak_n is not None)
        assert (measured.incidence_deg is None) is (contact.incidence_deg is None)
        assert measured.peak_torque_nm == (None if contact.incidence_deg is None else number)
        assert impact.contact_time_ms == pytest.approx(contact.contact_ms)
        settled = Mode.RIGID if number % 2 else Mode.FLEXIBLE
        assert impact.lock_mode is (settled if lock_phase(number) is LockPhase.SETTLED else None)
        assert (impact.recovery is not None) is contact.is_recovered
        assert impact.recovery is None or impact.recovery == pytest.approx((float(number), 0.5, 1.0))
        if impact.force is not None:
            along = sum(f * n for f, n in zip(impact.force, impact.collision.wall.normal, strict=True))
            assert along == pytest.approx(contact.peak_n)
        if contact.truth_after_ms is None:
            assert (impact.truth, impact.contact, impact.detection_latency_ms) == (None, None, 4.0)
        else:
            assert impact.truth is not None
            assert impact.truth.normal_m_s == -1.0
            assert impact.detection_latency_ms == pytest.approx(contact.truth_after_ms)


@settings(max_examples=50, deadline=None)
@given(contacts)
def test_building_the_verdict_twice_gives_the_same_impacts(drawn: list[DrawnContact]) -> None:
    builder = VerdictBuilder(MISSION)
    for record in records_of(drawn):
        builder.add(record)
    first, second = builder.build(None, None), builder.build(None, None)
    assert first == second
    for shown, impact in zip(first.collisions, builder.impacts(), strict=True):
        assert type(shown) is CollisionVerdict
        assert all(getattr(shown, name) == getattr(impact, name) for name in shown.__struct_fields__)
        assert impact.planned != Velocities()


def test_a_true_contact_with_another_wall_is_not_assigned_to_the_impact() -> None:
    builder = VerdictBuilder(MISSION)
    hit = DrawnContact(True, (-1.0, 0.0), 20.0, None, 50, (0.5, 0.0), False, None)
    for record in records_of([hit]):
        builder.add(record)
    other = MISSION.collisions[1].wall.name
    assert other != MISSION.collisions[0].wall.name
    builder.add(
        TruthContact(APART_US, APART_US, other, Mode.RIGID, -1.0, 0.0, 0.5, 0.0, 9.0, 0.0, (0.0,) * 3)
    )
    assert builder.impacts()[0].truth is None


@settings(max_examples=100, deadline=None)
@given(contacts)
def test_every_contact_is_listed_once_as_planned_or_as_another(drawn: list[DrawnContact]) -> None:
    builder = VerdictBuilder(MISSION)
    for record in records_of(drawn):
        builder.add(record)
    verdict = builder.build(None, None)
    planned = [number for number, contact in enumerate(drawn, 1) if contact.is_planned]
    others = [n for n in range(1, len(drawn) + 1) if n not in planned[: len(MISSION.collisions)]]
    assert [c.t_us for c in verdict.other_contacts] == [number * APART_US for number in others]
    for found, number in zip(verdict.other_contacts, others, strict=True):
        contact = drawn[number - 1]
        assert found.speed_m_s == pytest.approx(math.hypot(*contact.velocity))
        assert found.peak_force_n == contact.peak_n
        assert (found.truth is None) is (contact.truth_after_ms is None)


def test_a_true_contact_after_the_guard_broke_off_is_listed_even_if_nothing_was_detected() -> None:
    builder = VerdictBuilder(MISSION)
    wall = MISSION.collisions[0].wall.name
    for t_us, broke_off in ((1_000_000, False), (2_000_000, True)):
        if broke_off:
            builder.add(PhaseChange(t_us - 1, Phase.APPROACH, Phase.OVERRULED, "tilt"))
        builder.add(TruthContact(t_us, t_us + 9, wall, Mode.RIGID, -0.4, 0.0, 0.2, 0.0, 3.0, 0.0, (0.0,) * 3))
    (found,) = builder.build(None, None).other_contacts
    assert (found.t_us, found.wall, found.speed_m_s, found.phase) == (2_000_000, wall, None, Phase.OVERRULED)
    assert found.truth is not None
    assert found.truth.peak_force_n == 3.0
