"""The time-stepping model: complementarity at every step, convergence to the closed form, corners."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import contact_map, drop
from dart_flight.contact.law import Onset
from tests.oracles.stepping import Corner, simulate, step_corner, step_normal, stepped_map

MASS = 1.3
VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))
TABLE = [VEHICLE.materials[m].coefficients(mode) for m in ("concrete", "acrylic") for mode in Mode]
CORNER_CASES = 100_000  # seeded; in one batch they take half a second

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize("onset", list(Onset))
@pytest.mark.parametrize("push", [0.0, -3.0])
def test_stepping_converges_to_the_closed_form_at_first_order(onset: Onset, push: float) -> None:
    table = CoefficientArrays.from_table(TABLE)
    normal, tangential = np.array([-0.3, -0.8, -1.5, -2.5]), np.array([0.5, -1.0, 0.2, 1.5])
    exact = contact_map(table, MASS, normal, tangential, onset, acceleration_m_s2=push)
    errors = []
    for step in (4e-5, 1e-5):
        stepped = stepped_map(table, MASS, normal, tangential, onset, step_s=step, acceleration_m_s2=push)
        speeds = np.abs(np.stack(stepped[:2]) - np.stack(exact[:2]))  # of the order of 1 m/s
        others = np.abs(np.stack(stepped[2:]) / np.stack(exact[2:]) - 1.0)
        errors.append(max(float(speeds.max()), float(others.max())))
    assert errors[1] < 2e-3
    assert errors[1] < 0.4 * errors[0], "a quarter of the step must give about a quarter of the error"


def test_stepped_map_leaves_a_receding_vehicle_unchanged() -> None:
    r = stepped_map(CoefficientArrays.from_table(TABLE[0]), MASS, [0.3, 0.0], 0.2, Onset.LCP, step_s=1e-3)
    np.testing.assert_array_equal(r.normal_out_m_s, [0.3, 0.0])
    np.testing.assert_array_equal(r.contact_time_s, 0.0)
    with pytest.raises(ValueError, match="step"):
        stepped_map(CoefficientArrays.from_table(TABLE[0]), MASS, -1.0, 0.2, Onset.LCP, step_s=0.0)


def test_a_simulated_drop_matches_the_closed_form() -> None:
    c = TABLE[1]
    path = simulate(
        c, MASS, (0.05, 0.0, 0.0), (0.0, 0.0, 0.0), Onset.LCP,
        step_s=2e-5, duration_s=0.4, acceleration_m_s2=(-9.81, 0.0, 0.0),
    )  # fmt: skip
    want = drop(c, MASS, 0.05, Onset.LCP)
    assert path.velocity_m_s[:, 0].max() == pytest.approx(want.max_rebound_speed_m_s, rel=2e-3)
    assert path.force_n[:, 0].max() == pytest.approx(want.peak_force_n, rel=2e-3)
    assert -path.position_m[:, 0].min() == pytest.approx(want.penetration_m, rel=2e-3)


def test_drag_slows_free_flight() -> None:
    path = simulate(
        TABLE[0], MASS, (10.0, 0.0, 0.0), (0.0, 1.0, 0.5), Onset.LCP,
        step_s=1e-4, duration_s=1.0, drag_per_s=(0.2, 0.4, 0.0),
    )  # fmt: skip
    assert path.velocity_m_s[-1, 1] == pytest.approx(math.exp(-0.4), rel=1e-3)
    assert path.velocity_m_s[-1, 2] == pytest.approx(0.5)


positive = st.floats(10.0, 20_000.0)
states = st.tuples(st.floats(-0.05, 0.05), st.floats(-3.0, 3.0))


@given(positive, st.floats(0.0, 60.0), states, st.sampled_from([1e-2, 1e-3, 1e-4]), st.floats(-10.0, 10.0))
def test_complementarity_holds_at_the_end_of_a_step(
    k: float, f: float, state: tuple[float, float], h: float, a: float
) -> None:
    c = CoefficientArrays.from_table(Coefficients(k=k, f=f, mu=0.0, nu=0.0))
    x, v = np.asarray(state[0]), np.asarray(state[1])
    end = step_normal(c, MASS, (x, v + h * a), h, Onset.LCP)
    w = float(end.force + k * end.x + f * end.v)
    scale = k * abs(state[0]) + (k * h + f) * (abs(state[1]) + abs(a) * h) + 1e-12
    assert float(end.force) >= 0.0
    assert w >= -1e-12 * scale
    assert float(end.force) * w == pytest.approx(0.0, abs=1e-12 * scale * scale)
    assert float(end.v) == pytest.approx(float(v) + h * (a + float(end.force) / MASS), abs=1e-12)


def random_corners(n: int, seed: int) -> tuple[Corner, Array, Array]:
    """Return a right-angled corner with random coefficients, and vehicles inside and near it."""
    random = np.random.default_rng(seed)
    k = np.exp(random.uniform(np.log(100.0), np.log(20_000.0), (2, n)))
    f = np.exp(random.uniform(np.log(0.1), np.log(60.0), (2, n)))
    c = CoefficientArrays(k, f, random.uniform(0.0, 5.0, (2, n)), np.ones((2, n)))
    corner = Corner(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([-1.1, -1.65]), c)
    position = np.array([1.65, -1.1]) + random.uniform(-0.06, 0.06, (n, 2))
    return corner, position, random.uniform(-3.0, 3.0, (n, 2))


def test_complementarity_holds_in_a_right_angled_corner() -> None:
    h = 1e-3
    corner, p, v = random_corners(CORNER_CASES, seed=20260721)
    end = step_corner(corner, MASS, (p, v), h, np.array([0.5, -0.7]))
    z, w = end.normal_force_n, end.complement_n
    k, f, mu, _ = (values.T for values in corner.c)
    scale = k * 0.06 + (k * h + f) * 3.0 + 1.0
    assert (z >= 0.0).all()
    assert (w >= -1e-10 * scale).all()
    assert (z * w <= 1e-10 * scale * scale).all()
    # Momentum balance of the step, with friction from the velocity at its end.
    force = z @ corner.normals - (mu * z * end.sliding_m_s) @ corner.tangents
    np.testing.assert_allclose(
        end.velocity_m_s, v + h * (np.array([0.5, -0.7]) + force / MASS), rtol=0.0, atol=1e-10
    )
    both, one, none = (int(np.sum(np.sum(z > 0.0, axis=1) == i)) for i in (2, 1, 0))
    assert min(both, one, none) > CORNER_CASES // 20, "each number of active planes must occur"


planes = st.builds(Coefficients, k=positive, f=st.floats(0.0, 60.0), mu=st.floats(0.0, 5.0), nu=st.just(0.0))


@given(st.tuples(planes, planes), states, states, st.floats(math.radians(40.0), math.radians(140.0)))
def test_complementarity_holds_in_corners_of_any_angle(
    pair: tuple[Coefficients, Coefficients], one: tuple[float, float], two: tuple[float, float], angle: float
) -> None:
    h = 1e-3
    c = CoefficientArrays.from_table(pair)
    k, f = c.k, c.f
    corner = Corner(np.array([[1.0, 0.0], [math.cos(angle), math.sin(angle)]]), np.zeros(2), c)
    p, v = np.array([[one[0], two[0]]]), np.array([[one[1], two[1]]])
    end = step_corner(corner, MASS, (p, v), h)
    scale = k * 0.1 + (k * h + f) * 5.0 + 1.0
    assert (end.normal_force_n >= 0.0).all()
    assert (end.complement_n >= -1e-9 * scale).all()
    assert (end.normal_force_n * end.complement_n <= 1e-9 * scale * scale).all()


def test_a_corner_with_one_distant_plane_behaves_as_one_plane() -> None:
    c = TABLE[3]
    table = CoefficientArrays(*(np.repeat(np.atleast_1d(v), 2) for v in CoefficientArrays.from_table(c)))
    corner = Corner(np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([0.0, -50.0]), table)
    h, p, v = 1e-4, np.array([[0.005, 0.0]]), np.array([[-1.0, 0.6]])
    for _ in range(1500):
        p, v, *_ = step_corner(corner, MASS, (p, v), h)
    path = simulate(c, MASS, (0.005, 0.0, 0.0), (-1.0, -0.6, 0.0), Onset.LCP, step_s=h, duration_s=0.15)
    # The plane's own Y is the mission's -y.
    np.testing.assert_allclose(p[0] * [1.0, -1.0], path.position_m[-1, :2], atol=1e-12)
    np.testing.assert_allclose(v[0] * [1.0, -1.0], path.velocity_m_s[-1, :2], atol=1e-12)


def test_a_corner_dissipates_energy() -> None:
    corner, _, _ = random_corners(200, seed=3)
    random = np.random.default_rng(4)
    p = np.array([1.65, -1.1]) + np.array([-0.08, 0.08])
    p, v = (
        np.tile(p, (200, 1)),
        np.stack((random.uniform(0.2, 2.0, 200), random.uniform(-2.0, -0.2, 200)), axis=1),
    )
    before = np.sum(v * v, axis=1)
    for _ in range(3000):
        p, v, *_ = step_corner(corner, MASS, (p, v), 1e-3)
    assert (np.sum(v * v, axis=1) < before).all()
