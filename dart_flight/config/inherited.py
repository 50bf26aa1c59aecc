"""Values that a vehicle file inherits from another vehicle; `check` lists them and flags contradictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from dart_flight.config.document import Document, dotted, iterate_leaves
from dart_flight.config.file_kinds import EXTENDS
from dart_flight.config.vehicle import VehicleConfig, load_vehicle, packaged

_COPIED: Final = 0.5  # a file is a copy if it has more than this fraction of a packaged file's values
_SAME: Final = 0.1  # values with a smaller relative difference count as equal
_SIZE: Final = ("airframe.arm_x_m", "airframe.arm_y_m", "airframe.motors")
_TURNING: Final = ("airframe.mass_kg", "airframe.inertia_kg_m2", "thrust.full_n", *_SIZE)
LOCK: Final = "lock"

# Keys that must be measured for each vehicle -> keys on which their values depend.
FOLLOWS_FROM: Final[Mapping[str, tuple[str, ...]]] = {
    "airframe.mass_kg": (),
    "airframe.contact_distance_m": _SIZE,
    "airframe.guard_along_m": ("airframe.contact_distance_m", *_SIZE),
    "airframe.inertia_kg_m2": ("airframe.mass_kg", *_SIZE),
    "airframe.arm_x_m": ("airframe.motors",),
    "airframe.arm_y_m": ("airframe.motors",),
    "airframe.yaw_torque_per_thrust_m": (),
    "airframe.drag_per_s": (),
    "thrust.full_n": ("thrust.table",),
    "thrust.model_factor": ("thrust.table",),
    "thrust.motor_lag_s": (),
    "imu.full_scale_m_s2": (),
    "imu.position_m": (),
    "estimation.thrust_error_n": ("airframe.mass_kg",),
    "estimation.baseline_limit_n": ("airframe.mass_kg",),
    "estimation.battery.reference_v": (),
    "estimation.arm_vibration": (LOCK,),
    "detection.force_threshold_n": ("airframe.mass_kg",),
    "guard.battery_v": ("estimation.battery.reference_v",),
    "px4.MC_ROLLRATE_P": _TURNING,
    "px4.MC_PITCHRATE_P": _TURNING,
    "px4.MC_YAWRATE_P": _TURNING,
    "simulation.arm_vibration": (LOCK,),
    "simulation.battery_v": ("estimation.battery.reference_v",),
    "simulation.contact.guard_out_m": ("airframe.contact_distance_m",),
    "simulation.contact.guard_along_m": ("airframe.guard_along_m",),
}
_MATERIALS: Final = "materials."


class Inherited(NamedTuple):
    """Values that a vehicle file inherits from another vehicle's file.

    Attributes:
        file: the vehicle's own file.
        base: the file that it inherits from, such as "dart.yaml" or "the shipped rigid_cage.yaml".
        keys: inherited keys with their values, as text.
        contradictions: for each changed value, the inherited keys that contradict the change. The dict's
            keys are texts such as "airframe.mass_kg 1.2 instead of 0.9"; the lists are like `keys`.
    """

    file: str
    base: str
    keys: tuple[str, ...]
    contradictions: dict[str, list[str]]


class _Base(NamedTuple):
    """The base of a vehicle's file: the file that it extends, or the packaged file of which it is a copy."""

    path: Path
    is_original: bool  # whether the vehicle's file is a copy of this file
    is_dart: bool
    given: set[str]  # keys that the vehicle's file sets or has changed


