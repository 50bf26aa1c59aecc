"""Shared test settings."""

import gc
import threading
import time
from collections.abc import Generator

import pytest
from hypothesis import settings

import dart_flight  # noqa: F401  before NumPy: it sets the number of its threads
from tests.shared_flights import commanded, flown

__all__ = ["commanded", "flown"]

# Deterministic examples: the same commit gives the same answer on every machine.
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("ci")

_NAP_S = 0.005
_LATE_S = 0.03  # a program that runs this much later than it asked for cannot fly in real time


class LatenessWatch:
    """Measures how late this process runs, by short sleeps on a thread of its own.

    Attributes:
        worst_s: largest delay so far, seconds.
    """

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the measurement."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic() + _NAP_S
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            self.worst_s = max(self.worst_s, time.monotonic() - due_s)
            due_s = time.monotonic() + _NAP_S


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Skip a test in real time that fails while the computer does not keep up with real time.

    The failure then measures the computer. A test that fails on an idle computer fails.
    """
    if item.get_closest_marker("realtime") is None:
        return (yield)
    watch = LatenessWatch()
    try:
        return (yield)
    except Exception:
        if watch.worst_s > _LATE_S:
            pytest.skip(
                f"real time: this computer ran {watch.worst_s * 1e3:.0f} ms late, allowed {_LATE_S * 1e3:.0f}"
            )
        raise
    finally:
        watch.stop()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Modules and tests stay to the end: no garbage collection need look at them again and again."""
    gc.collect()
    gc.freeze()
