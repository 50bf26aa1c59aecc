"""Processor time as Linux counts it, to the nanosecond: of threads and of other processes."""

from __future__ import annotations

from pathlib import Path


def thread_seconds() -> dict[int, float]:
    """Processor seconds of every thread of this process, by its native id."""
    return {int(task.name): _seconds(task) for task in Path("/proc/self/task").iterdir()}


def process_seconds(pid: int) -> float:
    """Processor seconds of all threads of a process that are there."""
    return sum(_seconds(task) for task in Path(f"/proc/{pid}/task").iterdir())


def _seconds(task: Path) -> float:
    return int((task / "schedstat").read_text(encoding="ascii").split()[0]) * 1e-9
