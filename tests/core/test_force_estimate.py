"""Force estimate, its parts, and a seeded sample of single hits."""

from __future__ import annotations

import math
import random
import statistics

import msgspec
import numpy as np
import pytest

from dart_flight.base.geometry import (
    IDENTITY,
    MissionFrame,
    Vec3,
    advance_attitude,
    quaternion_from_euler,
    rotate,
)
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ContactEnd,
    DetectionFloor,
    EscSample,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    LandedState,
    Mode,
    OdometrySample,
    StatusSample,
)
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import ThrustSource, VehicleConfig
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.detector import ExpectedContact, ImpactDetector, _top_of, confirmed_force
from dart_flight.core.sense.force import ATTITUDE_ERROR_RAD, ForceEstimator
from dart_flight.core.sense.pulse import PulsePrior, TickReading, _binned, fit_friction, fit_normal
from dart_flight.core.sense.senses import Senses
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.thrust_model import LaggedCommands, ThrustModel
from tests.core.conftest import HOVER, ROOT, of_kind
from tests.core.force_hits import figures_of, grid
from tests.core.force_quiet import fly_quiet

# The paper's point law, for which the detector's pulse is designed; test_torque has the hits of a body.
MISSION = load_mission(
    ROOT / "missions" / "paper_dual_collision.yaml", settings=["simulation.contact.body=point"]
)
VEHICLE = MISSION.vehicle
MASS = VEHICLE.airframe.mass_kg


def with_estimation(**changes: object) -> VehicleConfig:
    return msgspec.structs.replace(VEHICLE, estimation=msgspec.structs.replace(VEHICLE.estimation, **changes))


# --- pulse -------------------------------------------------------------------------------------------


def true_pulse(
    k: float, f: float, v: float, push_n: float, vy: float, mu: float
) -> list[tuple[float, float]]:
    """Return normal and friction force every 10 us from the first force, by stepping the contact law."""
    h, x, vx = 1e-5, f * v / k, -v
    out: list[tuple[float, float]] = []
    while True:
        n = -(k * x + f * vx)
        if n < 0.0 and out:
            return out
        n = max(n, 0.0)
        t = -mu * n * vy
        out.append((n, t))
        vx += h * (n - push_n) / MASS
        vy += h * t / MASS
        x += h * vx


def readings_of(
    pulse: list[tuple[float, float]], phase_s: float, noise_n: float, full_n: float, lag_s: float
) -> list[TickReading]:
    """Return tick means of a filtered, saturated pulse until some ticks after its peak."""
    rng = random.Random(3)
    top = max(range(len(pulse)), key=lambda i: pulse[i][0])
    keep = math.exp(-1e-5 / lag_s)
    n = t = 0.0
    fine = []
    for i in range(-4000, min(len(pulse), top + 1500)):
        true_forces = pulse[i] if i >= 0 else (0.0, 0.0)
        n, t = true_forces[0] + (n - true_forces[0]) * keep, true_forces[1] + (t - true_forces[1]) * keep
        fine.append((min(n, full_n), t))
    out = []
    first = round(phase_s * 1e5)
    for begin in range(first, len(fine) - 400, 400):
        part = fine[begin : begin + 400]
        a = (begin - 4000) * 1e-5 - lag_s
        normal = sum(p[0] for p in part) / 400 + rng.gauss(0.0, noise_n)
        tangential = sum(p[1] for p in part) / 400 + rng.gauss(0.0, noise_n)
        out.append(TickReading(a, a + 0.004, normal, tangential, any(p[0] >= full_n for p in part)))
    return out


@pytest.mark.parametrize("phase_s", [0.0, 0.001, 0.0035])
@pytest.mark.parametrize(("mode", "push_n"), [(Mode.RIGID, 0.0), (Mode.FLEXIBLE, 7.0), (Mode.FLEXIBLE, -2.0)])
def test_the_fit_compensates_tick_averaging_and_filter_lag(mode: Mode, push_n: float, phase_s: float) -> None:
    c = VEHICLE.materials["acrylic"].coefficients(mode)
    pulse = true_pulse(c.k, c.f, 1.0, push_n, 0.5, c.mu)
    readings = readings_of(pulse, phase_s, 1e-4, 1e9, 0.00073)
    # A first guess that is 20 % off in stiffness.
    prior = PulsePrior(math.sqrt(1.2 * c.k / MASS), 0.5 * c.f / MASS, c.mu / MASS)
    fit = fit_normal(readings, push_n, prior, 0.05, -0.003, 0.00073)
    assert fit is not None
    top = max(n for n, _ in pulse)
    assert fit.peak_n == pytest.approx(top, rel=0.004)
    assert fit.peak_s == pytest.approx(max(range(len(pulse)), key=lambda i: pulse[i][0]) * 1e-5, abs=8e-4)
    for guess in (0.1, 1.5, 20.0):  # times the true friction
        friction = fit_friction(readings, fit, 0.0, MASS, guess * c.mu / MASS, 0.05)
        assert friction == pytest.approx(min(t for _, t in pulse), rel=0.03)
    # Before the peak, the newest friction is the largest.
    early = [r for r in readings if r.b < 0.6 * fit.peak_s]
    so_far = fit_friction(early, fit, 0.0, MASS, c.mu / MASS, 0.05)
    assert so_far == pytest.approx(min(t for _, t in pulse[: round(early[-1].b * 1e5)]), rel=0.1)


def test_tick_averaging_lowers_a_rigid_peak_by_a_known_share() -> None:
    """Compare the largest tick mean with the true peak of a 46 ms contact at every sampling phase."""
    c = VEHICLE.materials["concrete"].rigid
    pulse = true_pulse(c.k, c.f, 0.99, 0.0, 0.0, 0.0)
    top = max(n for n, _ in pulse)
    losses = []
    for phase in range(8):
        readings = readings_of(pulse, phase * 0.0005, 0.0, 1e9, 0.00073)
        losses.append(1.0 - max(r.normal for r in readings) / top)
    omega = math.sqrt(c.k / MASS)
    averaging = (omega * 0.004) ** 2 / 24.0
    assert min(losses) == pytest.approx(averaging, rel=0.6)
    # At the worst phase, the peak lies between two ticks: four times the loss.
    assert max(losses) == pytest.approx(4.0 * averaging, rel=0.35)


