"""The desired values of a vehicle's PX4 parameters, from `configs/px4/`, configuration and measurements.

`check` compares the vehicle's parameters with the desired values. `dart-flight parameters` lists the
differences and writes the desired values.
"""

from __future__ import annotations

import lzma
import math
from collections.abc import Collection, Mapping
from enum import StrEnum

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.config.mission import Mission
from dart_flight.config.parameter_file import (
    Parameter,
    ParameterDifference,
    PositionSource,
    Value,
    differences,
    vehicle_parameters,
)
from dart_flight.config.vehicle import LockDriver
from dart_flight.lock.drivers.px4_output import required_parameters
from dart_flight.planning.positioning import effective_source

POSE_DELAY = "EKF2_EV_DELAY"
# Parameters of PX4's controllers, on which the prediction of a recovery depends.
GAINS = ("MPC_XY_P", "MPC_XY_VEL_P_ACC", "MPC_XY_VEL_D_ACC", "MPC_VELD_LP", "MPC_TILTMAX_AIR", "MPC_Z_P")
# The IMU's position relative to the centre of mass, forward, right and down, like imu.position_m.
IMU_POSITION = ("EKF2_IMU_POS_X", "EKF2_IMU_POS_Y", "EKF2_IMU_POS_Z")
_FAILURE_ANGLES = ("FD_FAIL_P", "FD_FAIL_R")
_HITL, _OFFBOARD_LOSS = "SYS_HITL", "COM_OF_LOSS_T"
_GAIN_TOLERANCE = 0.02
_POSITION_TOLERANCE_M = 0.005
_DELAY_TOLERANCE_MS = 0.5

METADATA = "/etc/extras/parameters.json.xz"  # path on the flight controller, read by MAVLink FTP
# This program writes these parameters; PX4's source marks them @reboot_required (release/1.18, 2026-08-08).
_RESTART = (
    "CBRK_FLIGHTTERM EKF2_EV_DELAY EKF2_GPS_DELAY EKF2_HGT_REF EKF2_MAG_TYPE IMU_GYRO_RATEMAX IMU_INTEG_RATE "
    "MAV_0_FORWARD MAV_1_CONFIG MAV_1_FLOW_CTRL MAV_1_FORWARD MAV_1_MODE MAV_1_RATE SDLOG_PROFILE "
    "SENS_GPS0_DELAY SER_TEL2_BAUD SYS_HAS_GPS SYS_HAS_MAG SYS_HITL"
)
RESTART: frozenset[str] = frozenset(_RESTART.split())
RESTART_SOURCE = "@reboot_required in the source of PX4 release/1.18, 2026-08-08"


class MetadataError(FlightError):
    """PX4's parameter metadata has an unknown format."""


class ParameterState(StrEnum):
    """The state of a parameter that was requested from a vehicle."""

    PRESENT = "present"
    ABSENT = "absent"
    NOT_ANSWERED = "not answered"  # it is unknown whether the vehicle has the parameter


class ParameterRow(msgspec.Struct, frozen=True):
    """A parameter that does not have its desired value.

    Attributes:
        vehicle: the vehicle's value (an int is an INT32), or None if the parameter is not present.
        wanted: the desired value, in the vehicle's type.
        why: the reason for the desired value.
        restart: whether a new value takes effect only after a restart of the flight controller.
    """

    name: str
    state: ParameterState
    vehicle: Value | None
    wanted: Value
    why: str
    restart: bool


