"""The fit of a contact: synthetic pulses with known truth, properties of the posterior, and flights."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.geometry import IDENTITY
from dart_flight.base.records import ContactRequest, ContactSide, ImpactOnset, Mode, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.planning.contact_fit import (
    SURE_LOG_ODDS,
    Belief,
    ContactFit,
    ContactFitter,
    ContactReadings,
    Hypothesis,
    Ticks,
)
from tests.oracles.point_law import contact_force
from tests.shared_campaigns import campaign_rows
from tests.sim.plants import VEHICLE as AS_SHIPPED

VEHICLE = msgspec.structs.replace(
    AS_SHIPPED,
    onset="lcp",
    airframe=msgspec.structs.replace(AS_SHIPPED.airframe, guard_along_m=0.13, contact_distance_m=0.2),
)
MASS = VEHICLE.airframe.mass_kg
SCATTER, SPREAD = 0.05, 0.3
TICK_S, STEPS = 0.004, 80
NOISE_N = 0.26
AT_WALL = Wall("w", (1.0, 0.0), (-1.0, 0.0), 2.0, "wood")


Row = tuple[float, float, float, float, float, float, float, float, float, bool]


def ticks_of(rows: Sequence[Row]) -> Ticks:
    """Return ticks of both modes from rows (h, normal, along, up, pushes, turned, turning, torque, bound)."""
    h, normal, along, up, push, drive, turned, turning, torque = np.array([r[:9] for r in rows]).T
    both = [np.stack([read, read], axis=1) for read in (normal, along)]
    bound = np.array([r[9] for r in rows])
    return Ticks._make([h, *both, up, push, drive, turned, turning, torque, np.ones(len(rows)), bound])


def scaled(c: Coefficients, k: float = 1.0, f: float = 1.0, mu: float = 1.0) -> Coefficients:
    return Coefficients(c.k * k, c.f * f, c.mu * mu, c.nu)


def belief_of(material: str, mode: Mode, sd: float = SPREAD) -> Belief:
    c = VEHICLE.materials[material].coefficients(mode)
    return Belief(c.k, c.f, c.mu, c.nu, sd, sd, sd, sd)


def pulse(
    c: Coefficients,
    normal: float,
    along: float = 0.0,
    seed: int = 0,
    push: float = 0.0,
    onset: Onset = Onset.LCP,
    full_scale_n: float = math.inf,
) -> ContactReadings:
    """Integrate the contact law in steps of 0.05 ms and return the IMU's ticks."""
    rng = random.Random(seed)
    x, v, w = -normal * 0.0137 + c.f / c.k * -normal, normal, along
    ticks: list[Row] = []
    free = 0
    h = TICK_S / STEPS
    while free < 4 or len(ticks) < 6:
        sums = [0.0, 0.0, 0.0]
        for _ in range(STEPS):
            mid = (x + 0.5 * h * v, v, w)
            n, t, d = contact_force(c, onset, mid[0], (mid[1], mid[2], 0.0))
            v += h * (n + push) / MASS
            w += h * t / MASS
            x = mid[0] + 0.5 * h * v
            sums = [s + f / STEPS for s, f in zip(sums, (n, t, -d), strict=True)]
        touched = sums[0] > 0.0
        free = 0 if touched or not ticks or ticks[-1][1] == 0.0 else free + 1
        bound = sums[0] >= full_scale_n
        read = min(sums[0] + rng.gauss(0.0, NOISE_N), full_scale_n)
        rub, up = (value + rng.gauss(0.0, NOISE_N) for value in sums[1:])
        ticks.append((TICK_S, read, rub, up, push, 0.0, 0.0, 0.0, 0.0, bound))
        if len(ticks) > 80:
            break
    return ContactReadings(ticks_of(ticks), 0.0137, (normal, along), 0.0, NOISE_N, 0.1)


