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
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.figure_style import ESTIMATED, GREY, PAGE, PREDICTED, in_style, legend_above, new_figure
from dart_flight.lab.report.render import Number, PageTable, Row, picture, render
from dart_flight.lab.series.evidence import Evidence, SeriesHit
from dart_flight.lab.series.series_file import SeriesSettings
from dart_flight.lab.series.status import ModeStatus, SeriesStatus, describe, predict_hit


def series_page(
    settings: SeriesSettings, mission: Mission, evidence: Evidence, status: SeriesStatus, folder: Path
) -> str:
    """Return the page as HTML; links to logs are relative to `folder`, where the page will be."""
    logs = {flight.name: os.path.relpath(flight.path, folder) for flight in evidence.flights}
    return render(
        "series.html",
        f"Series on {status.wall} ({status.material})",
        flown=_flown(mission, evidence),
        missing=describe(status),
        changes=status.changes,
        problems=[(flight, ended) for flight, ended in status.flights.items() if ended != "completed"],
        modes=[_mode(mode, status.modes[mode.value], mission, evidence) for mode in settings.modes],
        hits=PageTable(
            ("hit", "mode", "normal m/s", "along m/s", "peak N", "out m/s", "k N/m", "use"),
            [_row(hit, logs) for hit in evidence.hits],
        ),
    )


def _flown(mission: Mission, evidence: Evidence) -> str:
    """Return what was flown, with what and when, in one sentence."""
    source = mission.flown_vehicle()
    which = Path(source.source).name if source.source else "of the logs"
    days = sorted(
        {flight.began.date().isoformat() for flight in evidence.flights if flight.began is not None}
    )
    when = f" from {days[0]} to {days[-1]}" if len(days) > 1 else f" on {days[0]}" if days else ""
    number = len(evidence.flights)
    return f"{number} flight{'s' * (number != 1)}{when} with the vehicle {which}, {source.mass_kg:g} kg"


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
        [p.hit, -p.normal_m_s, p.peak_measured_n, p.peak_n, p.out_measured_m_s, p.out_m_s, p.out_constant_m_s]
        for p in one.held_out.hits
    ]
    hits = [hit for hit in evidence.hits if hit.mode is mode and hit.measured is not None and not hit.aside]
    drawn = [picture(_figure(one, mission, hits))] if hits else []
    heads = ("", "value", "low", "high", "statistical ±", "aim ±", "from the prior")
    of_held = (
        "hit",
        "in m/s",
        "peak N",
        "predicted N",
        "out m/s",
        "predicted m/s",
        "by a constant restitution m/s",
    )
    return {
        "name": mode.value,
        "flown": one.flown,
        "used": one.used,
        "coefficients": PageTable(heads, coefficients),
        "held_out": PageTable(of_held, held),
        "errors": one.held_out,
        "figures": [
            (one, f"{mode.value}: the law (line) and the hits; below, measured minus predicted")
            for one in drawn
        ],
    }


def _percent(share: float) -> Number:
    return Number(f"{100.0 * share:.1f} %")


def _row(hit: SeriesHit, logs: dict[str, str]) -> Row:
    m, body = hit.measured, hit.body
    measured = hit.verdict.measured
    return [
        {"command": hit.name, "log": logs[hit.flight]},
        hit.mode.value,
        measured.normal_m_s,
        measured.tangential_m_s if m is None else m.tangential_in_m_s,
        measured.peak_force_n,
        measured.normal_out_m_s,
        None if body is None else body.belief.k,
        f"set aside: {hit.aside}" if hit.aside else "held out" if hit.held_out else "used",
    ]


@in_style
def _figure(one: ModeStatus, mission: Mission, hits: list[SeriesHit]) -> Any:
    """Plot peak force and outgoing speed over the incoming speed, and their residuals.

    The line is the law alone. The residuals include the measured thrust of each contact.
    """
    figure, axes = new_figure(PAGE, 4.2, 2, 2, sharex=True)
    fitted = Coefficients(**{name: c.statistical.value for name, c in one.coefficients.items()})
    vehicle = mission.vehicle
    line = np.linspace(0.05, 1.1 * max(_speed(hit) for hit in hits), 60)
    law = contact_map(
        CoefficientArrays.from_table(fitted),
        vehicle.airframe.mass_kg,
        -line,
        np.zeros_like(line),
        Onset(vehicle.onset),
    )
    rows = [
        (hit.held_out, _speed(hit), found, (hit.measured.peak_force_n, hit.verdict.measured.normal_out_m_s))
        for hit in hits
        if hit.measured is not None and (found := predict_hit(hit, fitted, mission)) is not None
    ]
    curves = (law.peak_normal_force_n, "peak force", "N"), (law.normal_out_m_s, "outgoing speed", "m/s")
    for column, (curve, words, unit) in enumerate(curves):
        top, bottom = axes[0][column], axes[1][column]
        top.plot(line, curve, **PREDICTED, label="law")
        bottom.axhline(0.0, color=GREY, linewidth=0.8)
        for held, name, marker in ((False, "used", "o"), (True, "held out", "s")):
            shown = [
                (speed, value, value - predicted[column])
                for held_out, speed, predicted, measured in rows
                if held_out is held and (value := measured[column]) is not None
            ]
            speeds, values, off = np.array(shown, dtype=float).reshape(-1, 3).T
            fill = {"markerfacecolor": "none"} if held else {}
            style = {"color": ESTIMATED["color"], "markersize": 4, **fill}
            top.plot(speeds, values, marker, label=name, **style)
            bottom.plot(speeds, off, marker, **style)
        top.set(ylabel=f"{words}, {unit}")
        bottom.set(xlabel="incoming, m/s", ylabel=f"off, {unit}")
    legend_above(axes[0][0], 3)
    return figure


def _speed(hit: SeriesHit) -> float:
    return -(hit.verdict.measured.normal_m_s or 0.0)
