"""The motors of an airframe as PX4 parameters (CA_ROTOR*): conversion in both directions, and comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Motor

COUNT = "CA_ROTOR_COUNT"
MAV_TYPES = {4: 2, 6: 13, 8: 14}  # MAV_TYPE by number of motors: quadrotor, hexarotor, octorotor
_AXES = ("PX", "PY", "KM")
_MAX = 12  # maximum number of motors in PX4
_PLACE_TOLERANCE_M = 0.03
_KM_TOLERANCE = 0.5  # relative tolerance; wide, because PX4 ships one value for all propellers


def rotor_parameters(motors: Sequence[Motor]) -> dict[str, int | float]:
    parameters: dict[str, int | float] = {COUNT: len(motors)}
    for i, motor in enumerate(motors):
        values = (motor.x_m, motor.y_m, motor.yaw_torque_per_thrust_m)
        parameters |= {f"CA_ROTOR{i}_{axis}": value for axis, value in zip(_AXES, values, strict=True)}
    return parameters


def rotor_names(count: float) -> list[str]:
    """Return the names of the parameters of `count` motors (CA_ROTOR_COUNT)."""
    return [f"CA_ROTOR{i}_{axis}" for i in range(min(_MAX, round(count))) for axis in _AXES]


def motors_from_parameters(parameters: Mapping[str, float], source: str) -> tuple[Motor, ...]:
    """Return the motors in PX4's parameters.

    Raises:
        InputError: the parameters lack the number of motors or a position.
    """
    if not parameters.get(COUNT):
        raise InputError(
            f"has no {COUNT}, so PX4 is older than 1.13 or the vehicle is not a multicopter", source=source
        )
    names = rotor_names(parameters[COUNT])
    missing = [name for name in names if name not in parameters]
    if missing:
        raise InputError(f"has no {', '.join(missing)}", source=source)
    values = [float(parameters[name]) for name in names]
    return tuple(Motor(*values[i : i + 3]) for i in range(0, len(values), 3))


def rotor_differences(motors: Sequence[Motor], actual: Sequence[Motor]) -> tuple[list[str], list[str]]:
    """Compare PX4's motors (`actual`) with the configuration's.

    Returns:
        Two lists of messages. The first has differences in number, side or direction of rotation: PX4 is
            configured for another vehicle. The second has differences in size.
    """
    if len(motors) != len(actual):
        return [f"PX4 has {len(actual)} motors, but the configuration has {len(motors)}"], []
    other: list[str] = []
    sizes: list[str] = []
    for number, (own, px4) in enumerate(zip(motors, actual, strict=True), start=1):
        for name, a, b in (("x_m", own.x_m, px4.x_m), ("y_m", own.y_m, px4.y_m)):
            if abs(a - b) <= _PLACE_TOLERANCE_M:
                continue
            opposite = a * b < 0.0 and min(abs(a), abs(b)) > _PLACE_TOLERANCE_M
            (other if opposite else sizes).append(f"motor {number}: {name} {a:g}, PX4 {b:g}")
        a, b = own.yaw_torque_per_thrust_m, px4.yaw_torque_per_thrust_m
        if a * b < 0.0:
            other.append(
                f"motor {number} turns in the opposite direction in PX4 "
                f"(yaw_torque_per_thrust_m {a:g}, PX4 {b:g})"
            )
        elif abs(a - b) > _KM_TOLERANCE * max(abs(a), abs(b)):
            sizes.append(f"motor {number}: yaw_torque_per_thrust_m {a:g}, PX4 {b:g}")
    return other, sizes