def guard_contact(
    c: Coefficients, degrees: float, seed: int = 0, along: float = 0.3, lever: float = 0.3
) -> ContactReadings:
    """Simulate a contact of two guards; the leading guard turns the vehicle towards its own side."""
    rng, a, out = random.Random(seed), 0.13, 0.2
    lead = incidence = math.radians(degrees)
    turning = -math.copysign(1.0, lead)
    x = 0.9 * 0.0137 + a * math.sin(abs(lead)) - out * (1.0 - math.cos(lead))
    v, w, h = -0.9, along, TICK_S / STEPS
    ticks: list[Row] = []
    for _ in range(30):
        turned, sums = incidence + 0.5 * TICK_S * turning - lead, [0.0, 0.0, 0.0]
        for _ in range(STEPS):
            x += 0.5 * h * v
            si, ci = math.sin(incidence), math.cos(incidence)
            right, left = (
                max(0.0, -0.5 * (c.k * depth + c.f * speed))
                for g in (1.0, -1.0)
                for depth in [x - g * a * si + out * (1.0 - ci)]
                for speed in [v + turning * (out * si - g * a * ci)]
            )
            friction = -c.mu * (right + left) * w
            v, w = v + h * (right + left) / MASS, w + h * friction / MASS
            x, incidence = x + 0.5 * h * v, incidence + h * turning
            uneven = (right - left) * a * ci - (right + left) * out * si
            found = (right + left, friction, uneven - lever * out * friction)
            sums = [s + f / STEPS for s, f in zip(sums, found, strict=True)]
        read, rub = (value + rng.gauss(0.0, NOISE_N) * (seed > 0) for value in sums[:2])
        ticks.append((TICK_S, read, rub, 0.0, 0.0, 0.0, turned, turning, sums[2], False))
    return ContactReadings(ticks_of(ticks), 0.0137, (-0.9, along), lead, NOISE_N, 0.1)


def fit_contact(
    contact: ContactReadings, before: Belief, scatter: float = SCATTER, vehicle: VehicleConfig = VEHICLE
) -> Hypothesis:
    (found,) = ContactFit(contact, [before], vehicle, scatter).run()
    return found


def log_odds(contact: ContactReadings, material: str) -> float:
    before = [belief_of(material, mode) for mode in Mode]
    rigid, flexible = ContactFit(contact, before, VEHICLE, SCATTER).run()
    return rigid.evidence - flexible.evidence