def test_no_pulse_is_fitted_to_readings_without_one() -> None:
    c = VEHICLE.materials["wood"].rigid
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, 0.2)
    readings = readings_of(true_pulse(c.k, c.f, 1.0, 0.0, 0.0, 0.0), 0.002, 0.0, 1e9, 0.00073)
    begun = [r for r in readings if r.b > -0.003]

    def fits(some: list[TickReading]) -> bool:
        return fit_normal(some, 0.0, prior, 0.26, -0.003, 0.00073) is not None

    assert fits(readings)
    assert not fits(begun[:2])
    assert fits(begun[:3])
    assert not fits([])
    assert not fits([r._replace(normal=-abs(r.normal)) for r in readings])
    assert not fits([r._replace(normal=0.0) for r in readings])
    # A force that alternates from tick to tick is no pulse.
    assert not fits([r._replace(normal=40.0 * (i % 2)) for i, r in enumerate(begun)])


@pytest.mark.parametrize("noise_n", [0.26, 1000.0])
def test_no_pulse_is_fitted_above_all_its_clipped_readings(noise_n: float) -> None:
    """The first step leads above all readings, and then none of them limits the pulse.

    In low noise, the next step of the fit fails. In high noise, the fit has settled by then.
    """
    forces = [0.0] * 5 + [17.0, 70.0, 68.0]
    begins = [-0.0247 + 0.004 * i for i in range(len(forces))]
    readings = [TickReading(a, a + 0.004, n, 0.0, n > 0.0) for a, n in zip(begins, forces, strict=True)]
    assert fit_normal(readings, 0.0, PulsePrior(65.0, 5.8, 0.2), noise_n, -0.003, 0.00073) is None


@pytest.mark.parametrize(
    ("noise_share", "misfit_share", "fits"),
    [(0.01, 0.15, True), (0.01, 0.26, False), (0.1, 0.26, True), (0.1, 0.36, False)],
)
def test_no_friction_is_fitted_to_readings_that_alternate(
    noise_share: float, misfit_share: float, fits: bool
) -> None:
    """The limit of the misfit is a fifth of the peak, or three standard deviations of the noise."""
    c = VEHICLE.materials["acrylic"].rigid
    pulse = true_pulse(c.k, c.f, 1.0, 0.0, 0.5, c.mu)
    peak = min(t for _, t in pulse)
    clean = readings_of(pulse, 0.002, 0.0, 1e9, 0.00073)
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, c.mu / MASS)
    normal = fit_normal(clean, 0.0, prior, 0.05, -0.003, 0.00073)
    assert normal is not None
    readings = [
        r._replace(tangential=r.tangential + misfit_share * peak * (-1) ** i) for i, r in enumerate(clean)
    ]
    found = fit_friction(readings, normal, 0.0, MASS, prior.kappa, noise_share * abs(peak))
    assert (found is not None) is fits
    inside = [r for r in clean if r.b > normal.start_s]
    assert fit_friction(inside[:2], normal, 0.0, MASS, prior.kappa, 0.05) is None
    assert fit_friction(inside[:3], normal, 0.0, MASS, prior.kappa, 0.05) is not None


@pytest.mark.parametrize(("sigma", "damped"), [(0.0, 50.0), (30.0, 40.0), (49.9, 5.0), (80.0, 5.0)])
def test_the_half_period_of_a_contact_is_bounded_if_damping_prevents_an_oscillation(
    sigma: float, damped: float
) -> None:
    """At least a tenth of the undamped frequency is assumed."""
    assert PulsePrior(50.0, sigma, 1.0).half_period_s == pytest.approx(math.pi / damped)


@pytest.mark.parametrize(
    ("share", "stiffness", "error"),
    [(0.6, 1.0, 0.04), (0.75, 1.0, 0.04), (0.9, 1.0, 0.04), (0.9, 1.25, 0.01), (0.9, 1.6, 0.01)],
)
def test_a_clipped_pulse_is_reconstructed(share: float, stiffness: float, error: float) -> None:
    """The bounds, also those after the first that the model satisfies, correct a prior that is too stiff."""
    c = VEHICLE.materials["wood"].rigid
    pulse = true_pulse(c.k, c.f, 3.0, 0.0, 0.0, 0.0)
    top = max(n for n, _ in pulse)
    readings = readings_of(pulse, 0.002, 0.2, share * top, 0.00073)
    for i in range(1, len(readings) - 1):  # like the detector, neighbours of a clipped tick are bounds
        bound = any(r.normal >= 0.99 * share * top for r in readings[i - 1 : i + 2])
        readings[i] = readings[i]._replace(bound=readings[i].bound or bound)
    prior = PulsePrior(math.sqrt(stiffness * c.k / MASS), 0.5 * c.f / MASS, 0.2)
    fit = fit_normal(readings, 0.0, prior, 0.26, -0.003, 0.00073)
    assert fit is not None
    assert fit.peak_n == pytest.approx(top, rel=error)
    assert max(r.normal for r in readings) < share * top + 1.0


@pytest.mark.parametrize("mode", list(Mode))
def test_pulse_misfit_and_peak_uncertainty_match_the_noise(mode: Mode) -> None:
    c, noise_n, rng = VEHICLE.materials["acrylic"].coefficients(mode), 1.5, random.Random(4)
    clean = readings_of(true_pulse(c.k, c.f, 1.0, 1.0, 0.0, 0.0), 0.002, 0.0, 1e9, 0.00073)
    prior = PulsePrior(math.sqrt(c.k / MASS), 0.5 * c.f / MASS, 0.2)
    fits = []
    for _ in range(40):
        readings = [r._replace(normal=r.normal + rng.gauss(0.0, noise_n)) for r in clean]
        fit = fit_normal(readings, 1.0, prior, noise_n, -0.003, 0.00073)
        assert fit is not None
        fits.append(fit)
    assert 0.6 < statistics.mean(fit.misfit for fit in fits) < 1.3
    scatter = statistics.stdev(fit.peak_n for fit in fits)
    assert 0.8 * scatter < statistics.mean(fit.sigma_n for fit in fits) < 1.6 * scatter


