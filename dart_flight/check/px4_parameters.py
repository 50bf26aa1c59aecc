"""The checks of the PX4 parameters that matter in a collision, and of the position source.

`PARAMETERS` lists the dangerous parameters: each is explained and may be a no-go. Position gains that differ
from the configuration are a no-go. Any other difference from `wanted_parameters` is a remark.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dart_flight.check.findings import CheckFinding
from dart_flight.check.wanted_parameters import GAINS, IMU_POSITION, POSE_DELAY, wanted_parameters
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import (
    Parameter,
    ParameterDifference,
    PositionSource,
    Version,
    differences,
    show_value,
    vehicle_parameters,
)
from dart_flight.planning.positioning import PLAIN_GPS, effective_source, frame_problem

_NO_TERMINATION = 121212  # CBRK_FLIGHTTERM: PX4's magic number for "off"
_OVERRIDE_IN_OFFBOARD = 2  # bit 1 of COM_RC_OVERRIDE: the sticks override offboard mode
_HORIZONTAL = 1  # bit 0 of EKF2_EV_CTRL and EKF2_GPS_CTRL: fuse the horizontal position
_RTK_FIX = "rtk_fixed"
_POSE_DELAY_TOLERANCE_MS = 30.0


_LOSS_ACTIONS = {
    0: "position mode: requires RC sticks",
    1: "altitude mode: requires RC sticks",
    2: "stabilized: requires RC sticks",
    3: "return: climbs and flies home regardless of obstacles",
    4: "land",
    5: "hold",
    6: "terminate: motors stop, vehicle falls",
    7: "disarm: motors stop, vehicle falls",
}
_RC_LOSS_ACTIONS = {
    0: "nothing",
    1: "hold",
    2: "return: climbs and flies home regardless of obstacles",
    3: "land",
    5: "terminate: motors stop, vehicle falls",
    6: "disarm: motors stop, vehicle falls",
}


def _offboard_loss(value: float, mission: Mission) -> tuple[bool, str]:
    whole = value + mission.vehicle.guard.deadman_s
    return value <= 1.5, (
        f"PX4's offboard-loss failsafe acts {value:g} s after the last setpoint; if the program hangs, the "
        f"vehicle continues to fly for at most {whole:.2f} s, including the deadman's timeout"
        + ("" if value <= 1.5 else "; near a wall this time is too long: set the parameter to 1.5 s or less")
    )


def _loss_action(value: float, _: Mission) -> tuple[bool, str]:
    action = round(value)
    return action in (
        0,
        1,
        2,
        4,
        5,
    ), f"action on loss of offboard setpoints: {_LOSS_ACTIONS.get(action, 'unknown')}"


def _rc_override(value: float, _: Mission) -> tuple[bool, str]:
    takes_over = bool(round(value) & _OVERRIDE_IN_OFFBOARD)
    return takes_over, (
        "RC sticks override offboard"
        if takes_over
        else "RC sticks do NOT override offboard; only the mode switch does"
    )


def _stick_speed(value: float, _: Mission) -> tuple[bool, str]:
    if value < 0.0:
        return False, "RC sticks do NOT override offboard; only the mode switch does"
    return True, f"RC sticks override offboard if their deflection changes faster than {value:g} 1/s"


def _rc_loss(value: float, _: Mission) -> tuple[bool, str]:
    action = round(value)
    return action in (0, 1, 3), f"action on RC loss: {_RC_LOSS_ACTIONS.get(action, 'unknown')}"


def _imbalance(value: float, _: Mission) -> tuple[bool, str]:
    quiet = value <= 0.0
    return quiet, (
        "PX4 only warns of an imbalanced propeller"
        if quiet
        else "PX4 ends the mission if a propeller is imbalanced, and may mistake an impact for an imbalance"
    )


def _rc_exception(value: float, _: Mission) -> tuple[bool, str]:
    ignores = round(value) & 4
    return True, (
        "PX4 ignores a loss of the remote control in offboard mode; after a loss, the pilot cannot take over"
        if ignores
        else "PX4 starts offboard mode only with a remote control, and ends it if the remote control is lost"
    )


def _attitude_limit(value: float, mission: Mission) -> tuple[bool, str]:
    limit = mission.vehicle.guard.tilt_deg
    good = value == 0.0 or value >= limit
    return good, f"PX4 detects a failure above {value:g} degrees, the guard's limit is {limit:g} degrees" + (
        "" if good else ": an impact could trigger PX4's failure detector before the guard acts"
    )


def _lockdown(value: float, _: Mission) -> tuple[bool, str]:
    return True, f"if PX4 detects a failure within {value:g} s after take-off, PX4 stops the motors"


def _termination(value: float, _: Mission) -> tuple[bool, str]:
    if round(value) == _NO_TERMINATION:
        return True, "flight termination is off: the attitude failure detector does not stop the motors"
    return True, "flight termination is ON: an attitude failure stops the motors in the air"


def _gyro_rate(value: float, _: Mission) -> tuple[bool, str]:
    return value >= 400.0, f"rate control at up to {value:g} Hz" + (
        "" if value >= 400.0 else "; to withstand the torque of a contact, PX4 needs at least 400 Hz"
    )


def _hitl(value: float, _: Mission) -> tuple[bool, str]:
    if value == 0.0:
        return True, "PX4 uses its own sensors"
    return False, (
        "hardware in the loop is still on: PX4 uses simulated sensors, and its outputs are off; set "
        "SYS_HITL to 0 and restart PX4"
    )


def _disarm_land(value: float, _: Mission) -> tuple[bool, str]:
    return (
        True,
        "PX4 does not disarm automatically after landing"
        if value <= 0.0
        else f"PX4 disarms {value:g} s after landing",
    )


# Each function returns whether a value allows the flight, and what the value means.
PARAMETERS: dict[str, Callable[[float, Mission], tuple[bool, str]]] = {
    "COM_OF_LOSS_T": _offboard_loss,
    "COM_OBL_RC_ACT": _loss_action,
    "COM_RC_OVERRIDE": _rc_override,
    "MAN_OVERRIDE_SPD": _stick_speed,  # PX4 v1.18 introduced this parameter instead of COM_RC_OVERRIDE
    "NAV_RCL_ACT": _rc_loss,
    "COM_RCL_EXCEPT": _rc_exception,
    "FD_FAIL_P": _attitude_limit,
    "FD_FAIL_R": _attitude_limit,
    "COM_LKDOWN_TKO": _lockdown,
    "CBRK_FLIGHTTERM": _termination,
    "COM_IMB_PROP_ACT": _imbalance,
    "IMU_GYRO_RATEMAX": _gyro_rate,
    "COM_DISARM_LAND": _disarm_land,
    "SYS_HITL": _hitl,
}
_LOCKDOWN, _LOCKDOWN_UNTIL = "COM_LKDOWN_TKO", (1, 17)  # removed after v1.17 without a replacement


def parameter_names(version: Version | None = None) -> list[str]:
    """Return the parameters that these checks need and that a version of PX4 has."""
    names, absent = [*PARAMETERS, *GAINS, *IMU_POSITION], set[str]()
    for source in PositionSource:
        parameters = vehicle_parameters(source)
        names += parameters
        absent |= {p.name for p in parameters.values() if p.is_absent_in(version)}
    if version is not None and version > _LOCKDOWN_UNTIL:
        absent.add(_LOCKDOWN)
    return [name for name in dict.fromkeys(names) if name not in absent]


def alternative_names(values: Mapping[str, float]) -> list[str]:
    """Return the names that other versions of PX4 use for the parameters that could not be read."""
    return [
        parameter.renamed
        for source in PositionSource
        for name, parameter in vehicle_parameters(source).items()
        if parameter.renamed is not None and name not in values
    ]


def evaluate_parameters(
    mission: Mission,
    values: Mapping[str, float],
    source: PositionSource | None,
    version: Version | None = None,
) -> list[CheckFinding]:
    """Explain the parameters and compare them with the configuration and with `configs/px4/`.

    Args:
        mission: provides the limits and the vehicle.
        values: parameters read from the vehicle.
        source: position source; if None, only the parameters that every vehicle needs are compared.
        version: PX4's version; if None, the parameters of every version are expected.
    """
    wanted = wanted_parameters(mission, source)
    different = {d.name: d for d in differences(wanted, values)}
    findings = []
    for name, judge in PARAMETERS.items():
        difference = different.pop(name, None)
        if name not in values:
            newer = "MAN_OVERRIDE_SPD" in values if version is None else version > _LOCKDOWN_UNTIL
            if name == _LOCKDOWN and newer:
                continue
            if name in wanted and _is_absent(wanted[name], wanted, values, version):
                continue
            findings.append(
                CheckFinding(name, False, "PX4 does not report this parameter, so PX4's behaviour is unknown")
            )
            continue
        go, message = judge(values[name], mission)
        if go and difference is not None:
            message += f"; recommended {show_value(difference.wanted)}, not {show_value(values[name])}: "
            message += difference.reason
        findings.append(CheckFinding(name, go, message, remark=go and difference is not None))
    if source is PositionSource.MOCAP and POSE_DELAY in values:
        findings.append(_evaluate_pose_delay(mission, values[POSE_DELAY], different.pop(POSE_DELAY, None)))
    findings += _evaluate_configured(different)
    findings += [CheckFinding(d.name, True, d.line(), remark=True) for d in different.values()]
    return findings


def _is_absent(
    missing: Parameter, wanted: Mapping[str, Parameter], values: Mapping[str, float], version: Version | None
) -> bool:
    """Return whether this PX4's version lacks a parameter; infer an unknown version from other parameters."""
    if version is not None:
        return missing.is_absent_in(version)
    # PX4 has either the parameter of an older version or its replacement, but not both.
    when = {"before": "after", "after": "before"}.get(missing.absent.partition(" ")[0])
    return any(
        one.absent.startswith(f"{when} ") and (one.name in values) for one in wanted.values() if one.absent
    )