class Fits:
    """The fits that a fitter runs.

    Attributes:
        seen: the fits, in order.
        results: results to return instead of fitting.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: list[ContactFit] = []
        self.results: list[Hypothesis] = []
        run = ContactFit.run

        def run_or_return(fit: ContactFit) -> list[Hypothesis]:
            self.seen.append(fit)
            return self.results or run(fit)

        monkeypatch.setattr(ContactFit, "run", run_or_return)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Fits:
    """Watch the fits of a test, or replace their results."""
    return Fits(monkeypatch)


# --- coefficients and mode --------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize(("material", "along"), [("wood", 0.4), ("acrylic", -0.3), ("acrylic", 0.5)])
@pytest.mark.parametrize(("k", "f", "mu"), [(1.0, 1.0, 1.0), (1.35, 0.7, 1.3), (0.75, 1.3, 0.7)])
def test_the_true_mode_and_its_coefficients_are_found(
    mode: Mode, material: str, along: float, k: float, f: float, mu: float
) -> None:
    true = scaled(VEHICLE.materials[material].coefficients(mode), k, f, mu)
    contact = pulse(true, -0.9, along, seed=3, push=0.5)
    after = fit_contact(contact, belief_of(material, mode)).belief
    assert after.k == pytest.approx(true.k, rel=0.05)
    assert abs(true.f / after.f - 1.0) < 3.0 * after.f_sd
    assert abs(true.mu / after.mu - 1.0) < 3.0 * after.mu_sd
    assert after.k_sd < 0.4 * SPREAD
    assert log_odds(contact, material) * (1.0 if mode is Mode.RIGID else -1.0) > 6.9


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("degrees", [-10.0, -7.0, 4.0, 7.0, 10.0])
def test_incidence_is_estimated_if_one_guard_touches_first(degrees: float, mode: Mode) -> None:
    true = VEHICLE.materials["wood"].coefficients(mode)
    found = fit_contact(guard_contact(true, degrees, 1), belief_of("wood", mode))
    assert found.belief.k == pytest.approx(true.k, rel=0.04)
    assert math.degrees(found.incidence_rad) == pytest.approx(degrees, abs=1.0)
    assert found.misfit < 1.5


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("lever", [0.0, 0.6, 0.9])
def test_the_lever_of_friction_is_found(lever: float, mode: Mode) -> None:
    true = VEHICLE.materials["wood"].coefficients(mode)
    found = fit_contact(guard_contact(true, 7.0, 1, 0.6, lever), belief_of("wood", mode))
    assert found.theta[7] == pytest.approx(lever, abs=0.15)
    assert math.degrees(found.incidence_rad) == pytest.approx(7.0, abs=1.0)


@pytest.mark.parametrize("lever", [-1.0, 2.0])
def test_the_lever_stays_within_its_limits(lever: float) -> None:
    true = VEHICLE.materials["wood"].coefficients(Mode.FLEXIBLE)
    found = fit_contact(guard_contact(true, 7.0, along=0.6, lever=lever), belief_of("wood", Mode.FLEXIBLE))
    assert found.theta[7] == np.clip(lever, 0.0, 1.0)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("degrees", [2.0, 4.0, 7.0, 10.0])
def test_a_mirrored_contact_gives_the_mirrored_estimate(degrees: float, mode: Mode) -> None:
    true = VEHICLE.materials["wood"].coefficients(mode)
    one, other = (
        fit_contact(guard_contact(true, side * degrees, along=side * 0.3), belief_of("wood", mode))
        for side in (1.0, -1.0)
    )
    assert other.incidence_rad == pytest.approx(-one.incidence_rad, rel=1e-3)
    assert other.place_m == pytest.approx(one.place_m, rel=1e-3)
    assert other.evidence == pytest.approx(one.evidence, rel=1e-3)
    assert other.belief[:4] == pytest.approx(one.belief[:4], rel=1e-3)


def test_mode_stays_undecided_for_a_wall_between_both_modes() -> None:
    """A head-on contact has no friction, so a soft rigid wall is as likely as a hard flexible one."""
    between = Coefficients(2070.0, 11.0, 1.0, 7.0)
    assert abs(log_odds(pulse(between, -0.8), "acrylic")) < SURE_LOG_ODDS
    # Friction along the wall identifies the mode at the same stiffness.
    sliding = Coefficients(2070.0, 11.0, 5.0, 7.0)
    assert log_odds(pulse(sliding, -0.8, 0.4), "acrylic") < -SURE_LOG_ODDS


@pytest.mark.parametrize("onset", list(Onset))
def test_stiffness_is_estimated_for_both_onset_laws(onset: Onset) -> None:
    true = scaled(VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE), 1.2)
    vehicle = msgspec.structs.replace(VEHICLE, onset=onset.value)
    contact = pulse(true, -1.0, 0.3, onset=onset)
    found = fit_contact(contact, belief_of("acrylic", Mode.FLEXIBLE), vehicle=vehicle)
    assert found.belief.k == pytest.approx(true.k, rel=0.05)


def test_a_certain_wall_position_is_kept() -> None:
    """The centre's distance from the wall is its travel from the first tick to the first touch."""
    true = VEHICLE.materials["acrylic"].rigid
    contact = pulse(true, -0.9, 0.3)._replace(place_sd=1e-6)
    assert fit_contact(contact, belief_of("acrylic", Mode.RIGID)).place_m == pytest.approx(
        0.9 * contact.touched_s, abs=1e-4
    )


def test_the_angle_of_a_tick_applies_at_its_middle(fits: Fits) -> None:
    """A left turn at 2 rad/s gives 4 mrad at the middle of the first tick and 12 mrad at the second."""
    ContactFitter(VEHICLE).answer(contact_request([0.0] * 3 + [9.0] * 5, rate=-2.0))
    assert fits.seen[0].contact.ticks.turned == pytest.approx([0.004 + 0.008 * i for i in range(8)])


def test_readings_at_full_scale_count_as_lower_bounds() -> None:
    true = scaled(VEHICLE.materials["wood"].rigid, 1.2)
    whole = pulse(true, -1.0, 0.3)
    cut = pulse(true, -1.0, 0.3, full_scale_n=0.7 * float(whole.ticks.normal.max()))
    assert cut.ticks.bound.sum() >= 4
    assert fit_contact(cut, belief_of("wood", Mode.RIGID)).belief.k == pytest.approx(true.k, rel=0.08)
    unmarked = cut.ticks._replace(bound=np.zeros_like(cut.ticks.bound))
    biased = fit_contact(cut._replace(ticks=unmarked), belief_of("wood", Mode.RIGID)).belief.k
    assert abs(biased / true.k - 1.0) > 0.08


