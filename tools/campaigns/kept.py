"""Campaigns that keep every flight in a file of lines, so that an interrupted one goes on where it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from rich.console import Console

J = TypeVar("J")
T = TypeVar("T")


def kept_lines(path: Path, kind: Any) -> list[Any]:
    """What a file of lines has so far, each of this type; nothing where there is no file."""
    lines = path.read_bytes().splitlines() if path.exists() else []
    return [msgspec.json.decode(line, type=kind) for line in lines]


def fly_missing(
    path: Path, jobs: Sequence[J], fly: Callable[[J], T], kinds: Any, processes: int = 2, fresh: bool = False
) -> list[T]:
    """Fly what a file does not have yet; results in the order of the jobs.

    Args:
        path: of the file, a job with its result in each line; made if need be.
        jobs: hashable.
        fly: flies one, in a process of its own.
        kinds: type of a job with its result, `tuple[Job, Result]`.
        processes: side by side.
        fresh: forget what was flown.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        path.unlink(missing_ok=True)
    have: dict[J, T] = dict(kept_lines(path, kinds))
    missing = [job for job in jobs if job not in have]
    console = Console(stderr=True)
    with ProcessPoolExecutor(processes) as pool, open(path, "ab", buffering=0) as file:
        for count, (job, flown) in enumerate(zip(missing, pool.map(fly, missing), strict=True), 1):
            have[job] = flown
            file.write(msgspec.json.encode((job, flown)) + b"\n")
            if count % 20 == 0:
                console.print(f"{path.stem}: {count} of {len(missing)}")
    return [have[job] for job in jobs]
