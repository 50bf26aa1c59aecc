"""Terminal output of a flight: a line per decision, a table at the end."""

from __future__ import annotations

import shlex
from importlib.util import find_spec

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from dart_flight.base.processes import LATE_S
from dart_flight.base.records import GuardEvent, MissionEnd, Outcome, PhaseChange, Record, World
from dart_flight.cli.live_line import LiveLine
from dart_flight.cli.terminal import emit_json, keep_status, styled, tables
from dart_flight.config.mission import Mission
from dart_flight.recording.events import Event, EventFormatter, Level
from dart_flight.recording.flight_time import FlightTime
from dart_flight.recording.flown_impact import CollisionVerdict, Velocities
from dart_flight.recording.plan_versus_flight import format_departures
from dart_flight.recording.verdict import Verdict
from dart_flight.run.many_flights import RunsSummary

TOO_BUSY = "the computer is too slow for real time; omit --realtime or use --fast"


class FlightLines:
    """Observer that prints the decisions of a flight, with the flight time (`flight_time`).

    Args:
        verbose: whether to print minor events as well.
        live_line: line that is updated below the decisions, or None.
    """

    def __init__(self, console: Console, verbose: bool = False, live_line: LiveLine | None = None) -> None:
        self._console, self._verbose, self._live_line = console, verbose, live_line
        self._time = FlightTime()
        self._newest_us = 0
        self._events = EventFormatter(every_problem=verbose)

    def __call__(self, record: Record) -> None:
        self._time.add(record)
        if self._live_line is not None:
            self._live_line(record)
        event = self._events.format_event(record)
        if event is None or (event.level is Level.DEBUG and not self._verbose):
            return
        self.close()
        # Show the time of detection, which keeps the lines in order. The stamp of a peak is earlier.
        self._newest_us = max(self._newest_us, getattr(record, "detected_us", getattr(record, "t_us", 0)))
        time_s = self._time.seconds(self._newest_us)
        shown = " " * 9 if time_s is None else f"{time_s:7.2f} s"
        self._console.print(styled((shown, "dim"), "  ", *_styled(record, event)), soft_wrap=True)

    def close(self) -> None:
        """Remove the live line, at the end of the flight or before other output."""
        if self._live_line is not None:
            self._live_line.clear()


def live_line_for(mission: Mission, console: Console) -> LiveLine | None:
    """Return a live line for a flight, or None if messages do not go to a terminal."""
    return LiveLine(mission, console.file) if console.is_terminal else None


def show_end(verdict: Verdict, console: Console, as_json: bool) -> None:
    """Print the result of a flight, the path of its log, and commands that use the log."""
    with keep_status(_in_a_line(verdict)):
        if as_json:
            emit_json(verdict)
        else:
            tables().print(verdict_table(verdict))
    if as_json:
        return
    for line in wall_lines(verdict):
        console.print(line, soft_wrap=True)
    late_ms = verdict.own_lateness_ms or 0.0
    if verdict.outcome is not Outcome.COMPLETED and late_ms > 1e3 * LATE_S:
        simulated = verdict.world is not None and verdict.world is not World.DRONE
        why = TOO_BUSY if simulated else "the computer was too busy (see docs/latency.md)"
        console.print(f"this program lagged by up to {late_ms:.0f} ms: {why}", style="yellow", soft_wrap=True)
    if verdict.log_failure is not None:
        text = f"log: {verdict.log} is incomplete: {verdict.log_failure}"
        console.print(text, soft_wrap=True, style="red")
        return
    for line in [f"log: {verdict.log}", *(f"  {step}" for step in next_steps(verdict))]:
        console.print(line, soft_wrap=True)


def _in_a_line(verdict: Verdict) -> str:
    reason = "" if verdict.reason is None else f": {verdict.reason}"
    log = "" if verdict.log is None else f", log: {verdict.log}"
    return f"{verdict.mission}, {verdict.world or 'unknown'}: {verdict.outcome}{reason}{log}"


