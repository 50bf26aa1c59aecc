"""Many flights of one mission, spread over the processor's cores, and what they amount to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.config.mission import Mission
from dart_flight.samples import Outcome
from dart_flight.verdict import Verdict
from dart_flight.worlds.fast import fly_fast


class Spread(msgspec.Struct):
    """A figure over many flights."""

    median: float
    low: float
    high: float


class Summary(msgspec.Struct):
    """Many flights of one mission in a few figures."""

    runs: int
    completed: int
    reasons: dict[str, int]
    goal_miss_m: Spread | None
    final_error_m: Spread | None
    max_tilt_deg: Spread | None
    peak_force_error_percent: Spread | None


def _fast_run(arguments: tuple[Mission, int, str | None, dict[str, float]]) -> Verdict:
    mission, seed, log_dir, spreads = arguments
    return fly_fast(mission, seed, Path(log_dir) if log_dir else None, spreads=spreads)


def fly_fast_many(
    mission: Mission,
    seeds: Iterable[int],
    log_dir: Path | None,
    done: Callable[[Verdict], None],
    spreads: Mapping[str, float] | None = None,
) -> list[Verdict]:
    """Many fast flights, spread over the processor's cores, in the order of the seeds."""
    drawn = dict(spreads or {})
    jobs = [(mission, seed, str(log_dir) if log_dir else None, drawn) for seed in seeds]
    verdicts = []
    with ProcessPoolExecutor() as pool:
        for verdict in pool.map(_fast_run, jobs):
            done(verdict)
            verdicts.append(verdict)
    return verdicts


def summarise(verdicts: list[Verdict]) -> Summary:
    """Counts and spreads over many flights."""
    reasons: dict[str, int] = {}
    for v in verdicts:
        if v.reason is not None:
            rule = v.reason.split(":")[0]
            reasons[rule] = reasons.get(rule, 0) + 1
    return Summary(
        runs=len(verdicts),
        completed=sum(v.outcome is Outcome.COMPLETED for v in verdicts),
        reasons=reasons,
        goal_miss_m=_spread(v.goal_miss_m for v in verdicts),
        final_error_m=_spread(v.final_error_m for v in verdicts),
        max_tilt_deg=_spread(v.max_tilt_deg for v in verdicts),
        peak_force_error_percent=_spread(_force_errors(verdicts)),
    )


def _force_errors(verdicts: list[Verdict]) -> Iterator[float]:
    for v in verdicts:
        for c in v.collisions:
            measured = c.measured.peak_force_n
            true = c.truth.peak_force_n if c.truth else None
            if measured is not None and true:
                yield 100.0 * (measured / true - 1.0)


def _spread(values: Iterable[Any]) -> Spread | None:
    known = sorted(v for v in values if v is not None)
    if not known:
        return None
    return Spread(known[len(known) // 2], known[0], known[-1])
