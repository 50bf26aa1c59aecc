"""Progress of many flights without a terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from dart_flight.cli.flight_progress import FlightProgress, flight_rate


@pytest.mark.parametrize(
    ("per_s", "shown"),
    [(5.0, "300 a minute"), (1 / 6, "10 a minute"), (0.1, "360 an hour"), (1 / 360, "10 an hour"),
     (1 / 1800, "2.0 an hour"), (1 / 36_000, "0.1 an hour")],
)  # fmt: skip
def test_a_low_rate_is_shown_per_hour(per_s: float, shown: str) -> None:
    assert flight_rate(per_s) == shown


def test_every_flight_is_counted_without_a_terminal() -> None:
    text = io.StringIO()
    with FlightProgress(Console(file=text), 20, "the plan", line_every_s=0.0) as progress:
        progress(0, 0)
        for flown in (1, 2):
            progress(flown, flown - 1)
        progress.interrupted(2)
    first, second, last = text.getvalue().splitlines()
    assert first.startswith("the plan: 1 of 20 flights, ")
    assert second.endswith(" left, 1 not completed")
    assert last.startswith("interrupted: waiting for 2 flights in progress to land")