def wanted_parameters(mission: Mission, source: PositionSource | None) -> dict[str, Parameter]:
    """Return the desired parameters by name; measured values replace the placeholders of the files.

    Without a position source, return only the parameters that every vehicle needs.
    """
    vehicle = mission.vehicle
    wanted = dict(vehicle_parameters(None if source is None else effective_source(mission, source)))
    delay_ms = vehicle.mocap.delay_ms
    if delay_ms is not None and POSE_DELAY in wanted:
        reason = "mocap.delay_ms, the measured age of a pose on arrival"
        wanted[POSE_DELAY] = Parameter(POSE_DELAY, float(delay_ms), reason, tolerance=_DELAY_TOLERANCE_MS)
    for name in _FAILURE_ANGLES:
        if wanted[name].value < vehicle.guard.tilt_deg:
            reason = "at the tilt limit guard.tilt_deg, the guard must act before PX4's failure detector"
            wanted[name] = Parameter(name, math.ceil(vehicle.guard.tilt_deg), reason)
    wanted[_HITL] = Parameter(_HITL, 0, "PX4 uses its own sensors")
    for name in (*GAINS, _OFFBOARD_LOSS):
        value = float(getattr(vehicle.px4, name.lower()))
        reason = f"the predictions assume px4.{name} of the configuration"
        wanted[name] = Parameter(name, value, reason, tolerance=_GAIN_TOLERANCE * abs(value))
    for name, place, axis in zip(IMU_POSITION, vehicle.imu.position_m, "xyz", strict=True):
        reason = f"{axis} of the IMU relative to the centre of mass, metres (imu.position_m)"
        wanted[name] = Parameter(name, place, reason, tolerance=_POSITION_TOLERANCE_M)
    return wanted


def with_lock_output(
    mission: Mission, wanted: Mapping[str, Parameter], values: Mapping[str, Value]
) -> dict[str, Parameter]:
    """If PX4 drives the lock's servo, add the parameters of the servo's output.

    If a desired parameter has a bit mask, copy the bits outside the mask from the vehicle's `values`.
    """
    lock, found = mission.vehicle.lock, dict(wanted)
    if lock is None or lock.driver is not LockDriver.PX4:
        return found
    for required in required_parameters(lock):
        value = required.value
        if required.mask is not None:
            value |= round(values.get(required.name, 0)) & ~required.mask
        found[required.name] = Parameter(required.name, value, required.why)
    return found


def list_differences(
    wanted: Mapping[str, Parameter],
    values: Mapping[str, Value],
    restart: Collection[str],
    unanswered: Collection[str] = (),
) -> list[ParameterRow]:
    """Return the parameters that do not have their desired values, in the order of the files.

    Args:
        values: the vehicle's values, in its types.
        restart: names of the parameters that need a restart.
        unanswered: names of the parameters for which the vehicle gave no answer. A missing answer counts as a
            difference even for a parameter that some builds lack.
    """
    found = differences(wanted, values)
    listed = {d.name for d in found}
    found += [
        ParameterDifference(p.name, p.value, None, p.reason)
        for p in wanted.values()
        if p.name in unanswered and p.name not in listed and p.renamed not in values
    ]
    rows = []
    for d in found:
        value = values.get(d.name)
        wanted_value = _in_type_of(value, d.wanted)
        state = state_of(d.name, values, unanswered)
        rows.append(ParameterRow(d.name, state, value, wanted_value, d.reason, d.name in restart))
    return rows


def state_of(name: str, values: Collection[str], unanswered: Collection[str]) -> ParameterState:
    """Return the state of a parameter from the names with a value and the names without an answer."""
    if name in values:
        return ParameterState.PRESENT
    return ParameterState.NOT_ANSWERED if name in unanswered else ParameterState.ABSENT


def _in_type_of(actual: Value | None, wanted: Value) -> Value:
    if isinstance(actual, float):
        return float(wanted)
    return round(wanted) if isinstance(actual, int) and float(wanted).is_integer() else wanted


def restart_names(metadata: bytes) -> frozenset[str]:
    """Return the parameters that need a restart, from PX4's metadata file (`METADATA`).

    Raises:
        MetadataError: the file has an unknown format.
    """
    try:
        tree = msgspec.json.decode(lzma.decompress(metadata))
        return frozenset(p["name"] for p in tree["parameters"] if p.get("rebootRequired"))
    except (lzma.LZMAError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MetadataError(f"PX4's parameter metadata cannot be read: {error!r}") from None
