"""The whole configuration of a vehicle: type, places where it is looked for, loading."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from dart_flight.config.document import Document
from dart_flight.config.kinds import EXTENDS
from dart_flight.config.section import Section
from dart_flight.config.settings import apply_settings
from dart_flight.config.vehicle.airframe import Airframe, Imu, Material, Thrust
from dart_flight.config.vehicle.autopilot import ConnectionConfig, Px4Parameters
from dart_flight.config.vehicle.estimation import Detection, Estimation
from dart_flight.config.vehicle.flight import Flying, GuardThresholds
from dart_flight.config.vehicle.lock import LockConfig
from dart_flight.config.vehicle.simulation import Simulation
from dart_flight.geometry import GRAVITY_M_S2


class VehicleConfig(Section, frozen=True):
    """The whole of `configs/dart.yaml`.

    Attributes:
        version: of the format.
        materials: by name, the contact coefficients in both modes: k N/m, f N s/m, mu s/m, nu N.
        onset: lcp: the contact begins by the complementarity condition, as in the paper; touch: not before
            the wall's plane is reached.
        vertical_force_sign: of the vertical contact force along Z of the collision frame; -1: up at a wall.
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
    lock: LockConfig
    connection: ConnectionConfig
    px4: Px4Parameters
    simulation: Simulation

    def hover_thrust_fraction(self) -> float:
        """Thrust at hover as a fraction of full thrust (what PX4 calls MPC_THR_HOVER)."""
        return self.airframe.mass_kg * GRAVITY_M_S2 / (4.0 * self.thrust.full_n)


def packaged(*parts: str) -> Path:
    """A file of `configs/` or `missions/`: from the checkout, else the copy in the installed package."""
    checkout = Path(__file__).resolve().parents[3].joinpath(*parts)
    if checkout.exists():
        return checkout
    return Path(str(resources.files("dart_flight").joinpath("data", *parts)))


def default_config_path() -> Path:
    """$DART_FLIGHT_CONFIG, else ./configs/dart.yaml, else the packaged default."""
    named = os.environ.get("DART_FLIGHT_CONFIG")
    if named:
        return Path(named)
    local = Path("configs/dart.yaml")
    return local if local.exists() else packaged("configs", "dart.yaml")


def load_vehicle(path: str | Path | None = None, settings: Sequence[str] = ()) -> VehicleConfig:
    """Load and validate a vehicle configuration.

    Args:
        path: of the file; the default configuration without.
        settings: `KEY=VALUE` with a dotted key, set before the validation (`config.settings`).

    A file with `extends: FILE` holds only what differs from that one, which lies relative to it.

    Raises:
        InputError: as `Document`; or the thrust cannot carry the mass.
    """
    document = _with_base(Path(path or default_config_path()))
    apply_settings(settings, document)
    config = document.convert(VehicleConfig)
    if config.hover_thrust_fraction() > 0.8:
        raise document.error(
            ("thrust", "full_n"),
            f"four motors of {config.thrust.full_n:g} N hover {config.airframe.mass_kg:g} kg at "
            f"{config.hover_thrust_fraction():.0%} of full thrust, at most 80 % is flown",
        )
    return config


def _with_base(path: Path, seen: tuple[Path, ...] = ()) -> Document:
    """A configuration's document, what it extends put below it."""
    document = Document.load(path)
    if EXTENDS not in document.tree:
        return document
    base = document.tree.pop(EXTENDS)
    if not isinstance(base, str):
        raise document.error((EXTENDS,), "expected the name of a configuration file")
    seen = (*seen, path.resolve())
    below = path.parent / base
    if below.resolve() in seen:
        raise document.error((EXTENDS,), "a configuration cannot extend itself")
    merged = _with_base(below, seen)
    for key, value in _leaves(document.tree):
        node = merged.tree
        for part in key[:-1]:
            if not isinstance(node.get(part), dict):
                node[part] = {}
            node = node[part]
        node[key[-1]] = value
        merged.set_by[key] = document.error(key, "").one_line()
    return merged


def _leaves(tree: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))
        else:
            yield (*above, key), value
