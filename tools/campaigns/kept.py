"""Campaigns that keep every flight in a file of lines, so that an interrupted one goes on where it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from rich.console import Console

T = TypeVar("T")


def fly_missing(
    path: Path, jobs: Sequence[Any], fly: Callable[[Any], T], kind: type[T], processes: int, fresh: bool
) -> list[T]:
    """Fly what a file does not have yet; results in the order of the jobs.

    Args:
        path: of the file, a result in each line; made if need be.
        jobs: hashable.
        fly: flies one, in a process of its own; the result names its `job`.
        kind: of the results.
        processes: side by side.
        fresh: forget what was flown.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        path.unlink(missing_ok=True)
    decode = msgspec.json.Decoder(kind).decode
    lines = path.read_bytes().splitlines() if path.exists() else []
    have: dict[Any, T] = {getattr(flown, "job"): flown for flown in map(decode, lines)}  # noqa: B009
    missing = [job for job in jobs if job not in have]
    console = Console(stderr=True)
    with ProcessPoolExecutor(processes) as pool, open(path, "ab", buffering=0) as file:
        for count, (job, flown) in enumerate(zip(missing, pool.map(fly, missing), strict=True), 1):
            have[job] = flown
            file.write(msgspec.json.encode(flown) + b"\n")
            if count % 20 == 0:
                console.print(f"{path.stem}: {count} of {len(missing)}")
    return [have[job] for job in jobs]