@pytest.mark.parametrize("count", [10, 200])
def test_binned_readings_keep_the_sums_of_a_pulse(count: int) -> None:
    """No bin spans a gap, and a reading at full scale keeps its own bin."""
    rng, at, readings = random.Random(count), 0.0, list[TickReading]()
    for i in range(count):
        begin = at + (0.004 if i == 7 else 0.0)
        at = begin + rng.choice((0.002, 0.004))
        readings.append(TickReading(begin, at, rng.gauss(0.0, 1.0), rng.gauss(0.0, 1.0), i == 3))
    bins = _binned(readings)
    assert sum(n for _, n in bins) == count
    assert len(bins) <= max(10, 45)
    assert [r for r, _ in bins if r.bound] == [readings[3]]
    assert not [r for r, _ in bins if r.a < readings[6].b and r.b > readings[7].a]
    for moment in (lambda r: 1.0, lambda r: r.normal, lambda r: r.tangential):
        together, alone = (
            sum((r.b - r.a) * moment(r) for r in some) for some in ([r for r, _ in bins], readings)
        )
        assert together == pytest.approx(alone)


@pytest.mark.parametrize(("apart_s", "averaged"), [(0.0, True), (0.9e-6, True), (1.1e-6, False)])
def test_readings_less_than_a_microsecond_apart_are_neighbours(apart_s: float, averaged: bool) -> None:
    begins = [(0.004 + apart_s) * i for i in range(90)]
    readings = [TickReading(at, at + 0.004, 1.0, 0.0, False) for at in begins]
    assert (len(_binned(readings)) < 90) is averaged


# --- thrust ------------------------------------------------------------------------------------------


def test_commands_act_from_their_stamp_with_the_motor_lag() -> None:
    lagged = LaggedCommands(0.025)
    lagged.update(1_000_000, (0.5,) * 4)
    lagged.update(1_010_000, (0.7,) * 4)
    lagged.update(1_005_000, (0.0,) * 4)  # late: its stamp does not advance
    lagged.advance(1_008_000)
    assert lagged.value == (0.5,) * 4
    lagged.advance(1_035_000)
    assert lagged.value[0] == pytest.approx(0.7 - 0.2 * math.exp(-1.0))


def test_a_change_of_the_number_of_motors_is_refused() -> None:
    lagged = LaggedCommands(0.025)
    lagged.update(1_000_000, (0.5,) * 4)
    lagged.update(1_004_000, (0.5,) * 6)
    lagged.advance(1_003_000)
    with pytest.raises(ValueError, match=r"^6 commands after 4$"):
        lagged.advance(1_008_000)


def test_the_best_fresh_thrust_source_is_used() -> None:
    model = ThrustModel(with_estimation(esc_thrust_n_per_rpm2=1.1e-8))
    assert model.mean_over_tick(1_000_000) == pytest.approx(MASS * 9.81)
    assert model.source is None
    model.add_commands(ActuatorSample(1_008_000, 0, (HOVER,) * 4))
    model.mean_over_tick(1_008_000)
    assert model.source is ThrustSource.ACTUATOR
    model.update_esc(EscSample(1_008_000, 0, (17_000.0,) * 4))
    model.update_esc(EscSample(1_012_000, 0, (17_000.0,) * 4))
    model.mean_over_tick(1_012_000)
    assert model.mean_over_tick(1_016_000) == pytest.approx(4 * 1.1e-8 * 17_000.0**2)
    assert model.source is ThrustSource.ESC
    model.add_commands(ActuatorSample(1_200_000, 0, (HOVER,) * 4))
    model.mean_over_tick(1_200_000)
    assert model.source is ThrustSource.ACTUATOR  # the ESC's telemetry is stale


def test_hover_thrust_is_assumed_without_a_fresh_source() -> None:
    model = ThrustModel(with_estimation(esc_thrust_n_per_rpm2=1.1e-8))
    for t_us in (1_000_000, 1_004_000):
        model.update_esc(EscSample(t_us, 0, (17_000.0,) * 4))
        model.mean_over_tick(t_us)
    known = (model.source, model.each_n)
    assert known == (ThrustSource.ESC, tuple([1.1e-8 * 17_000.0 * 17_000.0] * 4))
    model.mean_over_tick(1_200_000)
    assert (model.source, model.each_n) == (None, None)
    assert model.mean_over_tick(1_204_000) == pytest.approx(MASS * 9.81)


@pytest.mark.parametrize(("period_us", "constant"), [(100_000, 1.1e-8), (24_000, 1.1e-8), (8_000, None)])
def test_slow_or_uncalibrated_motor_speeds_are_not_used(period_us: int, constant: float | None) -> None:
    model = ThrustModel(with_estimation(esc_thrust_n_per_rpm2=constant))
    for t_us in range(1_000_000, 1_400_000, 4_000):
        model.add_commands(ActuatorSample(t_us, 0, (HOVER,) * 4))
        if t_us % period_us == 0:
            model.update_esc(EscSample(t_us, 0, (17_000.0,) * 4))
        model.mean_over_tick(t_us)
        assert model.source is ThrustSource.ACTUATOR


@pytest.mark.parametrize("late_us", [0, 4_000, 60_000])
def test_motor_speeds_that_arrive_late_do_not_replace_newer_ones(late_us: int) -> None:
    model = ThrustModel(with_estimation(esc_thrust_n_per_rpm2=1.1e-8))
    for t_us in (1_000_000, 1_010_000):
        model.update_esc(EscSample(t_us, 0, (17_000.0,) * 4))
    model.update_esc(EscSample(1_010_000 - late_us, 0, (9_000.0,) * 4))
    assert model.mean_over_tick(1_012_000) == pytest.approx(4 * 1.1e-8 * 17_000.0**2)
    assert model.source is ThrustSource.ESC


