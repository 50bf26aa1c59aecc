"""What a connected vehicle says of itself: parameters, and rates, battery and estimator as measured."""

from __future__ import annotations

import math
from collections.abc import Mapping

from dart_flight.check.findings import CheckFinding
from dart_flight.check.place_check import judge_place
from dart_flight.check.px4_parameters import (
    judge_parameters,
    judge_position,
    names_to_read,
    other_names,
    position_source,
)
from dart_flight.check.telemetry_check import (
    LOOPBACK,
    judge_battery,
    judge_motor_outputs,
    judge_rates,
    judge_resting_force,
    judge_sources,
    motor_output_names,
)
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import PositionSource, Version
from dart_flight.config.rotors import COUNT, motors_of, rotor_differences, rotor_names
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.drivers import DRIVERS, driver_names
from dart_flight.lock.drivers.px4_output import parameter_problems, required_parameters
from dart_flight.vehicle.ground_link import GroundLink, HeartbeatMode, Observation

_MEASURE_S = 3.0


def check_vehicle(
    mission: Mission, url: str, position_from: PositionSource | None = None
) -> list[CheckFinding]:
    """What a connected vehicle says of itself.

    Args:
        mission: what it is to fly.
        url: MAVSDK connection URL.
        position_from: what the operator believes; None: as the vehicle's parameters say.

    Raises:
        VehicleError: nothing answers at the URL.
        NoAnswerError: what answers there does not answer requests.
    """
    lock = mission.vehicle.lock
    with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
        mode = link.heartbeat_mode()
        other = judge_autopilot(mode)
        if other:
            return other  # another autopilot has neither PX4's parameters nor its modes
        late = judge_round_trip(mission, link.round_trip_s())
        if not late.go:
            return [late]  # over such a link the rest would take minutes, and tell nothing
        observed = link.observe(mission.vehicle, _MEASURE_S)
        version = _release_of(observed.version)
        names = [*names_to_read(version), COUNT]
        if lock is not None and lock.driver is LockDriver.PX4:
            names += [required.name for required in required_parameters(lock)]
        values = link.read_parameters(names)
        values |= link.read_parameters(dict.fromkeys(other_names(values)))
        values |= link.read_parameters(rotor_names(values.get(COUNT, 0.0)))
        values |= _read_outputs(link, len(mission.vehicle.airframe.motors))
        if any(s.reason for s in observed.sources if s.is_vehicle and s.sender.message == "ODOMETRY"):
            values |= link.read_parameters([LOOPBACK])
    found = position_source(values, observed.gps_fix)
    return [
        *judge_position(mission, found, observed.gps_fix, position_from),
        *judge_parameters(mission, values, position_from or found, version),
        *judge_mode(mode),
        *judge_airframe(mission, values),
        late,
        *judge_observation(mission, observed),
        *judge_rates(observed, values),
        *judge_sources(observed),
        judge_battery(mission, observed),
        *judge_resting_force(observed),
        *judge_motor_outputs(mission, observed, values),
        *judge_place(mission, observed.position_ned, observed.q_frd_to_ned),
        *judge_lock(mission, values),
    ]


def _read_outputs(link: GroundLink, motors: int) -> dict[str, float]:
    """Read the parameters of the motors' outputs, without those that the vehicle does not have."""
    values: dict[str, float] = {}
    while names := motor_output_names(values, motors):
        values |= dict.fromkeys(names, math.nan) | link.read_parameters(names)
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _release_of(text: str) -> Version | None:
    """Major and minor of a version in words; None where it tells none, as 0.0.0."""
    major, _, rest = text.partition(".")
    minor = rest.partition(".")[0]
    return (int(major), int(minor)) if major.isdigit() and minor.isdigit() and int(major) else None


def judge_round_trip(mission: Mission, seconds: float | None) -> CheckFinding:
    """Whether samples come in time, as far as a round trip tells; None: no request for it was answered."""
    item, limit_s = "round_trip", 2.0 * mission.vehicle.guard.telemetry_late_s
    if seconds is None:
        return CheckFinding(item, True, "vehicle does not answer TIMESYNC", remark=True)
    says = f"{seconds * 1e3:.0f} ms between vehicle and program, allowed are {limit_s * 1e3:.0f} ms"
    return CheckFinding(item, seconds <= limit_s, says)


def judge_observation(mission: Mission, observed: Observation) -> list[CheckFinding]:
    """Return findings about version, other vehicles and estimator."""
    findings = [
        CheckFinding(
            "version", True, f"PX4 {observed.version}" if observed.version else "version not reported"
        )
    ]
    if observed.other_vehicle is not None:
        findings.append(CheckFinding("second_vehicle", False, observed.other_vehicle))
    said = ", ".join(dict.fromkeys([*observed.blocking, *observed.texts]))
    says = "local position valid"
    if not observed.local_position_ok:
        says = "; ".join(["no valid local position", *observed.found_here])
        says += f"; PX4 says: {said}" if said else ""
    findings.append(CheckFinding("estimator", observed.local_position_ok, says))
    if observed.blocking or observed.texts:
        # No no-go: PX4 judges its present mode, and `fly` arms in offboard.
        begin = "PX4 would refuse to arm: " if observed.blocking else "PX4 says: "
        findings.append(CheckFinding("px4_checks", True, begin + said, remark=True))
    return findings


def judge_autopilot(mode: HeartbeatMode | None) -> list[CheckFinding]:
    """Return a no-go for an autopilot that is not PX4, with its name."""
    if mode is None or not mode.not_px4:
        return []
    says = f"heartbeats arrive, none {mode.not_px4}: this program supports PX4 only"
    return [CheckFinding("autopilot", False, says)]


def judge_mode(mode: HeartbeatMode | None) -> list[CheckFinding]:
    """Whether it flies from simulated sensors since its last start, whatever SYS_HITL says by now."""
    if mode is None or not mode.hil:
        return []
    says = "the vehicle flies from simulated sensors (hardware in the loop): restart it with SYS_HITL 0"
    return [CheckFinding("hil_mode", False, says)]


def judge_airframe(mission: Mission, values: Mapping[str, float]) -> list[CheckFinding]:
    """Whether PX4 flies the motors that the configuration describes.

    Thrust is summed over the motors and their torque taken off motor by motor: another number, order or
    direction makes both wrong. Other distances only scale the torque, and PX4's own may be in any unit.

    Args:
        mission: for its vehicle.
        values: PX4's parameters as read.
    """
    item, motors = "airframe", mission.vehicle.airframe.motors
    try:
        actual = motors_of(values, "PX4")
    except InputError as error:
        return [CheckFinding(item, True, f"not compared: {error}", remark=True)]
    other, sizes = rotor_differences(motors, actual)
    if other:
        hint = "; `calibrate airframe` prints PX4's"
        return [CheckFinding(item, False, "; ".join(other) + hint)]
    if sizes:
        return [CheckFinding(item, True, "; ".join(sizes) + ": measure, and set both", remark=True)]
    return [CheckFinding(item, True, f"{len(motors)} motors, as in PX4")]


def judge_lock(mission: Mission, values: Mapping[str, float]) -> list[CheckFinding]:
    """Whether the lock's servo would move; nothing where there is none."""
    lock = mission.vehicle.lock
    if lock is None:
        return []
    if not DRIVERS[lock.driver].moves:
        real = driver_names(lambda entry: entry.moves)
        says = f"lock.driver is {lock.driver.value}: nothing real moves; choose {real} (--driver)"
        return [CheckFinding("lock_driver", False, says)]
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