def test_a_wall_position_off_the_plan_is_estimated() -> None:
    true = VEHICLE.materials["acrylic"].rigid
    contact = pulse(true, -1.0)
    found = fit_contact(contact, belief_of("acrylic", Mode.RIGID))
    begins_m = 0.0137 + true.f / true.k
    assert found.place_m == pytest.approx(begins_m, abs=0.003)
    assert abs(found.place_m - begins_m) < 4.0 * found.place_sd


# --- posterior --------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(
    mode=st.sampled_from(list(Mode)),
    k=st.floats(0.5, 1.7),
    mu=st.floats(0.5, 1.7),
    normal=st.floats(-1.4, -0.4),
    along=st.floats(-0.6, 0.6),
    seed=st.integers(0, 1000),
)
def test_the_posterior_lies_between_prior_and_data(
    mode: Mode, k: float, mu: float, normal: float, along: float, seed: int
) -> None:
    contact = pulse(scaled(VEHICLE.materials["acrylic"].coefficients(mode), k, 1.0, mu), normal, along, seed)
    before = belief_of("acrylic", mode)
    # A very wide prior of k, and of k alone, leaves its estimate to the data.
    loose = fit_contact(contact, before._replace(k_sd=20.0)).belief.k
    sure = fit_contact(contact, before._replace(k_sd=0.02)).belief.k
    after = fit_contact(contact, before).belief
    low, high = min(loose, before.k), max(loose, before.k)
    assert 0.99 * low <= after.k <= 1.01 * high
    assert 0.99 * low <= sure <= 1.01 * high
    # A narrower prior draws the estimate nearer to itself.
    assert abs(sure - before.k) <= abs(after.k - before.k) + 0.01 * before.k


@settings(max_examples=30, deadline=None)
@given(
    mode=st.sampled_from(list(Mode)),
    k=st.floats(0.3, 2.0),
    normal=st.floats(-1.5, -0.3),
    along=st.floats(-1.0, 1.0),
    sd=st.floats(0.02, 0.6),
    scatter=st.floats(0.01, 0.2),
    seed=st.integers(0, 1000),
)
def test_readings_never_increase_a_standard_deviation(
    mode: Mode, k: float, normal: float, along: float, sd: float, scatter: float, seed: int
) -> None:
    """Compare absolute deviations: the relative one may grow if the coefficient turns out smaller."""
    contact = pulse(scaled(VEHICLE.materials["acrylic"].coefficients(mode), k), normal, along, seed)
    before = belief_of("acrylic", mode, sd)
    after = fit_contact(contact, before, scatter).belief
    for name in ("k", "f", "mu", "nu"):
        was = getattr(before, name) * getattr(before, f"{name}_sd")
        now = getattr(after, name) * getattr(after, f"{name}_sd")
        assert now <= was * (1.0 + 1e-9)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.5])
@pytest.mark.parametrize("nu", [0.8, 6.0])
def test_the_vertical_force_identifies_the_vertical_friction(nu: float, factor: float) -> None:
    """A larger coefficient is identified in fewer contacts; a force below the noise adds little."""
    c = VEHICLE.materials["acrylic"].rigid
    true = Coefficients(c.k, c.f, c.mu, nu * factor)
    before = belief = Belief(c.k, c.f, c.mu, nu, SPREAD, SPREAD, SPREAD, 0.5)
    for hit in range(12):
        after = fit_contact(pulse(true, -1.0, 0.3, seed=hit), belief).belief
        assert after.nu * after.nu_sd < belief.nu * belief.nu_sd * 1.001
        belief = after
    assert belief.nu * belief.nu_sd < 0.7 * before.nu * before.nu_sd
    assert belief.nu == pytest.approx(true.nu, rel=0.35 if nu < 1.0 else 0.1)