def test_a_measured_thrust_table_replaces_the_curve() -> None:
    """The table is interpolated for each motor and scaled by the battery voltage."""
    table = msgspec.structs.replace(
        VEHICLE.thrust, full_n=None, model_factor=None, table=((0.5, 3.0), (1.0, 8.0))
    )
    battery = msgspec.structs.replace(VEHICLE.estimation.battery, exponent=1.5)
    model = ThrustModel(msgspec.structs.replace(with_estimation(battery=battery), thrust=table))
    model.add_commands(ActuatorSample(1_000_000, 0, (0.25, 0.5, 0.6, 1.0)))
    assert model.mean_over_tick(1_004_000) == pytest.approx(1.5 + 3.0 + 4.0 + 8.0)
    assert model.each_n == pytest.approx((1.5, 3.0, 4.0, 8.0))
    model.update_voltage(0.9 * battery.reference_v)
    model.mean_over_tick(1_008_000)
    assert model.mean_over_tick(1_012_000) == pytest.approx(16.5 * 0.9**1.5)
    assert model.each_n == pytest.approx([0.9**1.5 * n for n in (1.5, 3.0, 4.0, 8.0)])


def test_battery_voltage_scales_the_thrust_curve() -> None:
    battery = msgspec.structs.replace(VEHICLE.estimation.battery, exponent=1.5)
    model = ThrustModel(with_estimation(battery=battery))
    model.add_commands(ActuatorSample(1_000_000, 0, (HOVER,) * 4))
    full = model.mean_over_tick(1_004_000)
    model.update_voltage(0.9 * battery.reference_v)
    model.mean_over_tick(1_008_000)
    assert model.mean_over_tick(1_012_000) == pytest.approx(full * 0.9**1.5)
    model.update_voltage(None)
    assert model.mean_over_tick(1_016_000) == pytest.approx(full * 0.9**1.5)
    model.update_voltage(0.0)  # reported by a vehicle that does not measure it
    assert model.mean_over_tick(1_020_000) == pytest.approx(full * 0.9**1.5)
    model.update_voltage(0.5)
    model.mean_over_tick(1_024_000)
    assert model.mean_over_tick(1_028_000) == pytest.approx(full * (0.5 / battery.reference_v) ** 1.5)


def test_battery_voltage_and_motor_speeds_affect_the_thrust() -> None:
    battery = msgspec.structs.replace(VEHICLE.estimation.battery, exponent=1.5)
    vehicle = with_estimation(battery=battery, esc_thrust_n_per_rpm2=1.1e-8)
    senses = Senses(msgspec.structs.replace(MISSION, vehicle=vehicle))

    def run(first_us: int, rpm: float | None = None) -> float:
        for t in range(first_us, first_us + 200_000, 4000):
            senses.update(AttitudeSample(t, t, IDENTITY), ExpectedContact())
            senses.update(ActuatorSample(t, t, (HOVER,) * 4), ExpectedContact())
            if rpm is not None:
                senses.update(EscSample(t, t, (rpm,) * 4), ExpectedContact())
            senses.update(ImuSample(t, t, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)), ExpectedContact())
        each_n = senses.estimator.thrust.each_n
        assert each_n is not None
        return sum(each_n)

    full_n = run(1_000_000)
    senses.update(StatusSample(0, 0, battery_v=0.9 * battery.reference_v), ExpectedContact())
    assert run(1_200_000) == pytest.approx(full_n * 0.9**1.5, rel=1e-3)
    assert run(1_400_000, 17_000.0) == pytest.approx(4 * 1.1e-8 * 17_000.0**2, rel=1e-3)


# --- estimator ---------------------------------------------------------------------------------------


class Hovering:
    """A hovering vehicle that feeds samples to a force estimator; force in NED, bias in FRD."""

    def __init__(self, vehicle: VehicleConfig, sigma: float = 0.0) -> None:
        self.state = FlightState()
        self.state.frame = MissionFrame()
        self.state.status = StatusSample(0, 0, landed=LandedState.IN_AIR)
        self.estimator = ForceEstimator(vehicle)
        self.rng, self.sigma, self.t_us = random.Random(5), sigma, 1_000_000
        self.bias: Vec3 = (0.0, 0.0, 0.0)
        self.force: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)
        self.true_thrust = 1.0  # relative to the thrust curve
        self.q = IDENTITY

    def run(self, seconds: float) -> list[ForceEstimate]:
        out = []
        for _ in range(round(seconds / 0.004)):
            self.t_us += 4000
            t, f, b = self.t_us, self.force, self.bias
            attitude = AttitudeSample(t, t, self.q)
            self.state.update_attitude(attitude)
            self.estimator.add_attitude(attitude)
            self.velocity = (
                self.velocity[0] + 0.004 * f[0] / MASS,
                self.velocity[1] + 0.004 * f[1] / MASS,
                0.0,
            )
            self.state.update_odometry(OdometrySample(t, t, (0.0, 0.0, -1.0), self.velocity))
            self.estimator.thrust.add_commands(ActuatorSample(t, t, (HOVER,) * 4))
            noise = [self.rng.gauss(0.0, self.sigma) for _ in range(3)]
            imu = ImuSample(
                t,
                t,
                (
                    f[0] / MASS + b[0] + noise[0],
                    f[1] / MASS + b[1] + noise[1],
                    f[2] / MASS - 9.81 * self.true_thrust + b[2] + noise[2],
                ),
                (0.0, 0.0, 0.0),
            )
            self.state.update_imu(imu)
            estimate = self.estimator.estimate(imu, self.state)
            assert estimate is not None
            out.append(estimate)
        return out


def test_hover_determines_bias_thrust_scale_and_noise() -> None:
    vehicle = Hovering(VEHICLE, sigma=0.3)
    vehicle.bias, vehicle.true_thrust = (0.2, -0.15, 0.0), 0.93
    vehicle.run(10.0)
    hover = vehicle.estimator.hover
    assert hover.bias_x == pytest.approx(0.2, abs=0.03)
    assert hover.bias_y == pytest.approx(-0.15, abs=0.03)
    assert hover.scale == pytest.approx(0.93, abs=0.01)
    assert hover.noise_m_s2 == pytest.approx(0.3, rel=0.15)
    last = vehicle.run(1.0)
    for axis in range(3):
        assert sum(e.force_mission[axis] for e in last) / len(last) == pytest.approx(0.0, abs=0.1)


