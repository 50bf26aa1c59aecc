"""The PX4 SITL build of the tests; tests are skipped with a message if there is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dart_flight.config.document import InputError
from dart_flight.sim.px4.launch import ENVIRONMENT, find_install


@pytest.fixture(scope="session")
def px4_dir() -> Path:
    """Return the folder of the user's PX4."""
    named = os.environ.get(ENVIRONMENT)
    if not named:
        pytest.skip(f"{ENVIRONMENT} is not set: no PX4 SITL to test with (docs/px4.md)")
    try:
        find_install(named)
    except InputError as error:
        pytest.fail(f"{ENVIRONMENT}: {error}")
    return Path(named)
