"""The motors of a vehicle from a file of PX4's: saved parameters, a `param show`, or a ULog."""

from __future__ import annotations

from pathlib import Path

from dart_flight.config.document import read_text
from dart_flight.config.parameters import load_parameters, parse_listing
from dart_flight.config.rotors import motors_of
from dart_flight.config.vehicle import Motor
from dart_flight.recording.ulog import open_ulog


def read_airframe(path: Path) -> tuple[Motor, ...]:
    """The motors that PX4 had.

    Args:
        path: a ULog (`.ulg`), QGroundControl's parameter file, or what `param show -a` printed.

    Raises:
        InputError: the file cannot be read, or does not say where the motors are.
    """
    return motors_of(_parameters(path), str(path))


def _parameters(path: Path) -> dict[str, float]:
    if path.suffix == ".ulg":
        return open_ulog(path, ["vehicle_land_detected"]).parameters
    listed = parse_listing(read_text(path))
    return listed or {name: float(p.value) for name, p in load_parameters(path).items()}
