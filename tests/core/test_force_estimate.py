"""Force estimate from IMU, attitude and thrust, and a seeded sample of single hits."""

from __future__ import annotations

import math
import random

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
    ForceEstimate,
    ImuSample,
    LandedState,
    Mode,
    OdometrySample,
    StatusSample,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.force import _CLIP_SHARE as CLIP
from dart_flight.core.sense.force import ATTITUDE_ERROR_RAD
from dart_flight.core.sense.senses import Senses
from dart_flight.core.sense.vehicle_motion import _ATTITUDE_REACH_US as REACH_US
from dart_flight.core.sense.vehicle_motion import _MOMENTUM_GAP_S
from tests.core.conftest import HOVER, known
from tests.core.force_hits import figures_of, grid
from tests.core.force_quiet import fly_quiet
from tests.core.pulses import MASS, MISSION, VEHICLE, with_estimation

GAP_US = round(1e6 * _MOMENTUM_GAP_S)
NO_CONTACT = ExpectedContact()


def sensing(
    vehicle: VehicleConfig, frame: MissionFrame | None = None, landed: LandedState = LandedState.IN_AIR
) -> Senses:
    """Return senses with a frame; on the ground they learn nothing."""
    senses = Senses(vehicle)
    senses.state.anchor(frame or MissionFrame())
    senses.update(StatusSample(0, 0, landed=landed), NO_CONTACT)
    return senses


class Hovering:
    """A hovering vehicle that feeds samples to the senses; force in NED, bias in FRD."""

    def __init__(self, vehicle: VehicleConfig, sigma: float = 0.0) -> None:
        self.senses = sensing(vehicle)
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
            self.senses.update(AttitudeSample(t, t, self.q), NO_CONTACT)
            self.velocity = (
                self.velocity[0] + 0.004 * f[0] / MASS,
                self.velocity[1] + 0.004 * f[1] / MASS,
                0.0,
            )
            self.senses.update(OdometrySample(t, t, (0.0, 0.0, -1.0), self.velocity), NO_CONTACT)
            self.senses.update(ActuatorSample(t, t, (HOVER,) * 4), NO_CONTACT)
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
            out.append(known(self.senses.update(imu, NO_CONTACT).estimate))
        return out


def test_hover_determines_bias_thrust_scale_and_noise() -> None:
    vehicle = Hovering(VEHICLE, sigma=0.3)
    vehicle.bias, vehicle.true_thrust = (0.2, -0.15, 0.0), 0.93
    vehicle.run(10.0)
    hover = vehicle.senses.motion.hover
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
    frame = MissionFrame(1.0, 2.0, -3.0, rng.uniform(-3.0, 3.0))
    senses = sensing(vehicle, frame, LandedState.ON_GROUND)
    velocity_ned, rate, f = random_vector(2.0), random_vector(3.0), random_vector(20.0)
    senses.update(OdometrySample(1_000_000, 0, (0.0, 0.0, 0.0), velocity_ned), NO_CONTACT)
    q = quaternion_from_euler(*random_vector(1.5))
    senses.update(AttitudeSample(1_000_000, 0, q), NO_CONTACT)
    senses.update(ActuatorSample(900_000, 0, (HOVER,) * 4), NO_CONTACT)
    hover = senses.motion.hover
    hover.bias_x, hover.bias_y, hover.scale = 0.3, -0.2, 0.9
    t_us = 1_050_000
    estimate = known(senses.update(ImuSample(t_us, 0, f, rate), NO_CONTACT).estimate)
    thrust_n = senses.motion.thrust_n
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


