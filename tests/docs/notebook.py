"""Runner of a notebook's code cells in this process: in order, in one namespace, inside an event loop.

It replaces Jupyter if that is not installed.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def code_cells(path: Path) -> Iterator[str]:
    """Yield the source of every code cell."""
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            yield "".join(cell["source"])


def stored_output(path: Path) -> list[str]:
    """Return the stored text output of every code cell."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [
        "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")
        for cell in cells
        if cell["cell_type"] == "code"
    ]


def run(path: Path) -> list[str]:
    """Run every code cell and return the text that each prints.

    Raises:
        Exception: the exception of a cell, with the cell's number in its notes.
    """

    async def cells() -> list[str]:
        names: dict[str, Any] = {"__name__": "__main__"}
        printed = []
        for number, source in enumerate(code_cells(path), start=1):
            out = io.StringIO()
            try:
                with contextlib.redirect_stdout(out):
                    exec(compile(source, f"{path.name}, cell {number}", "exec"), names)
            except Exception as error:
                error.add_note(f"in code cell {number} of {path}")
                raise
            printed.append(out.getvalue())
        return printed

    return asyncio.run(cells())
