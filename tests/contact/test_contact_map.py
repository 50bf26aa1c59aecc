"""The closed-form contact map, compared with reference solutions, an integrator and physical laws."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import WallContact, collide, contact_map, drop, drop_map
from dart_flight.contact.law import Onset
from dart_flight.lab.predict.path import ContactMotion, trajectory
from tests.oracles.point_law import contact_force

DATA = Path(__file__).parents[1] / "data"
MASS = 1.3
VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
TABLE = [VEHICLE.materials[m].coefficients(mode) for m in ("concrete", "acrylic") for mode in Mode]

pytestmark = pytest.mark.filterwarnings("error")


def is_close(got: float, want: float) -> bool:
    return got == pytest.approx(want, rel=1e-9, abs=1e-12)


def read_rows(name: str) -> list[dict[str, str]]:
    with (DATA / name).open() as file:
        return list(csv.DictReader(file))


coefficient_sets = st.builds(
    lambda k, zeta, mu, nu: Coefficients(k=k, f=2.0 * zeta * math.sqrt(k * MASS), mu=mu, nu=nu),
    k=st.floats(50.0, 20_000.0),
    zeta=st.one_of(st.floats(0.0, 3.0), st.sampled_from([0.0, 0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9])),
    mu=st.floats(0.0, 5.0),
    nu=st.floats(0.0, 12.0),
)
SOFT = Coefficients(k=50.0, f=0.5 * math.sqrt(50.0 * MASS), mu=5.0, nu=0.0)  # its friction peaks early
NEARLY_CRITICAL = Coefficients(k=50.0, f=2.0 * (1.0 - 1e-9) * math.sqrt(50.0 * MASS), mu=0.0, nu=0.0)
approaches = st.floats(-4.0, -0.01)
slips = st.floats(-2.0, 2.0)
onsets = st.sampled_from(list(Onset))


# --- references -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("onset", list(Onset))
def test_contact_map_matches_all_reference_wall_collisions(onset: Onset) -> None:
    rows = read_rows("wall_collisions.csv")
    assert len(rows) == 100
    table = CoefficientArrays.from_table([VEHICLE.materials["acrylic"].coefficients(mode) for mode in Mode])
    which = np.array([list(Mode).index(Mode(row["mode"])) for row in rows])
    normal, tangential = (np.array([float(row[k]) for row in rows]) for k in ("vx_in_m_s", "vy_in_m_s"))
    result = contact_map(table, MASS, normal, tangential, onset, rows=which)
    for column, got in {
        "vx_out_m_s": result.normal_out_m_s,
        "vy_out_m_s": result.tangential_out_m_s,
        "contact_time_s": result.contact_time_s,
        "peak_normal_force_n": result.peak_normal_force_n,
        "peak_friction_force_n": result.peak_friction_force_n,
    }.items():
        want = np.array([float(row[f"{onset.value}_{column}"]) for row in rows])
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-12, err_msg=column)


@pytest.mark.parametrize(
    "row", read_rows("drop_tests.csv"), ids=lambda r: f"{r['onset']}-{r['mode']}-{r['height_m']}"
)
def test_drop_matches_the_reference_drops(row: dict[str, str]) -> None:
    c = VEHICLE.materials["concrete"].coefficients(Mode(row["mode"]))
    result = drop(c, MASS, float(row["height_m"]), Onset(row["onset"]))
    for name in ("contact_time_s", "max_rebound_speed_m_s", "peak_force_n", "impulse_n_s"):
        assert is_close(getattr(result, name), float(row[name])), name


# --- an independent integrator --------------------------------------------------------------------------


def integrate(
    c: Coefficients, contact: ContactMotion, tangential: float, onset: Onset, end: float
) -> list[float]:
    """Return position and velocity on all axes and the normal impulse at `end`, by DOP853."""
    integrate_ = pytest.importorskip("scipy.integrate")

    def rate(_t: float, s: list[float]) -> list[float]:
        fx, fy, fz = contact_force(c, onset, s[0], (s[1], s[3], s[5]))
        a = contact.acceleration_m_s2
        return [s[1], fx / MASS + a, s[3], fy / MASS, s[5], fz / MASS, fx]

    # Start just after the onset: exactly there, the force of the law is still zero.
    begin = 1e-9
    x, v, _ = contact.normal(begin)
    start = [float(x), float(v), tangential * begin, tangential, 0.0, 0.0, 0.0]
    solution = integrate_.solve_ivp(
        rate, (begin, end), start, method="DOP853", rtol=1e-11, atol=1e-12, max_step=2e-3
    )
    return [float(v) for v in solution.y[:, -1]]


@pytest.mark.parametrize("onset", list(Onset))
@pytest.mark.parametrize("acceleration", [0.0, -9.81, -2.0, 4.0])
@pytest.mark.parametrize(
    ("c", "normal"),
    [
        (Coefficients(k=4200.0, f=15.0, mu=0.3, nu=5.0), -1.0),
        (Coefficients(k=1250.0, f=8.5, mu=5.0, nu=10.0), -1.4),
        (Coefficients(k=900.0, f=45.0, mu=2.0, nu=1.0), -0.6),
    ],
)
def test_closed_form_agrees_with_numerical_integration(
    onset: Onset, acceleration: float, c: Coefficients, normal: float
) -> None:
    contact = ContactMotion(c, MASS, normal, onset, acceleration_m_s2=acceleration)
    r = collide(c, MASS, normal, 0.7, onset, acceleration_m_s2=acceleration)
    assert r.contact_time_s == pytest.approx(contact.end_s, rel=1e-14)
    last = min(contact.end_s, 0.4)  # the most damped case never leaves the wall under the hardest push
    x, v, y, vy, _z, vz, impulse = integrate(c, contact, 0.7, onset, last)
    if math.isfinite(contact.end_s):
        assert r.normal_out_m_s == pytest.approx(v, abs=1e-7)
        assert r.tangential_out_m_s == pytest.approx(vy, abs=1e-7)
        assert r.impulse_n_s == pytest.approx(impulse, abs=1e-7)
    end = trajectory(contact, np.array([last]), 0.7)
    assert float(end.normal_m[0]) == pytest.approx(x, abs=1e-8)
    assert float(end.tangential_m[0]) == pytest.approx(y, abs=1e-8)
    assert float(end.vertical_m_s[0]) == pytest.approx(vz, abs=1e-6 if math.isfinite(contact.end_s) else 1e-3)


@given(coefficient_sets, approaches, slips, onsets, st.sampled_from([0.0, -9.81, -1.0, 6.0]))
@example(SOFT, -2.0, 1.0, Onset.LCP, -9.81)
@example(NEARLY_CRITICAL, -1.0, 0.0, Onset.LCP, 0.0)
def test_peaks_match_the_sampled_trajectory(
    c: Coefficients, normal: float, tangential: float, onset: Onset, push: float
) -> None:
    contact = ContactMotion(c, MASS, normal, onset, acceleration_m_s2=push)
    r = collide(c, MASS, normal, tangential, onset, acceleration_m_s2=push)
    # 40 time constants of the slower decay, which are sqrt(m/k)/0.17 at the largest damping. Near critical
    # damping, a contact ends only long after that.
    span = 240.0 * math.sqrt(MASS / c.k)
    ends = contact.end_s < span
    # A contact that does not end has its peaks early in the span, so it is sampled more densely there.
    t = contact.end_s * np.linspace(0.0, 1.0, 4001) if ends else span * np.linspace(0.0, 1.0, 4001) ** 2
    path = trajectory(contact, t, tangential)
    # Relative tolerance for the sampling. An endless contact only approaches its deepest point.
    coarse = 1e-4 if ends else 1e-2
    for peak, samples in (
        (r.peak_normal_force_n, path.normal_force_n),
        (r.peak_friction_force_n, np.abs(path.tangential_force_n)),
        (r.peak_vertical_force_n, np.abs(path.vertical_force_n)),
        (r.penetration_m, np.maximum(-path.normal_m, 0.0)),
    ):
        largest = float(samples.max())
        assert largest <= peak * (1.0 + 1e-9) + 1e-15
        assert peak <= largest * (1.0 + coarse) + 1e-7


def test_friction_peak_is_exact_to_rounding() -> None:
    # Fine sampling about a coarse peak: the maximum of a parabola through three samples is exact to 1e-12.
    c = VEHICLE.materials["acrylic"].coefficients(Mode.FLEXIBLE)
    for normal in (-0.2, -0.7, -1.5):
        contact = ContactMotion(c, MASS, normal, Onset.LCP)
        coarse = np.linspace(0.0, contact.end_s, 2001)
        i = int(np.abs(trajectory(contact, coarse, 0.5).tangential_force_n).argmax())
        t = np.linspace(coarse[i - 1], coarse[i + 1], 201)
        force = np.abs(trajectory(contact, t, 0.5).tangential_force_n)
        i = int(force.argmax())
        a, b, d = force[i - 1 : i + 2]
        vertex = b + (a - d) ** 2 / (16.0 * (b - 0.5 * (a + d)))
        assert collide(c, MASS, normal, 0.5, Onset.LCP).peak_friction_force_n == pytest.approx(
            vertex, rel=1e-9
        )


# --- laws -----------------------------------------------------------------------------------------------


@given(coefficient_sets, approaches, slips, onsets)
def test_a_wall_hit_obeys_momentum_and_energy_limits(
    c: Coefficients, normal: float, tangential: float, onset: Onset
) -> None:
    r = collide(c, MASS, normal, tangential, onset)
    assert not any(math.isnan(v) for v in r)
    assert 0.0 <= r.normal_out_m_s <= -normal * (1.0 + 1e-12), "energy created along the normal"
    assert abs(r.tangential_out_m_s) <= abs(tangential), "energy created along the wall"
    assert r.impulse_n_s == pytest.approx(MASS * (r.normal_out_m_s - normal), rel=1e-12)
    assert r.tangential_out_m_s == pytest.approx(
        tangential * math.exp(-c.mu * r.impulse_n_s / MASS), rel=1e-9, abs=1e-300
    )
    # Peak potential energy never exceeds the kinetic energy of the approach.
    assert 0.5 * c.k * r.penetration_m**2 <= 0.5 * MASS * normal * normal * (1.0 + 1e-12)
    friction_limit_n = c.mu * r.peak_normal_force_n * abs(tangential)
    assert r.peak_friction_force_n <= friction_limit_n * (1.0 + 1e-12) + 1e-300  # a denormal mu is rounded


@given(coefficient_sets, approaches, onsets, st.floats(0.1, 10.0))
def test_results_scale_linearly_with_speed(
    c: Coefficients, normal: float, onset: Onset, factor: float
) -> None:
    one = collide(c, MASS, normal, 0.0, onset)
    more = collide(c, MASS, factor * normal, 0.0, onset)
    assert more.contact_time_s == one.contact_time_s
    for name in ("normal_out_m_s", "penetration_m", "peak_normal_force_n", "impulse_n_s"):
        assert getattr(more, name) == pytest.approx(factor * getattr(one, name), rel=1e-12), name


@given(coefficient_sets, approaches, slips, onsets)
def test_zero_push_equals_no_push(c: Coefficients, normal: float, tangential: float, onset: Onset) -> None:
    table = CoefficientArrays.from_table(c)
    plain = contact_map(table, MASS, normal, tangential, onset)
    pushed = contact_map(table, MASS, normal, tangential, onset, acceleration_m_s2=0.0)
    for name, a, b in zip(WallContact._fields, plain, pushed, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=name)


def test_results_are_continuous_through_critical_damping() -> None:
    # Touch releases at any damping: no jump where the formulas change.
    for zeta in np.concatenate((1.0 + np.linspace(-1e-6, 1e-6, 41), [1.0 - 1e-12, 1.0, 1.0 + 1e-12])):
        c = Coefficients(k=1000.0, f=float(2.0 * zeta * math.sqrt(1300.0)), mu=1.0, nu=1.0)
        r = collide(c, MASS, -1.0, 0.5, Onset.TOUCH)
        # A = 1 - (zeta - 1)/3 + ...: contact time 2 A / omega, restitution exp(-2 zeta A).
        quarter = 1.0 - (zeta - 1.0) / 3.0
        assert r.contact_time_s == pytest.approx(2.0 * quarter * math.sqrt(MASS / 1000.0), rel=1e-10)
        assert r.normal_out_m_s == pytest.approx(math.exp(-2.0 * zeta * quarter), rel=1e-10)


def test_an_overdamped_lcp_contact_never_ends() -> None:
    c = Coefficients(k=500.0, f=80.0, mu=1.0, nu=1.0)
    r = collide(c, MASS, -1.0, 0.5, Onset.LCP)
    assert r.contact_time_s == math.inf
    assert r.normal_out_m_s == 0.0
    assert r.penetration_m == 0.0
    assert r.impulse_n_s == pytest.approx(MASS)
    assert r.tangential_out_m_s == pytest.approx(0.5 * math.exp(-1.0))


@pytest.mark.parametrize("onset", list(Onset))
@pytest.mark.parametrize("push", [None, 0.0, -9.81, 3.0])
def test_a_receding_vehicle_has_no_contact(onset: Onset, push: float | None) -> None:
    table = CoefficientArrays.from_table(TABLE[0])
    r = contact_map(table, MASS, np.array([0.7, 1e-12]), np.array([-0.2, 0.0]), onset, acceleration_m_s2=push)
    np.testing.assert_array_equal(r.normal_out_m_s, [0.7, 1e-12])
    np.testing.assert_array_equal(r.tangential_out_m_s, [-0.2, 0.0])
    for values in r[2:]:
        np.testing.assert_array_equal(values, 0.0)


@pytest.mark.parametrize("onset", list(Onset))
def test_zero_and_grazing_speeds_give_no_nan(onset: Onset) -> None:
    table = CoefficientArrays.from_table(TABLE)
    speeds = np.array([0.0, -0.0, -1e-300, -1e-15, -1e-9])[:, None]
    for push in (None, 0.0, -2.0, 5.0):
        r = contact_map(table, MASS, speeds, 0.5, onset, acceleration_m_s2=push)
        for name, values in zip(WallContact._fields, r, strict=True):
            assert values.shape == (5, 4)
            assert not np.isnan(values).any(), name
        if push is None:
            np.testing.assert_allclose(r.tangential_out_m_s, 0.5, rtol=1e-6)


def test_a_pushed_vehicle_can_stay_in_contact() -> None:
    # In a slow flexible approach under a strong push, damping keeps the vehicle at the wall.
    c = Coefficients(k=750.0, f=20.0, mu=1.0, nu=1.0)
    r = collide(c, MASS, -0.05, 0.2, Onset.LCP, acceleration_m_s2=-9.81)
    assert r.contact_time_s == math.inf
    assert r.normal_out_m_s == 0.0
    assert r.tangential_out_m_s == 0.0
    assert r.penetration_m > MASS * 9.81 / 750.0


# --- shapes and errors ----------------------------------------------------------------------------------


@pytest.mark.parametrize("onset", list(Onset))
@pytest.mark.parametrize("push", [None, -1.5])
def test_row_indices_selected_sets_and_scalars_agree(onset: Onset, push: float | None) -> None:
    random = np.random.default_rng(7)
    n = 9000  # more than one chunk
    rows = random.integers(0, len(TABLE), n)
    normal, tangential = -random.uniform(0.05, 3.0, n), random.uniform(-1.5, 1.5, n)
    table = CoefficientArrays.from_table(TABLE)
    by_row = contact_map(table, MASS, normal, tangential, onset, rows=rows, acceleration_m_s2=push)
    each = contact_map(table.select(rows), MASS, normal, tangential, onset, acceleration_m_s2=push)
    for a, b in zip(by_row, each, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    for i in (0, 4095, 4096, n - 1):
        single = collide(TABLE[rows[i]], MASS, normal[i], tangential[i], onset, acceleration_m_s2=push or 0.0)
        np.testing.assert_allclose([v[i] for v in by_row], single, rtol=1e-11)


def test_coefficients_and_velocities_broadcast() -> None:
    table = CoefficientArrays(*(v[:, None] for v in CoefficientArrays.from_table(TABLE)))
    r = contact_map(table, MASS, np.linspace(-2.0, -0.1, 5), 0.3, Onset.LCP)
    assert r.peak_normal_force_n.shape == (4, 5)
    want = collide(TABLE[2], MASS, -2.0, 0.3, Onset.LCP)
    assert is_close(float(r.peak_normal_force_n[2, 0]), want.peak_normal_force_n)
    assert (
        contact_map(CoefficientArrays.from_table(TABLE[0]), MASS, -1.0, 0.0, Onset.LCP).impulse_n_s.shape
        == ()
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_and_non_positive_inputs_are_rejected(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        collide(TABLE[0], MASS, bad, 0.0, Onset.LCP)
    with pytest.raises(ValueError, match="positive"):
        collide(TABLE[0], 0.0, -1.0, 0.0, Onset.LCP)
    with pytest.raises(ValueError, match="height"):
        drop(TABLE[0], MASS, 0.0, Onset.LCP)


def test_drop_map_matches_single_drops() -> None:
    heights = np.array([0.01, 0.05, 0.2, 1.0])
    table = CoefficientArrays.from_table(TABLE)
    r = drop_map(CoefficientArrays(*(v[:, None] for v in table)), MASS, heights, Onset.LCP)
    assert r.contact_time_s.shape == (4, 4)
    one = drop(TABLE[1], MASS, 0.2, Onset.LCP)
    for name, values in zip(r._fields, r, strict=True):
        assert is_close(float(values[1, 2]), getattr(one, name)), name
    # A higher drop rebounds faster, but always slower than it arrived.
    assert (np.diff(r.max_rebound_speed_m_s, axis=1) > 0.0).all()
    assert (r.max_rebound_speed_m_s < np.sqrt(2.0 * 9.81 * heights)).all()
