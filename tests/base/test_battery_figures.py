"""Battery figures as text, shared by the guard, `check` and the monitor; angles wrapped in degrees."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_flight.base.geometry import wrap_deg
from dart_flight.base.text import battery_figures
from dart_flight.vehicle.batteries import describe_reading
from dart_flight.vehicle.messages import BatteryReading


@pytest.mark.parametrize(
    ("remaining", "voltage_v", "figures"),
    [(0.954, 16.24, ["95 %", "16.2 V"]), (None, 16.2, ["16.2 V"]), (0.1, None, ["10 %"]), (None, None, [])],
)
def test_battery_figures_contain_only_the_known_values(
    remaining: float | None, voltage_v: float | None, figures: list[str]
) -> None:
    assert battery_figures(remaining, voltage_v) == figures
    reading = BatteryReading(3, voltage_v, remaining, flies=True)
    assert describe_reading(reading) == f"id 3: {', '.join(figures[::-1])}"


@given(st.floats(-1e4, 1e4), st.integers(-3, 3))
def test_wrapping_an_angle_ignores_whole_turns(angle_deg: float, turns: int) -> None:
    wrapped = wrap_deg(angle_deg + 360.0 * turns)
    assert -180.0 - 1e-9 <= wrapped < 180.0 + 1e-9
    assert math.cos(math.radians(wrapped - angle_deg)) == pytest.approx(1.0, abs=1e-9)
