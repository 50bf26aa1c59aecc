"""Plots of contacts; requires matplotlib (extra `report`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.lab.figure_style import (
    FORCE,
    LINES,
    PAGE,
    in_style,
    legend_above,
    panels,
    save_figure,
    shade,
)
from dart_flight.lab.paper.tables import PublishedDrop
from dart_flight.lab.predict.path import ContactMotion, trajectory
from dart_flight.lab.predict.prediction import Condition

_SETTLED_S = 0.5  # plotted duration of a contact that never ends
_NORMAL, _ALONG, _VERTICAL = LINES


def _title(condition: Condition, text: str) -> str:
    surface, mode, onset = condition.surface.capitalize(), condition.mode.value, condition.onset.value
    turned = f", incidence {condition.incidence_deg:g}°" if condition.incidence_deg else ""
    return f"{surface}, {mode}{turned}, onset {onset}: {text}"


def _finish(figure: Any, axes: Sequence[Any], contact_ms: tuple[float, float], path: str | Path) -> None:
    axes[-1].set(xlabel="time, ms", ylabel="force, N")
    for axis in axes:
        shade(axis, *contact_ms)
        legend_above(axis)
    figure.align_ylabels()
    save_figure(figure, Path(path))


@in_style
def plot_wall(path: str | Path, condition: Condition, contact: ContactMotion, tangential_m_s: float) -> None:
    figure, (position, velocity, force) = panels(PAGE, 3)
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    t = np.linspace(-0.25 * span, 1.35 * span, 1601)
    history = trajectory(contact, t, tangential_m_s, condition.vertical_sign)
    ms = 1e3 * t
    position.plot(ms, 1e3 * history.normal_m, label="from the plane of first touch", **_NORMAL)
    position.plot(ms, 1e3 * history.tangential_m, label="along the wall", **_ALONG)
    position.set_ylabel("position, mm")
    velocity.plot(ms, history.normal_m_s, label="normal", **_NORMAL)
    velocity.plot(ms, history.tangential_m_s, label="along the wall", **_ALONG)
    velocity.set_ylabel("velocity, m/s")
    force.plot(ms, history.normal_force_n, label="normal", **_NORMAL)
    force.plot(ms, history.tangential_force_n, label="friction", **_ALONG)
    force.plot(ms, history.vertical_force_n, label="vertical", **_VERTICAL)
    figure.suptitle(
        _title(condition, f"{contact.normal_m_s:g} m/s normal, {tangential_m_s:g} m/s tangential")
    )
    force.set_xlim(ms[0], ms[-1])
    _finish(figure, (position, velocity, force), (0.0, 1e3 * span), path)


@in_style
def plot_drop(
    path: str | Path,
    condition: Condition,
    contact: ContactMotion,
    height_m: float,
    published: PublishedDrop | None,
) -> None:
    """Plot height, velocity and force of a drop over time, from the release on, and write the plot to `path`.

    The plot includes the paper's contact time and rebound speed if the paper published this drop.
    """
    figure, (position, velocity, force) = panels(PAGE, 3)
    fallen = -contact.normal_m_s / -contact.acceleration_m_s2
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    rise = float(contact.normal(span)[1]) / -contact.acceleration_m_s2
    t = np.linspace(-fallen, span + max(rise, 0.0), 2001)
    history = trajectory(contact, t)
    ms = 1e3 * (t + fallen)
    begin, end = 1e3 * fallen, 1e3 * (fallen + span)
    position.plot(ms, 1e3 * history.normal_m, label="centre above its plane of first touch", **_NORMAL)
    position.set_ylabel("height, mm")
    velocity.plot(ms, history.normal_m_s, label="model", **_NORMAL)
    velocity.set_ylabel("velocity, m/s")
    force.plot(ms, history.normal_force_n, label="normal", **_NORMAL)
    if published is not None:
        velocity.plot(
            1e3 * (fallen + contact.turn_s),
            published.max_rebound_speed_m_s,
            "o",
            color=FORCE,
            label=f"paper: largest rebound {published.max_rebound_speed_m_s:.2f} m/s",
        )
        level = 0.5 * float(history.normal_force_n.max())
        last = begin + 1e3 * published.contact_time_s
        force.errorbar(
            0.5 * (begin + last),
            level,
            xerr=0.5 * (last - begin),
            color=FORCE,
            capsize=4,
            label=f"paper: contact {1e3 * published.contact_time_s:.0f} ms",
        )
    figure.suptitle(_title(condition, f"drop from {height_m:g} m"))
    force.set_xlim(0.0, ms[-1])
    _finish(figure, (position, velocity, force), (begin, end), path)
