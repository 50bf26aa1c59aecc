"""A real-time test that is too slow is skipped on a busy computer. Every other failure counts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests import conftest
from tests.real_time import TooSlow


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


def test_a_test_that_is_too_slow_on_a_busy_computer_is_skipped(ticks: list[tuple[int, int]]) -> None:
    ticks += [(1000, 5000), (1005, 5200)]
    with pytest.raises(pytest.skip.Exception, match="idle 2 % of the time, needed 10; not within 3 s"):
        run(TooSlow("not within 3 s"))


def test_another_failure_on_a_busy_computer_stays_a_failure(ticks: list[tuple[int, int]]) -> None:
    ticks += [(1000, 5000), (1005, 5200)]
    with pytest.raises(AssertionError, match="two sets of words"):
        run(AssertionError("two sets of words"))


def test_a_test_that_is_too_slow_on_an_idle_computer_fails(ticks: list[tuple[int, int]]) -> None:
    ticks += [(1000, 5000), (1100, 5200)]
    with pytest.raises(TooSlow, match="not within 3 s"):
        run(TooSlow("not within 3 s"))


def test_a_test_of_a_late_process_is_skipped(
    ticks: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks += [(1000, 5000), (1100, 5200)]
    monkeypatch.setattr(conftest.LoadWatch, "_run", lambda self: setattr(self, "worst_s", 0.05))
    with pytest.raises(pytest.skip.Exception, match="50 ms late, allowed 30"):
        run(TooSlow("not within 3 s"))


def test_passing_tests_and_tests_in_simulated_time_are_never_skipped(
    ticks: list[tuple[int, int]],
) -> None:
    ticks += [(1000, 5000)]
    run(None)
    with pytest.raises(TooSlow):
        run(TooSlow("not within 3 s"), realtime=False)
