"""Whether a flight controller is set up for hardware in the loop, on a table, with propellers off.

`configs/px4/hitl.params` holds what has to be set beside the vehicle's own parameters, a reason each.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from dart_flight.check.findings import CheckFinding
from dart_flight.check.px4_parameters import judge_parameters, names_to_read
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import Parameter, PositionSource, differences, load_parameters
from dart_flight.config.rotors import COUNT, motors_of, rotor_names
from dart_flight.config.vehicle import LockDriver, Motor, packaged
from dart_flight.vehicle.ground_link import GroundLink, HeartbeatMode

HITL = "SYS_HITL"
_ON_A_BOARD = "HIL_ACT_FUNC1"  # SITL's simulated outputs are PWM_MAIN_FUNC1 and on
_BOARD = "SYS_USB_AUTO"  # no POSIX build has it
_WITH_IO = "PWM_AUX_FUNC1"  # only where MAIN is a PX4IO are a board's own outputs AUX
_IO_OUTPUTS = [f"PWM_MAIN_FUNC{k}" for k in range(1, 9)]
_MOTORS = range(101, 113)  # output functions "Motor 1" to "Motor 12"


class HitlReadiness(msgspec.Struct, frozen=True):
    """What was found; `motors` are those of the flight controller's parameters, None where it has none."""

    findings: list[CheckFinding]
    motors: tuple[Motor, ...] | None


def hitl_parameters() -> dict[str, Parameter]:
    """What hardware in the loop needs beside the vehicle's own parameters, by name."""
    return load_parameters(packaged("configs", "px4", "hitl.params"))


def check_hitl(mission: Mission, url: str, position_from: PositionSource) -> HitlReadiness:
    """Ask a flight controller over the app's link, before anything is fed to it.

    Args:
        mission: what is to be flown.
        url: MAVSDK connection URL of the app's link.
        position_from: where the simulated position comes from.

    Raises:
        VehicleError: nothing answers at the URL.
        NoAnswerError: what answers there does not answer requests.
    """
    wanted = hitl_parameters()
    with GroundLink(url, mission.vehicle.connection.timeout_s) as link:
        mode = link.heartbeat_mode()
        values = link.read_parameters([*wanted, COUNT])
        if _ON_A_BOARD in values:
            values |= link.read_parameters([_WITH_IO, *_IO_OUTPUTS])
        else:
            values |= link.read_parameters([_BOARD])
        if round(values.get(HITL, 0)) == 1:
            # Elsewhere the rest would take a minute, and a restart comes first.
            values |= link.read_parameters([name for name in names_to_read() if name not in values])
            values |= link.read_parameters(rotor_names(values.get(COUNT, 0.0)))
    return judge_hitl(mission, values, mode, position_from)


def judge_hitl(
    mission: Mission, values: Mapping[str, float], mode: HeartbeatMode | None, position_from: PositionSource
) -> HitlReadiness:
    """The findings from parameters and heartbeat as read; the arguments are those of `check_hitl`."""
    wanted = hitl_parameters()
    findings = [_judge_lock(mission), *_judge_mode(values, mode)]
    findings += [
        CheckFinding(d.name, False, f"{d.line()} (param set {d.name} {d.wanted:g}, restart)")
        for d in differences(wanted, values)
        if d.actual is not None or not wanted[d.name].absent
    ]
    findings += _judge_outputs(values)
    if all(f.go for f in findings):
        theirs = judge_parameters(mission, values, position_from)
        findings += [f for f in theirs if f.item not in wanted]
    motors = motors_of(values, "the flight controller") if rotor_names(values.get(COUNT, 0.0)) else None
    return HitlReadiness(findings, motors)


def _judge_mode(values: Mapping[str, float], mode: HeartbeatMode | None) -> list[CheckFinding]:
    if mode is None:
        return [CheckFinding("heartbeat", False, "no heartbeat with a mode within 3 s")]
    if mode.armed:
        return [CheckFinding("disarmed", False, "flight controller is armed: disarm it first")]
    set_up = round(values.get(HITL, 0)) == 1
    if set_up and not mode.hil:
        says = f"{HITL} is 1, but the flight controller does not fly from simulated sensors: restart it"
        return [CheckFinding("hil_mode", False, says)]
    return [CheckFinding("disarmed", True, "disarmed")]


def _judge_outputs(values: Mapping[str, float]) -> list[CheckFinding]:
    """There must be simulated ones; a PX4IO goes on in this mode, and its motors turn (v1.18, its source)."""
    turning = [name for name in _IO_OUTPUTS if round(values.get(name, 0)) in _MOTORS]
    if _BOARD in values and _ON_A_BOARD not in values:
        says = "this firmware has no simulated outputs: build it with CONFIG_MODULES_SIMULATION_PWM_OUT_SIM=y"
        return [CheckFinding(_ON_A_BOARD, False, says)]
    if _WITH_IO not in values or not turning:
        return []
    says = f"{', '.join(turning)} put out motors, and a PX4IO goes on in this mode: set them to 0, restart"
    return [CheckFinding("real_outputs", False, says)]


def _judge_lock(mission: Mission) -> CheckFinding:
    lock = mission.vehicle.lock
    if lock is not None and lock.driver is LockDriver.PX4:
        return CheckFinding(
            "lock_driver",
            False,
            "lock.driver is px4, and hardware in the loop starts no real outputs: the servo would not move "
            "(--driver maestro, pwm or mock)",
        )
    return CheckFinding("lock_driver", True, "no lock" if lock is None else lock.driver.value)
