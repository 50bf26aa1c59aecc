"""The checks of a vehicle on the ground: round trip, estimator, autopilot, mode, airframe and lock.

Parameters, telemetry and the vehicle's place have their own modules.
"""

from __future__ import annotations

from collections.abc import Mapping

from dart_flight.check.findings import CheckFinding
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.rotors import motors_from_parameters, rotor_differences
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.drivers import DRIVERS, driver_names
from dart_flight.lock.drivers.px4_output import parameter_problems
from dart_flight.vehicle.ground_link import HeartbeatMode, Observation


def round_trip_limit_s(mission: Mission) -> float:
    """Return the longest allowed round trip, seconds: twice `guard.telemetry_late_s`."""
    return 2.0 * mission.vehicle.guard.telemetry_late_s


def evaluate_round_trip(mission: Mission, seconds: float | None) -> CheckFinding:
    """Check the round trip, an upper bound of the samples' delay; `seconds` is None without an answer."""
    item, limit_s = "round_trip", round_trip_limit_s(mission)
    if seconds is None:
        return CheckFinding(item, True, "the vehicle does not answer TIMESYNC", remark=True)
    message = f"{seconds * 1e3:.0f} ms between vehicle and program, limit {limit_s * 1e3:.0f} ms"
    return CheckFinding(item, seconds <= limit_s, message)


def evaluate_observation(observed: Observation) -> list[CheckFinding]:
    """Check the PX4 version, the estimator, and whether other vehicles share the link."""
    findings = [
        CheckFinding(
            "version",
            True,
            f"PX4 {observed.version}" if observed.version else "PX4 does not report its version",
        )
    ]
    if observed.other_vehicle is not None:
        findings.append(CheckFinding("second_vehicle", False, observed.other_vehicle))
    reasons = ", ".join(dict.fromkeys([*observed.blocking, *observed.texts]))
    message = "the local position is valid"
    if not observed.local_position_ok:
        message = "; ".join(["no valid local position", *observed.own_findings])
        message += f"; PX4 reports: {reasons}" if reasons else ""
    findings.append(CheckFinding("estimator", observed.local_position_ok, message))
    if observed.blocking or observed.texts:
        # This is only a remark: PX4 checks its current mode, but `fly` arms in offboard mode.
        begin = "PX4 would refuse to arm: " if observed.blocking else "PX4 reports: "
        findings.append(CheckFinding("px4_checks", True, begin + reasons, remark=True))
    return findings


def evaluate_autopilot(mode: HeartbeatMode | None) -> list[CheckFinding]:
    """Return a no-go that names the autopilot if it is not PX4."""
    if mode is None or not mode.not_px4:
        return []
    message = f"heartbeats arrive, but {mode.not_px4}: this program supports only PX4"
    return [CheckFinding("autopilot", False, message)]


def evaluate_mode(mode: HeartbeatMode | None) -> list[CheckFinding]:
    """Return a no-go if the vehicle has used simulated sensors since its start.

    The current value of SYS_HITL does not matter, because a new value takes effect only after a restart.
    """
    if mode is None or not mode.hil:
        return []
    message = "PX4 uses simulated sensors (hardware in the loop): set SYS_HITL to 0 and restart PX4"
    return [CheckFinding("hil_mode", False, message)]


def evaluate_airframe(mission: Mission, values: Mapping[str, float]) -> list[CheckFinding]:
    """Compare the motors in PX4's parameters with the motors in the configuration.

    A different number, order or direction of the motors invalidates the estimated thrust and torque. A
    different distance is only a remark, because distances only scale the torque, and PX4 accepts them in any
    unit.
    """
    item, motors = "airframe", mission.vehicle.airframe.motors
    try:
        actual = motors_from_parameters(values, "PX4")
    except InputError as error:
        return [CheckFinding(item, True, f"not compared: {error}", remark=True)]
    other, sizes = rotor_differences(motors, actual)
    if other:
        hint = "; `calibrate airframe` prints PX4's motor geometry"
        return [CheckFinding(item, False, "; ".join(other) + hint)]
    if sizes:
        return [CheckFinding(item, True, "; ".join(sizes) + ": measure and set both", remark=True)]
    return [CheckFinding(item, True, f"{len(motors)} motors, as in PX4")]


def evaluate_lock(mission: Mission, values: Mapping[str, float]) -> list[CheckFinding]:
    lock = mission.vehicle.lock
    if lock is None:
        return []
    if not DRIVERS[lock.driver].moves:
        real = driver_names(lambda entry: entry.moves)
        message = f"lock.driver is {lock.driver.value}: no real servo moves; choose {real} (--driver)"
        return [CheckFinding("lock_driver", False, message)]
    if lock.driver is not LockDriver.PX4:
        return [
            CheckFinding("lock_driver", True, f"{lock.driver.value}; try it with `dart-flight lock toggle`")
        ]
    problems = parameter_problems(lock, values)
    return [
        CheckFinding(
            "lock_driver", not problems, "; ".join(problems) or "PX4's output is set up for the servo"
        )
    ]