def wall_lines(verdict: Verdict) -> list[str]:
    """Return a line for each wall that contacts have located, with its estimated position and direction."""
    lines = []
    for wall in verdict.walls:
        if wall.yaw_sd_deg is None or wall.position_sd_m is None:
            continue
        (x, y), (nx, ny) = wall.point_m, wall.normal
        text = f"wall {wall.name}: at ({x:.3f}, {y:.3f}) ± {wall.position_sd_m:.3f} m along its normal "
        text += f"({nx:.3f}, {ny:.3f}) ± {wall.yaw_sd_deg:.2f} deg"
        lines.append(text + (f", {wall.material}" if wall.material is not None else ", material unknown"))
    return lines


def exit_status(verdict: Verdict) -> int:
    return 0 if verdict.outcome is Outcome.COMPLETED and verdict.log_failure is None else 1


def next_steps(verdict: Verdict) -> list[str]:
    """Return the commands that use a flight's log, except commands whose packages are not installed."""
    if verdict.log is None:
        return []
    log = shlex.quote(verdict.log)
    steps = [
        ("matplotlib", f"dart-flight report {log}"),
        ("foxglove", f"dart-flight export --foxglove {log}"),
        (None, f"dart-flight replay {log}"),
        *([("scipy", f"dart-flight identify {log}")] if verdict.collisions else []),
    ]
    return [step for needs, step in steps if needs is None or find_spec(needs) is not None]


def _styled(record: Record, event: Event) -> list[tuple[str, str]]:
    head, detail = event.head, event.detail
    if isinstance(record, PhaseChange):
        return [(head, "bold"), (f" ({detail})", "dim")]
    if isinstance(record, GuardEvent):
        return [(head, "red"), (f" ({detail})" if detail else "", "")]
    if isinstance(record, MissionEnd):
        colour = "green" if event.level is Level.INFO else "red"
        return [(head, colour), (f": {detail}" if detail else "", "")]
    return [(head, "dim" if event.source == "px4" else "")]


def verdict_table(verdict: Verdict) -> RenderableType:
    """Return a table of a flight: outcome, collisions (planned, measured, true) and figures."""
    title = Text(f"{verdict.mission}, {verdict.world or 'unknown'}: {verdict.outcome}", style="italic")
    parts: list[RenderableType] = [title]
    if verdict.reason is not None:
        parts.append(Text(f"reason: {verdict.reason}", style="red"))
    if verdict.collisions:
        table = Table()
        for column in ("", "normal\nm/s", "along\nm/s", "normal\npeak N", "contact\nms", "detected\nms"):
            table.add_column(column, justify="left" if not column else "right", no_wrap=bool(column))
        for collision in verdict.collisions:
            _add_collision(table, collision)
        parts.append(table)
    elif verdict.outcome is not Outcome.COMPLETED:
        parts.append(Text("no planned collision took place"))
    figures = [
        f"{name} {value:.2f}\N{NO-BREAK SPACE}{unit}"
        for name, value, unit in (
            ("goal miss", verdict.goal_miss_m, "m"),
            ("final error", verdict.final_error_m, "m"),
            ("max. tilt", verdict.max_tilt_deg, "deg"),
            ("max. EKF error", verdict.ekf_error_m, "m"),
            ("flight", verdict.flight_time_s, "s"),
        )
        if value is not None
    ]
    if figures:
        parts.append(Text(", ".join(figures)))
    if verdict.other_contacts:
        parts.append(_other_contacts_line(verdict))
    if verdict.estimator_resets:
        parts.append(_resets_line(verdict))
    if verdict.goal_reached is not None and verdict.outcome is Outcome.COMPLETED:
        parts.append(_goal_line(verdict))
    # If the mission was not completed, the verdict's reason is sufficient.
    if verdict.plan_followed is not None and verdict.outcome is Outcome.COMPLETED:
        parts.append(_plan_line(verdict))
    return Group(*parts)


