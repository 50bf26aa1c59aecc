"""The values that the templates print on the page of one flight or of several flights of one mission.

The page of one flight contains a script that animates the flight. If the browser runs no scripts, only the
animation is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
from dart_flight.base.summary import spread
from dart_flight.config.document import InputError, dotted, iterate_leaves
from dart_flight.lab.holes import describe_missing_parts
from dart_flight.lab.report.figures import forces, motion
from dart_flight.lab.report.figures import lock_timeline as lock
from dart_flight.lab.report.figures.flight_map import flight_map
from dart_flight.lab.report.player import player_data
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight, percentile
from dart_flight.lab.report.render import Cell, Number, PageTable, Row, asset, picture, render, signed
from dart_flight.recording.later_flights import contradicts, mean_excess
from dart_flight.recording.plan_versus_flight import format_departures
from dart_flight.recording.verdict import Verdict

_MAIN_ROWS = ("normal velocity", "peak force", "peak normal force", "peak friction force", "contact time")
_PLAN_HEADS = ["", "planned", "flown", "tolerance", "within"]


def flight_page(flight: RecordedFlight) -> str:
    """Return the page of one flight: outcome and map, then the course of the flight, then all details."""
    v, mission, course = flight.verdict, flight.mission, flight.course
    animation = player_data(flight)
    planned: list[Row] = [
        [d.what, d.planned, d.flown, d.tolerance, "yes" if d.within else "no"] for d in v.deviations
    ]
    return render(
        "flight.html",
        f"{v.mission}, {_world(v)}: {v.outcome}",
        script=asset("player.js") if animation else "",
        has={
            "walls": bool(mission.walls),
            "collisions": bool(mission.collisions),
            "lock": mission.vehicle.has_lock,
            "recovery": mission.recovers_to_goal,
            "no_messages": flight.log.world is World.FAST,
        },
        missing=_missing_parts([(flight, "The log")]),
        sentence=outcome_sentence(flight),
        reason=v.reason,
        hits=_hits_table(flight),
        shown=_tiles(v),
        facts=_facts(flight),
        map=picture(flight_map([flight])),
        animation=animation,
        compared=_compared_table(flight, _MAIN_ROWS),
        compared_all=_compared_table(flight),
        plan_followed=v.plan_followed,
        outside=PageTable(_PLAN_HEADS, [row for row in planned if row[-1] == "no"]),
        planned=PageTable(_PLAN_HEADS, planned),
        felt=PageTable(
            _WALL_ESTIMATE_HEADS,
            [_wall_estimate_row(flight, estimate) for estimate in course.all(WallEstimate)],
        ),
        replanned=PageTable(_REPLANNED_HEADS, [_replanned_row(flight, *plan) for plan in flight.replanned()]),
        impacts=[(hit.title, picture(forces.impact_forces(flight, hit))) for hit in flight.impacts],
        motion=picture(motion.motion(flight)),
        poses=picture(motion.poses(flight))
        if course.posed.time_s.size and course.estimated.time_s.size
        else "",
        attitude=picture(motion.attitude(flight)),
        tracking=picture(motion.tracking_error(flight)),
        thrust=picture(motion.thrust_and_battery(flight)),
        timeline=picture(lock.timeline(flight)),
        lock=_lock_table(flight),
        timing=_timing_table(flight),
        guard=PageTable(
            ["s", "rule", "action", "detail"],
            [[course.time_of(g.t_us), g.rule, g.action, g.detail] for g in v.guard],
        ),
        noise=_noise_table(flight),
        phases=PageTable(
            ["s", "from", "to", "reason"],
            [[course.time_of(c.t_us), c.before, c.after, c.reason] for c in course.all(PhaseChange)],
        ),
        materials=_coefficients([flight]),
        used=_parameters(flight),
    )


def comparison_page(flights: Sequence[RecordedFlight]) -> str:
    """Return the page of several flights of one mission, ordered by their start."""
    flights = sorted(flights, key=lambda f: (f.log.about.get("started_utc", ""), f.log.seed or 0))
    _check_same_mission(flights)
    done = sum(f.verdict.outcome == "completed" for f in flights)
    worlds = ", ".join(dict.fromkeys(_world(f.verdict) for f in flights))
    indices = sorted({i.verdict.index for f in flights for i in f.impacts})
    return render(
        "comparison.html",
        f"{flights[0].verdict.mission}, {worlds}: {done} of {len(flights)} completed",
        missing=_missing_parts([(flight, flight.name) for flight in flights]),
        flights=_flights_table(flights),
        map=picture(flight_map(flights)),
        errors=picture(forces.errors_over_trials(flights)),
        forces=[(i, picture(forces.impact_forces_over_trials(flights, i))) for i in indices],
        statistics=_statistics(flights, indices),
        materials=_coefficients(flights),
        used=_parameters(flights[0], flights[1:]),
    )


def _check_same_mission(flights: Sequence[RecordedFlight]) -> None:
    """Reject flights of different missions; vehicles and file names may differ."""
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
                f"this flight flew the mission {other.verdict.mission}, but {first.log.source} flew "
                f"another mission, {first.verdict.mission}{_first_difference(first, other)}: "
                "compare flights of the same mission",
                source=other.log.source,
            )


def _first_difference(first: RecordedFlight, other: RecordedFlight) -> str:
    """Return a text that names the first value in which two missions of the same name differ.

    The text is empty if the missions have different names.
    """
    if first.verdict.mission != other.verdict.mission:
        return ""
    flown = [flight.mission for flight in (first, other)]
    # Compare the keys of the mission file. Logs of earlier versions contain only the resolved mission.
    trees = [mission.written.tree for mission in flown if mission.written is not None]
    if len(trees) < len(flown) or trees[0] == trees[1]:
        trees = [msgspec.to_builtins(mission) for mission in flown]
    there, here = (
        {
            dotted(key): value
            for key, value in iterate_leaves(tree, in_lists=True)
            if key[0] not in ("source", "vehicle", "vehicle_source", "written")
        }
        for tree in trees
    )
    for key in there | here:
        if there.get(key) != here.get(key):
            return (
                f" (the names agree, but {key} is {here.get(key)} in this flight's mission and "
                f"{there.get(key)} in the other mission)"
            )
    return ""


# --- parts ---------------------------------------------------------------------------------------------


def _vehicle(v: Verdict) -> str:
    assert v.vehicle is not None
    packaged = ", the packaged configuration" if v.vehicle.packaged else ""
    return f"{v.vehicle.source or 'from the log'}{packaged}, {v.vehicle.mass_kg:g} kg"


def _tiles(verdict: Verdict) -> list[tuple[str, str]]:
    figures = [
        ("goal missed by", verdict.goal_miss_m, "m", 2),
        ("final error", verdict.final_error_m, "m", 3),
        ("largest tilt", verdict.max_tilt_deg, "°", 1),
        ("flight time", verdict.flight_time_s, "s", 1),
        ("EKF error", verdict.ekf_error_m, "m", 3),
    ]
    return [(f"{v:.{digits}f} {unit}", name) for name, v, unit, digits in figures if v is not None]


def _facts(flight: RecordedFlight) -> list[tuple[str, str]]:
    v, about, replayed = flight.verdict, flight.log.about, flight.replay
    equal = f"all {replayed.outputs} outputs equal"
    if not replayed.equal:
        equal = f"{len(replayed.differences)} of {replayed.outputs} outputs differ"
    return [
        ("world", _world(v) + (f", seed {v.seed}" if v.seed is not None else "")),
        ("vehicle", _vehicle(v)),
        ("started", about.get("started_utc", "?")),
        ("software", f"dart-flight {about.get('software', '?')} on {about.get('host', '?')}"),
        (
            "log",
            flight.log.source
            + ("" if flight.log.complete else " (cut short: the end of the flight is missing)"),
        ),
        ("PX4's own log", v.px4_log or _where_px4_log(flight)),
        ("records lost", flight.log.end.get("lost", "unknown: the log is cut short")),
        ("replayed", equal + (f"; {replayed.note}" if replayed.note else "")),
    ]


def _missing_parts(named: Iterable[tuple[RecordedFlight, str]]) -> list[tuple[str, str]]:
    lines = [(name, "; ".join(describe_missing_parts(flight.log))) for flight, name in named]
    return [(name, line) for name, line in lines if line]


def outcome_sentence(flight: RecordedFlight) -> str:
    v, planned, hit = flight.verdict, len(flight.mission.collisions), len(flight.impacts)
    if flight.mission.standoff_m is not None:
        hits = "in this rehearsal, the vehicle stopped short of each wall"
    elif planned == 0:
        hits = "no collision was planned"
    elif planned == 1:
        hits = f"the one planned collision was {'' if hit else 'not '}flown"
    else:
        hits = f"{hit if hit < planned else 'all'} of {planned} planned collisions were flown"
    begin = {
        Outcome.COMPLETED: "The flight was completed",
        Outcome.ABORTED: "The flight was aborted",
        Outcome.RELEASED: "Control was released to the pilot in flight",
    }[v.outcome]
    words = f"{begin}; {hits}"
    if v.goal_miss_m is not None:
        words += f", and the vehicle passed the goal at a distance of {v.goal_miss_m:.2f} m"
    if v.plan_followed is None:
        return f"{words}."
    plan = "The plan was followed" if v.plan_followed else "The plan was not followed"
    where = format_departures(v.deviations, most=1) if v.outcome is Outcome.COMPLETED else ""
    return f"{words}. {plan}" + (f": {where}." if where else ".")


def _hits_table(flight: RecordedFlight) -> PageTable:
    heads = ["hit", "at, s", "wall", "mode", "normal, m/s", "along, m/s", "peak, N", "normal, N", "error %"]
    return PageTable(heads, [_hit_row(impact) for impact in flight.impacts])


def _hit_row(impact: Impact) -> Row:
    v = impact.verdict
    rows = {row.name: row for row in impact.compared}
    peak = rows["peak normal force"]
    estimated = f", estimated {v.mode_felt}" if v.mode_felt not in (None, v.mode) else ""
    clipped = ", clipped" if v.clipped else ""
    return [
        v.index, impact.at_s, v.wall, f"{v.mode}{estimated}{clipped}", v.measured.normal_m_s,
        v.measured.tangential_m_s, rows["peak force"].measured,
        v.measured.peak_force_n, signed(peak.error_percent),
    ]  # fmt: skip


def _where_px4_log(flight: RecordedFlight) -> str:
    if flight.log.world in (World.FAST, World.EMBEDDED):
        return "none (not a PX4 flight)"
    armed = flight.armed_utc()
    return "not in the log's folder (run dart-flight px4-log)" + (f"; armed at {armed}" if armed else "")


def _compared_table(flight: RecordedFlight, names: Sequence[str] = ()) -> PageTable:
    """Return the table of the quantities of every collision; with `names`, only these quantities."""
    rows: list[Row] = []
    for impact in flight.impacts:
        rows.append(impact.title + (", clipped: lower bounds" if impact.verdict.clipped else ""))
        rows += [
            [f"{c.name}, {c.unit}", c.planned, c.predicted, c.measured, c.true, signed(c.error_percent)]
            for c in impact.compared
            if not names or c.name in names
        ]
    return PageTable(["", "planned", "predicted", "measured", "true", "error %"], rows)


_WALL_ESTIMATE_HEADS = [
    "wall", "mode reported", "mode estimated", "k, N/m", "before", "f, N s/m", "before", "mu, s/m", "before",
]  # fmt: skip


def _wall_estimate_row(flight: RecordedFlight, estimate: WallEstimate) -> Row:
    mode = estimate.mode_felt or estimate.mode_reported
    wall = next((w for w in flight.mission.walls if w.name == estimate.wall), None)
    vehicle = flight.mission.vehicle
    if mode is None or wall is None:
        return [estimate.wall, None, None, None, None, None, None, None, None]
    prior, spread = vehicle.materials[wall.material].coefficients(mode), vehicle.estimation.walls.spread
    cells: list[Cell] = [estimate.wall, estimate.mode_reported, estimate.mode_felt or "undecided"]
    for before, after, sd in (
        (prior.k, estimate.k_n_per_m, estimate.k_sd),
        (prior.f, estimate.f_ns_per_m, estimate.f_sd),
        (prior.mu, estimate.mu_s_per_m, estimate.mu_sd),
    ):
        pairs = ((after, sd), (before, spread))
        cells += [Number(f"{value:.4g} ± {100.0 * share:.0f} %") for value, share in pairs]
    return cells


_REPLANNED_HEADS = ["at, s", "to", "planning time, ms", "impact, m/s", "along, m/s", "peak, N", "flown"]


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


def _lock_table(flight: RecordedFlight) -> PageTable:
    rows: list[Row] = []
    for impact in flight.impacts:
        times = impact.verdict.lock
        if times is None or times.contact_end_us is None:
            continue
        end_us, moments = times.contact_end_us, (times.relaxed_us, times.commanded_us, times.settled_us)
        rows.append([impact.title, *(None if t is None else (t - end_us) * 1e-3 for t in moments)])
    return PageTable(["time after the contact's end, ms", "arms relaxed", "commanded", "settled"], rows)


def _timing_table(flight: RecordedFlight) -> PageTable:
    t = flight.timing
    rows: list[Row] = [
        [name, *(percentile(values, share) for share in (50, 99, 100))]
        for name, values in (
            ("setpoint interval", t.setpoint_interval_ms),
            ("IMU delay minus its minimum", t.imu_delay_ms),
            ("sample to recovery setpoint", t.recovery_ms),
        )
    ]
    for v in flight.verdict.collisions:
        rows.append([f"collision {v.index}: contact to detection", v.detection_latency_ms, None, None])
    return PageTable(["ms", "median", "99 %", "most"], rows)


def _noise_table(flight: RecordedFlight) -> PageTable:
    """Return the detection limits at the start of each approach; empty if the log lacks them."""
    time_of = flight.course.time_of
    rows: list[Row] = [
        [time_of(f.t_us), f.threshold_n, f.noise_short_n, f.noise_long_n, f.rigid_n, f.flexible_n]
        for f in flight.course.all(DetectionFloor)
    ]
    noise = ["noise, short mean N", "long mean N"]
    heads = ["s", "threshold N", *noise, "detection limit rigid, N", "detection limit flexible, N"]
    return PageTable(heads, rows)


def disagreements(flights: Sequence[RecordedFlight]) -> dict[str, dict[str, tuple[float, float]]]:
    """Compare measured peak forces with the contact law at the measured velocity.

    All flights must be of vehicles with the same materials.

    Returns:
        Material -> mode and force (such as `rigid, normal`) -> (mean disagreement, half the width of the
            mean's 95 % interval). The disagreement of a hit is measured peak / predicted peak - 1.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for impact in (impact for flight in flights for impact in flight.impacts):
        by_force = found.setdefault(impact.material, {})
        for force, value in (("normal", impact.disagreement), ("friction", impact.friction_disagreement)):
            if value is not None:
                by_force.setdefault(f"{impact.verdict.mode}, {force}", []).append(value)
    return {
        material: {force: mean_excess(values) for force, values in by_force.items()}
        for material, by_force in found.items()
    }


def beyond(disagreement: dict[str, tuple[float, float]]) -> bool:
    """Return whether the measured peak forces of a material contradict the contact law."""
    return any(contradicts(mean, half) for mean, half in disagreement.values())


def _coefficients(flights: Sequence[RecordedFlight]) -> list[dict[str, Any]]:
    return [
        {
            "material": material,
            "forces": [(force, 100 * mean, 100 * half) for force, (mean, half) in disagreement.items()],
            "disagrees": beyond(disagreement),
        }
        for material, disagreement in disagreements(flights).items()
    ]


def _parameters(flight: RecordedFlight, others: Sequence[RecordedFlight] = ()) -> dict[str, str]:
    about = flight.log.about
    return {
        "name": flight.name,
        "different": ", ".join(f.name for f in others if f.mission.vehicle != flight.mission.vehicle),
        "mission": about.get("mission_text", "not in the log"),
        "vehicle": msgspec.json.format(about.get("vehicle", "{}"), indent=2),
    }


# --- several flights -----------------------------------------------------------------------------------


def _flights_table(flights: Sequence[RecordedFlight]) -> PageTable:
    rows: list[Row] = []
    for f in flights:
        v = f.verdict
        outcome = v.outcome + (f": {v.reason}" if v.reason else "")
        rows.append(
            [f.name, outcome, len(f.impacts), v.goal_miss_m, v.final_error_m, v.max_tilt_deg,
             "equal" if f.replay.equal else f"{len(f.replay.differences)} differ"]
        )  # fmt: skip
    heads = ["flight", "outcome", "impacts", "goal miss m", "final error m", "tilt °", "replay"]
    return PageTable(heads, rows)


def _statistics(flights: Sequence[RecordedFlight], indices: list[int]) -> PageTable:
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
    return PageTable(["", "n", "mean", "± 95 %", "sd", "least", "most"], rows)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _spread(name: str, values: Iterable[float | None]) -> list[Cell]:
    """Return the row of `_statistics`; least and most are by magnitude: -0.9 m/s is less than -1.1 m/s."""
    s = spread(values, abs)
    if s is None:
        return [name, 0, *(None,) * 5]
    return [name, s.count, s.mean, s.mean_half_width, s.sd, s.low, s.high]


def _world(verdict: Verdict) -> str:
    return verdict.world or "unknown"
