"""Arming problems in plain text: PX4's checks as MAVSDK reports them, or the sensors of SYS_STATUS."""

from __future__ import annotations

import pytest
from mavsdk.plugins.events import (
    HealthAndArmingCheckMode,
    HealthAndArmingCheckProblem,
    HealthAndArmingCheckReport,
    LogLevel,
)

from dart_flight.vehicle.arming_problems import report_from_checks, report_from_sys_status, severity
from dart_flight.vehicle.messages import Sensors


def problem(text: str, level: LogLevel = LogLevel.ERROR) -> HealthAndArmingCheckProblem:
    return HealthAndArmingCheckProblem(text, "", level, "system")


def test_blocking_problems_are_separated_from_those_of_other_modes() -> None:
    blocking = [problem("No valid position estimate"), problem("Home position not set", LogLevel.INFO)]
    everything = [*blocking, problem("No manual control input"), problem("No valid position estimate")]
    report = HealthAndArmingCheckReport(HealthAndArmingCheckMode("Hold", False, blocking), [], everything)
    assert report_from_checks(report) == (
        False,
        ("No valid position estimate",),
        ("No manual control input",),
    )
    report.current_mode_intention.can_arm_or_run = True
    assert report_from_checks(report)[:2] == (True, ())


EVERY, PREARM, MAGNETOMETER = 1 << 28 | 0b1111, 1 << 28, 1 << 2


@pytest.mark.parametrize(
    ("enabled", "healthy", "sensors"),
    [
        (EVERY, EVERY, None),
        (EVERY, EVERY & ~PREARM & ~MAGNETOMETER, ("magnetometer not healthy",)),
        (EVERY, EVERY & ~PREARM, ()),
        # PX4 v1.14.2 in simulation: in Hold it would not arm without a global position.
        (35749897, 572555327, ("remote control not healthy",)),
    ],
)
def test_failed_preflight_checks_and_unhealthy_enabled_sensors_are_named(
    enabled: int, healthy: int, sensors: tuple[str, ...] | None
) -> None:
    failed = (False, ("preflight checks failed",), sensors)
    expected = (True, (), ()) if sensors is None else failed
    assert report_from_sys_status(Sensors(enabled, healthy)) == expected


def test_event_levels_are_converted_to_severities_of_texts() -> None:
    assert severity(LogLevel.CRITICAL) == "critical"
    assert severity(LogLevel.WARNING) == "warning"
    assert severity(9) == "debug"
