"""What the checks of a mission alone find."""

from dart_flight.check.checks import FlightContext, select_checks
from dart_flight.check.findings import CheckFinding
from dart_flight.check.stages import Stage, run_checks
from dart_flight.config.mission import Mission


def check_mission(mission: Mission) -> list[CheckFinding]:
    """Run the checks that need no vehicle and no computer."""
    return run_checks(select_checks(Stage.FILE), FlightContext(mission))
