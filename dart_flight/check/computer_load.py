"""Whether the computer has time for a flight."""

from __future__ import annotations

from dart_flight.base.processes import LATE_S, measure_lateness_s
from dart_flight.check.findings import CheckFinding
from dart_flight.config.mission import Mission


def check_lateness(mission: Mission) -> CheckFinding:
    """Measure for half a second how late this program runs: a no-go where the guard would see silence."""
    late_s = measure_lateness_s()
    says = f"this program lags by up to {late_s * 1e3:.0f} ms"
    if late_s <= LATE_S:
        return CheckFinding("lateness", True, says)
    says += ": the computer cannot keep up with a real-time flight (use `dry-run --fast` or --speed 0.5)"
    go = late_s <= mission.vehicle.guard.stream_timeout_s
    return CheckFinding("lateness", go, says, remark=go)