def test_the_vertical_force_is_ignored_if_the_vertical_coefficient_is_zero() -> None:
    c = VEHICLE.materials["acrylic"].rigid
    none = Belief(c.k, c.f, c.mu, 0.0, SPREAD, SPREAD, SPREAD, 0.5)
    contact = pulse(Coefficients(c.k, c.f, c.mu, 6.0), -1.0)
    without_vertical = contact._replace(ticks=contact.ticks._replace(up=0.0 * contact.ticks.up))
    assert fit_contact(contact, none).evidence == fit_contact(without_vertical, none).evidence
    assert fit_contact(contact, none).belief.nu == 0.0


def test_repeated_contacts_reduce_the_uncertainty_to_the_scatter_of_their_mean() -> None:
    true = VEHICLE.materials["wood"].coefficients(Mode.FLEXIBLE)
    before = belief_of("wood", Mode.FLEXIBLE)
    sds = [before.k_sd]
    for hit in range(8):
        factor = 1.2 * (1.0 + SCATTER * random.Random(hit).gauss(0.0, 1.0))
        before = fit_contact(pulse(scaled(true, factor), -0.8, 0.3, seed=hit), before).belief
        sds.append(before.k_sd)
    assert sds == sorted(sds, reverse=True)
    assert before.k == pytest.approx(1.2 * true.k, rel=0.05)
    # One contact cannot separate the wall's coefficient from the scatter between contacts.
    assert sds[1] > 0.9 * SCATTER
    assert 0.8 * SCATTER / math.sqrt(8) < sds[-1] < 1.6 * SCATTER / math.sqrt(8)


# --- arbitrary readings -----------------------------------------------------------------------------------

_any = st.floats(-1e6, 1e6)


@settings(max_examples=60, deadline=None)
@given(
    forces=st.lists(st.tuples(_any, _any, _any, st.booleans()), min_size=1, max_size=30),
    velocity=st.tuples(_any, _any),
    gap_us=st.integers(0, 200_000),
)
def test_the_fitter_returns_finite_numbers_or_a_problem_for_any_readings(
    forces: Sequence[tuple[float, float, float, bool]], velocity: tuple[float, float], gap_us: int
) -> None:
    request = contact_request([-f[0] for f in forces])
    onset = msgspec.structs.replace(request.onset, velocity_mission=(*velocity, 0.0))
    later = [t_us + gap_us * (i > 3) for i, t_us in enumerate(request.sample_us)]
    answer = ContactFitter(VEHICLE).answer(
        msgspec.structs.replace(
            request,
            onset=onset,
            sample_us=tuple(later),
            force_mission=tuple((-n, t, up) for n, t, up, _ in forces),
            clipped=tuple(bound for *_, bound in forces),
        )
    )
    assert answer.number == 1
    assert (answer.body is None) == (answer.wall is None) == bool(answer.problem)
    for record in (answer.body, answer.wall):
        values = () if record is None else msgspec.structs.astuple(record)
        assert all(math.isfinite(v) for v in values if isinstance(v, float))


# --- the mode ----------------------------------------------------------------------------------------------


def contact_request(
    normal_n: Sequence[float],
    wall: Wall | None = AT_WALL,
    reported: Mode | None = None,
    rate: float = 0.0,
    velocity: tuple[float, float] = (1.0, 0.0),
    along_n: Sequence[float] | None = None,
) -> ContactRequest:
    """Return a torque-free contact of a vehicle that flies along x, with some samples from before it."""
    count = len(normal_n)
    along_n = [0.0] * count if along_n is None else along_n
    onset = ImpactOnset(
        24_000, 16_000, 0, (-9.0, 0.0, 0.0), (*velocity, 0.0), (0.98, 0.0, 1.0), wall is not None
    )
    return ContactRequest(
        t_us=4000 * count,
        number=1,
        onset=onset,
        wall=wall,
        normal=(-1.0, 0.0),
        mode_reported=reported,
        frame_heading_rad=0.0,
        slow_force=(0.0, 0.0),
        noise_n=NOISE_N,
        noise_frd_nm=(0.05, 0.05, 0.05),
        sample_us=tuple(4000 * (i + 1) for i in range(count)),
        force_mission=tuple((-n, -t, 0.0) for n, t in zip(normal_n, along_n, strict=True)),
        push_mission=((0.0, 0.0),) * count,
        clipped=(False,) * count,
        torque_frd=((0.0, 0.0, 0.0),) * count,
        q_frd_to_ned=(IDENTITY,) * count,
        rate_frd=((0.0, 0.0, rate),) * count,
    )


