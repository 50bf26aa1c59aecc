"""The figures of a report, as SVG text.

Small on purpose: 4.6 inches are a phone's width, so that letters stay legible there. Lines differ in darkness
and dash as well as in colour, so that a page printed in grey can be read.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.recording.arrays import Array
from dart_flight.report.flight import Flight, Impact
from dart_flight.samples import (
    ContactEnd,
    ImpactOnset,
    LockPermission,
    LockPhase,
    LockState,
    Phase,
    PhaseChange,
)

TRUE = {"color": "#000000", "linestyle": "-", "linewidth": 1.8}
ESTIMATED = {"color": "#1f6fd0", "linestyle": (0, (5, 1.5)), "linewidth": 1.6}
PREDICTED = {"color": "#e8871e", "linestyle": (0, (1, 1.2)), "linewidth": 2.2}
REPLANNED = {"color": "#8a3fb5", "linestyle": (0, (4, 1.2, 1, 1.2)), "linewidth": 1.8}
_GREY, _LIGHT = "#666666", "#d9d9d9"
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "dart-flight",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Arial", "Helvetica", "sans-serif"],
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}
_WIDTH = 4.6


def _figure(height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    try:
        import matplotlib as mpl  # noqa: PLC0415  (an extra, and slow)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise InputError(f"a report needs {error.name}: pip install 'dart-flight[report]'") from None
    mpl.rcParams.update(_STYLE)
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def _svg(figure: Any) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _legend_above(axis: Any) -> None:
    """In one row over the plot, where it covers no line."""
    labels = axis.get_legend_handles_labels()[1]
    if labels:
        axis.legend(
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(labels), borderaxespad=0.2,
            columnspacing=1.2, handlelength=1.8,
        )  # fmt: skip


# --- map -----------------------------------------------------------------------------------------------


def flight_map(flights: Sequence[Flight]) -> str:
    """Walls, plan and flown paths from above; of several flights the paths lie over each other."""
    mission = flights[0].mission
    figure, axis = _figure(4.4)
    bounds = mission.bounds
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    axis.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=_LIGHT, linewidth=1.0)
    for wall in mission.walls:
        _draw_wall(axis, wall)
    alone = len(flights) == 1
    for i, flight in enumerate(flights):
        air = _airborne(flight)
        if air is None:
            continue
        for motion, style, label in (
            (flight.course.true, TRUE, "flown (true)"),
            (flight.course.estimated, ESTIMATED, "flown (estimated)"),
        ):
            if not motion.time_s.size or (
                not alone and motion is flight.course.estimated and _has_truth(flight)
            ):
                continue
            inside = (motion.time_s >= air[0]) & (motion.time_s <= air[1])
            place = motion.position[inside]
            thin = {} if alone else {"linewidth": 0.8, "alpha": 0.6}
            axis.plot(place[:, 0], place[:, 1], label=label if i == 0 else None, **{**style, **thin})
        if alone:
            for way in flight.ways():
                axis.plot(way[:, 0], way[:, 1], label="planned in flight", **REPLANNED)
            for x, y, _ in flight.recovery_points():
                axis.plot(x, y, "x", color=_GREY, markersize=7, label="recovery set-point")
    planned = flights[0].planned
    for line in (*(np.array(a) for a in planned.approaches), *planned.legs):
        axis.plot(line[:, 0], line[:, 1], label="planned", **PREDICTED)
    axis.plot(*mission.start, "o", color="black", markersize=6, label="start")
    axis.plot(*mission.goal.position_m, "*", color="black", markersize=11, label="goal")
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axis.legend(unique.values(), unique.keys(), loc="upper left", bbox_to_anchor=(0.0, -0.12), ncols=2)
    axis.set_aspect("equal")
    axis.set_xlabel("x, m")
    axis.set_ylabel("y, m")
    return _svg(figure)


def _has_truth(flight: Flight) -> bool:
    return bool(flight.course.true.time_s.size)


def _draw_wall(axis: Any, wall: Any) -> None:
    half = 0.5 * wall.length_m
    (px, py), (tx, ty), (nx, ny) = wall.point, wall.tangent, wall.normal
    ends = np.array([[px - half * tx, py - half * ty], [px + half * tx, py + half * ty]])
    back = 0.1 * np.array([nx, ny])
    axis.fill(
        [ends[0, 0], ends[1, 0], *(ends[1::-1, 0] - back[0])],
        [ends[0, 1], ends[1, 1], *(ends[1::-1, 1] - back[1])],
        facecolor="#c9c9c9",
        edgecolor="#555555",
        hatch="////",
        linewidth=0.6,
    )
    axis.annotate(
        wall.name, (px - 0.22 * nx, py - 0.22 * ny), ha="center", va="center", color="#333333",
        rotation=90 if abs(nx) > abs(ny) else 0,
    )  # fmt: skip


def _airborne(flight: Flight) -> tuple[float, float] | None:
    changes = flight.course.all(PhaseChange)
    begin = next((flight.course.time_of(c.t_us) for c in changes if c.after is Phase.CLIMB), None)
    if begin is None:
        return None
    end = next(
        (flight.course.time_of(c.t_us) for c in changes if c.after in (Phase.LANDING, Phase.DONE)),
        float("inf"),
    )
    return begin, end


# --- impacts -------------------------------------------------------------------------------------------


def impact_forces(flight: Flight, impact: Impact) -> str:
    """Normal and friction force of one collision over time: predicted, estimated, true."""
    figure, axes = _figure(3.9, 2, 1, sharex=True)
    wall = impact.collision.wall
    directions = (np.array([*wall.normal, 0.0]), np.array([*wall.tangent, 0.0]))
    for axis, direction, name in zip(axes, directions, ("normal force, N", "friction force, N"), strict=True):
        for force, style, label in (
            (flight.course.true_force, TRUE, "true"),
            (flight.course.estimated_force, ESTIMATED, "estimated"),
        ):
            shown = np.abs(force.time_s - impact.at_s) < 0.25
            if shown.any():
                axis.plot(
                    1e3 * (force.time_s[shown] - impact.at_s),
                    force.force[shown] @ direction,
                    label=label,
                    **style,
                )
        if impact.prediction is not None:
            path = impact.prediction
            values = path.normal_force_n if axis is axes[0] else path.tangential_force_n
            axis.plot(
                1e3 * (path.time_s + impact.onset_s - impact.at_s), values, label="predicted", **PREDICTED
            )
        axis.set_ylabel(name)
        axis.axvline(0.0, color=_GREY, linewidth=0.8)
    threshold = flight.mission.vehicle.detection.force_threshold_n
    axes[0].axhline(threshold, color=_GREY, linewidth=0.8, linestyle=":")
    axes[0].annotate("threshold", (170, threshold), va="bottom", ha="right", fontsize=8, color=_GREY)
    _legend_above(axes[0])
    axes[1].set_xlim(-60, 175)
    axes[1].set_xlabel("time after detection, ms")
    return _svg(figure)


def impact_forces_over_trials(flights: Sequence[Flight], index: int) -> str:
    """The estimated normal force of one collision in every flight, their mean, and the prediction's."""
    figure, axis = _figure(3.0)
    grid = np.arange(-0.05, 0.17, 0.002)
    curves, predictions = [], []
    for flight in flights:
        for impact in (i for i in flight.impacts if i.verdict.index == index):
            force = flight.course.estimated_force
            normal = force.force @ np.array([*impact.collision.wall.normal, 0.0])
            curves.append(np.interp(grid, force.time_s - impact.at_s, normal))
            if impact.prediction is not None:
                when = impact.prediction.time_s + impact.onset_s - impact.at_s
                predictions.append(np.interp(grid, when, impact.prediction.normal_force_n))
    thin = {"color": "#8db4e2", "linewidth": 0.7}
    for i, curve in enumerate(curves):
        axis.plot(1e3 * grid, curve, label="each trial" if i == 0 else None, **thin)
    if curves:
        axis.plot(1e3 * grid, np.mean(curves, axis=0), label="mean", **ESTIMATED)
    if predictions:
        axis.plot(1e3 * grid, np.mean(predictions, axis=0), label="predicted", **PREDICTED)
    _legend_above(axis)
    axis.set_ylabel("estimated normal force, N")
    axis.set_xlabel("time after detection, ms")
    return _svg(figure)


