"""Calibration values, travel time, the horn's model, and refused configurations."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.records import Mode
from dart_flight.config.document import Document, InputError
from dart_flight.config.vehicle import LockConfig, LockDriver, VehicleConfig, packaged
from dart_flight.lock import servo as calibration
from dart_flight.lock.servo import ServoFaults, ServoModel
from tests.lock.rigs import Vary


@pytest.mark.parametrize(
    ("supply_v", "seconds"), [(4.8, 0.285), (6.0, 0.225), (5.4, 0.255)]
)  # 1.5 times the catalogue's 0.19 and 0.15 s per 60 degrees, and the mean of the two
def test_travel_time_depends_on_the_supply_voltage(vary: Vary, supply_v: float, seconds: float) -> None:
    servo = vary(servo={"supply_v": supply_v}).servo
    assert servo.full_travel_s == pytest.approx(seconds)


def test_a_measured_travel_time_overrides_the_catalogue(vary: Vary) -> None:
    servo = vary(servo={"supply_v": 6.0, "travel_s": 0.4}).servo
    assert servo.full_travel_s == pytest.approx(0.4)


def test_the_controllers_speed_limit_lengthens_the_switch_time(vary: Vary) -> None:
    limited = vary(driver=LockDriver.MAESTRO, maestro={"speed_limit_us_s": 1600.0})
    assert limited.switch_time_s == pytest.approx(0.6 + 0.03)


def test_a_horn_position_has_a_mode_only_near_an_end(vary: Vary) -> None:
    servo = vary().servo
    assert calibration.mode_of(servo, 1975.0) is Mode.RIGID
    assert calibration.mode_of(servo, 1027.9) is Mode.FLEXIBLE
    assert calibration.mode_of(servo, 1030.0) is None


# --- the model of the horn -----------------------------------------------------------------------------


def test_the_horn_arrives_after_the_travel_time(vary: Vary) -> None:
    model = ServoModel(vary().servo, 1020.0)
    model.command(1_000_000, 1980.0)
    assert model.pulse_at(1_142_500) == pytest.approx(1500.0)
    assert model.pulse_at(1_284_000) < 1980.0
    assert model.pulse_at(1_285_000) == pytest.approx(1980.0)
    assert model.pulse_at(1_000_000) == pytest.approx(1980.0)  # an earlier timestamp is ignored


def test_the_horn_stops_without_pulses_and_at_its_end_stops(vary: Vary) -> None:
    model = ServoModel(vary().servo, 1020.0)
    model.command(0, 5000.0)
    model.command(142_500, None)
    assert model.pulse_at(5_000_000) == pytest.approx(1500.0)
    model.command(5_000_000, 5000.0)
    assert model.pulse_at(9_000_000) == pytest.approx(2100.0)


@pytest.mark.parametrize(
    ("faults", "at_285_ms", "at_last"),
    [
        (ServoFaults(stuck=True), 1020.0, 1020.0),
        (ServoFaults(slow=3.0), 1340.0, 1980.0),
        (ServoFaults(stall_fraction=0.5), 1500.0, 1500.0),
    ],
)
def test_faults_stop_or_slow_the_horn(
    vary: Vary, faults: ServoFaults, at_285_ms: float, at_last: float
) -> None:
    model = ServoModel(vary().servo, 1020.0, faults)
    model.command(0, 1980.0)
    assert model.pulse_at(285_000) == pytest.approx(at_285_ms)
    assert model.pulse_at(3_000_000) == pytest.approx(at_last)


def test_a_stall_acts_in_both_directions_and_can_be_cleared(vary: Vary) -> None:
    model = ServoModel(vary().servo, 1980.0, ServoFaults(stall_fraction=0.5))
    model.command(0, 1020.0)
    assert model.pulse_at(1_000_000) == pytest.approx(1500.0)
    assert model.pulse_at(2_000_000) == pytest.approx(1500.0)
    model.set_faults(2_000_000, ServoFaults())
    assert model.pulse_at(3_000_000) == pytest.approx(1020.0)


@given(
    steps=st.lists(
        st.tuples(st.integers(0, 400_000), st.none() | st.floats(0.0, 4000.0)), min_size=1, max_size=20
    ),
    slow=st.floats(0.2, 10.0),
)
def test_the_horn_never_leaves_its_end_stops_or_exceeds_the_motor_speed(
    lock_config: LockConfig, steps: list[tuple[int, float | None]], slow: float
) -> None:
    servo = lock_config.servo
    model = ServoModel(servo, 1500.0, ServoFaults(slow=slow))
    t_us, before = 0, model.pulse_at(0)
    for elapsed, pulse in steps:
        t_us += elapsed
        now = model.pulse_at(t_us)
        assert 900.0 <= now <= 2100.0
        assert abs(now - before) <= elapsed * 1e-6 * servo.us_per_deg / servo.s_per_deg / slow + 1e-6
        model.command(t_us, pulse)
        before = now


# --- refused configurations --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "key", "expected"),
    [
        ("rigid_pulse_us: 1980.0", "rigid_pulse_us: 2200.0", "lock.servo", "rigid_pulse_us must be within"),
        ("rigid_pulse_us: 1980.0", "rigid_pulse_us: 1020.0", "lock.servo", "must differ by more than"),
        ("rigid_pulse_us: 1980.0", "rigid_pulse_us: -5", "lock.servo.rigid_pulse_us", "> 0"),
        ("min_pulse_us: 900.0  ", "min_pulse_us: 2100.0  ", "lock.servo", "must be below max_pulse_us"),
        ("direction: 1 ", "direction: -1 ", "lock.servo", "direction -1 contradicts"),
        ("direction: 1 ", "direction: 2 ", "lock.servo.direction", "2"),
        (
            "theta0_deg: 0.0",
            "theta0_deg: 20.0",
            "lock",
            "flexible_deg 0 is outside the cam's range 20 to 110",
        ),
        (
            "rigid_deg: 90.0",
            "rigid_deg: 60.0",
            "lock",
            "exceeds the servo's end stops: 90 degrees needs 2460 us",
        ),
        ("rigid_deg: 90.0", "rigid_deg: 0.0", "lock.servo", "rigid_deg and flexible_deg must differ"),
        ("r_mm: 8.0", "r_mm: 23.0", "lock.cam", "must not exceed r_cam_mm"),
        ("supply_v: 4.8", "supply_v: 12.0", "lock.servo.supply_v", "<= 6"),
        ("travel_s: null", "travel_s: 1.6", "lock", "timeout_s 1.5 must be longer than the travel"),
        ("timeout_s: 1.5", "timeout_s: 0.3", "lock", "must be longer than the travel"),
        (
            "limit_switch: null",
            "limit_switch: {chip: /dev/gpiochip0}",
            "lock.limit_switch",
            "needs rigid_line",
        ),
        (
            "limit_switch: null",
            "limit_switch: {chip: c, rigid_line: 3, flexible_line: 3}",
            "lock.limit_switch",
            "must differ",
        ),
        ("driver: mock", "driver: hand", "lock.driver", "only: " + ", ".join(LockDriver)),
        ("min_pulse_us: 900.0 ", "min_pulse_us: 700.0 ", "lock.px4.min_pulse_us", ">= 800"),
        ("startup: home", "startup: guess", "lock.startup", "only: home, adopt"),
    ],
)
def test_an_invalid_configuration_is_reported_in_one_line(
    old: str, new: str, key: str, expected: str
) -> None:
    text = packaged("configs", "dart.yaml").read_text()
    assert old in text
    index = text.rindex(old) if key.startswith("lock.px4") else text.index(old)
    text = text[:index] + new + text[index + len(old) :]
    with pytest.raises(InputError) as caught:
        Document(text, "dart.yaml").convert(VehicleConfig)
    line = caught.value.one_line()
    assert "\n" not in line
    assert f": {key}: " in line
    assert expected in line
    assert line.startswith("dart.yaml:")
