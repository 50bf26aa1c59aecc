"""Arming problems in plain text: PX4's checks as MAVSDK reports them, or the sensors of SYS_STATUS."""

from __future__ import annotations

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


def sys_status(enabled: int, healthy: int) -> Sensors:
    return Sensors(enabled, healthy)


def test_unhealthy_enabled_sensors_are_named() -> None:
    every = 1 << 28 | 1 | 2 | 4 | 8
    assert report_from_sys_status(sys_status(every, every)) == (True, (), ())
    assert report_from_sys_status(sys_status(every, every & ~4 & ~(1 << 28))) == (
        False,
        ("preflight checks failed",),
        ("magnetometer not healthy",),
    )
    assert report_from_sys_status(sys_status(every, every & ~(1 << 28))) == (
        False,
        ("preflight checks failed",),
        (),
    )


def test_failed_preflight_checks_of_px4_1_14_are_reported() -> None:
    """SYS_STATUS of PX4 v1.14.2 in simulation: in Hold it would not arm without a global position."""
    assert report_from_sys_status(sys_status(35749897, 572555327)) == (
        False,
        ("preflight checks failed",),
        ("remote control not healthy",),
    )


def test_event_levels_are_converted_to_severities_of_texts() -> None:
    assert severity(LogLevel.CRITICAL) == "critical"
    assert severity(LogLevel.WARNING) == "warning"
    assert severity(9) == "debug"
