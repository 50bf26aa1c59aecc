"""The events of a flight as text: one line per decision, the same in the terminal and in a viewer."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from dart_flight.base.records import (
    ContactEnd,
    GoalPassed,
    GuardEvent,
    HealthReport,
    ImpactPeak,
    LockPhase,
    LockState,
    LogFailure,
    MissionEnd,
    Outcome,
    Override,
    PhaseChange,
    PlanTaken,
    PosesWithheld,
    Record,
    StatusText,
)


class Level(IntEnum):
    """Severity of an event, in the order of foxglove.Log's levels."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class Event(NamedTuple):
    """One event.

    Attributes:
        source: part of the program that reports the event: mission, contact, guard, lock, px4, link or log.
        head: what happened.
        detail: reason or amount; may be empty.
    """

    level: Level
    source: str
    head: str
    detail: str = ""

    @property
    def text(self) -> str:
        return f"{self.head} ({self.detail})" if self.detail else self.head


_SEVERITIES = {
    "emergency": Level.FATAL,
    "alert": Level.FATAL,
    "critical": Level.ERROR,
    "error": Level.ERROR,
    "warning": Level.WARNING,
}


class EventFormatter:
    """Converts the records of a flight, in order, to events.

    PX4's problems in the current flight mode are always reported. With `every_problem`, PX4's problems in
    other modes are also reported while the current mode has none.
    """

    def __init__(self, every_problem: bool = False) -> None:
        self._every_problem = every_problem
        self._problems: tuple[str, ...] = ()
        self._ready = False

    def format_event(self, record: Record) -> Event | None:
        if record.frequent:  # most records are frequent, so return early
            return None
        if isinstance(record, PhaseChange):
            self._ready = True
            which = f" {record.collision}" if record.collision else ""
            return Event(Level.INFO, "mission", f"→ {record.after.upper()}{which}", record.reason)
        if isinstance(record, ImpactPeak):
            clipped = ", clipped" if record.clipped else ""
            head = (
                f"impact: {record.normal_force_n:.1f} N normal, "
                f"{record.tangential_force_n:.1f} N along the wall{clipped}"
            )
            return Event(Level.INFO, "contact", head)
        if isinstance(record, ContactEnd):
            head = f"contact ended after {(record.t_us - record.first_us) * 1e-3:.0f} ms"
            return Event(Level.INFO, "contact", head)
        if isinstance(record, GuardEvent):
            level = Level.WARNING if record.action is Override.NONE else Level.ERROR
            return Event(level, "guard", f"guard: {record.rule} → {record.action}", record.detail)
        if isinstance(record, PosesWithheld):
            what = "attitudes of the poses" if record.attitude_only else "poses"
            return Event(Level.ERROR, "guard", f"{what} withheld from PX4: {record.reason}")
        if isinstance(record, GoalPassed):
            words = (
                "goal not passed in time, smallest distance"
                if record.timed_out
                else "goal passed, miss distance"
            )
            return Event(Level.INFO, "mission", f"{words} {record.miss_m:.2f} m")
        if isinstance(record, PlanTaken):
            head = "new trajectory accepted" if record.taken else f"new trajectory rejected: {record.reason}"
            return Event(Level.INFO, "mission", head)
        if isinstance(record, MissionEnd):
            level = Level.INFO if record.outcome is Outcome.COMPLETED else Level.ERROR
            return Event(level, "mission", record.outcome, record.reason or "")
        if isinstance(record, LockState):
            return _lock(record)
        if isinstance(record, StatusText):
            level = _SEVERITIES.get(record.severity, Level.DEBUG)
            if record.found_here:
                return Event(Level.INFO if record.severity == "notice" else level, "link", record.text)
            return Event(level, "px4", f"PX4 {record.severity}: {record.text}")
        if isinstance(record, HealthReport):
            return self._health(record)
        if isinstance(record, LogFailure):
            return Event(Level.ERROR, "log", f"flight log incomplete: {record.reason}")
        return None

    def _health(self, record: HealthReport) -> Event | None:
        problems = record.blocking or (record.others if self._every_problem else ())
        changed, self._problems = problems != self._problems, problems
        if not changed or not problems:
            return None
        text = f"PX4 would not arm now: {', '.join(problems)}"
        if not self._ready:
            text += "; this is usual until PX4 has started, and the flight waits for it"
        return Event(Level.WARNING, "px4", text)


def _lock(record: LockState) -> Event:
    settled = record.phase is LockPhase.SETTLED
    feedback = " (no feedback)" if settled and not record.feedback else ""
    mode = f" {record.mode.value}" if record.mode else ""
    why = f": {record.reason}" if record.reason else ""
    levels = {LockPhase.FAULT: Level.ERROR, LockPhase.TRAVELLING: Level.DEBUG}
    level = levels.get(record.phase, Level.INFO)
    return Event(level, "lock", f"lock {record.phase.value}{mode}{feedback}{why}")
