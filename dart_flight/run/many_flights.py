"""Many flights of one mission, spread over the processor's cores, and what they amount to."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import OperatorRequest, Outcome, Record, Request
from dart_flight.config.mission import Mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import Onlooker
from dart_flight.run.workers import Failure, Interrupt, usable_cores, work
from dart_flight.sim.draws import AS_COMMANDED, LOCK_TRUE_MODE


class RunSpread(msgspec.Struct):
    """A figure over many flights."""

    median: float
    low: float
    high: float


class RunsSummary(msgspec.Struct):
    """Many flights of one mission in a few figures.

    Attributes:
        unexplained_modes: by seed, where the arms were in another mode than the lock (`unexplained_modes`).
    """

    runs: int
    completed: int
    reasons: dict[str, int]
    goal_miss_m: RunSpread | None
    final_error_m: RunSpread | None
    max_tilt_deg: RunSpread | None
    peak_force_error_percent: RunSpread | None
    plan_followed: int | None = None  # flights; None: none had a plan
    unexplained_modes: dict[str, list[str]] = {}


class RunsInterruptedError(Exception):
    """Ctrl-C, SIGTERM or SIGHUP before the last of many flights; `verdicts` are of the complete ones."""

    def __init__(self, verdicts: list[Verdict]) -> None:
        super().__init__(f"interrupted after {len(verdicts)} flights")
        self.verdicts = verdicts


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM and SIGHUP (a dropped session) end many flights as Ctrl-C does."""

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def fly_fast_many(
    mission: Mission,
    seeds: Sequence[int],
    log_dir: Path | None,
    done: Callable[[Verdict], None],
    spreads: Mapping[str, float] | None = None,
) -> list[Verdict]:
    """Many fast flights, spread over the processor's cores (`run.workers`), in the order of the seeds.

    Raises:
        RunsInterruptedError: by Ctrl-C. The flights under way are flown to their end, no other is begun; a
            second Ctrl-C ends those under way, too.
        InputError: as `fly_fast`.
        FlightError: a flight's process died, and again when the flight was tried once more.
    """
    verdicts: dict[int, Verdict] = {}
    fly = partial(fly_fast, mission, log_dir=log_dir, spreads=dict(spreads or {}))
    with (
        Interrupt() as interrupt,
        contextlib.closing(work(fly, seeds, usable_cores(), interrupt)) as landings,
    ):
        for seed, result in landings:
            if isinstance(result, Failure):
                raise result.error or FlightError(f"seed {seed}: {result.what}")
            verdicts[seed] = result
            done(result)
    in_order = [verdicts[seed] for seed in seeds if seed in verdicts]
    if len(in_order) < len(seeds):
        raise RunsInterruptedError(in_order)
    return in_order


def fly_one_by_one(
    fly: Callable[[int, Onlooker], Verdict], seeds: Iterable[int], done: Callable[[Verdict], None]
) -> list[Verdict]:
    """Many flights in real time, one after the other.

    Args:
        fly: flies one seed; an onlooker sees its records.
        seeds: of the flights.
        done: called after each.

    Raises:
        RunsInterruptedError: by Ctrl-C; the flight under way has landed at that, and is among the verdicts.
    """
    verdicts: list[Verdict] = []
    asked: list[Record] = []

    def look(record: Record) -> None:
        if isinstance(record, OperatorRequest) and record.request is not Request.WORLD_DIED:
            asked.append(record)

    with _interruptible():
        try:
            for seed in seeds:
                verdicts.append(fly(seed, look))
                done(verdicts[-1])
                if asked:
                    raise RunsInterruptedError(verdicts)
        except KeyboardInterrupt:
            raise RunsInterruptedError(verdicts) from None
    return verdicts


def summarise(verdicts: list[Verdict]) -> RunsSummary:
    """Counts and spreads over many flights."""
    reasons: dict[str, int] = {}
    for v in verdicts:
        if v.reason is not None:
            rule = v.reason.split(":")[0]
            reasons[rule] = reasons.get(rule, 0) + 1
    return RunsSummary(
        runs=len(verdicts),
        completed=sum(v.outcome is Outcome.COMPLETED for v in verdicts),
        reasons=reasons,
        goal_miss_m=_spread(v.goal_miss_m for v in verdicts),
        final_error_m=_spread(v.final_error_m for v in verdicts),
        max_tilt_deg=_spread(v.max_tilt_deg for v in verdicts),
        peak_force_error_percent=_spread(_force_errors(verdicts)),
        plan_followed=_count(v.plan_followed for v in verdicts),
        unexplained_modes={str(v.seed): found for v in verdicts if (found := unexplained_modes(v))},
    )


def unexplained_modes(verdict: Verdict) -> list[str]:
    """Where the arms were not in the lock's mode although no fault of the lock was drawn.

    In a simulated world that is a fault of the simulation, or of the mode felt: no flight of it counts.
    """
    if verdict.drawn.get(LOCK_TRUE_MODE, AS_COMMANDED) != AS_COMMANDED:
        return []
    found = [] if verdict.arms_moved is not False else ["the arms never followed the lock"]
    for c in verdict.collisions:
        if c.mode_true not in (None, c.mode):
            found.append(f"collision {c.index}: the arms were {c.mode_true}, the lock {c.mode}")
        if c.mode_felt not in (None, c.mode):
            truly = "" if c.mode_true is None else f", truly {c.mode_true}"
            found.append(f"collision {c.index}: felt {c.mode_felt}, the lock {c.mode}{truly}")
    return found


def _count(followed: Iterable[bool | None]) -> int | None:
    known = [one for one in followed if one is not None]
    return sum(known) if known else None


def _force_errors(verdicts: list[Verdict]) -> Iterator[float]:
    for v in verdicts:
        for c in v.collisions:
            measured = c.measured.peak_force_n
            true = c.truth.peak_force_n if c.truth else None
            if measured is not None and true:
                yield 100.0 * (measured / true - 1.0)


def _spread(values: Iterable[Any]) -> RunSpread | None:
    known = sorted(v for v in values if v is not None)
    if not known:
        return None
    return RunSpread(known[len(known) // 2], known[0], known[-1])
