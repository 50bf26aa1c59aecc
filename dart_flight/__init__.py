"""DART flight: fly a dual-stiffness quadrotor into walls on purpose, and use the impacts.

Scripts use the names in this package (`dart_flight.simulate`, ...; docs/python.md). Names are imported
lazily, on first use. `docs/architecture.md` shows the folders and the path of one IMU sample.
"""

import os
from typing import TYPE_CHECKING, Any

# Set this before the first import of NumPy. NumPy's threads do not speed up small matrices, but they take
# processor time from a flight on the same machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.2.0"

# ruff: noqa: F405  (the names are in `api.__all__`, too)
if TYPE_CHECKING:
    from dart_flight.lab.api import *  # noqa: F403

__all__ = [
    "Flight",
    "FlightSetpoint",
    "Identification",
    "InputError",
    "Log",
    "Mission",
    "PlanResult",
    "Simulation",
    "Trial",
    "VehicleConfig",
    "Verdict",
    "identify",
    "load_mission",
    "load_scenario",
    "load_vehicle",
    "packaged",
    "plan",
    "predict",
    "predict_drop",
    "read_log",
    "simulate",
    "verdict_of",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from dart_flight.lab_entries import SCRIPT_NAMES, load_entry  # noqa: PLC0415  loaded on demand

    value = getattr(load_entry(SCRIPT_NAMES), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
