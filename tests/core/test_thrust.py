"""Thrust from motor commands or motor speeds, and the effect of the battery's voltage."""

from __future__ import annotations

import math

import msgspec
import pytest

from dart_flight.base.geometry import IDENTITY
from dart_flight.base.records import ActuatorSample, AttitudeSample, EscSample, ImuSample, StatusSample
from dart_flight.config.vehicle import ThrustSource
from dart_flight.core.sense.detector import ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.core.sense.thrust_model import LaggedCommands, ThrustModel
from tests.core.conftest import HOVER, known
from tests.core.pulses import MASS, VEHICLE, with_estimation


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
    senses = Senses(vehicle)

    def run(first_us: int, rpm: float | None = None) -> float:
        for t in range(first_us, first_us + 200_000, 4000):
            senses.update(AttitudeSample(t, t, IDENTITY), ExpectedContact())
            senses.update(ActuatorSample(t, t, (HOVER,) * 4), ExpectedContact())
            if rpm is not None:
                senses.update(EscSample(t, t, (rpm,) * 4), ExpectedContact())
            senses.update(ImuSample(t, t, (0.0, 0.0, -9.81), (0.0, 0.0, 0.0)), ExpectedContact())
        each_n = known(senses.motion.thrust.each_n)
        return sum(each_n)

    full_n = run(1_000_000)
    senses.update(StatusSample(0, 0, battery_v=0.9 * battery.reference_v), ExpectedContact())
    assert run(1_200_000) == pytest.approx(full_n * 0.9**1.5, rel=1e-3)
    assert run(1_400_000, 17_000.0) == pytest.approx(4 * 1.1e-8 * 17_000.0**2, rel=1e-3)
