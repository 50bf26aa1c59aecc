"""Findings of the checks that need only a mission, for several tests."""

from dart_flight.check.checks import FlightContext, Stage, run_checks
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission


def check_mission(mission: Mission) -> list[CheckFinding]:
    """Run the checks that need no vehicle and no computer."""
    return run_checks(FlightContext(mission), Stage.FILE)
