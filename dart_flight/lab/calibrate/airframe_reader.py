"""Reader of a vehicle's motors from PX4: a parameter file, `param show` output or a ULog."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dart_flight.config.document import InputError, read_text
from dart_flight.config.parameter_file import load_parameters, parse_listing
from dart_flight.config.rotors import COUNT, motors_from_parameters
from dart_flight.config.vehicle import Motor
from dart_flight.lab.ulog import open_ulog

_PLACEHOLDERS = (0.0, 1.0)


def read_airframe(path: Path) -> tuple[Motor, ...]:
    """Read motors from a ULog (`.ulg`), QGroundControl's parameter file or the output of `param show -a`."""
    return motors_from_parameters(_parameters(path), str(path))


def _parameters(path: Path) -> dict[str, float]:
    if path.suffix == ".ulg":
        return open_ulog(path, ["vehicle_land_detected"]).parameters
    listed = parse_listing(read_text(path))
    return listed or {name: float(p.value) for name, p in load_parameters(path).items()}


def refuse_unmeasured(motors: Sequence[Motor], source: str) -> None:
    """Reject the motors of a vehicle that is not a multicopter, and motors at PX4's placeholder positions."""
    if len(motors) < 3:
        raise InputError(f"{COUNT} is {len(motors)}: not a multicopter", source=source)
    if all(abs(m.x_m) in _PLACEHOLDERS and abs(m.y_m) in _PLACEHOLDERS for m in motors):
        raise InputError(
            "the motor positions are PX4's placeholders (0 and 1 m): measure your frame and set "
            "CA_ROTOR0_PX, CA_ROTOR0_PY and the positions of the other motors",
            source=source,
        )


def motors_block(motors: Sequence[Motor]) -> str:
    """Return `airframe.motors` as YAML, to be pasted below `airframe:`."""
    lines = ["  motors:"]
    for m in motors:
        x, y, yaw = m.x_m, m.y_m, m.yaw_torque_per_thrust_m
        lines.append(f"    - {{x_m: {x:.4g}, y_m: {y:.4g}, yaw_torque_per_thrust_m: {yaw:.4g}}}")
    return "\n".join(lines)
