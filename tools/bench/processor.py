"""Processor time of threads and processes, in seconds, as counted by Linux."""

from __future__ import annotations

from pathlib import Path


def thread_seconds() -> dict[int, float]:
    """Return the processor seconds of every thread of this process, by native id."""
    return {int(task.name): _seconds(task) for task in Path("/proc/self/task").iterdir()}


def process_seconds(pid: int) -> float:
    """Return the processor seconds of all existing threads of a process."""
    return sum(_seconds(task) for task in Path(f"/proc/{pid}/task").iterdir())


def _seconds(task: Path) -> float:
    return int((task / "schedstat").read_text(encoding="ascii").split()[0]) * 1e-9
