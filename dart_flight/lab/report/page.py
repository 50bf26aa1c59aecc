"""The report as one self-contained HTML file: nothing is loaded from anywhere.

A page of one flight has a script, which plays the flight from numbers in the page; without scripts it lacks
the animation and nothing else.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Sequence
from statistics import fmean, stdev
from typing import Any

import msgspec

from dart_flight.base.records import (
    DetectionFloor,
    Outcome,
    PhaseChange,
    PlanAnswer,
    PlanRequest,
    PlanTaken,
    WallEstimate,
    World,
)
from dart_flight.config.document import InputError
from dart_flight.lab.holes import describe_missing_parts
from dart_flight.lab.report.figures import forces, motion
from dart_flight.lab.report.figures import lock_timeline as lock
from dart_flight.lab.report.figures.flight_map import flight_map
from dart_flight.lab.report.markup import (
    Cell,
    Number,
    Row,
    details,
    figure_block,
    page,
    section,
    signed,
    table,
)
from dart_flight.lab.report.player import animation_html, script
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight, percentile
from dart_flight.lab.statistics import mean_half_width
from dart_flight.recording.plan_versus_flight import format_departures
from dart_flight.recording.verdict import Verdict

# Peak forces that agree to this teach nothing: a fifth of k would be twice as much. One flight alone has no
# spread; its measured velocity, on which the prediction stands, is off by up to 4 %.
AGREES, _ALONE = 0.05, 0.1
_MAIN_ROWS = ("normal velocity", "peak normal force", "contact time")


def flight_page(flight: RecordedFlight) -> str:
    """The page of one flight: what became of it and where, then how, then everything."""
    v = flight.verdict
    animation = animation_html(flight)
    parts = [
        _verdict(flight),
        figure_block((flight_map([flight]), _map_words(flight)), wide=True),
        animation,
    ]
    if flight.mission.collisions:
        parts += [
            section("Predicted against measured", _impact_table(flight)),
            section("Plan versus flight", _plan_tables(flight)),
        ]
    if flight.impacts:
        pictures = (
            (
                forces.impact_forces(flight, impact),
                f"{impact.title}. Predicted: contact law at the measured velocity. Vertical: up.",
            )
            for impact in flight.impacts
        )
        parts.append(section("Force of each impact", figure_block(*pictures)))
    parts += [
        section(
            "Motion",
            figure_block(
                (motion.motion(flight), "Velocities and height. Vertical lines: impacts detected."),
                (motion.attitude(flight), "Attitude in the mission frame."),
                (
                    motion.tracking_error(flight),
                    "Distance from the active setpoint. After an impact it is large on purpose: "
                    "the recovery setpoint lies far away.",
                ),
                (
                    motion.thrust_and_battery(flight),
                    "Thrust by the calibrated curve, commands to the motors, battery.",
                ),
            ),
        ),
        section(
            "Lock and timing" if flight.mission.vehicle.has_lock else "Phases and timing",
            figure_block((lock.timeline(flight), _timeline_words(flight)))
            + _lock_table(flight)
            + details("Timing", _timing_table(flight)),
        ),
        section("Guard and decisions", _guard_table(flight) + _noise_table(flight) + _phase_table(flight)),
    ]
    if flight.mission.collisions:
        parts.append(section("Contact coefficients", _coefficients([flight])))
    parts.append(_parameters(flight))
    return page(f"{v.mission}, {_world(v)}: {v.outcome}", parts, script() if animation else "")


def _map_words(flight: RecordedFlight) -> str:
    words = ["From above, mission frame."]
    if flight.mission.walls:
        words.append(
            "Hatched: walls, from their surface back; dashed: where the vehicle's centre is at first touch."
        )
    if flight.mission.collisions:
        arms = ", arms heavy where the lock was rigid, thin where flexible"
        to_scale = f"the vehicle to scale{arms if flight.mission.vehicle.has_lock else ''}"
        words.append(f"At each hit, with its number and peak force: {to_scale}.")
    if flight.mission.recovers_to_goal:
        words.append("Planned: until the closest to the goal.")
    return " ".join(words)


def _timeline_words(flight: RecordedFlight) -> str:
    lock = ", permission to lock, state of the lock" if flight.mission.vehicle.has_lock else ""
    return f"Phases, contact{lock}."


def comparison_page(flights: Sequence[RecordedFlight]) -> str:
    """The page of several flights of one mission, in the order in which they began.

    Raises:
        InputError: they are of different missions.
    """
    flights = sorted(flights, key=lambda f: (f.log.about.get("started_utc", ""), f.log.seed or 0))
    _check_same_mission(flights)
    done = sum(f.verdict.outcome == "completed" for f in flights)
    worlds = ", ".join(dict.fromkeys(_world(f.verdict) for f in flights))
    title = f"{flights[0].verdict.mission}, {worlds}: {done} of {len(flights)} completed"
    indices = sorted({i.verdict.index for f in flights for i in f.impacts})
    force_figures = [
        (forces.impact_forces_over_trials(flights, index), f"Collision {index}, every trial.")
        for index in indices
    ]
    parts = [
        section("Flights", "".join(_missing_parts(f, f.name) for f in flights) + _flights_table(flights)),
        section(
            "Paths and forces",
            figure_block(
                (
                    flight_map(flights),
                    "All paths from above, mission frame. Planned: to the closest approach to the goal.",
                ),
                (forces.errors_over_trials(flights), "Errors of the peak force."),
                *force_figures,
            ),
        ),
        section("Over all trials", _statistics(flights, indices)),
        section("Contact coefficients", _coefficients(flights)),
        _parameters(flights[0], flights[1:]),
    ]
    return page(title, parts)


def _check_same_mission(flights: Sequence[RecordedFlight]) -> None:
    """Whatever the vehicle and the place of the mission's file, it must be the same."""
    first = flights[0]
    for other in flights[1:]:
        alike = msgspec.structs.replace(
            other.mission,
            source=first.mission.source,
            vehicle=first.mission.vehicle,
            vehicle_source=first.mission.vehicle_source,
        )
        if alike != first.mission:
            raise InputError(
                f"another mission ({other.verdict.mission}) than {first.log.source} "
                f"({first.verdict.mission}){_first_difference(first, other)}: a comparison needs flights of "
                "one mission",
                source=other.log.source,
            )


