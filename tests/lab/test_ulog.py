"""Reading ULogs: motor outputs of several PX4 versions and output types, battery and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dart_flight.config.document import InputError
from dart_flight.lab.ulog import battery, motor_commands, open_ulog
from tests.doubles.ulog_file import Topics, write_ulog

pytest.importorskip("pyulog")

TOPICS = ("actuator_motors", "actuator_outputs", "battery_status")
SHARES = (0.2, 0.5, 0.8)


def motor_outputs(
    low: float, high: float, others: float = 0.0
) -> tuple[str, list[tuple[float, list[float]]]]:
    """Return outputs of four motors at shares of a range, and of four constant channels."""
    rows = [(1e6 + 1e4 * i, [low + (high - low) * SHARES[i % 3]] * 4 + [others] * 4) for i in range(60)]
    return "float[8] output;", rows


def decode_commands(
    tmp_path: Path, topics: Topics, parameters: dict[str, float] | None = None
) -> tuple[set[float], str]:
    found = motor_commands(open_ulog(write_ulog(tmp_path / "a.ulg", topics, parameters), TOPICS))
    return {round(float(v), 3) for v in found.values.ravel()}, found.description


@pytest.mark.parametrize(
    ("low", "high", "parameters", "expected"),
    [
        (1000.0, 2000.0, {}, "PWM 1000 to 2000"),
        (1075.0, 1950.0, {"PWM_MIN": 1075.0, "PWM_MAX": 1950.0}, "PWM 1075 to 1950"),
        (
            1100.0,
            1900.0,
            {"PWM_MIN": 1000.0, "PWM_MAIN_MIN": 1100.0, "PWM_MAIN_MAX": 1900.0},
            "PWM 1100 to 1900",
        ),
        (
            1200.0,
            1950.0,
            {
                f"PWM_MAIN_{end}{pin}": v
                for pin in range(1, 5)
                for end, v in (("MIN", 1200.0), ("MAX", 1950.0))
            }
            | {"PWM_MAIN_MIN": 1000.0},
            "PWM 1200 to 1950",
        ),
        (0.0, 1999.0, {}, "DShot"),
        (0.0, 8191.0, {}, "UAVCAN"),
        (0.0, 1.0, {}, "0 to 1"),
    ],
)
def test_motor_outputs_of_every_type_are_normalised(
    tmp_path: Path, low: float, high: float, parameters: dict[str, float], expected: str
) -> None:
    values, description = decode_commands(
        tmp_path, {("actuator_outputs", 0): motor_outputs(low, high)}, parameters
    )
    assert values == set(SHARES)
    assert expected in description


def test_the_instance_with_moving_motors_is_used(tmp_path: Path) -> None:
    constant = ("float[8] output;", [(1e6 + 1e4 * i, [1500.0] * 8) for i in range(60)])
    topics = {("actuator_outputs", 0): constant, ("actuator_outputs", 1): motor_outputs(1000.0, 2000.0)}
    values, description = decode_commands(tmp_path, topics)
    assert values == set(SHARES)
    assert "actuator_outputs[1]" in description


def test_actuator_motors_take_precedence_and_unused_motors_are_omitted(tmp_path: Path) -> None:
    nan = float("nan")
    rows = [(1e6 + 1e4 * i, [SHARES[i % 3]] * 6 + [nan] * 6) for i in range(60)]
    topics = {
        ("actuator_motors", 0): ("float[12] control;", rows),
        ("actuator_outputs", 0): motor_outputs(0.0, 1.0),
    }
    values, description = decode_commands(tmp_path, topics)
    assert values == set(SHARES)
    assert description == "actuator_motors, 6 motors"


def test_outputs_that_never_vary_are_refused(tmp_path: Path) -> None:
    constant = ("float[8] output;", [(1e6 + 1e4 * i, [900.0] * 8) for i in range(60)])
    with pytest.raises(InputError, match="no output in actuator_outputs varies"):
        decode_commands(tmp_path, {("actuator_outputs", 0): constant})


@pytest.mark.parametrize(("volts", "kept"), [(0.05, 0), (float("nan"), 0), (16.2, 20)])
def test_implausible_voltages_are_discarded(tmp_path: Path, volts: float, kept: int) -> None:
    rows = [(1e6 + 1e5 * i, [volts]) for i in range(20)]
    log = open_ulog(
        write_ulog(tmp_path / "a.ulg", {("battery_status", 0): ("float voltage_v;", rows)}), TOPICS
    )
    found = battery(log)
    assert len(found.volts) == kept
    assert bool(found.problem) == (kept == 0)


def test_version_and_samples_are_read(tmp_path: Path) -> None:
    topics = {("battery_status", 0): ("float voltage_v;", [(1e6, [16.0])])}
    path = write_ulog(tmp_path / "a.ulg", topics, release=0x010B02FF)
    assert open_ulog(path, TOPICS).version == (1, 11, 2)
    np.testing.assert_array_equal(open_ulog(path, TOPICS).topics["battery_status"][0]["voltage_v"], [16.0])
