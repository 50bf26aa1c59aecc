"""Plots of contacts and of fits. Needs matplotlib, the `report` extra; nothing else here imports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.law import Onset
from dart_flight.contact.path import Contact, Trajectory, trajectory
from dart_flight.contact.prediction import Condition
from dart_flight.identify.estimates import Identification
from dart_flight.identify.trials import Trial
from dart_flight.report.paper import PublishedDrop

# Okabe and Ito's colours: told apart by everyone, also in grey.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
_SETTLED_S = 0.5  # how much is drawn of a contact that never ends


def _figure(rows: int, width_in: float = 7.2, row_in: float = 2.1) -> tuple[Any, Any]:
    """A figure of panels above each other that share the time axis, without any window system.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        raise InputError("needs matplotlib: pip install dart-flight[report]", key=("plot",)) from None
    figure = Figure(figsize=(width_in, row_in * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axis in axes:
        axis.grid(visible=True, color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
    return figure, axes


def _save(figure: Any, path: str | Path) -> None:
    """Write the figure in the format of its suffix.

    Raises:
        InputError: the format is unknown or the file cannot be written.
    """
    try:
        figure.savefig(path, dpi=150)
    except ValueError as error:
        raise InputError(str(error), source=str(path)) from None
    except OSError as error:
        raise InputError(f"cannot write: {error.strerror or error}", source=str(path)) from None


def _shade(axes: Sequence[Any], begin_ms: float, end_ms: float) -> None:
    for axis in axes:
        axis.axvspan(begin_ms, end_ms, color=BLUE, alpha=0.07, linewidth=0)


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
    figure, (position, velocity, force) = _figure(3)
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    t = np.linspace(-0.25 * span, 1.35 * span, 1601)
    way = trajectory(contact, t, tangential_m_s, what.vertical_sign)
    ms = 1e3 * t
    _shade((position, velocity, force), 0.0, 1e3 * span)
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
    _save(figure, path)


def plot_drop(
    path: str | Path, what: Condition, contact: Contact, height_m: float, published: PublishedDrop | None
) -> None:
    """Height, velocity and force of a drop over time from the release, written to `path`.

    The paper's contact time and rebound speed are drawn where it has this drop.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    figure, (position, velocity, force) = _figure(3)
    fallen = -contact.normal_m_s / -contact.acceleration_m_s2
    span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
    rise = float(contact.normal(span)[1]) / -contact.acceleration_m_s2
    t = np.linspace(-fallen, span + max(rise, 0.0), 2001)
    way = trajectory(contact, t)
    ms = 1e3 * (t + fallen)
    begin, end = 1e3 * fallen, 1e3 * (fallen + span)
    _shade((position, velocity, force), begin, end)
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
    _save(figure, path)


def plot_fit(
    path: str | Path, trials: Sequence[Trial], found: Identification, mass_kg: float, onset: Onset
) -> None:
    """Recorded positions and the fit, one panel per trial (up to six), written to `path`.

    Raises:
        InputError: matplotlib is missing, or the file cannot be written.
    """
    fitted = zip(trials, found.trials, strict=True)
    shown = [(trial, fit) for trial, fit in fitted if fit.used == "samples" and found.is_known(fit.mode)][:6]
    if not shown or found.plane_m is None:
        raise InputError("no trial shows its contact in samples, nothing to plot", key=("plot",))
    figure, axes = _figure(len(shown))
    for axis, (trial, fit) in zip(axes, shown, strict=True):
        c = found.fitted(fit.mode, Coefficients(k=1.0, f=0.0, mu=0.0, nu=0.0))
        before, after = fit.push_m_s2
        push = trial.acceleration_m_s2 + before
        contact = Contact(c, mass_kg, fit.normal_m_s, onset, acceleration_m_s2=push)
        span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
        t = np.linspace(-0.15, span + 0.15, 1200)
        time, value = trial.normal
        near = (time - fit.onset_s >= t[0]) & (time - fit.onset_s <= t[-1])
        t = t[(t >= time[near][0] - fit.onset_s) & (t <= time[near][-1] - fit.onset_s)]
        if trial.acceleration_m_s2 < 0.0:  # before its release a drop does not fall
            t = t[t >= fit.normal_m_s / -trial.acceleration_m_s2]
        _shade((axis,), 0.0, 1e3 * span)
        axis.plot(
            1e3 * (time[near] - fit.onset_s),
            1e3 * value[near],
            ".",
            color=ORANGE,
            markersize=3,
            label="recorded",
        )
        late = np.maximum(t - contact.end_s, 0.0)
        x = contact.normal(t)[0] + 0.5 * (after - before) * late * late + found.plane_m.value
        axis.plot(1e3 * t, 1e3 * x, color=BLUE, linewidth=1.2, label="fit")
        axis.axhline(1e3 * found.plane_m.value, color=GREY, linestyle=":", label="plane, identified")
        axis.set_ylabel("normal, mm")
        axis.set_title(
            f"{Path(trial.name).name}: {fit.mode}, {fit.normal_m_s:.3f} m/s", fontsize=9, loc="left"
        )
    axes[0].legend(loc="best", fontsize=8, frameon=False)
    axes[-1].set_xlabel("time since the onset, ms")
    _save(figure, path)
