"""Calibration of the two ends in small steps."""

from __future__ import annotations

from itertools import pairwise
from unittest.mock import Mock

import pytest

from dart_flight.base.records import Mode
from dart_flight.lock import ground
from dart_flight.lock.calibration import STEP_US, Calibration, CalibrationError
from dart_flight.lock.state_machine import DriverReading
from tests.lock.rigs import Vary


def test_both_ends_are_reached_in_small_steps_and_confirmed(vary: Vary) -> None:
    moved = [1500.0]
    steps = Calibration(vary(), 1500.0, moved.append)
    for line in ("-", "-100", "1064.5", "ok\n"):
        assert steps.current_end is Mode.FLEXIBLE
        steps.execute(line)
    for line in ("1900", "+", " +22.25 ", "OK"):
        steps.execute(line)
    assert steps.current_end is None
    assert steps.found == {Mode.FLEXIBLE: 1064.5, Mode.RIGID: 1932.25}
    assert max(abs(b - a) for a, b in pairwise(moved)) <= STEP_US + 1e-9
    assert moved[-1] == 1932.25
    assert steps.values() == {
        ("lock", "servo", "rigid_pulse_us"): 1932.25,
        ("lock", "servo", "flexible_pulse_us"): 1064.5,
        ("lock", "servo", "direction"): 1,
    }


def test_a_mirrored_cam_has_a_negative_direction(vary: Vary) -> None:
    steps = Calibration(vary(), 1950.0, lambda pulse: None)
    for line in ("ok", "1050", "ok"):
        steps.execute(line)
    assert steps.values()["lock", "servo", "direction"] == -1
    assert steps.result().servo.us_per_deg == pytest.approx(10.0)


@pytest.mark.parametrize("line", ["", "up", "+-3", "nan", "inf", "899", "2100.5", "-700", "1e9"])
def test_an_invalid_step_does_not_move_the_servo(vary: Vary, line: str) -> None:
    moved: list[float] = []
    steps = Calibration(vary(), 1500.0, moved.append)
    with pytest.raises(CalibrationError):
        steps.execute(line)
    assert moved == []


def test_two_ends_at_the_same_pulse_are_refused(vary: Vary) -> None:
    steps = Calibration(vary(), 1500.0, lambda pulse: None)
    steps.execute("ok")
    with pytest.raises(CalibrationError, match="must differ"):
        steps.execute("ok")
    assert steps.current_end is Mode.RIGID
    for line in ("1980", "ok"):
        steps.execute(line)
    with pytest.raises(CalibrationError, match="both ends"):
        steps.execute("ok")


@pytest.mark.parametrize(("rigid_us", "apart"), [("1940", 440), ("1100", 400), ("1540", 40)])
def test_ends_too_close_for_any_cam_are_refused(vary: Vary, rigid_us: str, apart: int) -> None:
    steps = Calibration(vary(), 1500.0, lambda pulse: None)
    steps.execute("ok")
    steps.execute(rigid_us)
    with pytest.raises(
        CalibrationError,
        match=f"the ends are {apart} us apart, but a turn of the cam by .* degrees needs 450 us",
    ):
        steps.execute("ok")
    assert steps.current_end is Mode.RIGID
    steps.execute("1960")
    steps.execute("ok")
    assert steps.result().servo.us_per_deg == pytest.approx(460.0 / 90.0)


def test_a_failed_step_keeps_the_last_reached_position(vary: Vary) -> None:
    def fail_above_1520(pulse_us: float) -> None:
        if pulse_us > 1520.0:
            raise TimeoutError

    steps = Calibration(vary(), 1500.0, fail_above_1520)
    with pytest.raises(TimeoutError):
        steps.execute("+100")
    assert steps.pulse_us == 1520.0


# --- on the ground -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("held_us", "start_us"), [(1400.0, 1400.0), (None, 1500.0)])
def test_calibration_starts_at_the_current_pulse_or_the_middle(
    vary: Vary, held_us: float | None, start_us: float
) -> None:
    driver, moved = Mock(), list[float]()
    driver.read.return_value = DriverReading(pulse_us=held_us)
    driver.set_pulse.side_effect = moved.append
    steps = ground.calibration(vary(servo={"min_pulse_us": 900.0, "max_pulse_us": 2100.0}), driver)
    assert (steps.pulse_us, moved) == (start_us, [])
    steps.execute("+15")
    assert moved[-1] == steps.pulse_us == start_us + 15.0
