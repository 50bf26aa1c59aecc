"""PX4's reasons in words: its checks as MAVSDK reports them, else the sensors of SYS_STATUS."""

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


def test_what_blocks_comes_before_what_is_wrong_for_other_modes() -> None:
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


def test_sensors_in_use_that_are_not_well_are_named() -> None:
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


def test_a_check_that_fails_in_v1_14_is_not_among_what_is_in_use() -> None:
    """SYS_STATUS of v1.14.2 in simulation, indoors, in Hold: without a global position it would not arm."""
    assert report_from_sys_status(sys_status(35749897, 572555327)) == (
        False,
        ("preflight checks failed",),
        ("remote control not healthy",),
    )


def test_levels_of_events_are_those_of_texts() -> None:
    assert severity(LogLevel.CRITICAL) == "critical"
    assert severity(LogLevel.WARNING) == "warning"
    assert severity(9) == "debug"
