"""Pages of `docs/results`: their measured blocks, and Markdown tables.

A block is what one command measured. The command writes it between two comments of the page, so that a page
shows only what its command gave. `python -m tools.campaigns --list` reads the blocks.
"""

from __future__ import annotations

import datetime
import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from dart_flight.config.document import InputError

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"
# The pages of later measurements keep an older date: recordings, an emulated computer, serial ports.
KEEP_THEIR_DATE = ("real_data", "raspberry_pi", "hitl")
_MEASURED = re.compile(
    r"Measured on (?P<date>[\d-]+)\s+by\s+`(?P<command>[^`]+)`\s+at\s+commit\s+"
    r"(?P<commit>[0-9a-f]+)(?:[^\n]*\((?P<duration>[\d.]+ (?:s|min|h))\))?"
)


class Measurement(NamedTuple):
    """What a page rests on. `later` counts the commits since then; None: the commit is not in the history."""

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


def measured_line(command: str, what: str, seconds: float) -> str:
    """Return the line that tells what was measured, when, by which command and at which commit.

    Raises:
        InputError: a file of the program differs from the commit, so that the commit would not tell.
    """
    if changed := _git("status", "--porcelain", "-uno", "--", "dart_flight", "tools", "missions", "configs"):
        raise InputError(f"commit first; changed: {changed.splitlines()[0][3:]}", source=str(ROOT))
    commit, today = _git("rev-parse", "--short=8", "HEAD"), datetime.date.today().isoformat()
    return f"Measured on {today} by `{command}` at commit {commit}: {what} ({duration(seconds)})."


def duration(seconds: float) -> str:
    """Return a duration in the unit that suits it."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def measurements() -> Iterator[Measurement]:
    """Yield every measurement that a page names; a page that names none yields one without a command."""
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
