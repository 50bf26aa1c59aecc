"""Pages of `docs/results`: their measured blocks, Markdown tables, and what stands in a table's cells.

A block is what one command measured. The command writes it between two comments of the page, so that a page
shows only what its command gave. `python -m tools.campaigns --list` reads the blocks.
"""

from __future__ import annotations

import datetime
import re
import statistics
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dart_flight.base.errors import FlightError
from dart_flight.base.summary import wilson
from dart_flight.config.document import InputError
from dart_flight.lab.campaign.flight_job import JudgedRow

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"
_MEASURED = re.compile(
    r"(?:M|Kept: m)easured on (?P<date>[\d-]+)\s+by\s+`(?P<command>[^`]+)`\s+at\s+commit\s+"
    r"(?P<commit>[0-9a-f]+)(?:[^\n]*\((?P<duration>[\d.]+ (?:s|min|h))\))?"
)


class NoResultError(FlightError):
    """A run without a result is no fault of the program; the page counts it with this reason."""


class Measurement(NamedTuple):
    """A measurement of a page. `later` counts the commits since; None if the history lacks the commit."""

    page: str
    command: str
    date: str
    commit: str
    duration: str
    later: int | None


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = (heads, ["---"] * len(heads), *rows)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def grouped(rows: Iterable[JudgedRow], *keys: str) -> dict[tuple[str, ...], list[Any]]:
    """Return the flights of each combination of values of these keys."""
    groups: dict[tuple[str, ...], list[Any]] = {}
    for r in rows:
        groups.setdefault(tuple(r.values[key] for key in keys), []).append(r.row)
    return groups


def rate(count: int, total: int, digits: int = 0) -> str:
    """Return a number of flights with its 95 % interval."""
    low, high = wilson(count, total)
    return f"{count} of {total} ({100 * low:.{digits}f} to {100 * high:.{digits}f} %)"


def causes(names: Iterable[str]) -> str:
    """Return the rules that ended flights, the most frequent first."""
    return ", ".join(f"`{name}` {count}" for name, count in Counter(names).most_common()) or "-"


def without_result(errors: Sequence[str], runs: int) -> tuple[str, list[str]]:
    """Return a sentence about the runs without a result, and the errors of the program."""
    begin = f"{NoResultError.__name__}: "
    reasons = [error.removeprefix(begin).rsplit(" (", 1)[0] for error in errors if error.startswith(begin)]
    counted = ", ".join(f"{reason} {count}" for reason, count in Counter(reasons).most_common())
    sentence = f"Without a result: {len(reasons)} of {runs} runs ({counted})." if reasons else ""
    return sentence, [error for error in errors if not error.startswith(begin)]


def median_and_most(
    values: Iterable[float | None], digits: int = 0, most: Callable[[list[float]], float] = max
) -> str:
    """Return the median and the largest of the known values."""
    known = [value for value in values if value is not None]
    return f"{statistics.median(known):.{digits}f}, {most(known):.{digits}f}" if known else "-"


def marks(name: str) -> tuple[str, str]:
    """Return the comments around the block of a command."""
    return f"<!-- measured: {name} -->", f"<!-- end: {name} -->"


def pages_with(name: str) -> list[Path]:
    """Return the pages that have a block of this name."""
    return [path for path in sorted(PAGES.glob("*.md")) if marks(name)[0] in path.read_text("utf-8")]


def write_block(page: Path, name: str, text: str) -> None:
    """Replace a page's block.

    Raises:
        InputError: the page lacks one of the two comments.
    """
    (begin, end), old = marks(name), page.read_text("utf-8")
    head, found, rest = old.partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise InputError(f"needs the lines {begin} and {end}", source=str(page))
    page.write_text(f"{head}{begin}\n{text.strip()}\n{end}{tail}", "utf-8")


def current_commit() -> str:
    """Return the commit that is about to be measured.

    Raises:
        InputError: a file of the program differs from the commit, so that a page could not name what ran.
    """
    measured = ("dart_flight", "tests", "tools", "missions", "configs")
    if changed := _git("status", "--porcelain", "-uno", "--", *measured):
        raise InputError(f"commit first; changed: {changed.split()[1]}", source=str(ROOT))
    return _git("rev-parse", "--short=8", "HEAD")


def measured_line(command: str, commit: str, what: str, seconds: float) -> str:
    """Return the line that states what was measured, when, by which command and at which commit."""
    today = datetime.date.today().isoformat()
    return f"Measured on {today} by `{command}` at commit {commit}: {what} ({duration(seconds)})."


def duration(seconds: float) -> str:
    """Return a duration in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def measurements() -> Iterator[Measurement]:
    """Yield the measurements named on each page. For a page without any, yield one without a command."""
    for path in sorted(PAGES.glob("*.md")):
        found = list(_MEASURED.finditer(path.read_text("utf-8")))
        for match in found:
            commit = match["commit"]
            since = _git("rev-list", "--count", f"{commit}..HEAD")
            yield Measurement(
                path.stem,
                match["command"],
                match["date"],
                commit,
                match["duration"] or "",
                int(since) if since else None,
            )
        if not found:
            yield Measurement(path.stem, "", "", "", "", None)


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()