@pytest.mark.parametrize(
    ("away_us", "near"),
    [(-REACH_US, True), (-REACH_US - 1, False), (REACH_US, True)],
)
def test_an_attitude_is_propagated_for_a_limited_time(away_us: int, near: bool) -> None:
    senses = sensing(VEHICLE)
    at_us = 1_000_000 - round(VEHICLE.imu.reading_lag_s * 1e6)
    senses.update(AttitudeSample(at_us + away_us, 0, IDENTITY), NO_CONTACT)
    imu = ImuSample(1_000_000, 0, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0))
    assert (senses.update(imu, NO_CONTACT).estimate is not None) is near


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("share", "clipped"),
    [(-1.0, True), (1.001 * CLIP, True), (-1.001 * CLIP, True), (0.999 * CLIP, False)],
)
def test_a_reading_near_full_scale_is_clipped(share: float, clipped: bool, axis: int) -> None:
    vehicle = Hovering(VEHICLE)
    vehicle.run(0.1)
    reading = [0.0, 0.0, 0.0]
    reading[axis] = share * VEHICLE.imu.full_scale_m_s2
    vehicle.force = (MASS * reading[0], MASS * reading[1], MASS * (reading[2] + 9.81))
    assert {e.clipped for e in vehicle.run(0.02)} == {clipped}


def test_a_late_imu_sample_uses_the_attitude_of_its_time() -> None:
    """The vehicle pitches; attitudes from 100 ms before the sample to 100 ms after it have arrived."""
    senses = sensing(VEHICLE)
    at_us = 1_000_000 - round(VEHICLE.imu.reading_lag_s * 1e6)
    for away_us in range(-100_000, 100_001, 8000):
        q = quaternion_from_euler(0.0, 0.3 + 2e-6 * away_us, 0.0)
        senses.update(AttitudeSample(at_us + away_us, 0, q), NO_CONTACT)
    imu = ImuSample(1_000_000, 0, (0.0, 0.0, -9.81), (0.0, 2.0, 0.0))
    assert senses.update(imu, NO_CONTACT).estimate is not None
    assert senses.motion.attitude == pytest.approx(quaternion_from_euler(0.0, 0.3, 0.0), abs=1e-6)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_momenta_are_the_integral_of_the_specific_force_without_bias(seed: int) -> None:
    """After a gap, the integral starts again; gravity is not removed."""
    rng = random.Random(seed)
    frame = MissionFrame(1.0, 2.0, -3.0, rng.uniform(-3.0, 3.0))
    senses = sensing(VEHICLE, frame, LandedState.ON_GROUND)
    q = quaternion_from_euler(*(rng.uniform(-1.5, 1.5) for _ in range(3)))
    hover, momenta = senses.motion.hover, senses.motion.momenta
    hover.bias_x, hover.bias_y, hover.scale = 0.3, -0.2, 0.9

    def feed(t_us: int) -> Vec3:
        """Feed the sample of a stamp; return its specific force in the mission frame."""
        f = (rng.uniform(-20.0, 20.0), rng.uniform(-20.0, 20.0), rng.uniform(-20.0, 20.0))
        senses.update(AttitudeSample(t_us, 0, q), NO_CONTACT)
        senses.update(ActuatorSample(t_us, 0, (HOVER,) * 4), NO_CONTACT)
        assert senses.update(ImuSample(t_us, 0, f, (0.0, 0.0, 0.0)), NO_CONTACT).estimate is not None
        return frame.vector_from_ned(rotate(q, (f[0] - 0.3, f[1] + 0.2, f[2])))

    feed(1_000_000)
    for later_us in (1_004_000, 1_012_000, 1_012_000 + GAP_US):
        t_us, *before = momenta[-1]
        force = feed(later_us)
        expected = [p + MASS * a * (later_us - t_us) * 1e-6 for p, a in zip(before, force, strict=True)]
        assert momenta[-1] == pytest.approx((later_us, *expected))
    assert len(momenta) == 4
    feed(1_012_000 + 2 * GAP_US + 1)
    assert len(momenta) == 1


def test_arm_vibration_is_removed_from_the_force() -> None:
    arms = known(VEHICLE.estimation.arm_vibration)
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
    arms = known(VEHICLE.estimation.arm_vibration)
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
    arms = known(VEHICLE.estimation.arm_vibration)
    filters = [ArmFilter(arms, 0.004) for _ in range(3)]
    for each in filters[:2]:
        each.remove(30.0, -20.0, 0.004)
    jumped, stepped, fresh = filters
    for _ in range(gap):
        swinging = stepped.remove(1.0, 2.0, 0.004)
    found = jumped.remove(1.0, 2.0, 0.004 * gap)
    assert found == pytest.approx(fresh.remove(1.0, 2.0, 0.004) if rests else swinging, rel=1e-12)


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
