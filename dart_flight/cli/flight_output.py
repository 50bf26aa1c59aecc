"""How a flight shows on the terminal: a line per decision, a table at the end."""

from __future__ import annotations

from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from dart_flight.deviations import Deviation, worst
from dart_flight.recording.flight_time import FlightTime
from dart_flight.samples import (
    ContactEnd,
    GoalPassed,
    GuardEvent,
    HealthReport,
    ImpactPeak,
    LockPhase,
    LockState,
    MissionEnd,
    Outcome,
    PhaseChange,
    PlanTaken,
    Record,
    StatusText,
)
from dart_flight.verdict import CollisionVerdict, Velocities, Verdict
from dart_flight.worlds.campaigns import Summary

_MOST_DEVIATIONS = 3
_QUIET = frozenset({"notice", "info", "debug"})


class FlightLines:
    """Prints the decisions of a flight as they come, with the time since its zero (`flight_time`)."""

    def __init__(self, console: Console, verbose: bool = False) -> None:
        self._console, self._verbose = console, verbose
        self._time = FlightTime()
        self._problems: tuple[str, ...] = ()

    def __call__(self, record: Record) -> None:
        """Print a record if it is a decision."""
        self._time.take(record)
        line = self._line(record)
        if line is None:
            return
        time_s = self._time.seconds(getattr(record, "t_us", 0))
        shown = " " * 9 if time_s is None else f"{time_s:7.2f} s"
        self._console.print(f"[dim]{shown}[/]  {line}", soft_wrap=True)

    def _line(self, record: Record) -> str | None:
        if isinstance(record, PhaseChange):
            which = f" (collision {record.collision})" if record.collision else ""
            return f"[bold]{record.after}[/]{which}  [dim]{record.reason}[/]"
        if isinstance(record, ImpactPeak):
            clipped = ", clipped" if record.clipped else ""
            return (
                f"impact: {record.normal_force_n:.1f} N normal, "
                f"{record.tangential_force_n:.1f} N along the wall{clipped}"
            )
        if isinstance(record, ContactEnd):
            return f"contact over after {(record.t_us - record.first_us) * 1e-3:.0f} ms"
        if isinstance(record, GuardEvent):
            return f"[red]guard: {record.rule} -> {record.action}[/]  {record.detail}"
        if isinstance(record, GoalPassed):
            words = "time is up, nearest to the goal" if record.timed_out else "goal passed at"
            return f"{words} {record.miss_m:.2f} m"
        if isinstance(record, PlanTaken):
            return "flying a new plan" if record.taken else f"new plan not flown: {record.reason}"
        if isinstance(record, MissionEnd):
            colour = "green" if record.outcome == "completed" else "red"
            return f"[{colour}]{record.outcome}[/]" + (f": {record.reason}" if record.reason else "")
        if isinstance(record, LockState):
            return self._lock_line(record)
        if isinstance(record, StatusText) and (self._verbose or record.severity not in _QUIET):
            return f"[dim]PX4 {record.severity}: {escape(record.text)}[/]"
        if isinstance(record, HealthReport):
            return self._health_line(record)
        return None

    def _health_line(self, record: HealthReport) -> str | None:
        """What PX4's checks hold against arming; nothing where that has not changed."""
        problems = record.blocking or (record.others if self._verbose else ())
        changed, self._problems = problems != self._problems, problems
        if not changed or not problems:
            return None
        return f"[dim]PX4's checks: {escape(', '.join(problems))}[/]"

    def _lock_line(self, record: LockState) -> str | None:
        if record.phase is LockPhase.TRAVELLING and not self._verbose:
            return None
        feedback = "" if record.feedback or record.phase is not LockPhase.SETTLED else " (no feedback)"
        mode = f" {record.mode.value}" if record.mode else ""
        return f"lock {record.phase.value}{mode}{feedback}" + (f": {record.reason}" if record.reason else "")