AFTER = {mode: belief_of("wood", mode)._replace(k=777.0) for mode in Mode}


def answer_with_odds(
    fits: Fits, odds: float, misfit: float, reported: Mode | None
) -> tuple[ContactFitter, WallEstimate]:
    """Answer a contact whose two fits have these results, and the beliefs of `AFTER`."""
    theta = np.array([1.0, 1.0, 0.03, -1.0, 0.0, 1.0, 0.0, 0.3])
    found = Hypothesis(odds, misfit, AFTER[Mode.RIGID], 0.01, 0.02, 0.03, 0.004, theta)
    fits.results = [found, found._replace(evidence=0.0, belief=AFTER[Mode.FLEXIBLE])]
    fitter = ContactFitter(VEHICLE)
    answer = fitter.answer(contact_request([0.0] * 3 + [9.0] * 5, reported=reported))
    assert answer.wall is not None, answer.problem
    return fitter, answer.wall


@pytest.mark.parametrize(
    ("odds", "misfit", "identified"),
    [
        (1.01 * SURE_LOG_ODDS, 0.5, Mode.RIGID),
        (-1.01 * SURE_LOG_ODDS, 0.5, Mode.FLEXIBLE),
        (0.99 * SURE_LOG_ODDS, 0.5, None),
        (-0.99 * SURE_LOG_ODDS, 0.5, None),
        (1.9 * SURE_LOG_ODDS, 1.8, Mode.RIGID),  # a poor fit scales the odds down
        (1.7 * SURE_LOG_ODDS, 1.8, None),
        (50.0 * SURE_LOG_ODDS, 2.1, None),  # the misfit exceeds its limit
    ],
)
def test_mode_is_identified_if_the_odds_are_decisive_and_the_fit_is_good(
    fits: Fits, odds: float, misfit: float, identified: Mode | None
) -> None:
    begins_us = 4000 - round((VEHICLE.imu.tick_s + VEHICLE.imu.filter_lag_s) * 1e6)
    for reported in (None, *Mode):
        _, found = answer_with_odds(fits, odds, misfit, reported)
        assert (found.mode_felt, found.mode_reported) == (identified, reported)
        assert found.plane_offset_m == pytest.approx(0.02 + (24_000 - begins_us) * 1e-6 - 0.03)


@pytest.mark.parametrize(
    ("odds", "reported", "kept"),
    [
        (0.5 * SURE_LOG_ODDS, Mode.RIGID, Mode.RIGID),
        (0.5 * SURE_LOG_ODDS, None, Mode.RIGID),
        (-0.5 * SURE_LOG_ODDS, None, Mode.FLEXIBLE),
        (0.5 * SURE_LOG_ODDS, Mode.FLEXIBLE, None),  # the readings contradict the lock
        (2.0 * SURE_LOG_ODDS, Mode.FLEXIBLE, Mode.RIGID),
    ],
)
def test_the_fitted_coefficients_are_stored_for_the_likely_mode(
    fits: Fits, odds: float, reported: Mode | None, kept: Mode | None
) -> None:
    fitter, found = answer_with_odds(fits, odds, 0.5, reported)
    assert found.k_n_per_m == 777.0
    fitter.answer(contact_request([0.0] * 3 + [9.0] * 5))
    for mode, before in zip(VEHICLE.modes, fits.seen[-1].before, strict=True):
        assert (before == AFTER[mode]) is (mode is kept)


@pytest.mark.parametrize(
    ("inside", "velocity", "problem"),
    [
        (3, (1.0, 0.0), "there are too few force readings"),
        (12, (0.01, 0.5), "the vehicle did not fly towards the wall"),
        (12, (-1.0, 0.0), "the vehicle did not fly towards the wall"),
    ],
)
def test_an_unusable_contact_is_answered_with_the_reason(
    inside: int, velocity: tuple[float, float], problem: str
) -> None:
    answer = ContactFitter(VEHICLE).answer(contact_request([0.0] * 3 + [9.0] * inside, velocity=velocity))
    assert (answer.body, answer.wall) == (None, None)
    assert answer.problem == f"contact not fitted: {problem}"


