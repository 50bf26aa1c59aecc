"""The configuration of a vehicle: its type, its search path and its loading."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.config.document import Document, InputError, Key, iterate_leaves, read_text, unknown_name
from dart_flight.config.file_kinds import EXTENDS, HISTORY
from dart_flight.config.section import Section
from dart_flight.config.settings import apply_changes, apply_settings
from dart_flight.config.vehicle.airframe import Airframe, Imu, Material, Thrust, effectiveness
from dart_flight.config.vehicle.autopilot import ConnectionConfig, GroundStation, Px4Parameters
from dart_flight.config.vehicle.estimation import Detection, Estimation
from dart_flight.config.vehicle.flying import Flying, GuardThresholds
from dart_flight.config.vehicle.lock_config import NO_LOCK, LockConfig, LockDriver
from dart_flight.config.vehicle.mocap import MotionCapture
from dart_flight.config.vehicle.simulation import Simulation


class VehicleConfig(Section, frozen=True, kw_only=True):
    """A vehicle's whole configuration, the type of `configs/dart.yaml`.

    Attributes:
        version: version of the file format.
        materials: contact coefficients by name, for every mode of the vehicle: k N/m, f N s/m, mu s/m, nu N.
        onset: lcp: the complementarity condition of the paper defines the beginning of the contact; touch:
            the contact begins at the wall's plane.
        vertical_force_sign: sign of the vertical contact force along Z of the collision frame; -1: the force
            at a wall points up.
    """

    version: Literal[1]
    airframe: Airframe
    thrust: Thrust
    imu: Imu
    estimation: Estimation
    materials: dict[str, Material]
    onset: Literal["lcp", "touch"]
    vertical_force_sign: Literal[-1, 1]
    detection: Detection
    guard: GuardThresholds
    flying: Flying
    lock: LockConfig | None = None
    connection: ConnectionConfig
    ground_station: GroundStation = GroundStation()
    mocap: MotionCapture = MotionCapture()
    px4: Px4Parameters
    simulation: Simulation

    @property
    def has_lock(self) -> bool:
        """Whether the vehicle can change its stiffness."""
        return self.lock is not None

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes of the vehicle; a vehicle without a lock has only rigid mode."""
        return tuple(Mode) if self.has_lock else (Mode.RIGID,)

    @property
    def lock_driver(self) -> LockDriver | None:
        """Driver of the lock, or None if the vehicle has no lock."""
        return None if self.lock is None else self.lock.driver

    def mode_problem(self, mode: Mode) -> str | None:
        """Return the reason why the vehicle cannot be in a mode, or None if it can."""
        return (
            None
            if mode in self.modes
            else f"this vehicle has no lock: its mode is always rigid, not {mode.value}"
        )

    def hover_thrust_fraction(self) -> float:
        """Return the thrust at hover as a fraction of full thrust (PX4's MPC_THR_HOVER)."""
        return self.airframe.mass_kg * GRAVITY_M_S2 / (len(self.airframe.motors) * self.thrust.max_thrust_n)

    def to_dict(self) -> dict[str, Any]:
        """Return the keys and values of a configuration file; `load_vehicle` restores the configuration."""
        tree: dict[str, Any] = msgspec.to_builtins(self)
        return tree

    def replace(self, changes: Mapping[str, Any]) -> VehicleConfig:
        """Return another configuration with some keys changed, and validate everything again.

        Args:
            changes: value by dotted key, such as `{"materials.acrylic.rigid.k": 5000.0}`.

        Raises:
            InputError: a key is unknown, or a value has the wrong type or is out of range.
        """
        document = Document.from_tree(self.to_dict())
        apply_changes(changes, document)
        return parse_vehicle(document)


def packaged(*parts: str) -> Path:
    """Return a file of `configs/` or `missions/`, from the checkout or else from the installed package.

    Raises:
        InputError: there is no such file.
    """
    copies = Path(str(resources.files("dart_flight").joinpath("data")))
    for root in (Path(__file__).resolve().parents[3], copies):
        path = root.joinpath(*parts)
        if path.exists():
            return path
        if len(parts) > 1 and path.parent.is_dir():  # the folder exists only in a checkout
            known = sorted(other.name for other in path.parent.iterdir())
            raise InputError(
                f"is not a packaged file: {unknown_name(path.name, known)}", source="/".join(parts)
            )
    raise InputError("is not a packaged file; packaged folders: configs, missions", source="/".join(parts))


def default_config_path() -> Path:
    """Return $DART_FLIGHT_CONFIG, the file chosen from ./configs, or the packaged default, in this order.

    `init --vehicle` writes a vehicle's file, which extends dart.yaml, next to dart.yaml. Therefore a file in
    ./configs is a candidate only if no other file in ./configs extends it. If there is only one candidate, it
    is chosen. If there are several and all are unchanged packaged files, dart.yaml is chosen.

    Raises:
        InputError: there are several candidates, and one of them is the user's own file.
    """
    named = os.environ.get("DART_FLIGHT_CONFIG")
    if named:
        return Path(named)
    local = Path("configs/dart.yaml")
    there = [path for path in sorted(local.parent.glob("*.yaml")) if not path.stem.endswith(HISTORY)]
    bases = {path.parent / base for path in there if (base := extended_file(path)) is not None}
    last = [path for path in there if path not in bases]
    if len(last) == 1:
        return last[0]
    if any(not _is_unchanged(path) for path in last):
        names = ", ".join(path.name for path in last)
        extended = ", ".join(sorted(path.name for path in there if path in bases))
        others = f"; not {extended}, which they extend" if extended else ""
        text = f"contains several vehicles ({names}{others}): choose one with --config or $DART_FLIGHT_CONFIG"
        raise InputError(text, source=str(local.parent))
    return local if local.exists() else packaged("configs", "dart.yaml")


