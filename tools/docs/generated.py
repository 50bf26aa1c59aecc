"""Generator of the manual's tables, diagrams, schemas and configuration comments: `make docs` updates them.

A generated part is in a page of docs/ between `<!-- begin: NAME -->` and `<!-- end -->`. The JSON Schemas in
docs/schemas are generated as a whole. In configs/dart.yaml the generator writes the part of each comment
before the source. A test runs `python -m tools.docs.generated --check`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.docs import (
    configuration_comments,
    fault_table,
    key_tables,
    log_channels,
    message_table,
    phase_diagram,
    rule_table,
    schemas,
)

DOCS = Path(__file__).resolve().parents[2] / "docs"
PARTS: dict[str, Callable[[], str]] = {
    "configuration keys": key_tables.configuration_table,
    "fault kinds": fault_table.table,
    "guard rules": rule_table.table,
    "lock states": phase_diagram.lock_diagram,
    "log channels": log_channels.tables,
    "messages": message_table.table,
    "mission keys": key_tables.mission_tables,
    "mission phases": phase_diagram.diagram,
    "scenario keys": key_tables.scenario_tables,
}
_MARKED = re.compile(r"(<!-- begin: ([a-z ]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def pages() -> dict[Path, list[str]]:
    """Return the pages with generated parts, and the names of the parts."""
    found = {page: [m[2] for m in _MARKED.finditer(page.read_text("utf-8"))] for page in DOCS.glob("*.md")}
    return {page: names for page, names in sorted(found.items()) if names}


def current(text: str) -> str:
    """Return a page with up-to-date generated parts.

    Raises:
        KeyError: a part has an unknown name.
    """
    return _MARKED.sub(lambda mark: mark[1] + PARTS[mark[2]]() + mark[3], text)


def stale() -> Iterator[str]:
    """Yield a line for every file that is out of date, and for parts without a place or a generator."""
    for page, names in pages().items():
        text = page.read_text("utf-8")
        unknown = [name for name in names if name not in PARTS]
        if unknown:
            yield f"{page.name}: no generator for {unknown[0]}"
        elif current(text) != text:
            yield page.name
    places = sorted(name for names in pages().values() for name in names)
    if places != sorted(PARTS):
        yield f"parts with no place or with two: {sorted(set(PARTS) ^ set(places)) or places}"
    wanted = {name: schemas.text_of(schema) for name, schema in schemas.schemas().items()}
    if {path.name: path.read_text("utf-8") for path in schemas.FOLDER.iterdir()} != wanted:
        yield "docs/schemas"
    configuration = configuration_comments.CONFIGURATION.read_text("utf-8")
    if configuration_comments.current(configuration) != configuration:
        yield "configs/dart.yaml: comments"


def main() -> int:
    """Write everything, or with --check list what is stale; return the exit status."""
    if sys.argv[1:] == ["--check"]:
        found = list(stale())
        print("\n".join(found))
        return 1 if found else 0
    schemas.write()
    configuration_comments.write()
    for page in pages():
        page.write_text(current(page.read_text("utf-8")), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
