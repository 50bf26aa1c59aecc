"""The choice of the next hits: limits of force and speed, order, and gain of information."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import load_vehicle
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.next_hits import (
    Known,
    ModeFit,
    NextHitLimits,
    expected_halves,
    fastest_m_s,
    next_hits,
    predict_hit,
)

VEHICLE = load_vehicle()


def limits(peak_n: float = 96.0, fastest: float = 1.5) -> NextHitLimits:
    return NextHitLimits(0.3, fastest, 2.0, peak_n, VEHICLE.airframe.mass_kg, Onset(VEHICLE.onset))


def fit(mode: Mode, half: float = 0.6) -> ModeFit:
    c = VEHICLE.materials["acrylic"].coefficients(mode)
    return ModeFit(Known(c.k, half), Known(c.f, half), Known(c.mu, half), c.nu)


BOTH = {mode: fit(mode) for mode in (Mode.FLEXIBLE, Mode.RIGID)}


def test_no_planned_peak_exceeds_the_limit_by_the_upper_end_of_the_interval() -> None:
    rng = np.random.default_rng(1)
    for hit in next_hits(BOTH, limits(), 8):
        assert hit.peak_n < hit.highest_n <= 96.0 * (1.0 + 1e-9)
        own = BOTH[hit.mode]
        for _ in range(50):
            factors = np.exp(0.6 * rng.uniform(-1.0, 1.0, 3))
            c = own.coefficients.scaled(*factors.tolist())
            table = CoefficientArrays.from_table(c)
            mass_kg, onset = VEHICLE.airframe.mass_kg, Onset(VEHICLE.onset)
            contact = contact_map(table, mass_kg, hit.normal_m_s, hit.tangential_m_s, onset)
            peak_n = math.hypot(float(contact.peak_normal_force_n), float(contact.peak_friction_force_n))
            assert peak_n <= hit.highest_n


def test_hits_are_within_the_speeds_and_the_gentlest_is_first() -> None:
    hits = next_hits(BOTH, limits(), 8)
    assert len(hits) == 8
    assert [hit.highest_n for hit in hits] == sorted(hit.highest_n for hit in hits)
    assert all(0.3 <= -hit.normal_m_s <= 1.5 for hit in hits)
    assert all(math.hypot(hit.normal_m_s, hit.tangential_m_s) <= 2.0 + 1e-9 for hit in hits)


def test_a_better_known_wall_is_hit_faster() -> None:
    slow, fast = fastest_m_s(fit(Mode.RIGID, 0.6), limits()), fastest_m_s(fit(Mode.RIGID, 0.05), limits())
    assert slow is not None
    assert fast is not None
    assert 0.3 < slow < 0.8 * fast


def test_without_a_safe_speed_there_is_no_hit() -> None:
    assert fastest_m_s(fit(Mode.RIGID), limits(peak_n=20.0)) is None
    found = next_hits(BOTH, limits(peak_n=30.0), 4)
    assert {hit.mode for hit in found} == {Mode.FLEXIBLE}


def test_the_speeds_are_equal_steps_through_the_whole_range() -> None:
    only = {Mode.FLEXIBLE: fit(Mode.FLEXIBLE, 0.05)}
    steps = [-hit.normal_m_s for hit in next_hits(only, limits(), 4)]
    assert steps == pytest.approx([0.3, 0.7, 1.1, 1.5])


def test_more_hits_are_expected_to_narrow_the_intervals() -> None:
    own = fit(Mode.FLEXIBLE, 0.3)
    hits = [predict_hit(own, limits(), Mode.FLEXIBLE, -1.0, 0.4)] * 4
    few, many = expected_halves(own, limits(), hits[:2]), expected_halves(own, limits(), hits)
    assert all(many[name] < few[name] < 0.3 for name in ("k", "f", "mu"))