# --- over the whole flight -----------------------------------------------------------------------------


def _span(flight: Flight) -> tuple[float, float]:
    motion = flight.course.estimated
    if not motion.time_s.size:
        return (0.0, 1.0)
    air = _airborne(flight)
    last = float(motion.time_s[-1])
    return (air[0], min(last, air[1] + 1.0)) if air is not None else (0.0, last)


def _mark_impacts(axis: Any, flight: Flight) -> None:
    for impact in flight.impacts:
        axis.axvline(impact.at_s, color=_GREY, linewidth=0.9)


def motion(flight: Flight) -> str:
    """Velocities and height over time, estimated and true; vertical lines are detections."""
    figure, axes = _figure(4.2, 3, 1, sharex=True)
    for j, (axis, name) in enumerate(
        zip(axes, ("x velocity, m/s", "y velocity, m/s", "height, m"), strict=True)
    ):
        for track, style, label in (
            (flight.course.true, TRUE, "true"),
            (flight.course.estimated, ESTIMATED, "estimated"),
        ):
            if track.time_s.size:
                values = track.position[:, 2] if j == 2 else track.velocity[:, j]
                axis.plot(track.time_s, values, label=label, **style)
        axis.set_ylabel(name)
        _mark_impacts(axis, flight)
    axes[2].set_xlim(*_span(flight))
    axes[2].set_xlabel("time, s")
    _legend_above(axes[0])
    return _svg(figure)


