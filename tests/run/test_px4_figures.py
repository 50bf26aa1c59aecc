"""What PX4's own log says is the lab's: where reading it fails, that costs a line and not the flight."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest

from dart_flight.base.records import Record, StatusText
from dart_flight.recording.verdict import Px4Figures
from dart_flight.run import px4_flight


@pytest.mark.parametrize(("error", "lines"), [(KeyError("failsafe"), 1), (ImportError("no lab"), 0)])
def test_a_fault_of_the_lab_costs_one_line(
    error: Exception, lines: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(entry: str) -> NoReturn:
        raise error

    monkeypatch.setattr(px4_flight, "load_entry", fails)
    told: list[Record] = []
    assert px4_flight._px4_figures(Path("px4.ulg"), "1.18.0", told.append) == Px4Figures("1.18.0")
    assert len(told) == lines
    assert all(isinstance(one, StatusText) and "KeyError('failsafe')" in one.text for one in told)
