"""Another process that runs a few lines of Python while a test looks at what it holds."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def running(code: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run code that prints a line once it is ready and then waits; kill it at the end of the context."""
    words = [
        sys.executable,
        "-c",
        f"{code}\nprint('ready', flush=True)\nimport time\ntime.sleep(60)",
        *arguments,
    ]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def stat_of(pid: int) -> list[str]:
    """Return the fields of a process's status after its name: state, parent, group, session and more."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def is_alive(pid: int | None) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return pid is not None and stat_of(pid)[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False
