"""The index of the site's search: one entry per section; static/searchtools.js searches it without a server.

Sphinx's own search finds pages, not sections, and cannot show text when the pages are opened as files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bs4 import BeautifulSoup, Tag

_LINES = ("p", "li", "tr", "pre", "dd", "figcaption")  # each of these elements is a line of an excerpt


class Section(NamedTuple):
    """A section of a page, or a name of the reference.

    Attributes:
        address: page and anchor.
        page: title of the page.
        title: title of the section.
        lines: its text without the sections inside.
    """

    address: str
    page: str
    title: str
    lines: list[str]


def write(site: Path) -> None:
    """Write the index of the built pages in place of Sphinx's."""
    pages = (path for path in sorted(site.rglob("*.html")) if path.stem not in ("genindex", "search"))
    found = [
        section for path in pages for section in sections(path.read_text("utf-8"), path.relative_to(site))
    ]
    text = json.dumps(found, ensure_ascii=False, separators=(",", ":"))
    (site / "searchindex.js").write_text(f"Search.setIndex({text})", encoding="utf-8")


def sections(html: str, path: Path) -> Iterator[Section]:
    """Yield the sections of a page."""
    article = BeautifulSoup(html, "html.parser").find("article")
    assert isinstance(article, Tag)
    for link in article.select("a.headerlink, svg, thead, .toctree-wrapper"):
        link.decompose()
    page = ""
    # Inner sections come first: each is removed from the text of the section around it.
    found = []
    for part in reversed(article.select("section[id], dt[id]")):
        head = part if part.name == "dt" else part.find(["h1", "h2", "h3", "h4"])
        assert isinstance(head, Tag)
        body = part.find_next_sibling("dd") if part.name == "dt" else part
        title = _offered(part["id"]) if part.name == "dt" else _text(head)
        signature = [_text(head)] if part.name == "dt" else []
        if part.name == "section":
            head.extract()
        found.append((f"{path.as_posix()}#{part['id']}", title, signature + _lines(body)))
        part.extract()
        if body is not part and isinstance(body, Tag):
            body.extract()
    for address, title, lines in reversed(found):
        page = page or title
        yield Section(address, page, title, lines)


def _offered(name: str) -> str:
    """Return the name of a class, method or function without the modules."""
    parts = name.split(".")
    first = next((i for i, part in enumerate(parts) if part[0].isupper()), len(parts) - 1)
    return ".".join(parts[first:])


def _lines(body: Tag) -> list[str]:
    """Return one line per paragraph, list item, row of a table, and line of a code block."""
    lines = []
    for part in body.find_all(_LINES):
        if part.name == "pre":
            lines += part.get_text().splitlines()
        elif part.name == "tr" or not part.find_parent("tr"):
            own = _text(part) if part.name == "tr" or not part.find(_LINES) else ""
            lines.append(own)
    return [line for line in lines if line.strip()]


def _text(part: Tag) -> str:
    separator = " | " if part.name == "tr" else ""
    cells = part.find_all(["td", "th"]) if part.name == "tr" else [part]
    return separator.join(" ".join(cell.get_text().split()) for cell in cells)
