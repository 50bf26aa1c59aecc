"""Fly one mission many times for `dry-run --runs`, in parallel or one by one, and summarise the flights."""

from __future__ import annotations

import contextlib
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import OperatorRequest, Outcome, Record, Request
from dart_flight.base.signals import StopSignals
from dart_flight.base.summary import Spread, cause_of, spread
from dart_flight.config.mission import Mission
from dart_flight.recording.verdict import Verdict
from dart_flight.run.fast import fly_fast
from dart_flight.run.flight_record import Onlooker
from dart_flight.run.workers import Failure, Interrupt, usable_cores, work
from dart_flight.sim.draws import AS_COMMANDED, LOCK_TRUE_MODE


class RunsSummary(msgspec.Struct):
    """Summary of many flights; `unexplained_modes` maps a seed to the texts of `unexplained_modes()`."""

    runs: int
    completed: int
    reasons: dict[str, int]
    goal_miss_m: Spread | None
    final_error_m: Spread | None
    max_tilt_deg: Spread | None
    peak_force_error_percent: Spread | None
    plan_followed: int | None = None  # flights that followed their plan, or None if no flight had a plan
    unexplained_modes: dict[str, list[str]] = {}


class RunsInterruptedError(Exception):
    """Ctrl-C, SIGTERM or SIGHUP has interrupted the flights; `verdicts` has the completed flights."""

    def __init__(self, verdicts: list[Verdict]) -> None:
        super().__init__(f"interrupted after {len(verdicts)} flights")
        self.verdicts = verdicts


def _interrupt(number: signal.Signals) -> None:
    raise KeyboardInterrupt


def fly_fast_many(
    mission: Mission,
    seeds: Sequence[int],
    log_dir: Path | None,
    done: Callable[[Verdict], None],
    spreads: Mapping[str, float] | None = None,
    announce: Callable[[int], None] = lambda under_way: None,
) -> list[Verdict]:
    """Fly many fast flights in parallel (`run.workers`); return verdicts in seed order.

    Args:
        announce: called after the first Ctrl-C, with the number of flights in progress.

    Raises:
        RunsInterruptedError: the operator has pressed Ctrl-C. Flights in progress were completed, and no
            other flight began. A second Ctrl-C also ends the flights in progress.
        InputError: a log cannot be written, or the lock driver does not work in simulated time.
        FlightError: a flight's process died, and died again when the flight was retried.
    """
    verdicts: dict[int, Verdict] = {}
    fly = partial(fly_fast, mission, log_dir=log_dir, spreads=dict(spreads or {}))
    with (
        Interrupt(announce) as interrupt,
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
    """Fly one seed after the other and return the verdicts.

    Args:
        fly: flies one seed and passes its records to an onlooker.

    Raises:
        RunsInterruptedError: the operator has pressed Ctrl-C. The flight in progress has landed, and its
            verdict is included.
    """
    verdicts: list[Verdict] = []
    asked: list[Record] = []

    def look(record: Record) -> None:
        if isinstance(record, OperatorRequest) and record.request is not Request.WORLD_DIED:
            asked.append(record)

    with StopSignals(_interrupt, numbers=(signal.SIGTERM, signal.SIGHUP)):  # like Ctrl-C
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
    followed = [v.plan_followed for v in verdicts if v.plan_followed is not None]
    return RunsSummary(
        runs=len(verdicts),
        completed=sum(v.outcome is Outcome.COMPLETED for v in verdicts),
        reasons=dict(Counter(cause_of(v.reason) for v in verdicts if v.reason is not None)),
        goal_miss_m=spread(v.goal_miss_m for v in verdicts),
        final_error_m=spread(v.final_error_m for v in verdicts),
        max_tilt_deg=spread(v.max_tilt_deg for v in verdicts),
        peak_force_error_percent=spread(
            100.0 * error for v in verdicts for c in v.collisions if (error := c.force_error) is not None
        ),
        plan_followed=sum(followed) if followed else None,
        unexplained_modes={str(v.seed): found for v in verdicts if (found := unexplained_modes(v))},
    )


def unexplained_modes(verdict: Verdict) -> list[str]:
    """Return a text for each difference between the arms' mode and the lock's mode.

    A flight with a simulated fault of the lock has no findings. In any other simulated flight, a finding
    means that the simulation or the estimated mode is wrong, so the flight is invalid.
    """
    if verdict.drawn.get(LOCK_TRUE_MODE, AS_COMMANDED) != AS_COMMANDED:
        return []
    found = [] if verdict.arms_moved is not False else ["the arms did not follow the lock"]
    for c in verdict.collisions:
        if c.mode_true not in (None, c.mode):
            found.append(f"collision {c.index}: the arms were {c.mode_true}, but the lock reported {c.mode}")
        if c.mode_felt not in (None, c.mode):
            truly = "" if c.mode_true is None else f", true mode {c.mode_true}"
            found.append(
                f"collision {c.index}: the contact indicates {c.mode_felt}, but the lock reports "
                f"{c.mode}{truly}"
            )
    return found
