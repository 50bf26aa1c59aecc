"""The sources of the site: the pages of docs/, in the order of docs/index.md, and what only the site has.

Markdown is written once: the pages are copied, and a link that shows the name of a file shows the title.
The site adds a navigation, which is read from the tables of docs/index.md, the beginning of the README, the
notebook as a page, and the reference of the Python interface.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tools.site import reference

ROOT = Path(__file__).resolve().parents[2]
RESULTS_PAGE = "all_results"
_NAMED = re.compile(r"\[[\w./-]+\.(?:md|ipynb)\]\((?=[\w./-]+\.md[)#])")  # the site shows the title instead
_HEADING = re.compile(r"^## (.+)$", re.MULTILINE)
_PAGE = re.compile(r"\]\(((?!https?:)[\w./-]+)\.md(?:#[\w-]*)?\)")


def stage(into: Path, docs: Path = ROOT / "docs", readme: Path = ROOT / "README.md") -> None:
    """Write the sources of the site into an empty or new folder."""
    shutil.rmtree(into, ignore_errors=True)
    shutil.copytree(docs, into)
    for notebook in sorted(into.rglob("*.ipynb")):
        notebook.with_suffix(".md").write_text(notebook_page(notebook), encoding="utf-8")
    for page in into.rglob("*.md"):
        text = _NAMED.sub("[](", page.read_text(encoding="utf-8").replace(".ipynb)", ".md)"))
        page.write_text(text, encoding="utf-8")
    (into / "reference.rst").write_text(reference.page(), encoding="utf-8")
    index = into / "index.md"
    (into / f"{RESULTS_PAGE}.md").write_text(results_page(index.read_text("utf-8")), encoding="utf-8")
    index.write_text(front_page(index.read_text("utf-8"), readme.read_text("utf-8")), encoding="utf-8")


def sections(index: str) -> dict[str, str]:
    """Return the sections of docs/index.md by title; the beginning has an empty title."""
    parts = _HEADING.split(index)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def linked(text: str) -> list[str]:
    """Return the pages to which a text links, in order and without repetition."""
    return list(dict.fromkeys(_PAGE.findall(text)))


def navigation(index: str) -> Iterator[tuple[str, list[str]]]:
    """Yield caption and pages of each part of the navigation; a page is in the part that names it first."""
    named: set[str] = set()
    first: list[str] = linked(sections(index)[""])
    for title, text in sections(index).items():
        if title in ("", "Results"):
            continue
        pages = [page for page in dict.fromkeys((*first, *linked(text))) if page not in named]
        named.update(pages)
        first = []
        yield title, pages
    yield "Reference", ["reference", "notebooks/first_flight", RESULTS_PAGE]


def _toctree(pages: list[str], caption: str = "") -> str:
    title = f":caption: {caption}\n" if caption else ""
    return f"\n```{{toctree}}\n:hidden:\n{title}\n" + "\n".join(pages) + "\n```\n"


def front_page(index: str, readme: str) -> str:
    """Return the index with the beginning of the README above it and the navigation below it."""
    beginning = readme.partition("\n## ")[0].replace("](docs/", "](")
    body = index.partition("\n")[2]
    return beginning + body + "".join(_toctree(pages, caption) for caption, pages in navigation(index))


def results_page(index: str) -> str:
    """Return the page above the pages of results in the navigation."""
    text = sections(index)["Results"]
    return f"# Results\n{text}{_toctree(linked(text.partition('| subject')[2]))}"


def notebook_page(path: Path) -> str:
    """Return a notebook with its outputs as Markdown; pictures become files beside the page."""
    parts = []
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            parts += _output_parts(output, path.with_name(f"{path.stem}_{number}.png"))
    return "\n\n".join(parts) + f"\n\n{{download}}`Download the notebook <{path.name}>`\n"


def _output_parts(output: dict[str, Any], picture: Path) -> Iterator[str]:
    data = output.get("data", {})
    if "image/png" in data:
        picture.write_bytes(base64.b64decode("".join(data["image/png"])))
        yield f"![Output of the cell above]({picture.name})"
    elif text := "".join(output.get("text", data.get("text/plain", ""))):
        yield f"```\n{text.rstrip()}\n```"