def test_the_stated_covariance_matches_the_scatter_of_the_estimate() -> None:
    """The noise is white; the filtered force is quieter than the raw one."""
    vehicle = Hovering(VEHICLE, sigma=0.5)
    vehicle.run(5.0)
    estimates = vehicle.run(4.0)
    n = len(estimates)
    spread = sum(e.force_mission[0] ** 2 for e in estimates) / n
    stated = sum(e.variance_n2[0] for e in estimates) / n
    assert stated == pytest.approx(spread, rel=0.25)
    assert sum(e.filtered_mission[0] ** 2 for e in estimates) / n < 0.3 * spread
    # In a tilt, the thrust error adds variance along the tilt.
    vehicle.q = quaternion_from_euler(0.0, -0.5, 0.0)
    tilted = vehicle.run(0.1)[-1]
    assert tilted.variance_n2[0] > tilted.variance_n2[1]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_force_is_the_residual_of_thrust_gravity_and_drag(seed: int) -> None:
    """Attitude, heading and velocity are random; the gyro propagates the attitude for 50 ms."""
    rng = random.Random(seed)

    def random_vector(most: float) -> Vec3:
        return (rng.uniform(-most, most), rng.uniform(-most, most), rng.uniform(-most, most))

    airframe = msgspec.structs.replace(VEHICLE.airframe, drag_per_s=(0.3, 0.2, 0.1))
    vehicle = msgspec.structs.replace(with_estimation(arm_vibration=None), airframe=airframe)
    estimator, state = ForceEstimator(vehicle), FlightState()
    frame = MissionFrame(1.0, 2.0, -3.0, rng.uniform(-3.0, 3.0))
    state.anchor(frame)
    velocity_ned, rate, f = random_vector(2.0), random_vector(3.0), random_vector(20.0)
    state.update_odometry(OdometrySample(1_000_000, 0, (0.0, 0.0, 0.0), velocity_ned))
    q = quaternion_from_euler(*random_vector(1.5))
    estimator.add_attitude(AttitudeSample(1_000_000, 0, q))
    estimator.thrust.add_commands(ActuatorSample(900_000, 0, (HOVER,) * 4))
    hover = estimator.hover
    hover.bias_x, hover.bias_y, hover.scale = 0.3, -0.2, 0.9
    t_us = 1_050_000
    estimate = estimator.estimate(ImuSample(t_us, 0, f, rate), state, in_contact=True)
    assert estimate is not None
    thrust_n = estimator.thrust_n
    assert thrust_n == pytest.approx(0.9 * MASS * 9.81, rel=0.01)
    lag_s = vehicle.imu.reading_lag_s
    then = advance_attitude(q, rate, 0.05 - round(lag_s * 1e6) * 1e-6)
    force_ned = rotate(then, (MASS * (f[0] - 0.3), MASS * (f[1] + 0.2), MASS * f[2] + thrust_n))
    (x, y, z), v = frame.vector_from_ned(force_ned), frame.vector_from_ned(velocity_ned)
    drag = (0.3 * MASS * v[0], 0.2 * MASS * v[1], 0.1 * MASS * v[2])
    force = (x + drag[0], y + drag[1], z + drag[2])
    assert estimate.force_mission == pytest.approx(force)
    up = frame.vector_from_ned(rotate(then, (0.0, 0.0, -1.0)))
    assert estimate.push_mission == pytest.approx((thrust_n * up[0] - drag[0], thrust_n * up[1] - drag[1]))
    e, noise = vehicle.estimation, MASS * hover.noise_m_s2
    size2 = sum(axis * axis for axis in force)
    for axis in range(3):
        across2 = size2 - force[axis] ** 2
        variance = noise**2 + (e.thrust_error_n * up[axis]) ** 2 + ATTITUDE_ERROR_RAD**2 * across2
        assert estimate.variance_n2[axis] == pytest.approx(variance)


@pytest.mark.parametrize(("away_us", "near"), [(-60_000, True), (-60_001, False), (60_000, True)])
def test_an_attitude_is_propagated_for_at_most_sixty_milliseconds(away_us: int, near: bool) -> None:
    estimator, state = ForceEstimator(VEHICLE), FlightState()
    state.anchor(MissionFrame())
    at_us = 1_000_000 - round(VEHICLE.imu.reading_lag_s * 1e6)
    estimator.add_attitude(AttitudeSample(at_us + away_us, 0, IDENTITY))
    imu = ImuSample(1_000_000, 0, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0))
    assert (estimator.estimate(imu, state) is not None) is near


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("share", "clipped"), [(-1.0, True), (0.991, True), (-0.991, True), (0.989, False)])
def test_a_reading_within_a_hundredth_of_full_scale_is_clipped(
    share: float, clipped: bool, axis: int
) -> None:
    vehicle = Hovering(VEHICLE)
    vehicle.run(0.1)
    reading = [0.0, 0.0, 0.0]
    reading[axis] = share * VEHICLE.imu.full_scale_m_s2
    vehicle.force = (MASS * reading[0], MASS * reading[1], MASS * (reading[2] + 9.81))
    assert {e.clipped for e in vehicle.run(0.02)} == {clipped}


