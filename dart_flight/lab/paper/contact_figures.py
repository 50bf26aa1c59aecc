"""Plots of contacts. Needs matplotlib, the `report` extra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.lab.figure_panels import BLUE, GREEN, ORANGE, panels, save, shade
from dart_flight.lab.paper.tables import PublishedDrop
from dart_flight.lab.predict.path import Contact, Trajectory, trajectory
from dart_flight.lab.predict.prediction import Condition

_SETTLED_S = 0.5  # how much is drawn of a contact that never ends


def _title(what: Condition, text: str) -> str:
    turned = f", incidence {what.incidence_deg:g}°" if what.incidence_deg else ""
    return f"{what.surface.capitalize()}, {what.mode.value}{turned}, onset {what.onset.value}: {text}"


def _forces(axis: Any, t_ms: Any, path: Trajectory, drawn: Sequence[str]) -> None:
    styles = {"normal": (BLUE, "-"), "friction": (ORANGE, "-"), "vertical": (GREEN, "--")}
    values = {
        "normal": path.normal_force_n,
        "friction": path.tangential_force_n,
        "vertical": path.vertical_force_n,
    }
    for name in drawn:
        colour, line = styles[name]
        axis.plot(t_ms, values[name], line, color=colour, label=name)
    axis.set_ylabel("force, N")
    axis.set_xlabel("time, ms")


def plot_wall(path: str | Path, what: Condition, contact: Contact, tangential_m_s: float) -> None:
    """Position, velocity and force of a wall hit over time, written to `path`.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    figure, (position, velocity, force) = panels(3)
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    t = np.linspace(-0.25 * span, 1.35 * span, 1601)
    way = trajectory(contact, t, tangential_m_s, what.vertical_sign)
    ms = 1e3 * t
    shade((position, velocity, force), 0.0, 1e3 * span)
    position.plot(ms, 1e3 * way.normal_m, color=BLUE, label="normal, from the plane of first touch")
    position.plot(ms, 1e3 * way.tangential_m, color=ORANGE, label="along the wall, from the onset")
    position.set_ylabel("position, mm")
    velocity.plot(ms, way.normal_m_s, color=BLUE, label="normal")
    velocity.plot(ms, way.tangential_m_s, color=ORANGE, label="along the wall")
    velocity.set_ylabel("velocity, m/s")
    _forces(force, ms, way, ("normal", "friction", "vertical"))
    for axis in (position, velocity, force):
        axis.legend(loc="best", fontsize=8, frameon=False)
    position.set_title(
        _title(what, f"{contact.normal_m_s:g} m/s normal, {tangential_m_s:g} m/s along"), fontsize=10
    )
    force.set_xlim(ms[0], ms[-1])
    figure.align_ylabels()
    save(figure, path)


def plot_drop(
    path: str | Path, what: Condition, contact: Contact, height_m: float, published: PublishedDrop | None
) -> None:
    """Height, velocity and force of a drop over time from the release, written to `path`.

    The paper's contact time and rebound speed are drawn where it has this drop.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    figure, (position, velocity, force) = panels(3)
    fallen = -contact.normal_m_s / -contact.acceleration_m_s2
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    rise = float(contact.normal(span)[1]) / -contact.acceleration_m_s2
    t = np.linspace(-fallen, span + max(rise, 0.0), 2001)
    way = trajectory(contact, t)
    ms = 1e3 * (t + fallen)
    begin, end = 1e3 * fallen, 1e3 * (fallen + span)
    shade((position, velocity, force), begin, end)
    position.plot(ms, 1e3 * way.normal_m, color=BLUE, label="centre above its plane of first touch")
    position.set_ylabel("height, mm")
    velocity.plot(ms, way.normal_m_s, color=BLUE, label="model")
    velocity.set_ylabel("velocity, m/s")
    _forces(force, ms, way, ("normal",))
    if published is not None:
        velocity.plot(
            1e3 * (fallen + contact.turn_s),
            published.max_rebound_speed_m_s,
            "o",
            color=ORANGE,
            label=f"paper: largest rebound {published.max_rebound_speed_m_s:.2f} m/s",
        )
        level = 0.5 * float(way.normal_force_n.max())
        last = begin + 1e3 * published.contact_time_s
        force.errorbar(
            0.5 * (begin + last),
            level,
            xerr=0.5 * (last - begin),
            color=ORANGE,
            capsize=4,
            label=f"paper: contact {1e3 * published.contact_time_s:.0f} ms",
        )
    for axis in (position, velocity, force):
        axis.legend(loc="best", fontsize=8, frameon=False)
    position.set_title(_title(what, f"drop from {height_m:g} m"), fontsize=10)
    force.set_xlim(0.0, ms[-1])
    figure.align_ylabels()
    save(figure, path)