def timeline(flight: Flight) -> str:
    """Phases, contact, permission to lock and the lock's state over time."""
    figure, axis = _figure(2.9)
    course = flight.course
    begin, end = _span(flight)
    rows = ["lock", "may lock", "contact", "phase"]
    tones = {
        "flexible": ("#ffffff", ""),
        "rigid": ("#7f7f7f", ""),
        "travelling": ("#d9d9d9", "////"),
        "fault": ("#000000", ""),
        "unknown": ("#ffffff", "xx"),
    }

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
                0.5 * (left + right), rows.index(row), text, ha="center", va="center", fontsize=7.5,
                color="white" if dark else "black", clip_on=True,
            )  # fmt: skip

    for since, until, state in _stretches([(course.time_of(s.t_us), s) for s in course.all(LockState)], end):
        known = state.mode.value if state.mode else "unknown"
        name = known if state.phase is LockPhase.SETTLED else state.phase.value
        bar("lock", since, until, *tones[name], text=name)
    for since, until, allowed in _stretches(
        [(course.time_of(p.t_us), p.permitted) for p in course.all(LockPermission)], end
    ):
        if allowed:
            bar("may lock", since, until, "#e9e9e9")
    ends = [course.time_of(e.t_us) for e in course.all(ContactEnd)]
    for onset in course.all(ImpactOnset):
        first = course.time_of(onset.first_us)
        bar("contact", first, next((e for e in ends if e > first), first + 0.2), "#000000")
    changes = [(course.time_of(c.t_us), c.after) for c in course.all(PhaseChange)]
    for i, (since, until, phase) in enumerate(_stretches(changes, end)):
        bar("phase", since, until, "#ffffff" if i % 2 else "#ececec", text=phase)
    axis.set_yticks(range(len(rows)), rows)
    axis.set_xlim(begin, end)
    axis.set_xlabel("time, s")
    axis.grid(axis="y", visible=False)
    return _svg(figure)


