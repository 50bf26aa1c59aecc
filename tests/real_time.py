"""Limits of time in tests. Only a limit that is exceeded while the computer is busy counts as skipped."""

from __future__ import annotations

import contextlib
import queue
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

# Rules of the guard that judge the arrival of messages by the computer's clock.
LATENESS_RULES = (
    "link_lost",
    "imu_silent",
    "attitude_silent",
    "odometry_silent",
    "actuator_silent",
    "status_silent",
    "stream_rate",
    "telemetry_late_ground",
    "telemetry_late",
    "world_died",
)
_T = TypeVar("_T")


class TooSlow(AssertionError):  # noqa: N818  the name says what happened
    """The program, or this computer, exceeded a limit of time."""


def wait_until(condition: Callable[[], _T | None], seconds: float, what: str) -> _T:
    """Return the first true value of `condition`, which is asked every 20 ms.

    Raises:
        TooSlow: no value was true within `seconds`.
    """
    until = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > until:
            raise TooSlow(f"{what}: not within {seconds:g} s")
        time.sleep(0.02)
    return value


@contextlib.contextmanager
def limited(what: str) -> Iterator[None]:
    """Turn a timeout within the context, of a process, of asyncio or of a queue, into `TooSlow`."""
    try:
        yield
    except (TimeoutError, subprocess.TimeoutExpired, queue.Empty) as error:
        raise TooSlow(f"{what}: {error or 'not in time'}") from error


def assert_not_later(value: float, limit: float, what: str) -> None:
    """Assert that a measured time, or another figure that the load increases, does not exceed its limit.

    Raises:
        TooSlow: it does.
    """
    if value > limit:
        raise TooSlow(f"{what}: {value:g}, limit {limit:g}")


def run_within(seconds: float, words: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Return the result of a command, with its output as text.

    Raises:
        TooSlow: the command did not end within `seconds`.
    """
    try:
        return subprocess.run(words, timeout=seconds, text=True, capture_output=True, check=False, **options)
    except subprocess.TimeoutExpired as error:
        raise TooSlow(f"{words[-1]}: not ended within {seconds:g} s") from error


def end_within(seconds: float, process: subprocess.Popen[str]) -> tuple[str, str]:
    """Return the output and the errors of a started process, which has ended.

    Raises:
        TooSlow: the process did not end within `seconds`, and is killed.
    """
    try:
        return process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired as error:
        process.kill()
        raise TooSlow(f"{process.args!r}: not ended within {seconds:g} s") from error


def assert_below(limit: float, value: float, what: str) -> None:
    """Assert a limit of a time or of a load.

    Raises:
        TooSlow: `value` is not below `limit`.
    """
    if not value < limit:
        raise TooSlow(f"{what}: {value:g}, limit {limit:g}")


def assert_above(limit: float, value: float, what: str) -> None:
    """Assert a least rate.

    Raises:
        TooSlow: `value` is not above `limit`.
    """
    if not value > limit:
        raise TooSlow(f"{what}: {value:g}, least {limit:g}")


def rule_of(reason: str | None) -> str:
    """Return the rule that gave a reason.

    Raises:
        TooSlow: the rule judges the computer's lateness.
    """
    rule = (reason or "").partition(":")[0]
    if rule in LATENESS_RULES:
        raise TooSlow(str(reason))
    return rule


def assert_flown(outcome: str, reason: str | None, wanted: str = "completed") -> None:
    """Assert the outcome of a flight in real time.

    Raises:
        TooSlow: the flight ended by a rule that judges the computer's lateness.
        AssertionError: the flight ended otherwise.
    """
    if outcome != wanted:
        rule_of(reason)
        raise AssertionError(f"{outcome}: {reason}")
