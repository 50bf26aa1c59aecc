"""Figures from PX4's own log: if the lab cannot read it, the flight still ends with a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest

from dart_flight.base.records import Record, StatusText
from dart_flight.recording.verdict import Px4Figures
from dart_flight.run import px4_flight


@pytest.mark.parametrize(("error", "lines"), [(KeyError("failsafe"), 1), (ImportError("no lab"), 0)])
def test_an_error_in_the_lab_is_reported_and_a_missing_lab_is_not(
    error: Exception, lines: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(entry: str) -> NoReturn:
        raise error

    monkeypatch.setattr(px4_flight, "load_entry", fail)
    shown: list[Record] = []
    # The function around it flies with PX4.
    assert px4_flight._px4_figures(Path("px4.ulg"), "1.18.0", shown.append) == Px4Figures("1.18.0")
    assert len(shown) == lines
    assert all(isinstance(record, StatusText) and "KeyError('failsafe')" in record.text for record in shown)
