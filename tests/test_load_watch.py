"""A failing real-time test is skipped on a busy computer, and fails on an idle one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests import conftest


@pytest.fixture
def ticks(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Idle and total ticks that the watch reads in turn; its thread does not measure."""
    given: list[tuple[int, int]] = []
    monkeypatch.setattr(conftest, "_processor_ticks", lambda: given.pop(0))
    monkeypatch.setattr(conftest.LoadWatch, "_run", lambda self: None)
    return given


def run(error: BaseException | None, realtime: bool = True) -> None:
    """Run a test that ends with `error` inside the hook."""
    item: Any = SimpleNamespace(get_closest_marker=lambda name: realtime or None)
    hook = conftest._skipped_if_busy(item)
    next(hook)
    try:
        if error is None:
            hook.send(None)
        else:
            hook.throw(error)
    except StopIteration:
        pass


@pytest.mark.parametrize("error", [AssertionError("late"), pytest.fail.Exception("ended before")])
def test_a_failure_on_a_busy_computer_becomes_a_skip(
    ticks: list[tuple[int, int]], error: BaseException
) -> None:
    ticks += [(1000, 5000), (1005, 5200)]
    with pytest.raises(pytest.skip.Exception, match="idle 2 % of the time, needed 10"):
        run(error)


def test_a_failure_on_an_idle_computer_stays_a_failure(ticks: list[tuple[int, int]]) -> None:
    ticks += [(1000, 5000), (1100, 5200)]
    with pytest.raises(AssertionError, match="wrong"):
        run(AssertionError("wrong"))


def test_a_failure_of_a_late_process_becomes_a_skip(
    ticks: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks += [(1000, 5000), (1100, 5200)]
    monkeypatch.setattr(conftest.LoadWatch, "_run", lambda self: setattr(self, "worst_s", 0.05))
    with pytest.raises(pytest.skip.Exception, match="50 ms late, allowed 30"):
        run(AssertionError("wrong"))


def test_passing_tests_and_tests_in_simulated_time_are_never_skipped(
    ticks: list[tuple[int, int]],
) -> None:
    ticks += [(1000, 5000)]
    run(None)
    with pytest.raises(AssertionError, match="wrong"):
        run(AssertionError("wrong"), realtime=False)