def test_a_late_imu_sample_uses_the_attitude_of_its_time() -> None:
    """The vehicle pitches; attitudes from 100 ms before the sample to 100 ms after it have arrived."""
    estimator, state = ForceEstimator(VEHICLE), FlightState()
    state.anchor(MissionFrame())
    at_us = 1_000_000 - round(VEHICLE.imu.reading_lag_s * 1e6)
    for away_us in range(-100_000, 100_001, 8000):
        pitch = 0.3 + 2e-6 * away_us
        estimator.add_attitude(AttitudeSample(at_us + away_us, 0, quaternion_from_euler(0.0, pitch, 0.0)))
    imu = ImuSample(1_000_000, 0, (0.0, 0.0, -9.81), (0.0, 2.0, 0.0))
    assert estimator.estimate(imu, state) is not None
    assert estimator.attitude == pytest.approx(quaternion_from_euler(0.0, 0.3, 0.0), abs=1e-6)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_momenta_are_the_integral_of_the_specific_force_without_bias(seed: int) -> None:
    """After a gap of more than 50 ms, the integral starts again; gravity is not removed."""
    rng = random.Random(seed)
    estimator, state = ForceEstimator(VEHICLE), FlightState()
    state.anchor(MissionFrame(1.0, 2.0, -3.0, rng.uniform(-3.0, 3.0)))
    q = quaternion_from_euler(*(rng.uniform(-1.5, 1.5) for _ in range(3)))
    hover = estimator.hover
    hover.bias_x, hover.bias_y, hover.scale = 0.3, -0.2, 0.9

    def feed(t_us: int) -> Vec3:
        """Feed the sample of a stamp; return its specific force in the mission frame."""
        f = (rng.uniform(-20.0, 20.0), rng.uniform(-20.0, 20.0), rng.uniform(-20.0, 20.0))
        estimator.add_attitude(AttitudeSample(t_us, 0, q))
        estimator.thrust.add_commands(ActuatorSample(t_us, 0, (HOVER,) * 4))
        assert estimator.estimate(ImuSample(t_us, 0, f, (0.0, 0.0, 0.0)), state, in_contact=True) is not None
        assert state.frame is not None
        return state.frame.vector_from_ned(rotate(q, (f[0] - 0.3, f[1] + 0.2, f[2])))

    feed(1_000_000)
    for later_us in (1_004_000, 1_012_000, 1_062_000):
        t_us, *before = estimator.momenta[-1]
        force = feed(later_us)
        expected = [p + MASS * a * (later_us - t_us) * 1e-6 for p, a in zip(before, force, strict=True)]
        assert estimator.momenta[-1] == pytest.approx((later_us, *expected))
    assert len(estimator.momenta) == 4
    feed(1_112_001)
    assert len(estimator.momenta) == 1


@pytest.mark.parametrize("lost", [(), (1,), (3,), (4,)])
@pytest.mark.parametrize("skew", [-1.0, 1.0])
def test_a_lost_sample_does_not_shift_the_parabola_of_a_peak(lost: tuple[int, ...], skew: float) -> None:
    """With a sample missing, the stamps are not symmetric about their mean."""
    top_us = 9300
    samples = [(4000 * i, 10.0 - 0.01 * (4.0 * i - 9.3) ** 2) for i in range(6) if i not in lost]
    if skew < 0.0:
        top_us, samples = 40_000 - top_us, [(40_000 - t, height) for t, height in reversed(samples)]
    height, t_us = _top_of(samples)
    assert height == pytest.approx(10.0)
    assert abs(t_us - top_us) <= 1


@pytest.mark.parametrize("first_us", [4000, 8000])
def test_the_peak_of_a_parabola_is_found_between_its_samples(first_us: int) -> None:
    """Four samples, the largest of them the second or the first."""
    pulse = [(t, 10.0 - 0.02 * ((t - 9300) * 1e-3) ** 2) for t in range(first_us, first_us + 16_000, 4000)]
    height, t_us = _top_of(pulse)
    assert height == pytest.approx(10.0)
    assert abs(t_us - 9300) <= 1


def test_arm_vibration_is_removed_from_the_force() -> None:
    arms = VEHICLE.estimation.arm_vibration
    assert arms is not None
    w, h = 2.0 * math.pi * arms.frequency_hz, 1e-5
    q = v = 0.0
    inverse = ArmFilter(arms, 0.004)
    with_arms, without = [], []
    for tick in range(100):
        mean = true = 0.0
        for i in range(400):
            t = tick * 0.004 + i * h
            a = 30.0 * math.sin(20.0 * t) if t < math.pi / 20.0 else 0.0
            qdd = -w * w * q - 2.0 * arms.damping_ratio * w * v - a
            q, v = q + h * v, v + h * qdd
            mean, true = mean + (a - arms.mass_fraction * qdd) / 400, true + a / 400
        with_arms.append(abs(mean - true))
        without.append(abs(inverse.remove(mean, 0.0, 0.004)[0] - true))
    assert max(with_arms) > 0.3
    assert max(without) < 0.05


def test_arm_vibration_is_added_and_removed_alike_on_both_axes() -> None:
    arms = VEHICLE.estimation.arm_vibration
    assert arms is not None
    adds, removes, rng = ArmFilter(arms, 0.004), ArmFilter(arms, 0.004), random.Random(4)
    for _ in range(50):
        x, y = rng.gauss(0.0, 10.0), rng.gauss(0.0, 10.0)
        shaken = adds.add(x, y)
        assert removes.remove(*shaken, 0.004) == pytest.approx((x, y))
    assert shaken != pytest.approx((x, y), rel=0.01)
    along_x, along_y = ArmFilter(arms, 0.004), ArmFilter(arms, 0.004)
    for i in range(50):
        assert along_x.remove(float(i % 7), 0.0, 0.004)[0] == along_y.remove(0.0, float(i % 7), 0.004)[1]


@pytest.mark.parametrize(("gap", "rests"), [(25, False), (26, True)])
def test_arm_vibration_continues_over_a_gap_until_it_has_decayed(gap: int, rests: bool) -> None:
    arms = VEHICLE.estimation.arm_vibration
    assert arms is not None
    filters = [ArmFilter(arms, 0.004) for _ in range(3)]
    for each in filters[:2]:
        each.remove(30.0, -20.0, 0.004)
    jumped, stepped, fresh = filters
    for _ in range(gap):
        swinging = stepped.remove(1.0, 2.0, 0.004)
    found = jumped.remove(1.0, 2.0, 0.004 * gap)
    assert found == pytest.approx(fresh.remove(1.0, 2.0, 0.004) if rests else swinging, rel=1e-12)


# --- detector ----------------------------------------------------------------------------------------


def detector_events(
    forces: list[tuple[float, float]],
    noise_n: float = 0.26,
    normal: tuple[float, float] | None = None,
    push: tuple[float, float] = (0.0, 0.0),
) -> list[object]:
    """Return the events of a detector for forces every 4 ms."""
    detector = ImpactDetector(with_estimation(imu_noise_m_s2=0.2))  # the noise is already learned
    expected = ExpectedContact(True, normal, "wood" if normal else None)
    state = FlightState()
    events: list[object] = []
    for i, (fx, fy) in enumerate(forces):
        t = 1_000_000 + 4000 * i
        estimate = ForceEstimate(t, (fx, fy, 0.0), False, noise_n=noise_n, push_mission=push)
        found = detector.update(estimate, t, state, expected)
        events += [e for e in found if not isinstance(e, DetectionFloor)]
    return events