def _evaluate_configured(different: dict[str, ParameterDifference]) -> list[CheckFinding]:
    """Remove gains and IMU position from `different`; return a finding for each of them that PX4 has."""
    findings = []
    for name in (*GAINS, *IMU_POSITION):
        difference = different.pop(name, None)
        if difference is None or difference.actual is None:
            continue
        shown = show_value(difference.actual)
        if name in GAINS:
            message = (
                f"{shown} on the vehicle, {show_value(difference.wanted)} in the configuration: "
                "recoveries differ from the prediction"
            )
        else:
            message = (
                f"{shown} m on the vehicle, {show_value(difference.wanted)} m in imu.position_m: rotation "
                "corrupts PX4's velocity or the force estimate; measure the IMU's offset from the centre of "
                "mass and set both values"
            )
        findings.append(CheckFinding(name, name not in GAINS, message, remark=name not in GAINS))
    return findings


def _evaluate_pose_delay(
    mission: Mission, delay_ms: float, difference: ParameterDifference | None
) -> CheckFinding:
    """Compare the pose delay that PX4 assumes with the measured delay.

    If no delay has been measured, the finding reports `difference`, the deviation from PX4's usual value.
    """
    measured_ms = mission.vehicle.mocap.delay_ms
    if measured_ms is None:
        message = f"{show_value(delay_ms)} ms" if difference is None else difference.line()
        message += (
            "; mocap.delay_ms is not set: measure the age of a pose on arrival at PX4, and set "
            f"mocap.delay_ms and {POSE_DELAY} to this age"
        )
        return CheckFinding(POSE_DELAY, True, message, remark=True)
    apart_ms = abs(delay_ms - measured_ms)
    message = f"{show_value(delay_ms)} ms on the vehicle, {measured_ms:g} ms in mocap.delay_ms"
    if apart_ms > _POSE_DELAY_TOLERANCE_MS:
        message += (
            f"; the difference of {apart_ms:g} ms, limit {_POSE_DELAY_TOLERANCE_MS:g} ms, makes the position "
            f"estimate oscillate: set {POSE_DELAY} to {measured_ms:g}"
        )
    return CheckFinding(POSE_DELAY, apart_ms <= _POSE_DELAY_TOLERANCE_MS, message)


