"""Figures of the vehicle's motion, its tracking of setpoints, and thrust and battery."""

from __future__ import annotations

from typing import Any

import numpy as np

from dart_flight.lab.figure_style import (
    ESTIMATED,
    GREY,
    PAGE,
    TRUE,
    Look,
    in_style,
    legend_above,
    new_figure,
)
from dart_flight.lab.report.recorded_flight import RecordedFlight
from dart_flight.lab.report.tracks import angles, power, tracking

_MAX_POINTS = 700  # maximum number of points of a line over a whole flight; more than the page's pixels


def mark_impacts(axis: Any, flight: RecordedFlight) -> None:
    for impact in flight.impacts:
        axis.axvline(impact.at_s, color=GREY, linewidth=0.7, zorder=1)


def _plot(axis: Any, flight: RecordedFlight, time_s: Any, values: Any, **style: Any) -> None:
    """Plot a line over the flight's `shown_span`.

    A line of more than `_MAX_POINTS` points is divided into intervals, and only the lowest and the highest
    point of each interval are kept.
    """
    begin, end = flight.shown_span
    inside = (time_s >= begin) & (time_s <= end)
    t, v = time_s[inside], np.asarray(values)[inside]
    if v.size > _MAX_POINTS:
        step = -(-2 * v.size // _MAX_POINTS)
        count = v.size // step
        parts = v[: count * step].reshape(count, step)
        first = np.arange(count) * step
        low, high = first + parts.argmin(axis=1), first + parts.argmax(axis=1)
        chosen = np.unique(np.concatenate([low, high]))
        t, v = t[chosen], v[chosen]
    if v.size:
        axis.plot(t, v, **style)


def _over_time(axis: Any, flight: RecordedFlight) -> None:
    axis.set_xlim(*flight.shown_span)
    axis.set_xlabel("time, s")


def _label(axes: Any, names: tuple[str, ...], flight: RecordedFlight) -> None:
    for axis, name in zip(axes, names, strict=True):
        axis.set_ylabel(name)
        mark_impacts(axis, flight)
    _over_time(axes[-1], flight)
    legend_above(axes[0])


@in_style
def motion(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw velocities and height over time, estimated and true; vertical lines mark detections."""
    figure, axes = new_figure(look, 4.2, 3, 1, sharex=True)
    for j, axis in enumerate(axes):
        for track, style, label in (
            (flight.course.true, TRUE, "true"),
            (flight.course.estimated, ESTIMATED, "estimated"),
        ):
            if track.time_s.size:
                values = track.position[:, 2] if j == 2 else track.velocity[:, j]
                _plot(axis, flight, track.time_s, values, label=label, **style)
    _label(axes, ("x velocity, m/s", "y velocity, m/s", "height, m"), flight)
    return figure


@in_style
def poses(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw x and y from motion capture and from PX4's estimate, and the 3D distance of the two positions."""
    figure, axes = new_figure(look, 4.2, 3, 1, sharex=True)
    raw, estimated = flight.course.posed, flight.course.estimated
    for j in (0, 1):
        _plot(axes[j], flight, raw.time_s, raw.position[:, j], label="motion capture", **TRUE)
        _plot(axes[j], flight, estimated.time_s, estimated.position[:, j], label="estimated", **ESTIMATED)
    there = [np.interp(raw.time_s, estimated.time_s, axis) for axis in estimated.position.T]
    away_m = np.linalg.norm(raw.position - np.stack(there, axis=1), axis=1)
    _plot(axes[2], flight, raw.time_s, 1e3 * away_m, **{**TRUE, "linewidth": 1.0})
    axes[2].set_ylim(bottom=0.0)
    _label(axes, ("x, m", "y, m", "distance, mm"), flight)
    return figure


@in_style
def attitude(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw roll, pitch and yaw, estimated and true, degrees."""
    figure, axes = new_figure(look, 4.2, 3, 1, sharex=True)
    for track, style, label in (
        (angles(flight.course, true=True), TRUE, "true"),
        (angles(flight.course), ESTIMATED, "estimated"),
    ):
        for axis, values in zip(axes, (track.roll, track.pitch, track.yaw), strict=True):
            if track.time_s.size:
                _plot(axis, flight, track.time_s, np.degrees(values), label=label, **style)
    _label(axes, ("roll, °", "pitch, °", "yaw, °"), flight)
    return figure


@in_style
def tracking_error(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw the differences in position and velocity between the estimate and the active setpoint."""
    figure, axes = new_figure(look, 2.9, 2, 1, sharex=True)
    times, *errors = tracking(flight.course)
    for axis, values, name in zip(axes, errors, ("position, m", "velocity, m/s"), strict=True):
        _plot(axis, flight, times, values, **ESTIMATED)
        axis.set_ylabel(name)
        axis.set_ylim(bottom=0.0)
        mark_impacts(axis, flight)
    _over_time(axes[1], flight)
    return figure


@in_style
def thrust_and_battery(flight: RecordedFlight, *, look: Look = PAGE) -> Any:
    """Draw the total thrust from the core's model, the lowest and highest motor command, and the battery."""
    figure, axes = new_figure(look, 4.0, 3, 1, sharex=True)
    p = power(flight.course, flight.mission)
    _plot(axes[0], flight, p.time_s, p.thrust_n, **ESTIMATED)
    axes[0].set_ylabel("thrust, N")
    _plot(axes[1], flight, p.motor_time_s, 100.0 * p.highest, label="highest", **{**TRUE, "linewidth": 1.0})
    _plot(
        axes[1], flight, p.motor_time_s, 100.0 * p.lowest, label="lowest", **{**ESTIMATED, "linewidth": 1.0}
    )
    axes[1].set_ylabel("motors, %")
    axes[1].set_ylim(0.0, 100.0)
    legend_above(axes[1])
    if p.battery_time_s.size:
        axes[2].step(p.battery_time_s, p.battery_v, where="post", color="#000000", linewidth=1.2)
        low, high = float(p.battery_v.min()), float(p.battery_v.max())
        axes[2].set_ylim(low - 0.3, high + 0.3)
    else:
        axes[2].annotate("not reported", (0.5, 0.5), xycoords="axes fraction", ha="center", color=GREY)
    axes[2].set_ylabel("battery, V")
    for axis in axes:
        mark_impacts(axis, flight)
    _over_time(axes[2], flight)
    return figure
