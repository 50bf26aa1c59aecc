"""Figures of contact forces in one hit, in one hit over several trials, and in a whole log of any vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.lab.figure_style import (
    ESTIMATED,
    GREY,
    PAGE,
    PREDICTED,
    TRUE,
    Look,
    in_style,
    legend_above,
    new_figure,
)
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight

_SHOWN_MS = (-60.0, 175.0)


@in_style
def impact_forces(flight: RecordedFlight, impact: Impact, *, look: Look = PAGE) -> Any:
    """Draw normal, friction and vertical force of one collision over time: predicted, estimated, true.

    The vertical force is positive upwards. The law predicts the force along Z of the collision frame, which
    points down, so the sign of the prediction is reversed.
    """
    figure, axes = new_figure(look, 5.0, 3, 1, sharex=True)
    wall, path = impact.collision.wall, impact.prediction
    panels = (
        ("normal, N", (*wall.normal, 0.0), None if path is None else path.normal_force_n),
        ("friction, N", (*wall.tangent, 0.0), None if path is None else path.tangential_force_n),
        ("vertical, N", (0.0, 0.0, 1.0), None if path is None else -path.vertical_force_n),
    )
    for axis, (name, direction, predicted) in zip(axes, panels, strict=True):
        for force, style, label in (
            (flight.course.true_force, TRUE, "true"),
            (flight.course.estimated_force, ESTIMATED, "estimated"),
        ):
            after_ms = 1e3 * (force.time_s - impact.at_s)
            shown = (after_ms > _SHOWN_MS[0] - 5.0) & (after_ms < _SHOWN_MS[1] + 5.0)
            if shown.any():
                axis.plot(after_ms[shown], force.force[shown] @ np.array(direction), label=label, **style)
        if path is not None and predicted is not None:
            after_ms = 1e3 * (path.time_s + impact.onset_s - impact.at_s)
            axis.plot(after_ms[::2], predicted[::2], label="predicted", **PREDICTED)
        axis.set_ylabel(name)
        axis.axvline(0.0, color=GREY, linewidth=0.8)
    threshold = flight.mission.vehicle.detection.force_threshold_n
    axes[0].axhline(threshold, color=GREY, linewidth=0.8, linestyle=":")
    axes[0].annotate(
        "threshold", (170, threshold), va="bottom", ha="right", fontsize=look.small_pt, color=GREY
    )
    legend_above(axes[0])
    axes[2].set_xlim(*_SHOWN_MS)
    axes[2].set_xlabel("time after detection, ms")
    return figure


@in_style
def impact_forces_over_trials(flights: Sequence[RecordedFlight], index: int, *, look: Look = PAGE) -> Any:
    """Draw one collision's normal force: each flight's estimate, mean estimate and mean prediction."""
    figure, axis = new_figure(look, 3.0)
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
    legend_above(axis)
    axis.set_ylabel("estimated normal force, N")
    axis.set_xlabel("time after detection, ms")
    return figure


@in_style
def errors_over_trials(flights: Sequence[RecordedFlight], *, look: Look = PAGE) -> Any:
    """Draw two errors of each measured peak normal force: against the prediction and against the truth."""
    indices = sorted({i.verdict.index for f in flights for i in f.impacts})
    figure, axis = new_figure(look, 2.8)
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
            if (error := i.disagreement if predicted else i.verdict.force_error) is not None
        ]
        if points:
            x, y = zip(*points, strict=True)
            spread = np.linspace(-0.06, 0.06, len(x))
            axis.scatter(np.array(x) + spread, 100.0 * np.array(y), s=24, label=label, **style)
    axis.axhline(0.0, color=GREY, linewidth=0.8)
    axis.set_xticks(indices, [f"collision {i}" for i in indices])
    axis.set_xlim(min(indices, default=1) - 0.5, max(indices, default=1) + 0.5)
    axis.set_ylabel("peak normal force, error %")
    legend_above(axis)
    return figure


@in_style
def force_over_flight(
    time_s: Array, force_m_s2: Array, threshold_m_s2: Array, impacts_s: Sequence[float], look: Look = PAGE
) -> Any:
    """Draw the horizontal force, divided by the vehicle's mass, over a whole flight.

    Each drawn point is the maximum over 0.05 s.
    """
    figure, axis = new_figure(look, 2.6)
    step = max(1, round(0.05 / max(float(np.median(np.diff(time_s))), 1e-3))) if len(time_s) > 1 else 1
    count = max(1, len(time_s) // step)
    largest = np.array([force_m_s2[i * step : (i + 1) * step].max() for i in range(count)])
    # Draw a solid line, because dashes would look like gaps in the recording.
    axis.plot(
        time_s[: count * step : step], largest, **{**ESTIMATED, "linestyle": "-", "linewidth": 0.9}
    )  # fmt: skip
    axis.plot(time_s[::step], threshold_m_s2[::step], color=GREY, linewidth=1.0)
    for at in impacts_s:
        axis.axvline(at, color="#000000", linewidth=0.8)
    axis.set(xlabel="s", ylabel="m/s²")
    return figure
