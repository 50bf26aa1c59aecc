"""The PX4 SITL of the tests; tests are skipped with a message if there is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dart_flight.config.document import InputError
from dart_flight.sim.px4.installation import ENVIRONMENT, find_install


@pytest.fixture(scope="session")
def px4_dir() -> Path:
    """Return the folder of the PX4 that `dry-run --px4` finds."""
    try:
        return find_install(None).folder
    except InputError as error:
        if os.environ.get(ENVIRONMENT):
            pytest.fail(str(error))
        pytest.skip(f"{error} (docs/px4.md)")