def _is_unchanged(path: Path) -> bool:
    """Return whether a file equals the packaged file of the same name or is not a vehicle configuration."""
    try:
        text = read_text(path)
        if re.search(rf"^({EXTENDS}|airframe):", text, re.MULTILINE) is None:
            return True
        return text == read_text(packaged("configs", path.name))
    except InputError:
        return False


def extended_file(path: Path) -> str | None:
    """Return the value of `extends` in a file, or None if the file is unreadable or has no `extends`."""
    try:
        found = re.search(rf"^{EXTENDS}:\s*([^\s#]+)", read_text(path), re.MULTILINE)
    except InputError:
        return None
    return found[1].strip("'\"") if found else None


def load_vehicle(
    path: str | Path | Mapping[str, Any] | Document | None = None, settings: Sequence[str] = ()
) -> VehicleConfig:
    """Load and validate a vehicle configuration.

    A file with `extends: FILE` contains only its differences from FILE. The path FILE is relative to the
    folder of the extending file.

    Args:
        path: the file, a mapping with the same content, or a parsed document; default: the default
            configuration.
        settings: `KEY=VALUE` with a dotted key, set before the validation (`config.settings`).

    Raises:
        InputError: the file is not a valid YAML file (`Document`), or the configuration is invalid
            (`parse_vehicle`).
    """
    if isinstance(path, Mapping):
        document = Document.from_tree(path)
    elif isinstance(path, Document):
        document = path
    else:
        document = Document.load(path or default_config_path())
    document = _merge_base(document)
    apply_settings(settings, document)
    return parse_vehicle(document)


def parse_vehicle(document: Document) -> VehicleConfig:
    """Return the configuration in a document.

    Raises:
        InputError: a key is unknown or missing; a value has the wrong type or is out of range; a material
            lacks a mode of the vehicle; or the motors cannot carry the mass or control every axis.
    """
    lock = document.tree.get("lock")
    if isinstance(lock, dict) and lock.get("driver") == NO_LOCK:
        document.tree["lock"] = None
    elif isinstance(lock, dict) and "driver" in lock and lock["driver"] not in list(LockDriver):
        given = lock["driver"] if isinstance(lock["driver"], str) else json.dumps(lock["driver"])
        known = ", ".join(driver.value for driver in LockDriver)
        text = f"{given!r} is not allowed, only: {known}, or {NO_LOCK} for a vehicle without a lock"
        raise document.error(("lock", "driver"), text)
    config = document.convert(VehicleConfig)
    for name, material in config.materials.items():
        if config.has_lock and material.flexible is None:
            text = "missing key `flexible`: the vehicle has a lock (if not, set lock.driver to none)"
            raise document.error(("materials", name), text)
    _refuse_unflyable(config, document)
    return config


def _refuse_unflyable(config: VehicleConfig, document: Document) -> None:
    count, most_n, hover = (
        len(config.airframe.motors),
        config.thrust.max_thrust_n,
        config.hover_thrust_fraction(),
    )
    if hover > 0.8:
        thrust = "table" if config.thrust.table is not None else "full_n"
        raise document.error(
            _set_last(document, ("airframe", "mass_kg"), ("thrust", thrust)),
            f"{count} motors of {most_n:g} N (thrust.{thrust}) need {hover:.0%} of full thrust to hover "
            f"{config.airframe.mass_kg:g} kg (airframe.mass_kg), limit 80 %: correct one of the two",
        )
    if config.airframe.listed is None:
        return
    import numpy as np  # noqa: PLC0415  slow to import and rarely needed here

    turning = np.array(effectiveness(config.airframe.motors))
    if np.linalg.matrix_rank(turning, tol=1e-4) < len(turning):
        text = "the motors cannot control roll, pitch, yaw and lift independently: check the motors"
        raise document.error(("airframe", "motors"), text)
    lift = np.linalg.pinv(turning)[:, 3]
    if lift.min() <= 0.0:
        text = (
            f"in level hover, motor {lift.argmin() + 1} would need a thrust of zero or less: the centre of "
            "mass is not between the motors"
        )
        raise document.error(("airframe", "motors"), text)


def _set_last(document: Document, first: Key, second: Key) -> Key:
    """Return the one of two keys that a later file has set; `first` if both are from the same file."""
    names = list(document.set_by)
    if second not in names or (first in names and names.index(first) > names.index(second)):
        return first
    file, other = (document.set_by.get(key, "").partition(":")[0] for key in (first, second))
    return first if file == other else second


def _merge_base(document: Document, seen: tuple[Path, ...] = ()) -> Document:
    """Return a configuration's document; missing keys are added from the file that `extends` names."""
    if EXTENDS not in document.tree:
        return document
    base = document.tree.pop(EXTENDS)
    if not isinstance(base, str):
        raise document.error((EXTENDS,), "expected the name of a configuration file")
    path = Path(document.source)  # relative to the working folder if the document was built in Python
    seen = (*seen, path.resolve())
    below = path.parent / base
    if below.resolve() in seen:
        raise document.error((EXTENDS,), "a configuration cannot extend itself")
    merged = _merge_base(Document.load(below), seen)
    for key, value in iterate_leaves(document.tree):
        node = merged.tree
        for part in key[:-1]:
            if not isinstance(node.get(part), dict):
                node[part] = {}
            node = node[part]
        node[key[-1]] = value
        merged.set_by.pop(key, None)  # a dict keeps a key's old place, so remove the key first
        merged.set_by[key] = document.error(key, "").one_line()
    return merged
