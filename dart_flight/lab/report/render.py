"""Rendering of self-contained HTML files from the templates in this folder.

Python assembles values, tables and pictures; all markup is in `templates/`. Printed values are escaped, and a
missing value is an error.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Sequence
from functools import cache
from importlib import resources
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from dart_flight.config.packages import missing_package
from dart_flight.lab.figure_style import as_svg

if TYPE_CHECKING:
    from jinja2 import Environment

Cell = str | float | int | dict[str, Any] | None  # a dictionary has a command and the log of its flight
Row = Sequence[Cell] | str  # a string is a heading above the rows that follow


class Number(str):
    """A number that is already formatted."""


class PageTable(NamedTuple):
    """A table whose columns of numbers are right-aligned."""

    heads: Sequence[str]
    rows: Sequence[Row]

    @property
    def columns(self) -> list[tuple[str, bool]]:
        """The columns, each as (heading, whether the column contains numbers)."""
        first = next((row for row in self.rows if not isinstance(row, str)), [])
        return [(head or "", is_number(cell)) for head, cell in zip_longest(self.heads, first)]

    def folded(self, count: int) -> tuple[PageTable, PageTable]:
        return self._replace(rows=self.rows[:count]), self._replace(rows=self.rows[count:])


def is_number(value: Cell) -> bool:
    """Return whether a cell is a number; None counts as an unknown number."""
    return isinstance(value, Number) or not isinstance(value, str | dict)


def write_number(value: Cell) -> str:
    """Return a number as text with at least three digits; an unknown number becomes a dash."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"{value:.{digits}f}"


def signed(value: float | None) -> Cell:
    """Return a number with its sign and one decimal."""
    return None if value is None else Number(f"{value:+.1f}" if abs(value) >= 0.05 else "0.0")


def picture(figure: Any) -> str:
    """Return a figure as base64 for a page."""
    return base64.b64encode(as_svg(figure).encode()).decode()


def render(template: str, title: str, *, script: str = "", **values: Any) -> str:
    """Return a complete HTML file from a template in `templates/`.

    The file loads nothing. Its content security policy allows only embedded pictures and the given script,
    which it identifies by a hash. `script` is JavaScript to run when the page is loaded.
    """
    environment = _environment()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = environment.get_template(template)
    return page.render(title=title, style=asset("page.css"), script=script, script_digest=digest, **values)


def asset(name: str) -> str:
    """Return the text of a file in this folder."""
    return resources.files("dart_flight.lab.report").joinpath(name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415  (an extra)
    except ImportError:
        raise missing_package("a page needs jinja2", "report") from None
    environment = Environment(
        loader=PackageLoader("dart_flight.lab.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_function"] = lambda value, **_: msgspec.json.encode(value).decode()
    environment.filters["number"] = write_number
    environment.tests["a_number"] = is_number
    return environment
