"""A short campaign of random toggles with faults, and proof that it detects a wrong report."""

from __future__ import annotations

import pytest

from dart_flight.config.vehicle import LockConfig
from tests.lock.random_toggles import run_campaign


@pytest.mark.parametrize(("controller", "toggles"), [("mock", 200), ("maestro", 75)])
def test_random_toggles_with_faults_find_no_violation(controller: str, toggles: int) -> None:
    tally = run_campaign(controller, toggles, seed=7)
    assert tally.violations == []
    assert tally.toggles == toggles
    # The campaign has covered every kind of outcome.
    assert tally.settled_with_feedback > 0.3 * toggles
    assert tally.settled_without_feedback > 0.3 * toggles
    assert tally.faults_reported > 0.05 * toggles
    assert tally.wrong_without_feedback > 0
    assert tally.refused > 0


def test_the_campaign_detects_a_lock_that_settles_too_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LockConfig, "switch_time_s", property(lambda self: 0.1))
    assert any("but the horn is at" in line for line in run_campaign("mock", 50, seed=7).violations)
