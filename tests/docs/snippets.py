"""The commands and fenced blocks in README and docs, with their places."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
MANUAL = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RESULTS = sorted((ROOT / "docs" / "results").glob("*.md"))
PAGES = [*MANUAL, *RESULTS, ROOT / "CONTRIBUTING.md"]


def name_of(page: Path) -> str:
    """Return the name of a page for test ids and messages: its path in the repository."""
    return page.relative_to(ROOT).as_posix()


_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\s*$")
_COMMENT = re.compile(r"\s+#\s(?P<text>.*)$")
_STATUS = re.compile(r"\bends with (\d)\b")
# A command in the text is set off by indentation.
_INDENTED = re.compile(r"^    (?P<command>(?:dart-flight|python -m) .*)$")


class Block(NamedTuple):
    """A fenced block: language, text, number of the line with its fence, and the preceding line."""

    page: Path
    line: int
    language: str
    text: str
    before: str

    @property
    def place(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def produced_by(self) -> str:
        """The command whose JSON the block shows, or an empty string."""
        found = re.match("<!-- json: (.*) -->", self.before)
        return found[1] if found else ""


class Command(NamedTuple):
    """A command line, and the exit status that the page states."""

    page: Path
    line: int
    text: str
    status: int

    @property
    def place(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def is_synopsis(self) -> bool:
        """Whether the line shows the syntax (`[--json]`, `LOG...`) and not an actual command."""
        return bool(re.search(r"\[|\.\.\.(\s|$)|\s[A-Z]{3,}(\s|$)", self.text))

    def arguments(self) -> list[str] | None:
        """Return the arguments of `dart-flight`, or None if the line runs another program."""
        # Pipes and redirections end the command; NAME=value before it is the environment.
        text = re.sub(r"[\[\]]|\.\.\.", " ", self.text) if self.is_synopsis else self.text
        words = shlex.split(text)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            words.pop(0)
        if not words or words[0] != "dart-flight":
            return None
        ends = [i for i, word in enumerate(words) if word in {"|", ">", "<", "&&", "||", ";", "&"}]
        return words[1 : ends[0] if ends else None]


def blocks(page: Path) -> Iterator[Block]:
    """Yield every fenced block of a page."""
    rows = page.read_text(encoding="utf-8").splitlines()
    start: tuple[int, re.Match[str]] | None = None
    for i, row in enumerate(rows):
        fence = _FENCE.match(row)
        if fence is None:
            continue
        if start is None:
            start = (i, fence)
            continue
        begin, opened = start
        indent = len(opened["indent"])
        text = "\n".join(line[indent:] for line in rows[begin + 1 : i])
        yield Block(page, begin + 1, opened["language"], text, rows[begin - 1] if begin else "")
        start = None
    assert start is None, f"{page}: a fenced block is not closed"


def commands(page: Path) -> list[Command]:
    """Return every command of a page: the lines of `sh` blocks, and indented commands."""
    found = []
    fenced: set[int] = set()
    for block in blocks(page):
        rows = block.text.splitlines()
        fenced |= set(range(block.line, block.line + len(rows) + 2))
        if block.language == "sh":
            found += [_command(page, block.line + 1 + i, row) for i, row in enumerate(rows) if row.strip()]
    for number, row in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        indented = _INDENTED.match(row)
        if indented and number not in fenced:
            found.append(_command(page, number, indented["command"]))
    return sorted((c for c in found if c.text), key=lambda c: c.line)


def _command(page: Path, line: int, row: str) -> Command:
    text = row.strip()
    comment = _COMMENT.search(text)
    promised = _STATUS.search(comment["text"]) if comment else None
    if comment:
        text = text[: comment.start()].rstrip()
    return Command(page, line, "" if text.startswith("#") else text, int(promised[1]) if promised else 0)
