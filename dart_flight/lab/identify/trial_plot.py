"""A plot of recordings and their fit; requires matplotlib (extra `report`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Coefficients
from dart_flight.lab.figure_style import ESTIMATED, GREY, PAGE, TRUE, in_style, panels, save_figure, shade
from dart_flight.lab.identify.identify_trials import IdentifyResult
from dart_flight.lab.predict.path import ContactMotion

_SETTLED_S = 0.5  # plotted duration of a contact that never ends


@in_style
def plot_fit(path: str | Path, result: IdentifyResult) -> None:
    """Plot recorded positions and the fit into `path`, one panel for each of up to six trials."""
    found = result.found
    fitted = zip(result.trials, found.trials, strict=True)
    shown = [(trial, fit) for trial, fit in fitted if fit.used != "whole" and found.is_known(fit.mode)][:6]
    if not shown or found.plane_m is None:
        raise InputError(
            "no trial has enough samples during the contact: there is nothing to plot", key=("plot",)
        )
    figure, axes = panels(PAGE, len(shown))
    for axis, (trial, fit) in zip(axes, shown, strict=True):
        c = found.fitted(fit.mode, Coefficients(k=1.0, f=0.0, mu=0.0, nu=0.0))
        before, after = fit.push_m_s2
        push = trial.acceleration_m_s2 + before
        contact = ContactMotion(c, result.mass_kg, fit.normal_m_s, result.onset, acceleration_m_s2=push)
        span = contact.end_s if np.isfinite(contact.end_s) else _SETTLED_S
        t = np.linspace(-0.15, span + 0.15, 1200)
        time, value = trial.normal
        near = (time - fit.onset_s >= t[0]) & (time - fit.onset_s <= t[-1])
        t = t[(t >= time[near][0] - fit.onset_s) & (t <= time[near][-1] - fit.onset_s)]
        if trial.acceleration_m_s2 < 0.0:  # before its release, a dropped vehicle does not fall
            t = t[t >= fit.normal_m_s / -trial.acceleration_m_s2]
        shade(axis, 0.0, 1e3 * span)
        axis.plot(
            1e3 * (time[near] - fit.onset_s),
            1e3 * value[near],
            ".",
            color=TRUE["color"],
            markersize=3,
            label="recorded",
        )
        late = np.maximum(t - contact.end_s, 0.0)
        x = contact.normal(t)[0] + 0.5 * (after - before) * late * late + found.plane_m.value
        axis.plot(1e3 * t, 1e3 * x, label="fit", **ESTIMATED)
        axis.axhline(1e3 * found.plane_m.value, color=GREY, linestyle=":", label="plane, identified")
        axis.set_ylabel("normal, mm")
        axis.set_title(f"{Path(trial.name).name}: {fit.mode}, {fit.normal_m_s:.3f} m/s", loc="left")
    axes[0].legend(loc="best")
    axes[-1].set_xlabel("time since the onset, ms")
    save_figure(figure, Path(path))
