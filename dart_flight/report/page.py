"""The report as one self-contained HTML file: no script, no link to anything outside."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence
from importlib import resources
from statistics import fmean, stdev

import msgspec

from dart_flight.report import figures
from dart_flight.report.flight import Flight, Impact, percentile
from dart_flight.report.proposal import Proposal, propose

Cell = str | float | int | None


def flight_page(flight: Flight, *, identify: bool = False) -> str:
    """The page of one flight."""
    v = flight.verdict
    parts = [
        _verdict(flight),
        _section("Predicted against measured", _impact_table(flight)),
        _section(
            "Path and motion",
            _figures(
                (figures.flight_map([flight]), "From above, mission frame. Hatched: walls."),
                (figures.motion(flight), "Velocities and height. Vertical lines: impacts detected."),
            ),
        ),
    ]
    if flight.impacts:
        shown = (
            (
                figures.impact_forces(flight, impact),
                f"{impact.title}. Predicted: contact law at the measured velocity.",
            )
            for impact in flight.impacts
        )
        parts.append(_section("Force of each impact", _figures(*shown)))
    parts += [
        _section(
            "Lock and timing",
            _figures(
                (figures.timeline(flight), "Phases, contact, permission to lock, state of the lock."),
                (figures.timing(flight), "Regularity of set-points and delay of IMU samples."),
            )
            + _lock_table(flight)
            + _timing_table(flight),
        ),
        _section("Guard and decisions", _guard_table(flight) + _phase_table(flight)),
        _section("Contact coefficients", _proposals(propose([flight], identify))),
        _parameters(flight),
    ]
    return _page(f"{v.mission}, {v.world}: {v.outcome}", parts)


def comparison_page(flights: Sequence[Flight], *, identify: bool = False) -> str:
    """The page of several flights of one mission."""
    done = sum(f.verdict.outcome == "completed" for f in flights)
    title = f"{flights[0].verdict.mission}: {done} of {len(flights)} completed"
    indices = sorted({i.verdict.index for f in flights for i in f.impacts})
    force_figures = [
        (figures.impact_forces_over_trials(flights, index), f"Collision {index}, every trial.")
        for index in indices
    ]
    parts = [
        _section("Flights", _flights_table(flights)),
        _section("Over all trials", _statistics(flights, indices)),
        _section(
            "Paths and forces",
            _figures(
                (figures.flight_map(flights), "All paths from above, mission frame."),
                (figures.errors_over_trials(flights), "Errors of the peak force."),
                *force_figures,
            ),
        ),
        _section("Contact coefficients", _proposals(propose(flights, identify))),
        _parameters(flights[0]),
    ]
    return _page(title, parts)


# --- parts ---------------------------------------------------------------------------------------------


def _verdict(flight: Flight) -> str:
    v, about, replayed = flight.verdict, flight.log.about, flight.replay
    facts = [
        ("outcome", v.outcome + (f": {v.reason}" if v.reason else "")),
        ("world", v.world + (f", seed {v.seed}" if v.seed is not None else "")),
        ("started", about.get("started_utc", "?")),
        ("software", f"dart-flight {about.get('software', '?')} on {about.get('host', '?')}"),
        ("log", flight.log.source + ("" if flight.log.complete else " (cut short)")),
        ("PX4's own log", v.px4_log or "not beside the log"),
        ("records lost", flight.log.end.get("lost", "unknown: the log was cut")),
        (
            "replayed",
            (
                f"all {replayed.outputs} outputs equal"
                if replayed.equal
                else f"{len(replayed.differences)} of {replayed.outputs} outputs differ"
            )
            + (f"; {replayed.note}" if replayed.note else ""),
        ),
    ]
    figures_ = [
        ("goal missed by", v.goal_miss_m, "m", 2),
        ("final error", v.final_error_m, "m", 3),
        ("largest tilt", v.max_tilt_deg, "°", 1),
        ("flight time", v.flight_time_s, "s", 1),
        ("EKF error", v.ekf_error_m, "m", 3),
    ]
    tiles = "".join(
        f"<div class=tile><b>{value:.{digits}f} {unit}</b><span>{name}</span></div>"
        for name, value, unit, digits in figures_
        if value is not None
    )
    listed = "".join(f"<dt>{k}</dt><dd>{html.escape(t)}</dd>" for k, t in facts)
    return f"<section><div class=tiles>{tiles}</div><dl>{listed}</dl></section>"


def _impact_table(flight: Flight) -> str:
    rows: list[list[Cell]] = []
    for impact in flight.impacts:
        v = impact.verdict
        truth = v.truth
        for name, unit, planned, predicted, measured, true in (
            (
                "normal velocity",
                "m/s",
                v.planned.normal_m_s,
                None,
                v.measured.normal_m_s,
                truth.normal_m_s if truth else None,
            ),
            (
                "tangential velocity",
                "m/s",
                v.planned.tangential_m_s,
                None,
                v.measured.tangential_m_s,
                truth.tangential_m_s if truth else None,
            ),
            (
                "peak normal force",
                "N",
                v.planned.peak_force_n,
                impact.predicted_n,
                v.measured.peak_force_n,
                truth.peak_force_n if truth else None,
            ),
            ("contact time", "ms", None, _predicted_contact_ms(impact), v.contact_time_ms, None),
        ):
            reference = true if true is not None else (predicted if predicted is not None else planned)
            rows.append(
                [
                    f"{v.index} {v.wall}, {v.mode}",
                    f"{name}, {unit}",
                    planned,
                    predicted,
                    measured,
                    true,
                    _percent(measured, reference),
                ]
            )
    if not rows:
        return "<p>No planned wall was hit.</p>"
    heads = ["collision", "", "planned", "predicted", "measured", "true", "error %"]
    note = (
        "<p class=note>Planned: the mission. Predicted: the contact law at the measured velocity. Error: of "
        "the measured value, against the true one where there is one, else the predicted or planned.</p>"
    )
    return _table(heads, rows) + note


def _predicted_contact_ms(impact: Impact) -> float | None:
    if impact.prediction is None:
        return None
    in_contact = impact.prediction.time_s[impact.prediction.normal_force_n > 0.0]
    return float(1e3 * (in_contact[-1] - in_contact[0])) if in_contact.size else None


def _percent(value: float | None, reference: float | None) -> float | None:
    return 100.0 * (value / reference - 1.0) if value is not None and reference else None


def _lock_table(flight: Flight) -> str:
    rows: list[list[Cell]] = []
    for impact in flight.impacts:
        times = impact.verdict.lock
        end = times.contact_end_us
        if end is None:
            continue

        def after(t_us: int | None, end: int = end) -> float | None:
            return (t_us - end) * 1e-3 if t_us is not None else None

        rows.append(
            [impact.title, after(times.relaxed_us), after(times.commanded_us), after(times.settled_us)]
        )
    heads = ["after the contact's end, ms", "arms relaxed", "commanded", "settled"]
    return _table(heads, rows) if rows else ""


def _timing_table(flight: Flight) -> str:
    t = flight.timing
    rows: list[list[Cell]] = [
        [name, *(percentile(values, share) for share in (50, 99, 100))]
        for name, values in (
            ("set-point interval", t.setpoint_interval_ms),
            ("IMU delay over the least", t.imu_delay_ms),
            ("sample to recovery set-point", t.recovery_ms),
        )
    ]
    for impact in flight.impacts:
        rows.append(
            [f"{impact.title}: contact to detection", impact.verdict.detection_latency_ms, None, None]
        )
    return _table(["ms", "median", "99 %", "most"], rows)


def _guard_table(flight: Flight) -> str:
    if not flight.verdict.guard:
        return "<p>The guard did not interfere.</p>"
    rows: list[list[Cell]] = [
        [flight.course.time_of(g.t_us), g.rule, g.action, g.detail] for g in flight.verdict.guard
    ]
    return _table(["s", "rule", "action", "detail"], rows)


def _phase_table(flight: Flight) -> str:
    from dart_flight.samples import PhaseChange  # noqa: PLC0415

    rows: list[list[Cell]] = [
        [flight.course.time_of(c.t_us), c.before, c.after, c.reason] for c in flight.course.all(PhaseChange)
    ]
    return _details("Phases", _table(["s", "from", "to", "because"], rows))


def _proposals(proposals: list[Proposal]) -> str:
    if not proposals:
        return "<p>No impact to learn from.</p>"
    parts = []
    for p in proposals:
        parts.append(f"<h3>{html.escape(p.material)}</h3>")
        for mode, (mean, half) in p.disagreement.items():
            parts.append(
                f"<p>{mode}: measured peak force {100 * mean:+.1f} % of the predicted "
                f"(± {100 * half:.1f} %).</p>"
            )
        if p.note:
            parts.append(f"<p class=note>{html.escape(p.note[:1].upper() + p.note[1:])}.</p>")
        if p.suggestions:
            rows: list[list[Cell]] = [
                [
                    s.mode,
                    s.name,
                    s.configured,
                    *((None,) * 3 if s.identified is None else s.identified),
                    "change" if s.change else "keep",
                ]
                for s in p.suggestions
            ]
            heads = ["mode", "", "configured", "identified", "low", "high", ""]
            parts.append(_table(heads, rows))
        if p.entry:
            parts.append(f"<p>Proposed entry of the configuration:</p><pre>{html.escape(p.entry)}</pre>")
    return "".join(parts)


def _parameters(flight: Flight) -> str:
    about = flight.log.about
    vehicle = msgspec.json.format(about.get("vehicle", "{}"), indent=2)
    return _section(
        "Parameters used",
        _details(
            "Mission as written", f"<pre>{html.escape(about.get('mission_text', 'not in the log'))}</pre>"
        )
        + _details("Vehicle configuration as flown", f"<pre>{html.escape(vehicle)}</pre>"),
    )


# --- several flights -----------------------------------------------------------------------------------


def _flights_table(flights: Sequence[Flight]) -> str:
    rows: list[list[Cell]] = []
    for f in flights:
        v = f.verdict
        outcome = v.outcome + (f": {v.reason}" if v.reason else "")
        rows.append(
            [f.name, v.world, outcome, len(f.impacts), v.goal_miss_m, v.final_error_m, v.max_tilt_deg,
             "equal" if f.replay.equal else f"{len(f.replay.differences)} differ"]
        )  # fmt: skip
    heads = ["flight", "world", "outcome", "impacts", "goal miss m", "final error m", "tilt °", "replay"]
    return _table(heads, rows)


def _statistics(flights: Sequence[Flight], indices: list[int]) -> str:
    rows: list[list[Cell]] = [
        _spread("goal miss, m", (f.verdict.goal_miss_m for f in flights)),
        _spread("final error, m", (f.verdict.final_error_m for f in flights)),
        _spread("largest tilt, °", (f.verdict.max_tilt_deg for f in flights)),
    ]
    for index in indices:
        hits = [i for f in flights for i in f.impacts if i.verdict.index == index]
        name = f"{index} {hits[0].verdict.wall}, {hits[0].verdict.mode}: "
        rows += [
            _spread(name + "normal velocity, m/s", (i.verdict.measured.normal_m_s for i in hits)),
            _spread(name + "tangential velocity, m/s", (i.verdict.measured.tangential_m_s for i in hits)),
            _spread(name + "peak force measured, N", (i.verdict.measured.peak_force_n for i in hits)),
            _spread(name + "peak force predicted, N", (i.predicted_n for i in hits)),
            _spread(
                name + "peak force true, N",
                (i.verdict.truth.peak_force_n if i.verdict.truth else None for i in hits),
            ),
            _spread(name + "contact time, ms", (i.verdict.contact_time_ms for i in hits)),
            _spread(name + "detected after, ms", (i.verdict.detection_latency_ms for i in hits)),
        ]
    return _table(["", "n", "mean", "sd", "least", "most"], rows)


def _spread(name: str, values: Iterable[float | None]) -> list[Cell]:
    known = [v for v in values if v is not None]
    if not known:
        return [name, 0, None, None, None, None]
    sd = stdev(known) if len(known) > 1 else None
    return [name, len(known), fmean(known), sd, min(known), max(known)]


# --- HTML ----------------------------------------------------------------------------------------------


def _section(title: str, body: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{body}</section>"


def _details(title: str, body: str) -> str:
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>"


def _figures(*shown: tuple[str, str]) -> str:
    parts = []
    for svg, caption in shown:
        data = base64.b64encode(svg.encode()).decode()
        text = html.escape(caption)
        parts.append(
            f'<figure><img alt="{text}" src="data:image/svg+xml;base64,{data}">'
            f"<figcaption>{text}</figcaption></figure>"
        )
    return f"<div class=figures>{''.join(parts)}</div>"


def _table(heads: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    head = "".join(f"<th>{html.escape(h)}</th>" for h in heads)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _cell(value: Cell) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "<td class=n>–</td>"
    if isinstance(value, str):
        return f"<td>{html.escape(value)}</td>"
    if isinstance(value, int):
        return f"<td class=n>{value}</td>"
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 2 if abs(value) >= 1 else 3
    return f"<td class=n>{value:.{digits}f}</td>"


def _page(title: str, parts: Sequence[str]) -> str:
    style = resources.files("dart_flight.report").joinpath("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body>"
        f"<header><h1>{html.escape(title)}</h1></header><main>{''.join(parts)}</main></body></html>\n"
    )
