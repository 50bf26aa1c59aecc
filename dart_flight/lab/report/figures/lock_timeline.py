"""The timeline of phases, contacts and the lock over a flight."""

from __future__ import annotations

from typing import Any

from dart_flight.base.records import ContactEnd, ImpactOnset, LockPermission, PhaseChange
from dart_flight.lab.figure_style import PAGE, Look, in_style, new_figure
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.tracks import lock_stretches, stretches

_TONES = {
    "flexible": ("#ffffff", ""),
    "rigid": ("#7f7f7f", ""),
    "travelling": ("#d9d9d9", "////"),
    "fault": ("#000000", ""),
    "unknown": ("#ffffff", "xx"),
}
_ROWS = ["lock", "may lock", "contact", "phase"]  # the first two need a vehicle with a lock


@in_style
def timeline(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw phases, contacts, permission to lock, and the lock's state over time."""
    figure, axis = new_figure(look, 2.9)
    course, has_lock = flight.course, flight.mission.vehicle.has_lock
    rows = _ROWS if has_lock else _ROWS[2:]
    begin, end = flight.shown_span

    def bar(row: str, t0: float, t1: float, face: str, hatch: str = "", text: str = "") -> None:
        left, right = max(t0, begin), min(t1, end)
        if right <= left:
            return
        axis.barh(
            rows.index(row), right - left, left=left, height=0.62, facecolor=face, hatch=hatch,
            edgecolor="#444444", linewidth=0.6,
        )  # fmt: skip
        if text and right - left > 0.075 * (end - begin):
            dark = face == "#7f7f7f"
            axis.text(
                0.5 * (left + right), rows.index(row), text, ha="center", va="center",
                fontsize=look.small_pt - 0.5, color="white" if dark else "black", clip_on=True,
            )  # fmt: skip

    if has_lock:
        for since, until, name in lock_stretches(course, end):
            bar("lock", since, until, *_TONES[name], text=name)
        permitted = [(course.time_of(p.t_us), p.permitted) for p in course.all(LockPermission)]
        for since, until, allowed in stretches(permitted, end):
            if allowed:
                bar("may lock", since, until, "#e9e9e9")
    ends = [course.time_of(e.t_us) for e in course.all(ContactEnd)]
    for onset in course.all(ImpactOnset):
        first = course.time_of(onset.first_us)
        bar("contact", first, next((e for e in ends if e > first), first + 0.2), "#000000")
    changes = [(course.time_of(c.t_us), c.after) for c in course.all(PhaseChange)]
    for i, (since, until, phase) in enumerate(stretches(changes, end)):
        bar("phase", since, until, "#ffffff" if i % 2 else "#ececec", text=phase)
    axis.set_yticks(range(len(rows)), rows)
    axis.set_xlim(begin, end)
    axis.set_xlabel("time, s")
    axis.grid(axis="y", visible=False)
    return figure
