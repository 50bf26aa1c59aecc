"""Statistics of the simulated sensors that PX4 receives."""

from __future__ import annotations

import itertools
import math
import random
import statistics

import msgspec
import pytest

from dart_flight.base.geometry import quaternion_from_euler
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import ImuRinging, load_vehicle, packaged
from dart_flight.sim.noise import GaussianNoise
from dart_flight.sim.plant import Plant, make_plant
from dart_flight.sim.sensors import (
    GPS_QUALITIES,
    Barometer,
    GpsReceiver,
    ImuSensor,
    Magnetometer,
    altitude_m,
    pressure_hpa,
)
from dart_flight.sim.wind import GUST_TIME_S, Wind


@pytest.fixture
def plant() -> Plant:
    return make_plant(load_mission(packaged("missions", "paper_dual_collision.yaml")))


def fixes_of(receiver: GpsReceiver, plant: Plant, seconds: float) -> list[tuple[float, float, float]]:
    found = []
    for i in range(round(seconds * 250)):
        plant.time_s = i * 0.004
        fix = receiver.measure(plant)
        if fix is not None:
            found.append(fix.position_ned)
    return found


@pytest.mark.parametrize(("name", "sigma"), [("rtk", 0.02), ("plain", 1.0)])
def test_the_gps_error_has_the_specified_size(name: str, sigma: float, plant: Plant) -> None:
    north: list[float] = []
    for seed in range(60):
        receiver = GpsReceiver(GPS_QUALITIES[name], GaussianNoise(random.Random(seed)))
        north += [fix[0] for fix in fixes_of(receiver, plant, 4.0)]
    assert statistics.pstdev(north) == pytest.approx(sigma, rel=0.2)


def test_the_gps_error_drifts_without_jumps(plant: Plant) -> None:
    fixes = fixes_of(GpsReceiver(GPS_QUALITIES["plain"], GaussianNoise(random.Random(3))), plant, 60.0)
    steps = [abs(b[0] - a[0]) for a, b in itertools.pairwise(fixes)]
    assert statistics.mean(steps) < 0.15
    assert max(f[0] for f in fixes) - min(f[0] for f in fixes) > 0.3


def test_a_gps_fix_is_delayed_by_0_1_s(plant: Plant) -> None:
    receiver = GpsReceiver(GPS_QUALITIES["rtk"], GaussianNoise(random.Random(1)))
    north = []
    for i in range(250):
        plant.time_s = i * 0.004
        plant.position = (5.0 * plant.time_s, 0.0, 0.0)
        fix = receiver.measure(plant)
        if fix is not None:
            north.append((plant.time_s, fix.position_ned[0]))
    assert statistics.mean(t - n / 5.0 for t, n in north) == pytest.approx(0.1, abs=0.02)


def test_the_barometer_follows_the_standard_atmosphere(plant: Plant) -> None:
    assert pressure_hpa(0.0) == pytest.approx(1013.25)
    assert pressure_hpa(1000.0) == pytest.approx(898.75, abs=0.2)  # standard atmosphere
    assert altitude_m(pressure_hpa(488.0)) == pytest.approx(488.0, abs=1e-6)
    barometer = Barometer(GaussianNoise(random.Random(1)), 488.0)
    plant.position = (0.0, 0.0, -2.0)
    heights = [barometer.measure(plant)[1] for _ in range(400)]
    assert statistics.mean(heights) == pytest.approx(490.0, abs=0.05)
    assert 0.04 < statistics.pstdev(heights) < 0.15


def test_the_measured_magnetic_field_rotates_with_the_vehicle(plant: Plant) -> None:
    magnetometer = Magnetometer(GaussianNoise(random.Random(1)), (0.2, 0.0, 0.4))
    plant.q = quaternion_from_euler(0.0, 0.0, math.radians(90.0))  # nose to the east: north is to the left
    fields = [magnetometer.measure(plant) for _ in range(200)]
    means = [statistics.mean(f[i] for f in fields) for i in range(3)]
    assert means == pytest.approx([0.0, -0.2, 0.4], abs=0.002)


def test_noise_does_not_lift_a_saturated_reading_off_full_scale() -> None:
    vehicle = load_vehicle()
    scale = vehicle.imu.full_scale_m_s2
    for seed in range(20):
        imu = ImuSensor(vehicle, GaussianNoise(random.Random(seed)))
        f, _ = imu.measure((-scale, scale, 0.0), (0.0, 0.0, 0.0))
        assert f[:2] == (-scale, scale)
        assert abs(f[2]) < 2.0


def test_stopped_motors_cause_no_vibration() -> None:
    vehicle = load_vehicle()
    ringing = ImuRinging(white_m_s2=3.0, tone_m_s2=3.0)
    simulation = msgspec.structs.replace(vehicle.simulation, imu_ringing=ringing)
    imu = ImuSensor(msgspec.structs.replace(vehicle, simulation=simulation), GaussianNoise(random.Random(1)))
    spread = {
        turn: statistics.pstdev(
            imu.measure((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), turn)[0][0] for _ in range(2000)
        )
        for turn in (False, True)
    }
    assert spread[False] == pytest.approx(vehicle.simulation.imu_noise_m_s2, rel=0.1)
    assert spread[True] == pytest.approx(math.hypot(3.0, 3.0), rel=0.1)


def test_gusts_have_the_configured_size_and_correlation_time(plant: Plant) -> None:
    lag = 125  # steps after which the correlation is 1/e
    simulation = msgspec.structs.replace(
        load_vehicle().simulation, wind_north_east_m_s=(2.0, -1.0), gust_m_s=0.8
    )
    wind = Wind(simulation, 1, GUST_TIME_S / lag)
    north, east = [], []
    for _ in range(100_000):
        wind.step(plant)
        north.append(plant.wind_ned[0])
        east.append(plant.wind_ned[1])
    assert statistics.mean(north) == pytest.approx(2.0, abs=0.15)
    assert statistics.mean(east) == pytest.approx(-1.0, abs=0.15)
    assert statistics.pstdev(north) == pytest.approx(0.8, rel=0.1)
    mean = statistics.mean(north)
    correlation = statistics.mean(
        (a - mean) * (b - mean) for a, b in zip(north, north[lag:], strict=False)
    ) / statistics.pvariance(north)
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.1)