# --- position source -------------------------------------------------------------------------------------


def position_source(values: Mapping[str, float], gps_fix: str | None) -> PositionSource | None:
    """Return the position source that PX4 fuses: motion capture if it fuses both, None if it fuses neither.

    Args:
        values: parameters read from the vehicle.
        gps_fix: MAVLink's GPS fix type in lower case, or None if no GPS receiver reports; `rtk_fixed` selects
            RTK.
    """
    if round(values.get("EKF2_EV_CTRL", 0)) & _HORIZONTAL:
        return PositionSource.MOCAP
    if round(values.get("EKF2_GPS_CTRL", 0)) & _HORIZONTAL:
        return PositionSource.RTK if gps_fix == _RTK_FIX else PositionSource.PLAIN
    return None


def evaluate_position(
    mission: Mission,
    found: PositionSource | None,
    gps_fix: str | None,
    claimed: PositionSource | None,
) -> list[CheckFinding]:
    """Check that the position is accurate enough for a collision and that its source is as claimed.

    Args:
        mission: provides the frame.
        found: result of `position_source`.
        gps_fix: argument of `position_source`.
        claimed: the operator's claim, or None.
    """
    item, fix = "position_source", (gps_fix or "no fix").replace("_", " ")
    if found is None:
        nothing = "PX4 fuses neither motion capture (EKF2_EV_CTRL) nor GPS (EKF2_GPS_CTRL)"
        return [CheckFinding(item, False, nothing)]
    if claimed not in (None, found, PositionSource.PLAIN):
        other = "motion capture" if found is PositionSource.MOCAP else f"GPS ({fix})"
        return [
            CheckFinding(item, False, f"--position-from is {claimed}, but PX4's position comes from {other}")
        ]
    source = claimed or found
    if source is PositionSource.MOCAP:
        return [CheckFinding(item, True, "motion capture"), *evaluate_claim(mission, source)]
    if source is PositionSource.RTK:
        return [CheckFinding(item, True, f"GPS, {fix}"), *evaluate_claim(mission, source)]
    return evaluate_claim(mission, source, f" (the receiver reports: {fix})")


def evaluate_claim(mission: Mission, source: PositionSource, addition: str = "") -> list[CheckFinding]:
    """Check a position source for a mission; append `addition` to a finding about plain GPS."""
    findings = []
    source = effective_source(mission, source)
    if source is PositionSource.ANCHORED:
        findings.append(
            CheckFinding(
                "position_source", True, "plain GPS gives the position, and contacts correct it" + addition
            )
        )
    if source is PositionSource.PLAIN:
        findings.append(CheckFinding("position_source", False, PLAIN_GPS + addition))
    problem = frame_problem(mission, source)
    if problem is not None:
        findings.append(CheckFinding("frame", False, problem))
    return findings