def _first_difference(first: RecordedFlight, other: RecordedFlight) -> str:
    """Return the first key that differs between two missions of one name, as text, or an empty string."""
    if first.verdict.mission != other.verdict.mission:
        return ""
    there, here = (dict(_leaves(flight.mission.to_dict())) for flight in (first, other))
    for key in there | here:
        if not key.startswith("vehicle") and there.get(key) != here.get(key):
            return f" of the same name, {key} is {here.get(key)} and not {there.get(key)}"
    return ""


def _leaves(tree: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from _leaves(value, f"{key}.{name}" if key else name)
    elif isinstance(tree, list | tuple):
        for i, value in enumerate(tree):
            yield from _leaves(value, f"{key}[{i}]")
    else:
        yield key, tree


# --- parts ---------------------------------------------------------------------------------------------


def _vehicle(v: Verdict) -> str:
    assert v.vehicle is not None
    packaged = ", the packaged configuration" if v.vehicle.packaged else ""
    return f"{v.vehicle.source or 'as the log says'}{packaged}, {v.vehicle.mass_kg:g} kg"


def _verdict(flight: RecordedFlight) -> str:
    v, about, replayed = flight.verdict, flight.log.about, flight.replay
    facts = [
        ("world", _world(v) + (f", seed {v.seed}" if v.seed is not None else "")),
        ("vehicle", _vehicle(v)),
        ("started", about.get("started_utc", "?")),
        ("software", f"dart-flight {about.get('software', '?')} on {about.get('host', '?')}"),
        ("log", flight.log.source + ("" if flight.log.complete else " (cut: not all of the flight is here)")),
        ("PX4's own log", v.px4_log or _where_px4_log(flight)),
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
    reason = f"<p class=reason>{html.escape(v.reason)}</p>" if v.reason else ""
    return (
        f"<section>{_missing_parts(flight)}<p class=sentence>{html.escape(outcome_sentence(flight))}</p>"
        f"{reason}{_hits_table(flight)}"
        f"<div class=tiles>{tiles}</div>{details('Source', f'<dl>{listed}</dl>')}</section>"
    )


def _missing_parts(flight: RecordedFlight, name: str = "The log") -> str:
    """Return the line at the top of the page on a log that was cut or has holes."""
    lines = "; ".join(describe_missing_parts(flight.log))
    if not lines:
        return ""
    return f"<p class=note>{html.escape(name)} does not hold the whole flight: {html.escape(lines)}.</p>"


def outcome_sentence(flight: RecordedFlight) -> str:
    """What became of a flight, in plain words."""
    v, planned, met = flight.verdict, len(flight.mission.collisions), len(flight.impacts)
    if flight.mission.standoff_m is not None:
        hits = "a rehearsal, which stops before each wall"
    elif planned == 0:
        hits = "no collision was planned"
    elif planned == 1:
        hits = f"the one planned collision was {'' if met else 'not '}flown"
    else:
        hits = f"{met if met < planned else 'all'} of {planned} planned collisions were flown"
    begin = {
        Outcome.COMPLETED: "The flight was completed",
        Outcome.ABORTED: "The flight was broken off",
        Outcome.RELEASED: "Control was released to the pilot in flight",
    }[v.outcome]
    words = f"{begin}; {hits}"
    if v.goal_miss_m is not None:
        words += f", and the goal was passed at {v.goal_miss_m:.2f} m"
    if v.plan_followed is None:
        return f"{words}."
    plan = "The plan was followed" if v.plan_followed else "The plan was not followed"
    where = format_departures(v.deviations, most=1) if v.outcome is Outcome.COMPLETED else ""
    return f"{words}. {plan}" + (f": {where}." if where else ".")


def _hits_table(flight: RecordedFlight) -> str:
    if not flight.mission.collisions:
        return ""
    if not flight.impacts:
        return "<p>No planned wall was hit.</p>"
    heads = ["hit", "at, s", "wall", "mode", "normal, m/s", "along, m/s", "peak, N", "error %"]
    return table(heads, [_hit_row(flight, impact) for impact in flight.impacts])


def _hit_row(flight: RecordedFlight, impact: Impact) -> Row:
    v = impact.verdict
    peak = next(c for c in impact.compared if c.name == "peak normal force")
    felt = f", felt {v.mode_felt}" if v.mode_felt not in (None, v.mode) else ""
    clipped = ", clipped" if v.clipped else ""
    return [
        v.index, impact.at_s, v.wall, f"{v.mode}{felt}{clipped}", v.measured.normal_m_s,
        v.measured.tangential_m_s, v.measured.peak_force_n, signed(peak.error_percent),
    ]  # fmt: skip


def _where_px4_log(flight: RecordedFlight) -> str:
    if flight.log.world in (World.FAST, World.EMBEDDED):
        return "none (not a PX4 flight)"
    armed = flight.armed_utc()
    return "not beside the log" + (f"; armed at {armed}" if armed else "")


def _impact_table(flight: RecordedFlight) -> str:
    if not flight.impacts:
        return "<p>No planned wall was hit.</p>"
    heads = ["", "planned", "predicted", "measured", "true", "error %"]
    note = (
        "<p class=note>Planned: the mission, and for later collisions the planner's flight model. Predicted: "
        "the contact law at the measured velocity. Measured: by the flight core; velocities by PX4's "
        "estimate, those out when the force was gone. True: the simulated vehicle. Error: of the measured "
        "value, against the true one where there is one, else the predicted or planned.</p>"
    )
    main = table(heads, list(_compared_rows(flight, _MAIN_ROWS)))
    return main + details("All rows", table(heads, list(_compared_rows(flight)))) + note


def _compared_rows(flight: RecordedFlight, names: Sequence[str] = ()) -> Iterable[Row]:
    """The rows of every collision, or those of some names."""
    for impact in flight.impacts:
        yield impact.title + (", clipped: lower bounds" if impact.verdict.clipped else "")
        for c in impact.compared:
            if not names or c.name in names:
                yield [
                    f"{c.name}, {c.unit}", c.planned, c.predicted, c.measured, c.true,
                    signed(c.error_percent),
                ]  # fmt: skip


def _plan_tables(flight: RecordedFlight) -> str:
    """Planned against flown, what contacts taught of the walls, and what was planned in flight."""
    v = flight.verdict
    if v.plan_followed is None:
        return "<p>Nothing was planned.</p>"
    rows: list[Row] = [
        [d.what, d.planned, d.flown, d.tolerance, "yes" if d.within else "no"] for d in v.deviations
    ]
    text = "<p>The plan was followed.</p>" if v.plan_followed else "<p>The plan was not followed.</p>"
    heads = ["", "planned", "flown", "tolerance", "within"]
    outside = [row for row, d in zip(rows, v.deviations, strict=True) if not d.within]
    text += (table(heads, outside) if outside else "") + details("All planned quantities", table(heads, rows))
    felt = flight.course.all(WallEstimate)
    if felt:
        text += "<h3>Wall estimates</h3>" + table(_FELT_HEADS, [_felt_row(flight, f) for f in felt])
    replanned = flight.replanned()
    if replanned:
        rows = [_replanned_row(flight, *one) for one in replanned]
        text += "<h3>Trajectories planned in flight</h3>" + table(
            ["at, s", "to", "planning time, ms", "impact, m/s", "along, m/s", "peak, N", "flown"], rows
        )
    return text


_FELT_HEADS = ["wall", "mode reported", "felt", "k, N/m", "before", "f, N s/m", "before", "mu, s/m", "before"]


def _felt_row(flight: RecordedFlight, felt: WallEstimate) -> Row:
    mode = felt.mode_felt or felt.mode_reported
    wall = next((w for w in flight.mission.walls if w.name == felt.wall), None)
    vehicle = flight.mission.vehicle
    if mode is None or wall is None:
        return [felt.wall, None, None, None, None, None, None, None, None]
    prior, spread = vehicle.materials[wall.material].of(mode), vehicle.estimation.walls.spread
    cells: list[Cell] = [felt.wall, felt.mode_reported, felt.mode_felt or "undecided"]
    for before, after, sd in (
        (prior.k, felt.k_n_per_m, felt.k_sd),
        (prior.f, felt.f_ns_per_m, felt.f_sd),
        (prior.mu, felt.mu_s_per_m, felt.mu_sd),
    ):
        told = ((after, sd), (before, spread))
        cells += [Number(f"{value:.4g} ± {100.0 * share:.0f} %") for value, share in told]
    return cells


def _replanned_row(
    flight: RecordedFlight, request: PlanRequest, answer: PlanAnswer | None, taken: PlanTaken | None
) -> Row:
    to = "the goal" if request.collision is None else f"collision {request.collision}"
    at = flight.course.time_of(request.t_us)
    if answer is None:
        return [at, to, None, None, None, None, "no answer"]
    after = flight.answered_ms(request, answer)
    flown = "?" if taken is None else "yes" if taken.taken else f"no: {taken.reason}"
    return [at, to, after, answer.normal_m_s, answer.tangential_m_s, answer.peak_force_n, flown]


def _lock_table(flight: RecordedFlight) -> str:
    rows: list[Row] = []
    for impact in flight.impacts:
        times = impact.verdict.lock
        end = None if times is None else times.contact_end_us
        if times is None or end is None:
            continue

        def after(t_us: int | None, end: int = end) -> float | None:
            return (t_us - end) * 1e-3 if t_us is not None else None

        rows.append(
            [impact.title, after(times.relaxed_us), after(times.commanded_us), after(times.settled_us)]
        )
    heads = ["after the contact's end, ms", "arms relaxed", "commanded", "settled"]
    return table(heads, rows) if rows else ""


def _timing_table(flight: RecordedFlight) -> str:
    t = flight.timing
    rows: list[Row] = [
        [name, *(percentile(values, share) for share in (50, 99, 100))]
        for name, values in (
            ("setpoint interval", t.setpoint_interval_ms),
            ("IMU delay above its minimum", t.imu_delay_ms),
            ("sample to recovery setpoint", t.recovery_ms),
        )
    ]
    for v in flight.verdict.collisions:
        rows.append([f"collision {v.index}: contact to detection", v.detection_latency_ms, None, None])
    note = "<p class=note>From detection to recovery the core sends no setpoint; PX4 holds the last one.</p>"
    if flight.log.world is World.FAST:
        note += "<p class=note>Simulated in one process: messages take no time.</p>"
    return table(["ms", "median", "99 %", "most"], rows) + note


def _guard_table(flight: RecordedFlight) -> str:
    if not flight.verdict.guard:
        return "<p>No guard rule fired.</p>"
    rows: list[Row] = [
        [flight.course.time_of(g.t_us), g.rule, g.action, g.detail] for g in flight.verdict.guard
    ]
    return table(["s", "rule", "action", "detail"], rows)


def _noise_table(flight: RecordedFlight) -> str:
    """What could be felt as each approach began; empty for flights from before that was recorded."""
    time_of = flight.course.time_of
    rows: list[Row] = [
        [time_of(f.t_us), f.threshold_n, f.noise_short_n, f.noise_long_n, f.rigid_n, f.flexible_n]
        for f in flight.course.all(DetectionFloor)
    ]
    noise = ["noise, short mean N", "long mean N"]
    heads = ["s", "threshold N", *noise, "detection limit rigid, N", "detection limit flexible, N"]
    return table(heads, rows) if rows else ""


def _phase_table(flight: RecordedFlight) -> str:
    rows: list[Row] = [
        [flight.course.time_of(c.t_us), c.before, c.after, c.reason] for c in flight.course.all(PhaseChange)
    ]
    return details("Phases", table(["s", "from", "to", "because"], rows))


def disagreements(flights: Sequence[RecordedFlight]) -> dict[str, dict[str, tuple[float, float]]]:
    """How far measured peak forces are off those that the contact law predicts at the measured velocity.

    Args:
        flights: of vehicles with the same materials.

    Returns:
        By material, then by mode and force (`rigid, normal`): mean of measured over predicted peak minus one,
        and its 95 % half width.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for impact in (impact for flight in flights for impact in flight.impacts):
        by_force = found.setdefault(impact.material, {})
        for force, value in (("normal", impact.disagreement), ("friction", impact.friction_disagreement)):
            if value is not None:
                by_force.setdefault(f"{impact.verdict.mode}, {force}", []).append(value)
    return {
        material: {force: _mean(values) for force, values in by_force.items()}
        for material, by_force in found.items()
    }


def _mean(values: Sequence[float]) -> tuple[float, float]:
    half = mean_half_width(values)
    return fmean(values), _ALONE if half is None else half


def beyond(disagreement: dict[str, tuple[float, float]]) -> bool:
    """Whether one of a material's peak forces is off by more than chance and measurement are."""
    return any(abs(mean) > max(half, AGREES) for mean, half in disagreement.values())


def _coefficients(flights: Sequence[RecordedFlight]) -> str:
    parts = []
    for material, disagreement in disagreements(flights).items():
        parts.append(f"<h3>{html.escape(material)}</h3>")
        for force, (mean, half) in disagreement.items():
            parts.append(
                f"<p>{force} force: the measured peak is {100 * mean:+.1f} % off the predicted one "
                f"(± {100 * half:.1f} %).</p>"
            )
        if beyond(disagreement):
            command = html.escape(f"dart-flight identify LOG... --surface {material} -o {material}.yaml")
            parts.append(
                "<p>Prediction and measurement disagree. What these flights say of the coefficients:</p>"
                f"<pre>{command}</pre>"
            )
        else:
            agree = "Prediction and measurement agree." if disagreement else "No peak force to compare."
            parts.append(f"<p class=note>{agree}</p>")
    return "".join(parts) or "<p>No impact to identify coefficients from.</p>"


def _parameters(flight: RecordedFlight, others: Sequence[RecordedFlight] = ()) -> str:
    about = flight.log.about
    different = [f.name for f in others if f.mission.vehicle != flight.mission.vehicle]
    note = (
        f"<p class=note>Of {html.escape(flight.name)}. Flown with another vehicle configuration: "
        f"{html.escape(', '.join(different))}.</p>"
        if different
        else ""
    )
    vehicle = msgspec.json.format(about.get("vehicle", "{}"), indent=2)
    return section(
        "Parameters used",
        note
        + details(
            "Mission as written", f"<pre>{html.escape(about.get('mission_text', 'not in the log'))}</pre>"
        )
        + details("Vehicle configuration as flown", f"<pre>{html.escape(vehicle)}</pre>"),
    )


# --- several flights -----------------------------------------------------------------------------------


def _flights_table(flights: Sequence[RecordedFlight]) -> str:
    rows: list[Row] = []
    for f in flights:
        v = f.verdict
        outcome = v.outcome + (f": {v.reason}" if v.reason else "")
        rows.append(
            [f.name, outcome, len(f.impacts), v.goal_miss_m, v.final_error_m, v.max_tilt_deg,
             "equal" if f.replay.equal else f"{len(f.replay.differences)} differ"]
        )  # fmt: skip
    heads = ["flight", "outcome", "impacts", "goal miss m", "final error m", "tilt °", "replay"]
    return table(heads, rows)


def _statistics(flights: Sequence[RecordedFlight], indices: list[int]) -> str:
    rows: list[Row] = [
        _spread("goal miss, m", (f.verdict.goal_miss_m for f in flights)),
        _spread("final error, m", (f.verdict.final_error_m for f in flights)),
        _spread("largest tilt, °", (f.verdict.max_tilt_deg for f in flights)),
    ]
    for index in indices:
        hits = [i for f in flights for i in f.impacts if i.verdict.index == index]
        rows.append(hits[0].title)
        for same in zip(*(i.compared for i in hits), strict=True):
            name, unit = same[0].name, same[0].unit
            rows.append(_spread(f"{name}, {unit}", (c.measured for c in same)))
            if any(c.predicted is not None for c in same):
                rows.append(_spread(f"{name}: predicted", (c.predicted for c in same)))
            if any(c.true is not None for c in same):
                rows.append(_spread(f"{name}: true", (c.true for c in same)))
        rows += [
            _spread("peak against predicted, %", (_percent(i.disagreement) for i in hits)),
            _spread("peak against true, %", (_percent(i.verdict.force_error) for i in hits)),
            _spread("detected after, ms", (i.verdict.detection_latency_ms for i in hits)),
        ]
    note = "<p class=note>± 95 %: half width of the interval of the mean, by Student's t.</p>"
    return table(["", "n", "mean", "± 95 %", "sd", "least", "most"], rows) + note


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _spread(name: str, values: Iterable[float | None]) -> list[Cell]:
    """Number, mean, half its 95 % interval, standard deviation, least and most of what is known."""
    known = [v for v in values if v is not None]
    if not known:
        return [name, 0, *(None,) * 5]
    sd = stdev(known) if len(known) > 1 else None
    half = mean_half_width(known)
    return [name, len(known), fmean(known), half, sd, min(known), max(known)]


def _world(verdict: Verdict) -> str:
    return verdict.world or "unknown"
