"""ULogs opened: motor outputs of several versions and output types, battery, refusals."""

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


def outputs(low: float, high: float, others: float = 0.0) -> tuple[str, list[tuple[float, list[float]]]]:
    """Four motors through the shares of a range, four further outputs at rest."""
    rows = [(1e6 + 1e4 * i, [low + (high - low) * SHARES[i % 3]] * 4 + [others] * 4) for i in range(60)]
    return "float[8] output;", rows


def commands(
    tmp_path: Path, topics: Topics, parameters: dict[str, float] | None = None
) -> tuple[set[float], str]:
    found = motor_commands(open_ulog(write_ulog(tmp_path / "a.ulg", topics, parameters), TOPICS))
    return {round(float(v), 3) for v in found.values.ravel()}, found.description


@pytest.mark.parametrize(
    ("low", "high", "parameters", "said"),
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
def test_outputs_are_decoded(
    tmp_path: Path, low: float, high: float, parameters: dict[str, float], said: str
) -> None:
    values, says = commands(tmp_path, {("actuator_outputs", 0): outputs(low, high)}, parameters)
    assert values == set(SHARES)
    assert said in says


def test_the_instance_with_the_motors_is_taken(tmp_path: Path) -> None:
    still = ("float[8] output;", [(1e6 + 1e4 * i, [1500.0] * 8) for i in range(60)])
    topics = {("actuator_outputs", 0): still, ("actuator_outputs", 1): outputs(1000.0, 2000.0)}
    values, says = commands(tmp_path, topics)
    assert values == set(SHARES)
    assert "actuator_outputs[1]" in says


def test_actuator_motors_come_first_and_only_those_that_turn(tmp_path: Path) -> None:
    nan = float("nan")
    rows = [(1e6 + 1e4 * i, [SHARES[i % 3]] * 6 + [nan] * 6) for i in range(60)]
    topics = {
        ("actuator_motors", 0): ("float[12] control;", rows),
        ("actuator_outputs", 0): outputs(0.0, 1.0),
    }
    values, says = commands(tmp_path, topics)
    assert values == set(SHARES)
    assert says == "actuator_motors, 6 motors"


def test_motors_that_do_not_move_are_none(tmp_path: Path) -> None:
    still = ("float[8] output;", [(1e6 + 1e4 * i, [900.0] * 8) for i in range(60)])
    with pytest.raises(InputError, match="no output in actuator_outputs varies"):
        commands(tmp_path, {("actuator_outputs", 0): still})


@pytest.mark.parametrize(("volts", "kept"), [(0.05, 0), (float("nan"), 0), (16.2, 20)])
def test_only_a_plausible_voltage_is_one(tmp_path: Path, volts: float, kept: int) -> None:
    rows = [(1e6 + 1e5 * i, [volts]) for i in range(20)]
    log = open_ulog(
        write_ulog(tmp_path / "a.ulg", {("battery_status", 0): ("float voltage_v;", rows)}), TOPICS
    )
    found = battery(log)
    assert len(found.volts) == kept
    assert bool(found.problem) == (kept == 0)


def test_the_version_is_read(tmp_path: Path) -> None:
    topics = {("battery_status", 0): ("float voltage_v;", [(1e6, [16.0])])}
    path = write_ulog(tmp_path / "a.ulg", topics, release=0x010B02FF)
    assert open_ulog(path, TOPICS).version == (1, 11, 2)
    np.testing.assert_array_equal(open_ulog(path, TOPICS).topics["battery_status"][0]["voltage_v"], [16.0])
