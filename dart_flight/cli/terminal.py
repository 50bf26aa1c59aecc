"""What every command prints with: JSON alone on standard output, everything else on standard error."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from dart_flight.config.document import writing


def messages() -> Console:
    """Console for progress and messages: standard error."""
    return Console(stderr=True, highlight=False)


def print_status(*lines: object) -> None:
    """Lines on standard error as they are: square brackets are no markup, and the terminal may break them."""
    for line in lines:
        messages().print(line, markup=False, soft_wrap=True)


def write_text(path: Path, text: str) -> None:
    """Write a file, and say so.

    Raises:
        InputError: it cannot be written.
    """
    with writing(path):
        path.write_text(text, encoding="utf-8")
    print_status(f"wrote {path}")


def tables() -> Console:
    """Console for what the command was asked for, when it is not `--json`: standard output."""
    return Console(highlight=False)


def emit_json(value: Any) -> None:
    """Print one object as JSON on standard output; a number that is not finite becomes null."""
    sys.stdout.write(msgspec.json.format(msgspec.json.encode(value), indent=2).decode() + "\n")
    sys.stdout.flush()