def _other_contacts_line(verdict: Verdict) -> Text:
    """Describe the number of unplanned contacts, and their largest speed and force."""
    contacts = verdict.other_contacts
    speeds = [c.speed_m_s if c.truth is None else abs(c.truth.normal_m_s or 0.0) for c in contacts]
    forces = [c.peak_force_n if c.truth is None else c.truth.peak_force_n for c in contacts]
    figures = [
        f"{max(known):.{digits}f} {unit}"
        for values, digits, unit in ((speeds, 2, "m/s"), (forces, 0, "N"))
        if (known := [v for v in values if v is not None])
    ]
    count = "1 contact was" if len(contacts) == 1 else f"{len(contacts)} contacts were"
    return Text(f"{count} not planned, the hardest at {', '.join(figures)}", style="yellow")


def _resets_line(verdict: Verdict) -> Text:
    """Describe the number of resets of PX4's estimator in the air, and the largest steps."""
    resets = verdict.estimator_resets
    position_m, velocity_m_s = max(r.position_m for r in resets), max(r.velocity_m_s for r in resets)
    heading_deg = max((r.heading_deg for r in resets), key=abs)
    figures = f"position {position_m:.2f} m, velocity {velocity_m_s:.2f} m/s, heading {heading_deg:.1f} deg"
    times = "once" if len(resets) == 1 else f"{len(resets)} times"
    return Text(f"PX4 reset its estimator {times}; the largest steps were {figures}", style="yellow")


def _goal_line(verdict: Verdict) -> Text:
    """Return "reached", or the actual and predicted distance from the goal."""
    if verdict.goal_reached:
        return Text("goal reached")
    text = "goal not reached"
    if verdict.goal_miss_m is not None:
        text = f"goal not passed within the capture radius: passed at {verdict.goal_miss_m:.2f} m"
        if verdict.goal_miss_planned_m is not None:
            text += f", predicted at {verdict.goal_miss_planned_m:.2f} m"
    if verdict.final_error_m is not None:
        text = f"held {verdict.final_error_m:.2f} m from the goal; {text}"
    return Text(text, style="yellow")


def _plan_line(verdict: Verdict) -> Text:
    """Return "plan followed", or the flight's largest deviations from the plan."""
    if verdict.plan_followed:
        return Text("plan followed")
    return Text(f"plan not followed: {format_departures(verdict.deviations)}", style="yellow")


def _add_collision(table: Table, c: CollisionVerdict) -> None:
    head = styled((f"{c.index} {c.wall}, {c.mode}", "bold"), (" clipped" if c.clipped else "", "red"))
    if c.mode_felt not in (None, c.mode):
        head.append(f", but the contact indicates {c.mode_felt}", style="red")
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
            extra = [figure_or_dash(c.contact_time_ms, 0), figure_or_dash(c.detection_latency_ms, 1)]
        table.add_row(
            f"  {name}",
            figure_or_dash(v.normal_m_s, 2),
            figure_or_dash(v.tangential_m_s, 2),
            figure_or_dash(v.peak_force_n, 1),
            *extra,
        )


def figure_or_dash(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def summary_table(summary: RunsSummary) -> Table:
    table = Table(title=f"{summary.completed} of {summary.runs} completed", title_justify="left")
    for column in ("", "median", "least", "most"):
        table.add_column(column, justify="left" if not column else "right")
    for name, spread in (
        ("goal miss m", summary.goal_miss_m),
        ("final error m", summary.final_error_m),
        ("largest tilt deg", summary.max_tilt_deg),
        ("peak force error %", summary.peak_force_error_percent),
    ):
        if spread is not None:
            table.add_row(name, *(f"{v:.3f}" for v in (spread.median, spread.low, spread.high)))
    if summary.plan_followed is not None:
        table.add_row(f"plan followed: {_flights(summary.plan_followed)}")
    for reason, count in summary.reasons.items():
        table.add_row(styled((f"{reason}: {_flights(count)}", "red")))
    return table


def _flights(count: int) -> str:
    return "1 flight" if count == 1 else f"{count} flights"
