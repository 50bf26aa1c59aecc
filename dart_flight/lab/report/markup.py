"""The HTML of pages: sections, tables, figures, and the whole self-contained file."""

from __future__ import annotations

import base64
import hashlib
import html
import math
from collections.abc import Sequence
from importlib import resources
from itertools import zip_longest
from typing import Any

from dart_flight.lab.figure_style import as_svg

Cell = str | float | int | None
Row = Sequence[Cell] | str  # text alone: a heading over the rows that follow


def section(title: str, body: str) -> str:
    """A part of a page, with its heading."""
    return f"<section><h2>{html.escape(title)}</h2>{body}</section>"


def details(title: str, body: str) -> str:
    """A part that is folded away until it is opened."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>"


def figure_block(*figures_and_captions: tuple[Any, str], wide: bool = False) -> str:
    """Figures, each with its caption.

    Args:
        figures_and_captions: from `dart_flight.lab.report.figures`.
        wide: larger than the others.
    """
    parts = []
    for figure, caption in figures_and_captions:
        data = base64.b64encode(as_svg(figure).encode()).decode()
        text = html.escape(caption)
        parts.append(
            f'<figure><img alt="{text}" src="data:image/svg+xml;base64,{data}">'
            f"<figcaption>{text}</figcaption></figure>"
        )
    return f'<div class="figures{" wide" if wide else ""}">{"".join(parts)}</div>'


def table(heads: Sequence[str], rows: Sequence[Row]) -> str:
    """A table; columns of numbers are set to the right."""
    firsts = next((row for row in rows if not isinstance(row, str)), [])
    head = "".join(
        f"<th{' class=n' if _is_number(cell) else ''}>{html.escape(h)}</th>"
        for h, cell in zip_longest(heads, firsts)
    )
    body = "".join(
        f"<tr class=group><th colspan={len(heads)}>{html.escape(row)}</th></tr>"
        if isinstance(row, str)
        else f"<tr>{''.join(map(_cell, row))}</tr>"
        for row in rows
    )
    return f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _is_number(value: Cell) -> bool:
    return not isinstance(value, str) or isinstance(value, Number)


class Number(str):
    """A number that is already written."""


class Markup(str):
    """A cell that is HTML already."""


def signed(value: float | None) -> Cell:
    """A number with its sign and one decimal."""
    return None if value is None else Number(f"{value:+.1f}" if abs(value) >= 0.05 else "0.0")


def _cell(value: Cell) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "<td class=n>–</td>"
    if isinstance(value, Number):
        return f"<td class=n>{value}</td>"
    if isinstance(value, Markup):
        return f"<td>{value}</td>"
    if isinstance(value, str):
        return f"<td>{html.escape(value)}</td>"
    if isinstance(value, int):
        return f"<td class=n>{value}</td>"
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"<td class=n>{value:.{digits}f}</td>"


def page(title: str, parts: Sequence[str], script: str = "") -> str:
    """The whole file.

    Nothing is loaded, and the file forbids it: its policy lets it show pictures that it holds, and run the
    one script whose hash it names, or none.

    Args:
        title: of the page.
        parts: sections.
        script: JavaScript that runs once the page is there.
    """
    style = resources.files("dart_flight.lab.report").joinpath("page.css").read_text(encoding="utf-8")
    run, allowed = "", "'none'"
    if script:
        run = f"<script>{script}</script>"
        allowed = f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body>"
        f"<header><h1>{html.escape(title)}</h1></header><main>{''.join(parts)}</main>{run}</body></html>\n"
    )