def find_inherited(
    vehicle: VehicleConfig, file: str | None, settings: Sequence[str] = ()
) -> Inherited | None:
    """Return the values that a vehicle's file inherits from a packaged file or from the file in `extends`.

    A copy of a packaged example inherits every unchanged value, because this value was not measured.

    Args:
        vehicle: the whole configuration.
        file: file of the configuration, or None if it was built in Python.
        settings: `KEY=VALUE` pairs from `--set`.

    Returns:
        None for DART itself. A file describes DART if it is DART's own file, or if it extends or copies that
        file and changes neither the lock, a material nor a key in `FOLLOWS_FROM`.
    """
    if file is None:
        return None
    base = _base(Path(file))
    given = base.given | {setting.partition("=")[0].strip() for setting in settings}
    own, inherited = _values(vehicle), _values(load_vehicle(base.path))
    materials = {f"{_MATERIALS}{name}": ("airframe.mass_kg", LOCK) for name in vehicle.materials}
    measured = {**FOLLOWS_FROM, **materials}
    of_vehicle = base.given if base.is_original else given  # ignore `--set`
    if own[LOCK] == inherited[LOCK] and not any(_is_given(key, of_vehicle) for key in measured):
        if base.is_dart:
            return None
        if not base.is_original:  # the vehicle is still that of the extended file
            return find_inherited(vehicle, str(base.path), settings)
    kept: list[str] = []
    contradictions: dict[str, list[str]] = {}
    for key, follows in measured.items():
        value = own.get(key)
        if value is None or value != inherited.get(key) or _is_given(key, given):
            continue
        text = key if key.startswith(_MATERIALS) else f"{key} {_short(value)}"
        reason = next((k for k in follows if _differ(own.get(k), inherited.get(k))), None)
        if reason is None:
            kept.append(text)
        else:
            there, here = _short(inherited.get(reason)), _short(own.get(reason))
            contradictions.setdefault(f"{reason} {here} instead of {there}", []).append(text)
    name = f"the shipped {base.path.name}" if base.is_original else base.path.name
    return Inherited(file, name, tuple(kept), contradictions)


def _base(path: Path) -> _Base:
    own = _by_name(Document.load(path).tree)
    original = _copied_from(path.name, own)
    if original is None:
        extended = path.parent / str(own[EXTENDS])
        return _Base(extended, False, EXTENDS not in Document.load(extended).tree, set(own))
    known = _by_name(Document.load(original).tree)
    given = {key for key, value in own.items() if value != known.get(key)}
    return _Base(original, True, EXTENDS not in known, given)


def _copied_from(name: str, own: Mapping[str, Any]) -> Path | None:
    """Return the packaged file from which this file was copied, even if it was renamed and edited since."""
    shipped = sorted(packaged("configs", "dart.yaml").parent.glob("*.yaml"))
    for path in shipped:
        if path.name == name:
            return path
    if EXTENDS not in own:
        return packaged("configs", "dart.yaml")

    def share(path: Path) -> float:
        known = _by_name(Document.load(path).tree)
        return sum(bool(own.get(key) == value) for key, value in known.items()) / len(known)

    likest = max(shipped, key=share)
    return likest if share(likest) > _COPIED else None


def _by_name(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {dotted(key): value for key, value in iterate_leaves(tree)}


def _values(vehicle: VehicleConfig) -> dict[str, Any]:
    """Return the vehicle's values for the keys in `FOLLOWS_FROM` and for the keys of the materials."""
    tree = vehicle.to_dict()
    values: dict[str, Any] = {LOCK: "servo" if vehicle.has_lock else "none"}
    for key in {key for row in FOLLOWS_FROM.items() for key in (row[0], *row[1])} - {LOCK}:
        value: Any = tree
        for part in key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        values[key] = value
    values |= {f"{_MATERIALS}{name}": material["rigid"] for name, material in tree["materials"].items()}
    return values


def _is_given(key: str, given: set[str]) -> bool:
    return any(one == key or one.startswith(f"{key}.") or key.startswith(f"{one}.") for one in given)


def _differ(a: Any, b: Any) -> bool:
    """Return whether a value differs from the inherited `b` by more than the measurement error."""
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) > _SAME * abs(b)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and len(a) == len(b) and not isinstance(a, str):
        return any(_differ(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return any(_differ(a[key], b[key]) for key in a)
    return bool(a != b)


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "of unlocked arms" if "damping_ratio" in value else "of another vehicle"
    if isinstance(value, list | tuple):
        return f"of {len(value)} motors" if value and isinstance(value[0], dict) else f"{list(value)}"
    return f"{value:g}" if isinstance(value, int | float) else str(value)