def request_from(contact: ContactReadings, **changes: Any) -> ContactRequest:
    """Return the request of a synthetic contact, with the IMU's lag in its sample times."""
    readings = contact.ticks
    request = contact_request(
        readings.normal[:, 0].tolist(), velocity=(1.0, 0.0), along_n=readings.along[:, 0].tolist(), **changes
    )
    onset = msgspec.structs.replace(
        request.onset, velocity_mission=(-contact.velocity[0], -contact.velocity[1], 0.0)
    )
    return msgspec.structs.replace(request, onset=onset)


def test_an_unplanned_contact_is_fitted_without_a_wall_estimate(fits: Fits) -> None:
    """The force gives its direction to 15 degrees, and no belief of a wall is stored."""
    contact = pulse(VEHICLE.materials["acrylic"].rigid, -1.0)
    fitter = ContactFitter(VEHICLE)
    answer = fitter.answer(request_from(contact, wall=None))
    assert answer.body is not None, answer.problem
    assert (answer.wall, answer.body.side) == (None, ContactSide.BOTH)
    assert abs(answer.body.incidence_rad) < 3.0 * answer.body.incidence_sigma_rad
    for one in (fitter, fitter, ContactFitter(VEHICLE)):
        planned = one.answer(request_from(contact))
        assert planned.wall is not None
        assert planned.wall.wall == "w"
    _, after_unplanned, after_planned, at_first = (fit.before for fit in fits.seen)
    assert after_unplanned == at_first != after_planned


@pytest.mark.parametrize(("planned", "degrees"), [(True, 4.0), (False, 15.0)])
def test_a_planned_wall_narrows_the_prior_of_the_incidence(fits: Fits, planned: bool, degrees: float) -> None:
    """docs/torque.md gives a standard deviation of 4 degrees for a planned wall and 15 otherwise."""
    request = contact_request([0.0] * 3 + [9.0] * 8)
    ContactFitter(VEHICLE).answer(request if planned else msgspec.structs.replace(request, wall=None))
    assert math.degrees(fits.seen[0].contact.angle_sd) == pytest.approx(degrees)


# --- flights ----------------------------------------------------------------------------------------------


@pytest.mark.rest
def test_the_true_mode_is_identified_if_the_lock_misreports(tmp_path: Path) -> None:
    """Fly the campaign's first flights with a misreporting lock, on seeds that the software was tuned on."""
    rows = []
    for kind, seed in (("wood", "6"), ("sliding", "2")):
        rows += campaign_rows(
            tmp_path / kind, "contact_fit", "--only", f"set={kind}", "--seed", seed, "--runs", "1"
        )
    assert len(rows) == 2
    for row in rows:
        assert row["mode_reported"] != row["true_mode"]
        assert row["mode_felt"] == row["true_mode"]
        assert row["after_ms"] <= 150.0  # the longest wait of a plan for the estimate
        assert abs(row["plane_error_m"]) < 0.01
        value, sd, true = row["coefficients"]["k"]
        assert abs(true / value - 1.0) <= 2.0 * sd


@pytest.mark.parametrize("count", [36, 37, 100, 160])
def test_merging_many_readings_preserves_their_totals(count: int) -> None:
    """A reading at full scale is not merged."""
    rng = random.Random(count)
    rows = [
        (rng.choice((0.002, 0.004)), *(rng.gauss(0.0, 1.0) for _ in range(8)), i == 20) for i in range(count)
    ]
    ticks = ticks_of(rows)  # type: ignore[arg-type]
    merged = ticks.merged()
    assert len(merged.h) <= 36 + 2
    assert (merged is ticks) is (count <= 36)
    assert merged.bound.sum() == 1
    (alone,) = np.flatnonzero(merged.bound)
    assert [values[alone].tolist() for values in merged] == [values[20].tolist() for values in ticks]
    assert merged.samples.sum() == count
    assert merged.h.sum() == pytest.approx(ticks.h.sum())
    for together, apart in zip(merged[1:9], ticks[1:9], strict=True):
        assert merged.h @ together == pytest.approx(ticks.h @ apart)
