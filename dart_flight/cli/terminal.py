"""What every command prints with: JSON alone on standard output, everything else on standard error."""

from __future__ import annotations

import sys
from typing import Any

import msgspec
from rich.console import Console


def messages() -> Console:
    """Console for progress and messages: standard error."""
    return Console(stderr=True, highlight=False)


def tables() -> Console:
    """Console for what the command was asked for, when it is not `--json`: standard output."""
    return Console(highlight=False)


def emit_json(value: Any) -> None:
    """Print one object as JSON on standard output; a number that is not finite becomes null."""
    sys.stdout.write(msgspec.json.format(msgspec.json.encode(value), indent=2).decode() + "\n")
    sys.stdout.flush()