def half_sine(peak: float, ticks: int) -> list[float]:
    return [peak * math.sin(math.pi * (i + 0.5) / ticks) for i in range(ticks)]


def test_planned_and_unplanned_hits_are_distinguished() -> None:
    pulse = [(0.0, 0.0)] * 20 + [(-f, 0.2 * f) for f in half_sine(30.0, 12)] + [(0.0, 0.0)] * 20
    onset, peak = detector_events(pulse, normal=(-1.0, 0.0))[:2]
    assert isinstance(onset, ImpactOnset)
    assert isinstance(peak, ImpactPeak)
    assert onset.planned
    assert peak.normal == (-1.0, 0.0)
    onset, peak = detector_events(pulse, normal=(1.0, 0.0))[:2]  # from behind
    assert isinstance(onset, ImpactOnset)
    assert isinstance(peak, ImpactPeak)
    assert not onset.planned
    assert math.degrees(math.atan2(peak.normal[1], -peak.normal[0])) == pytest.approx(
        math.degrees(math.atan(0.2)), abs=1.0
    )


@pytest.mark.parametrize("angle", [0.5, 2.0, -0.9])
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_peak_forces_do_not_depend_on_the_wall_angle(angle: float, direction: float) -> None:
    """The friction comes from the fit; the thrust pushes into the wall and along it."""
    co, so = math.cos(angle), math.sin(angle)

    def rotated(x: float, y: float) -> tuple[float, float]:
        return x * co - y * so, x * so + y * co

    pulse = true_pulse(750.0, 8.5, 1.0, 0.0, -direction, 5.0)
    ticks = [pulse[i : i + 400] for i in range(0, len(pulse) - 400, 400)]
    hit = [(-sum(n for n, _ in one) / 400, direction * 0.3 * sum(n for n, _ in one) / 400) for one in ticks]
    forces, push = [(0.0, 0.0)] * 20 + hit + [(0.0, 0.0)] * 20, (1.5, 0.8 * direction)
    peaks = []
    for samples, normal, lean in (
        (forces, (-1.0, 0.0), push),
        ([rotated(*force) for force in forces], rotated(-1.0, 0.0), rotated(*push)),
    ):
        (peak,) = [e for e in detector_events(samples, normal=normal, push=lean) if isinstance(e, ImpactPeak)]
        assert peak.normal == pytest.approx(normal)
        peaks.append(peak)
    straight, oblique = peaks
    assert oblique.fitted is straight.fitted is True
    assert oblique.normal_force_n == pytest.approx(straight.normal_force_n)
    assert oblique.tangential_force_n == pytest.approx(straight.tangential_force_n)
    assert straight.tangential_force_n * direction > 1.0


@pytest.mark.parametrize(("bump_n", "peak_n"), [(2.5, 30.0), (3.0, 3.0)])
def test_the_peak_is_awaited_until_the_wall_pushes_if_friction_comes_first(
    bump_n: float, peak_n: float
) -> None:
    """The wall must push with half the threshold; a smaller force can drop before the real contact."""
    foot = [(-0.5 * bump_n, 8.0), (-bump_n, 9.0), (-bump_n, 9.0), (-0.5 * bump_n, 9.0), (-0.1, 9.0)]
    pulse = [(-f, 6.0) for f in half_sine(30.0, 12)]
    events = detector_events([(0.0, 0.0)] * 20 + foot + pulse + [(0.0, 0.0)] * 60, 0.01, (-1.0, 0.0))
    first = of_kind(ImpactPeak, events)[0]
    assert first.normal_force_n == pytest.approx(peak_n, rel=0.1)


@pytest.mark.parametrize(("dip_n", "noise_n", "past"), [(1.2, 0.01, False), (1.6, 0.01, True)])
def test_a_dip_of_a_quarter_of_the_threshold_ends_a_weak_peak(
    dip_n: float, noise_n: float, past: bool
) -> None:
    flat = [(-8.0, 0.0)] * 6
    events = detector_events([(0.0, 0.0)] * 20 + flat + [(dip_n - 8.0, 0.0)] + flat, noise_n, (-1.0, 0.0))
    assert any(isinstance(e, ImpactPeak) for e in events) is past


def test_an_endless_contact_is_ended_after_half_a_second() -> None:
    end = next(
        e for e in detector_events([(0.0, 0.0)] * 20 + [(-20.0, 0.0)] * 200) if isinstance(e, ContactEnd)
    )
    assert end.t_us - end.first_us == 500_000


@pytest.mark.parametrize(("into_n", "planned"), [(0.9, True), (1.2, False)])
def test_a_force_slightly_into_the_wall_can_be_the_planned_hit(into_n: float, planned: bool) -> None:
    """The limit is a tenth of the force: friction comes first, with noise on top."""
    events = detector_events([(0.0, 0.0)] * 20 + [(into_n, 10.0)] * 3, 0.001, (-1.0, 0.0))
    assert [e.planned for e in of_kind(ImpactOnset, events)] == [planned]


@pytest.mark.parametrize(("normal", "first"), [(None, (6.0, -3.0)), ((-1.0, 0.0), (0.5, -10.0))])
def test_a_contact_without_its_expected_wall_has_the_direction_of_its_impulse(
    normal: tuple[float, float] | None, first: tuple[float, float]
) -> None:
    """The first samples, of friction, do not give the direction, nor does the expected wall."""
    pulse = [(f, 0.2 * f) for f in half_sine(30.0, 12)[1:]]
    events = detector_events([(0.0, 0.0)] * 20 + [first] * 2 + pulse + [(0.0, 0.0)] * 60, 0.01, normal)
    (onset,) = of_kind(ImpactOnset, events)
    (peak,) = of_kind(ImpactPeak, events)
    assert onset.planned is (normal is not None)
    assert math.degrees(math.atan2(peak.normal[1], peak.normal[0])) == pytest.approx(0.0, abs=12.0)
    assert peak.normal_force_n == pytest.approx(30.0, rel=0.15)