def verdict_table(verdict: Verdict) -> RenderableType:
    """A flight: how it ended and why, its collisions planned, measured and true, and its figures."""
    title = Text(f"{verdict.mission}, {verdict.world or 'unknown'}: {verdict.outcome}", style="italic")
    parts: list[RenderableType] = [title]
    if verdict.reason is not None:
        parts.append(Text(f"reason: {verdict.reason}", style="red"))
    if verdict.collisions:
        table = Table()
        for column in ("", "normal\nm/s", "along\nm/s", "peak\nN", "contact\nms", "detected\nms"):
            table.add_column(column, justify="left" if not column else "right", no_wrap=bool(column))
        for collision in verdict.collisions:
            _add_collision(table, collision)
        parts.append(table)
    else:
        parts.append(Text("no planned collision was flown"))
    figures = [
        f"{name} {value:.2f}\N{NO-BREAK SPACE}{unit}"
        for name, value, unit in (
            ("goal miss", verdict.goal_miss_m, "m"),
            ("final error", verdict.final_error_m, "m"),
            ("tilt up to", verdict.max_tilt_deg, "deg"),
            ("EKF error up to", verdict.ekf_error_m, "m"),
            ("flight", verdict.flight_time_s, "s"),
        )
        if value is not None
    ]
    if figures:
        parts.append(Text(", ".join(figures)))
    # Of a flight that was broken off the reason says what is to be known.
    if verdict.plan_followed is not None and verdict.outcome is Outcome.COMPLETED:
        parts.append(_plan_line(verdict))
    return Group(*parts)


def _plan_line(verdict: Verdict) -> Text:
    """Whether the plan was followed, and where it was left most."""
    if verdict.plan_followed:
        return Text("plan followed")
    outside = worst(verdict.deviations)
    shown = "; ".join(map(_deviation, outside[:_MOST_DEVIATIONS]))
    more = len(outside) - _MOST_DEVIATIONS
    return Text(f"plan not followed: {shown}" + (f"; {more} more" if more > 0 else ""), style="yellow")


def _deviation(one: Deviation) -> str:
    name, _, unit = one.what.partition(", ")
    within = f" ± {one.tolerance:.2f}" if one.tolerance is not None else ""
    return f"{name} {_figure(one.flown)} instead of {_figure(one.planned)}{within} {unit}".rstrip()


def _figure(value: float | str | None) -> str:
    return "none" if value is None else value if isinstance(value, str) else f"{value:.2f}"


def _add_collision(table: Table, c: CollisionVerdict) -> None:
    head = f"[bold]{c.index} {c.wall}, {c.mode}[/]" + (" [red]clipped[/]" if c.clipped else "")
    if c.mode_log_odds is None:
        if c.mode_by_contact_time not in (None, c.mode):
            head += f" [red]but {c.mode_by_contact_time} by its contact time[/]"
    elif c.mode_felt not in (None, c.mode):
        head += f" [red]but felt {c.mode_felt}[/]"
    table.add_row(head)
    rows: list[tuple[str, Velocities | None]] = [
        ("planned", c.planned),
        ("measured", c.measured),
        ("truth", c.truth),
    ]
    for name, v in rows:
        if v is None:
            continue
        extra = ["", ""]
        if name == "measured":
            extra = [_number(c.contact_time_ms, 0), _number(c.detection_latency_ms, 1)]
        table.add_row(
            f"  {name}",
            _number(v.normal_m_s, 2),
            _number(v.tangential_m_s, 2),
            _number(v.peak_force_n, 1),
            *extra,
        )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def summary_table(summary: Summary) -> Table:
    """Many flights in a few rows."""
    table = Table(title=f"{summary.completed} of {summary.runs} completed", title_justify="left")
    for column in ("", "median", "least", "most"):
        table.add_column(column, justify="left" if not column else "right")
    if summary.plan_followed is not None:
        table.add_row("plan followed", str(summary.plan_followed))
    for name, spread in (
        ("goal miss m", summary.goal_miss_m),
        ("final error m", summary.final_error_m),
        ("largest tilt deg", summary.max_tilt_deg),
        ("peak force error %", summary.peak_force_error_percent),
    ):
        if spread is not None:
            table.add_row(name, *(f"{v:.3f}" for v in (spread.median, spread.low, spread.high)))
    for reason, count in summary.reasons.items():
        table.add_row(f"[red]{escape(reason)}[/]", str(count))
    return table
