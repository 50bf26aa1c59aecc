"""Progress of many simulated flights on standard error: a bar on a terminal, otherwise lines."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

ONLY_NOISE = (
    "the flights differ only in sensor noise; --vary all also draws vehicle, walls and lock (docs/draws.md)"
)
_LEAST_SHOWN = 10.0  # show lower rates per minute as rates per hour, and lower rates per hour with a decimal
_SHOWN_IN_MINUTES_S = 120.0


class FlightProgress:
    """Number of flights flown and failed, their rate and the remaining time.

    Args:
        name: text before the counts.
        line_every_s: interval between lines if the output is not a terminal, seconds.
    """

    def __init__(self, console: Console, flights: int, name: str = "", line_every_s: float = 10.0) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._console, self._flights, self._line_every_s = console, flights, line_every_s
        self._name = f"{name}: " if name else ""
        self._began_s, self._printed_s = time.monotonic(), time.monotonic()
        self._begun_with: int | None = None
        self._bar = Progress(
            TextColumn(name),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[failed]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("flights", total=flights, rate="", failed="")

    def __enter__(self) -> FlightProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, flown: int, failed: int) -> None:
        """Show how many flights have been flown so far and how many of them did not complete."""
        now_s = time.monotonic()
        if self._begun_with is None:
            self._begun_with = flown
            self._bar.update(self._task, completed=flown)
            if flown:
                self._console.print(f"{flown} of {self._flights} flights are already in the table")
        per_s = (flown - self._begun_with) / max(now_s - self._began_s, 1e-6)
        rate = flight_rate(per_s) if per_s else ""
        bad = f"{failed} not completed" if failed else ""
        self._bar.update(self._task, completed=flown, rate=rate, failed=bad)
        if self._console.is_terminal or not per_s or now_s - self._printed_s < self._line_every_s:
            return
        self._printed_s = now_s
        left_s = (self._flights - flown) / per_s
        left = f"{left_s / 60.0:.0f} min left" if left_s >= _SHOWN_IN_MINUTES_S else f"{left_s:.0f} s left"
        parts = [f"{self._name}{flown} of {self._flights} flights", rate, left]
        self._console.print(", ".join([*parts, *([bad] if bad else [])]), soft_wrap=True)

    def interrupted(self, under_way: int) -> None:
        """Report the operator's interrupt; `under_way` flights are still in progress."""
        flights = "1 flight" if under_way == 1 else f"{under_way} flights"
        self._console.print(
            f"interrupted: waiting for {flights} in progress to land; interrupt again to abandon them",
            style="red",
            soft_wrap=True,
        )


def flight_rate(per_s: float) -> str:
    """Return a rate of flights per minute or, if it is low, per hour."""
    if 60.0 * per_s >= _LEAST_SHOWN:
        return f"{60.0 * per_s:.0f} a minute"
    per_hour = 3600.0 * per_s
    return f"{per_hour:.0f} an hour" if per_hour >= _LEAST_SHOWN else f"{per_hour:.1f} an hour"
