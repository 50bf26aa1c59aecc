"""What simulated worlds need beyond the program itself, looked for before anything is started or written."""

from __future__ import annotations

import importlib.util

from dart_flight.config.document import InputError


def need_mavlink() -> None:
    """Make sure that the process of the simulated vehicle will find what it imports.

    Raises:
        InputError: a package is not installed.
    """
    if importlib.util.find_spec("pymavlink") is None:
        raise InputError("simulation needs pymavlink: pip install 'dart-flight[sim]'")
