"""Settings, fixtures and hooks of all tests."""

import gc
import threading
import time
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis.internal.conjecture import providers

import dart_flight  # noqa: F401  before NumPy: it sets the number of its threads
from tests.command_fixtures import alarm, folder, refusal_of, run_json, type_lines
from tests.real_time import TooSlow
from tests.shared_flights import commanded, flown

__all__ = ["alarm", "commanded", "flown", "folder", "refusal_of", "run_json", "type_lines"]

# Examples must be the same on every machine. Hypothesis also draws constants from the sources of all imported
# modules. They would depend on the other imports of a worker, and reading them takes 7 s per worker.
providers._get_local_constants = lambda: providers._local_constants
settings.register_profile("ci", derandomize=True, deadline=None, max_examples=100)
settings.load_profile("ci")

COLLECTED = pytest.StashKey[dict[str, set[str]]]()
_NAP_S = 0.005
_LATE_S = 0.03  # a program that runs this much too late cannot fly in real time
_IDLE_SHARE = 0.1  # required share of processor time, because real-time tests mostly wait


class LoadWatch:
    """A measurement of this process's lateness, by short sleeps of a thread, and of the computer's idle time.

    Attributes:
        worst_s: largest delay so far, seconds.
    """

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._began = _processor_ticks()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the measurement."""
        self._stop.set()
        self._thread.join()

    def problem(self) -> str:
        """Return why real-time results are invalid, or an empty string if they are valid."""
        if self.worst_s > _LATE_S:
            return f"this computer ran {self.worst_s * 1e3:.0f} ms late, allowed {_LATE_S * 1e3:.0f}"
        (idle, total), (idle_then, total_then) = _processor_ticks(), self._began
        share = (idle - idle_then) / max(1, total - total_then)
        if share < _IDLE_SHARE:
            return f"this computer was idle {100 * share:.0f} % of the time, needed {100 * _IDLE_SHARE:.0f}"
        return ""

    def _run(self) -> None:
        due_s = time.monotonic() + _NAP_S
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            self.worst_s = max(self.worst_s, time.monotonic() - due_s)
            due_s = time.monotonic() + _NAP_S


def _processor_ticks() -> tuple[int, int]:
    """Return the idle ticks of all processors since the start of the computer, and all ticks."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    return fields[3] + fields[4], sum(fields[:8])


def _skipped_if_busy(item: pytest.Item) -> Generator[None, None, None]:
    if item.get_closest_marker("realtime") is None:
        return (yield)
    watch = LoadWatch()
    try:
        return (yield)
    except TooSlow as error:
        if problem := watch.problem():
            pytest.skip(f"real time: {problem}; {error}")
        raise
    finally:
        watch.stop()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, None, None]:
    """Skip a real-time test if its fixtures exceed a limit of time while the computer is busy."""
    return (yield from _skipped_if_busy(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Skip a real-time test if it exceeds a limit of time while the computer is too busy for real time.

    On an idle computer the failure counts, and so does every other failure.
    """
    return (yield from _skipped_if_busy(item))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Note the marks of all collected tests, before `-m` deselects some."""
    config.stash[COLLECTED] = {item.nodeid: {mark.name for mark in item.iter_markers()} for item in items}


def pytest_collection_finish(session: pytest.Session) -> None:
    """Exempt modules and tests from garbage collection, because they exist until the end."""
    gc.collect()
    gc.freeze()