@pytest.mark.parametrize(("noise_n", "samples"), [(1.19, 2), (1.2, 3)])
def test_three_samples_confirm_an_impact_if_two_are_too_noisy(noise_n: float, samples: int) -> None:
    """The limit is the threshold of 5.5 N divided by 4.6."""
    config = VEHICLE.detection
    mean = confirmed_force(6.0, 0.0, ((6.0, 3.0), (0.0, 3.0)), noise_n, config)
    assert mean == ((6.0, 1.5) if samples == 2 else (4.0, 2.0))


@pytest.mark.parametrize(("noise_n", "samples"), [(0.2, 1), (0.4, 4), (0.5, 5), (5.0, 5)])
def test_samples_are_averaged_until_their_noise_is_a_fiftieth_of_the_peak(
    noise_n: float, samples: int
) -> None:
    """At most five samples are averaged."""
    detector = ImpactDetector(VEHICLE)
    detector._noise = noise_n  # the count is used inside of the peak detector only
    assert detector._smoothing(10.0) == samples


def test_short_windows_need_a_higher_noise_multiple_than_long_ones() -> None:
    detector = ImpactDetector(VEHICLE)
    for window in detector._windows:  # learned in flight, but not to exact values
        window.noise_n = 2.0
    assert detector.thresholds_n() == (12.0, 12.0, 10.0, 10.0)


def test_the_peak_fit_uses_only_samples_above_seven_tenths_of_the_largest() -> None:
    """Fewer than four samples give no least-squares parabola, so the largest sample is used."""
    for heights in ((1.0, 6.9, 10.0, 8.0, 7.1, 6.9, 5.0), (9.0, 9.0, 6.9, 10.0, 6.9, 9.0, 9.0)):
        sharp = [(4000 * i, height) for i, height in enumerate(heights)]
        top_us = 4000 * heights.index(10.0)
        assert _top_of(sharp) == (10.0, top_us)
        assert _top_of([(28_000 - t, height) for t, height in reversed(sharp)]) == (10.0, 28_000 - top_us)


@pytest.mark.parametrize("seed", range(8))
def test_the_peak_is_that_of_the_parabola_through_four_samples_on_either_side(seed: int) -> None:
    rng = random.Random(seed)
    middle, stamps = rng.randrange(6, 12), [4000 * i + rng.randrange(0, 2000) for i in range(18)]
    pulse = [(t, 10.0 - 0.05 * abs(i - middle) + rng.uniform(-0.02, 0.02)) for i, t in enumerate(stamps)]
    near = pulse[middle - 4 : middle + 5]
    a, b, c = np.polyfit([(t - stamps[middle]) * 1e-3 for t, _ in near], [height for _, height in near], 2)
    height, t_us = _top_of(pulse)
    assert height == pytest.approx(c - b * b / (4.0 * a))
    assert t_us == pytest.approx(stamps[middle] - 500.0 * b / a, abs=1.0)


def test_wind_is_no_contact_but_a_lean_on_a_wall_is() -> None:
    rise = [(4.0 * 0.5 * (1.0 - math.cos(math.pi * min(1.0, i / 125))), 0.0) for i in range(1000)]
    assert detector_events(rise) == []
    lean = [(9.0 * 0.5 * (1.0 - math.cos(math.pi * min(1.0, i / 250))), 0.0) for i in range(1000)]
    assert len(of_kind(ImpactOnset, detector_events(lean))) == 1


def test_one_noisy_sample_is_no_impact() -> None:
    quiet = [(0.0, 0.0)] * 50
    assert detector_events([*quiet, (5.9, 0.0), *quiet]) == []
    assert (
        len(
            [
                e
                for e in detector_events([*quiet, (5.9, 0.0), (5.7, 0.0), *quiet])
                if isinstance(e, ImpactOnset)
            ]
        )
        == 1
    )


def test_the_wait_for_a_peak_is_bounded() -> None:
    forever = [(0.0, 0.0)] * 20 + [(0.5 * i, 0.0) for i in range(200)]
    events = detector_events(forever)
    onset = of_kind(ImpactOnset, events)[0]
    peak = of_kind(ImpactPeak, events)[0]
    assert peak.detected_us - onset.first_us <= VEHICLE.detection.peak_wait_s * 1e6 + 4000


# --- the campaign's sample -----------------------------------------------------------------------------


@pytest.mark.rest
def test_a_sample_of_the_hit_grid_stays_within_its_error_limits() -> None:
    hits = list(grid((0.3, 0.75, 2.0, 3.0), (45.0, 270.0), (0.0, 30.0)))
    rows = [figures_of(MISSION, hit, 0.2, i) for i, hit in enumerate(hits)]
    reached = [r for r in rows if r.reached]
    assert len(reached) >= 50
    assert all(r.onsets >= 1 for r in reached)
    assert all(r.onsets <= r.contacts for r in reached)
    assert all(r.delay_samples is not None and r.delay_samples <= 2 for r in reached)
    errors = [abs(r.peak_error) for r in reached if not r.clipped]
    assert np.quantile(errors, 0.5) <= 0.01
    assert np.quantile(errors, 0.95) <= 0.05
    assert max(r.direction_deg for r in reached) <= 5.0
    # Without a lean away, every hit from 0.3 m/s on reaches the threshold.
    assert all(r.reached for r in rows if r.hit.lean != "away")


def test_a_clipped_hit_of_the_plant_is_reconstructed() -> None:
    hits = [h for h in grid((3.5,), (0.0,), (0.0, 15.0), ("wood",)) if h.mode is Mode.RIGID]
    rows = [figures_of(MISSION, hit, 0.2, i) for i, hit in enumerate(hits)]
    assert all(r.clipped and r.fitted for r in rows)
    assert max(abs(r.peak_error) for r in rows) <= 0.05


@pytest.mark.rest
def test_hard_flying_without_contact_gives_no_false_impact() -> None:
    quiet = fly_quiet(MISSION, 90.0, 0.2, 4)
    assert quiet.false_hits == []
    assert quiet.max_tilt_deg > 30.0
    assert quiet.wind_force_n > 1.0
