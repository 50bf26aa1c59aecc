"""Shared test settings."""

import gc

import pytest
from hypothesis import settings

import dart_flight  # noqa: F401  before NumPy: it sets the number of its threads
from tests.shared_flights import commanded, flown

__all__ = ["commanded", "flown"]

# Deterministic examples: the same commit gives the same answer on every machine.
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("ci")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Modules and tests stay to the end: no garbage collection need look at them again and again."""
    gc.collect()
    gc.freeze()
