"""The figures of a report as files for a paper: vector graphics, one column wide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dart_flight.config.document import report_write_errors
from dart_flight.lab.figure_style import COLUMN, save_figure, save_pages
from dart_flight.lab.report.figures import forces, motion
from dart_flight.lab.report.figures import lock_timeline as lock
from dart_flight.lab.report.figures.flight_map import flight_map
from dart_flight.lab.report.recorded_flight import RecordedFlight


def figures_of(flights: Sequence[RecordedFlight]) -> Iterator[tuple[str, Any]]:
    """Yield (name, figure), `COLUMN` wide, for each figure of a report on flights of one mission."""
    yield "map", flight_map(flights, look=COLUMN)
    if len(flights) > 1:
        yield "errors", forces.errors_over_trials(flights, look=COLUMN)
        for index in sorted({impact.verdict.index for flight in flights for impact in flight.impacts}):
            yield f"force_{index}", forces.impact_forces_over_trials(flights, index, look=COLUMN)
        return
    flight = flights[0]
    for impact in flight.impacts:
        yield f"force_{impact.verdict.index}", forces.impact_forces(flight, impact, look=COLUMN)
    yield "motion", motion.motion(flight, look=COLUMN)
    yield "attitude", motion.attitude(flight, look=COLUMN)
    yield "tracking", motion.tracking_error(flight, look=COLUMN)
    yield "thrust", motion.thrust_and_battery(flight, look=COLUMN)
    yield "timeline", lock.timeline(flight, look=COLUMN)


def write_svgs(flights: Sequence[RecordedFlight], folder: Path) -> list[Path]:
    """Write one SVG file for each figure; text stays text and is not converted to outlines."""
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, figure in figures_of(flights):
        path = folder / f"{name}.svg"
        save_figure(figure, path)
        written.append(path)
    return written


def write_pdf(flights: Sequence[RecordedFlight], path: Path) -> None:
    """Write all figures into one PDF, one per page, with fonts embedded as TrueType."""
    save_pages((figure for _, figure in figures_of(flights)), path)
