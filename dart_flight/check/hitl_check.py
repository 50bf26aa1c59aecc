"""Checks of a flight controller's setup for hardware in the loop.

The flight controller is on a table, with propellers off. `configs/px4/hitl.params` lists the parameters that
hardware in the loop needs in addition to the vehicle's parameters, each with a reason.
"""

from __future__ import annotations

from collections.abc import Mapping

from dart_flight.check.findings import CheckFinding
from dart_flight.check.px4_parameters import evaluate_parameters
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import (
    Parameter,
    PositionSource,
    differences,
    load_parameters,
    show_value,
)
from dart_flight.config.vehicle import LockDriver, packaged
from dart_flight.lock.drivers import driver_names
from dart_flight.vehicle.ground_link import HeartbeatMode

HITL = "SYS_HITL"
ON_A_BOARD = "HIL_ACT_FUNC1"  # only PX4 on a board has this parameter; SITL has PWM_MAIN_FUNC1 instead
BOARD = "SYS_USB_AUTO"  # POSIX builds lack this parameter
WITH_IO = "PWM_AUX_FUNC1"  # if a PX4IO provides MAIN, a board calls its own outputs AUX
IO_OUTPUTS = [f"PWM_MAIN_FUNC{k}" for k in range(1, 9)]
_MOTORS = range(101, 113)  # output functions "Motor 1" to "Motor 12"


def hitl_parameters() -> dict[str, Parameter]:
    return load_parameters(packaged("configs", "px4", "hitl.params"))


def evaluate_hitl_parameters(values: Mapping[str, float]) -> list[CheckFinding]:
    """Return a no-go for each parameter that differs from `hitl.params`."""
    wanted = hitl_parameters()
    return [
        CheckFinding(d.name, False, f"{d.line()} (param set {d.name} {show_value(d.wanted)}, restart)")
        for d in differences(wanted, values)
        if d.actual is not None or not wanted[d.name].absent
    ]


def evaluate_own_parameters(
    mission: Mission, values: Mapping[str, float], position_from: PositionSource | None
) -> list[CheckFinding]:
    """Check the vehicle's parameters as before a real flight, but skip the parameters in `hitl.params`."""
    wanted = hitl_parameters()
    return [f for f in evaluate_parameters(mission, values, position_from) if f.item not in wanted]


def evaluate_hitl_mode(values: Mapping[str, float], mode: HeartbeatMode | None) -> list[CheckFinding]:
    """Check that the flight controller is disarmed and has restarted since SYS_HITL was set to 1."""
    if mode is None:
        return [CheckFinding("heartbeat", False, "no heartbeat that contains a mode arrived within 3 s")]
    if mode.armed:
        return [CheckFinding("disarmed", False, "the flight controller is armed: disarm it first")]
    set_up = round(values.get(HITL, 0)) == 1
    if set_up and not mode.hil:
        message = f"{HITL} is 1, but the flight controller does not use simulated sensors: restart it"
        return [CheckFinding("hil_mode", False, message)]
    return [CheckFinding("disarmed", True, "disarmed")]


def evaluate_hitl_outputs(values: Mapping[str, float]) -> list[CheckFinding]:
    """Return a no-go if the firmware lacks simulated outputs, or if a PX4IO would drive real motors.

    According to the source of PX4 v1.18, hardware in the loop does not switch off the outputs of a PX4IO.
    """
    turning = [name for name in IO_OUTPUTS if round(values.get(name, 0)) in _MOTORS]
    if BOARD in values and ON_A_BOARD not in values:
        message = (
            "this firmware has no simulated outputs: build it with CONFIG_MODULES_SIMULATION_PWM_OUT_SIM=y"
        )
        return [CheckFinding(ON_A_BOARD, False, message)]
    if WITH_IO not in values or not turning:
        return []
    message = f"the PX4IO would turn real motors: set {', '.join(turning)} to 0 and restart PX4"
    return [CheckFinding("real_outputs", False, message)]


def evaluate_hitl_lock(mission: Mission) -> CheckFinding:
    lock = mission.vehicle.lock
    if lock is not None and lock.driver is LockDriver.PX4:
        return CheckFinding(
            "lock_driver",
            False,
            "lock.driver is px4, but hardware in the loop starts no real outputs: the servo would not move; "
            f"choose {driver_names(lambda entry: 'link' not in entry.needs)} (--driver)",
        )
    return CheckFinding("lock_driver", True, "no lock" if lock is None else lock.driver.value)