def _stretches(moments: list[tuple[float, Any]], end: float) -> list[tuple[float, float, Any]]:
    """Values that hold from one moment to the next, the last to the end."""
    stops = [t for t, _ in moments[1:]] + [end] if moments else []
    return [(t, stop, value) for (t, value), stop in zip(moments, stops, strict=True)]


def timing(flight: Flight) -> str:
    """How regular set-points and how late IMU samples are: shares of at most so many milliseconds."""
    figure, axes = _figure(2.5, 1, 2, sharey=True)
    for axis, values, name in (
        (axes[0], flight.timing.setpoint_interval_ms, "set-point interval, ms"),
        (axes[1], flight.timing.imu_delay_ms, "IMU delay over the least, ms"),
    ):
        _cumulative(axis, values)
        axis.set_xlabel(name)
    axes[0].set_ylabel("share, %")
    return _svg(figure)


def _cumulative(axis: Any, values: Array) -> None:
    if not values.size:
        axis.annotate("no data", (0.5, 0.5), xycoords="axes fraction", ha="center")
        return
    ordered = np.sort(values)
    share = 100.0 * np.arange(1, ordered.size + 1) / ordered.size
    right = max(1.0, 1.25 * float(np.percentile(ordered, 99.9)))
    left = -0.06 * right  # a line at 0 is not hidden by the axis
    axis.step(
        [left, ordered[0], *ordered, right], [0.0, 0.0, *share, share[-1]], where="post", color="black",
        linewidth=1.4,
    )  # fmt: skip
    axis.set_xlim(left, right)
    axis.locator_params(axis="x", nbins=4)


def errors_over_trials(flights: Sequence[Flight]) -> str:
    """Peak normal force against its prediction and its truth, one mark per collision and flight."""
    indices = sorted({i.verdict.index for f in flights for i in f.impacts})
    figure, axis = _figure(2.8)
    styles = {
        "measured against predicted": {"marker": "o", "facecolors": "none", "edgecolors": "#1f6fd0"},
        "measured against true": {"marker": "x", "color": "black"},
    }
    for label, style in styles.items():
        predicted = "predicted" in label
        points = [
            (i.verdict.index + (-0.12 if predicted else 0.12), error)
            for f in flights
            for i in f.impacts
            if (error := i.disagreement if predicted else i.force_error) is not None
        ]
        if points:
            x, y = zip(*points, strict=True)
            spread = np.linspace(-0.06, 0.06, len(x))
            axis.scatter(np.array(x) + spread, 100.0 * np.array(y), s=24, label=label, **style)
    axis.axhline(0.0, color=_GREY, linewidth=0.8)
    axis.set_xticks(indices, [f"collision {i}" for i in indices])
    axis.set_xlim(min(indices, default=1) - 0.5, max(indices, default=1) + 0.5)
    axis.set_ylabel("peak normal force, error %")
    _legend_above(axis)
    return _svg(figure)


def texts_of(svg: str) -> list[str]:
    """The words in a figure; for tests."""
    return [t.strip() for t in re.findall(r"<text[^>]*>([^<]+)</text>", svg)]


# --- other vehicles' logs ------------------------------------------------------------------------------


def felt_force(time_s: Array, force_m_s2: Array, threshold_m_s2: Array, impacts_s: Sequence[float]) -> str:
    """Horizontal force over mass of a whole flight: of every twentieth of a second the largest."""
    figure, axis = _figure(2.6)
    step = max(1, round(0.05 / max(float(np.median(np.diff(time_s))), 1e-3))) if len(time_s) > 1 else 1
    count = max(1, len(time_s) // step)
    largest = np.array([force_m_s2[i * step : (i + 1) * step].max() for i in range(count)])
    axis.plot(time_s[: count * step : step], largest, **ESTIMATED)
    axis.plot(time_s[::step], threshold_m_s2[::step], color=_GREY, linewidth=1.0)
    for at in impacts_s:
        axis.axvline(at, color="#000000", linewidth=0.8)
    axis.set(xlabel="s", ylabel="m/s²")
    return _svg(figure)
