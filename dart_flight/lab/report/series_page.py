"""The page of a trial series: coefficients, fits, residuals, held-out hits, and one line for each hit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.mission import Mission
from dart_flight.config.units import COEFFICIENTS
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import WallContact, contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.figure_style import ESTIMATED, GREY, PAGE, PREDICTED, in_style, legend_above, new_figure
from dart_flight.lab.report.render import Number, PageTable, Row, picture, render
from dart_flight.lab.series.evidence import Evidence, SeriesHit
from dart_flight.lab.series.series_file import SeriesSettings
from dart_flight.lab.series.status import ModeStatus, SeriesStatus, describe


def series_page(
    settings: SeriesSettings, mission: Mission, evidence: Evidence, status: SeriesStatus, folder: Path
) -> str:
    """Return the page as HTML; links to logs are relative to `folder`, where the page will be."""
    logs = {flight.name: os.path.relpath(flight.path, folder) for flight in evidence.flights}
    return render(
        "series.html",
        f"Series on {status.wall} ({status.material})",
        missing=describe(status),
        changes=status.changes,
        problems=[(flight, ended) for flight, ended in status.flights.items() if ended != "completed"],
        modes=[_mode(mode, status.modes[mode.value], mission, evidence) for mode in settings.modes],
        hits=PageTable(
            ("hit", "mode", "normal m/s", "along m/s", "peak N", "out m/s", "k N/m", "use"),
            [_row(hit, logs) for hit in evidence.hits],
        ),
    )


def _mode(mode: Mode, one: ModeStatus, mission: Mission, evidence: Evidence) -> dict[str, Any]:
    coefficients: list[Row] = [
        [
            f"{name}, {COEFFICIENTS[name]}",
            *c.whole,
            _percent(0.5 * (c.statistical.high - c.statistical.low) / c.statistical.value),
            None if c.aim is None else _percent(c.aim),
            _percent(c.prior_share),
        ]
        for name, c in one.coefficients.items()
    ]
    held: list[Row] = [
        [p.hit, -p.normal_m_s, p.peak_n, p.peak_measured_n, p.out_m_s, p.out_constant_m_s, p.out_measured_m_s]
        for p in one.held_out.hits
    ]
    hits = [hit for hit in evidence.hits if hit.mode is mode and hit.measured is not None and not hit.aside]
    drawn = [picture(_figure(one, mission, hits))] if hits else []
    heads = ("", "value", "low", "high", "statistical ±", "aim ±", "from the prior")
    of_held = ("hit", "normal m/s", "peak N", "measured", "out m/s", "constant restitution", "measured")
    return {
        "name": mode.value,
        "flown": one.flown,
        "used": one.used,
        "coefficients": PageTable(heads, coefficients),
        "held_out": PageTable(of_held, held),
        "errors": one.held_out,
        "figures": [(one, f"{mode.value}: the law (line) and the hits") for one in drawn],
    }


def _percent(share: float) -> Number:
    return Number(f"{100.0 * share:.1f} %")


def _row(hit: SeriesHit, logs: dict[str, str]) -> Row:
    m, body = hit.measured, hit.body
    measured = hit.verdict.measured
    return [
        {"command": hit.name, "log": logs[hit.flight]},
        hit.mode.value,
        measured.normal_m_s if m is None else -m.normal_in_m_s,
        measured.tangential_m_s if m is None else m.tangential_in_m_s,
        measured.peak_force_n,
        None if m is None else m.normal_out_m_s,
        None if body is None else body.belief.k,
        f"set aside: {hit.aside}" if hit.aside else "held out" if hit.held_out else "used",
    ]


def _predict(one: ModeStatus, mission: Mission, speed: Array) -> WallContact[Array]:
    fitted = Coefficients(**{name: c.statistical.value for name, c in one.coefficients.items()})
    vehicle = mission.vehicle
    table, mass_kg = CoefficientArrays.from_table(fitted), vehicle.airframe.mass_kg
    return contact_map(table, mass_kg, -speed, np.zeros_like(speed), Onset(vehicle.onset))


@in_style
def _figure(one: ModeStatus, mission: Mission, hits: list[SeriesHit]) -> Any:
    """Plot peak force and outgoing speed over the incoming speed, and their residuals."""
    figure, axes = new_figure(PAGE, 4.2, 2, 2, sharex=True)
    fastest = max(hit.measured.normal_in_m_s for hit in hits if hit.measured is not None)
    line = np.linspace(0.05, 1.1 * fastest, 60)
    law = _predict(one, mission, line)
    quantities = (
        ("peak_normal_force_n", "peak_force_n", "peak force, N"),
        ("normal_out_m_s", "normal_out_m_s", "outgoing speed, m/s"),
    )
    for column, (predicted, measured, words) in enumerate(quantities):
        top, bottom = axes[0][column], axes[1][column]
        top.plot(line, getattr(law, predicted), **PREDICTED, label="law")
        bottom.axhline(0.0, color=GREY, linewidth=0.8)
        for held, name, marker in ((False, "used", "o"), (True, "held out", "s")):
            shown = [
                (hit.measured.normal_in_m_s, getattr(hit.measured, measured))
                for hit in hits
                if hit.held_out is held and hit.measured is not None
            ]
            points = np.array([p for p in shown if p[1] is not None]).reshape(-1, 2)
            fill = {"markerfacecolor": "none"} if held else {}
            style = {"color": ESTIMATED["color"], "markersize": 4, **fill}
            top.plot(*points.T, marker, label=name, **style)
            off = points[:, 1] - getattr(_predict(one, mission, points[:, 0]), predicted)
            bottom.plot(points[:, 0], off, marker, **style)
        top.set(ylabel=words)
        bottom.set(xlabel="incoming speed, m/s", ylabel="measured - law")
    legend_above(axes[0][0], 3)
    return figure
