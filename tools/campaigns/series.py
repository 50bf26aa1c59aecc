"""Campaign: trial series in simulation, from the first batch to coefficients (docs/series.md).

A seed is a vehicle: k, f and mu of the wall differ by up to 30 % from the configured values in each mode, and
the true mass by 0.5 % from the weighed mass. The truth of a coefficient is its mean before the scatter of
single contacts. After the series, ten more hits are predicted with its result.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.records import Mode, World
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Coefficients
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.lab.identify.flight_trials import ALLOWANCE
from dart_flight.lab.identify.next_hits import FITTED, next_hits
from dart_flight.lab.series.batch import HitChoice, plan_batch
from dart_flight.lab.series.evidence import Evidence, SeriesFlight, read_flight, sort_hits
from dart_flight.lab.series.series_file import SeriesSettings
from dart_flight.lab.series.status import SeriesStatus, predict_held_out, status_of, wall_material
from dart_flight.recording.found import LOG_NAME
from dart_flight.recording.reader import IN_MEMORY, Log
from dart_flight.recording.verdict import Verdict, verdict_of
from dart_flight.run.fast import FastFlight
from dart_flight.run.flight_record import FlightRecord
from dart_flight.sim.draws import DrawnWorld
from tools.campaigns.results import grouped, markdown

_SPREAD, _MASS_SD, _SCATTER = 0.3, 0.005, 0.05
_MOST_HITS = 16  # a mode
_HITS_PER_FLIGHT = 8
_PREDICTED_HITS = 10
_WORST, _HELD = 0.92, 0.95  # coverage below which a row is bold; coverage for which an allowance is enough


class SeriesOutcome(msgspec.Struct, frozen=True):
    """The result of one series.

    Attributes:
        coefficients: by `mode name`: estimate, low and high of the statistical interval, low and high
            with the allowance, and the truth.
        hits, flights: numbers flown in the series.
        highest_share: largest true peak of a hit, relative to the force limit.
        uncontrolled: number of uncontrolled flights.
        reasons: why flights did not complete.
        peak_rms, out_rms_m_s, out_constant_rms_m_s: errors on the predicted hits, largest over the modes.
    """

    coefficients: dict[str, tuple[float, float, float, float, float, float]]
    hits: int
    flights: int
    highest_share: float
    uncontrolled: int
    reasons: list[str]
    peak_rms: float | None
    out_rms_m_s: float | None
    out_constant_rms_m_s: float | None


def fly_series(point: Point, seed: int, choose: HitChoice = next_hits) -> SeriesOutcome:
    """Fly a series of at most 16 hits a mode, then ten hits that its result predicts."""
    mission, wall = point.mission, point.case["wall"]
    settings = SeriesSettings(
        wall=wall,
        modes=(Mode.FLEXIBLE, Mode.RIGID),
        peak_force_n=mission.limits.peak_force_n,
        held_out=0.0,
        hits_per_flight=_HITS_PER_FLIGHT,
    )
    drawn = _drawn_coefficients(mission, wall, seed)
    evidence, verdicts, reasons = Evidence(), list[Verdict](), list[str]()
    status = status_of(settings, mission, evidence)
    while not status.is_complete and max(one.flown for one in status.modes.values()) < _MOST_HITS:
        if len(verdicts) == 2 * _MOST_HITS // _HITS_PER_FLIGHT + 2:  # a guard may have ended some flights
            break
        try:
            status = _fly_batch(settings, mission, drawn, evidence, verdicts, seed, choose)
        except FlightError as error:
            reasons.append(str(error))
            break
    hits, flights = sum(one.flown for one in status.modes.values()), len(verdicts)
    predicted = _predict(settings, mission, drawn, status, evidence, verdicts, seed)
    truths = [c.truth.peak_force_n or 0.0 for v in verdicts for c in v.collisions if c.truth is not None]
    reasons += [v.reason for v in verdicts if v.reason is not None]
    return SeriesOutcome(
        {
            f"{mode} {name}": (*c.statistical, *c.whole[1:], getattr(drawn[Mode(mode)], name))
            for mode, one in status.modes.items()
            for name, c in one.coefficients.items()
            if name in FITTED
        },
        hits,
        flights,
        max(truths, default=0.0) / settings.peak_force_n,
        sum(bool(v.uncontrolled) for v in verdicts),
        reasons,
        *predicted,
    )


def _drawn_coefficients(mission: Mission, wall: str, seed: int) -> dict[Mode, Coefficients]:
    rng = random.Random(f"series {wall} {seed}")
    material = mission.vehicle.materials[wall_material(mission, wall)]
    return {
        mode: material.coefficients(mode).scaled(*(1.0 + rng.uniform(-_SPREAD, _SPREAD) for _ in FITTED))
        for mode in (Mode.FLEXIBLE, Mode.RIGID)
    }


def _fly_batch(
    settings: SeriesSettings,
    mission: Mission,
    drawn: dict[Mode, Coefficients],
    evidence: Evidence,
    verdicts: list[Verdict],
    seed: int,
    choose: HitChoice,
) -> SeriesStatus:
    """Fly the next batch, add it to evidence and verdicts, and return the state afterwards."""
    number = len(verdicts) + 1
    status = status_of(settings, mission, evidence)
    batch = plan_batch(settings, mission, status, f"{settings.wall} {number}", choose)
    log = _log_of(batch.mission, settings.wall, drawn, 100 * seed + number)
    verdicts.append(verdict_of(log))
    flight = SeriesFlight(f"{number:02d}/flight", Path(LOG_NAME))
    evidence.flights.append(flight)
    evidence.hits += read_flight(log, flight, settings)
    sort_hits(evidence, settings)
    return status_of(settings, mission, evidence)


def _predict(
    settings: SeriesSettings,
    mission: Mission,
    drawn: dict[Mode, Coefficients],
    status: SeriesStatus,
    evidence: Evidence,
    verdicts: list[Verdict],
    seed: int,
) -> tuple[float | None, float | None, float | None]:
    """Fly ten hits, and return the largest rms errors over the modes: peak, outgoing speed, and baseline."""
    later = Evidence()
    more = msgspec.structs.replace(settings, hits_per_flight=_PREDICTED_HITS)
    try:
        batch = plan_batch(more, mission, status, f"{settings.wall} predicted")
    except FlightError:
        return None, None, None
    log = _log_of(batch.mission, settings.wall, drawn, 100 * seed)
    verdicts.append(verdict_of(log))
    later.hits += read_flight(log, SeriesFlight("predicted/flight", Path(LOG_NAME)), settings)
    errors = []
    for mode, one in status.modes.items():
        fitted = Coefficients(**{name: c.statistical.value for name, c in one.coefficients.items()})
        used = evidence.used(Mode(mode))
        errors.append(predict_held_out(fitted, used, later.used(Mode(mode)), mission))
    columns = zip(*((e.peak, e.out_m_s, e.out_constant_m_s) for e in errors), strict=True)
    peak, out, constant = (max((v for v in column if v is not None), default=None) for column in columns)
    return peak, out, constant


def _log_of(batch: Mission, wall: str, drawn: dict[Mode, Coefficients], seed: int) -> Log:
    """Fly a batch in the drawn world, and return its log, which contains only the mission's own values."""
    rng = random.Random(f"series mass {seed // 100}")
    name = wall_material(batch, wall)
    vehicle = batch.vehicle
    material = msgspec.structs.replace(
        vehicle.materials[name], rigid=drawn[Mode.RIGID], flexible=drawn[Mode.FLEXIBLE]
    )
    mass_kg = vehicle.airframe.mass_kg * (1.0 + _MASS_SD * rng.gauss(0.0, 1.0))
    contact = msgspec.structs.replace(vehicle.simulation.contact, scatter=_SCATTER)
    real = msgspec.structs.replace(
        vehicle,
        materials={**vehicle.materials, name: material},
        airframe=msgspec.structs.replace(vehicle.airframe, mass_kg=mass_kg),
        simulation=msgspec.structs.replace(vehicle.simulation, contact=contact),
    )
    world = DrawnWorld(msgspec.structs.replace(batch, vehicle=real), None, {})
    record = FlightRecord(batch, World.FAST, seed, IN_MEMORY)
    FastFlight(batch, seed, observe=record, world=world).run()
    record.close()
    return record.log


def page(rows: Sequence[JudgedRow]) -> str:
    """Return two tables: the coefficients, pooled over walls and modes, and the flights and predictions."""
    body, errors = "simulation.contact.body", []
    for (of,), series in grouped(rows, body).items():
        for name in FITTED:
            found = [c for one in series for key, c in one.coefficients.items() if key.split()[1] == name]
            off = [value / truth - 1.0 for value, *_, truth in found]
            narrow, wide = (
                sum(c[low] <= c[-1] <= c[low + 1] for c in found)
                for low in (1, 3)  # without and with the allowance
            )
            most = f"{wide}/{len(found)}"
            beside = [max(0.0, c[1] - c[-1], c[-1] - c[2]) / c[0] for c in found]
            enough = sorted(beside)[math.ceil(_HELD * len(beside)) - 1]
            errors.append(
                [
                    of,
                    name,
                    f"{100.0 * median(map(abs, off)):.1f}",
                    f"{100.0 * median(off):+.1f}",
                    f"{narrow}/{len(found)}",
                    most if wide >= _WORST * len(found) else f"**{most}**",
                    f"{100.0 * ALLOWANCE[name]:g}; {100.0 * enough:.1f}",
                ]
            )
    flown = []
    for values, series in grouped(rows, body, "wall").items():
        known = [
            [v for one in series if (v := getattr(one, key)) is not None]
            for key in ("peak_rms", "out_rms_m_s", "out_constant_rms_m_s")
        ]
        peaks, *speeds = (median(column) if column else float("nan") for column in known)
        flown.append(
            [
                *values,
                str(len(series)),
                f"{median(one.hits for one in series):g}",
                f"{max(one.highest_share for one in series):.2f}",
                f"{sum(one.uncontrolled for one in series)}, {sum(len(one.reasons) for one in series)}",
                f"{100.0 * peaks:.1f}",
                *(f"{speed:.3f}" for speed in speeds),
            ]
        )
    of_errors = (
        "body",
        "",
        "median error, %",
        "bias, %",
        "statistical",
        "with allowance",
        "allowance; enough, %",
    )
    heads = ("body", "wall", "series", "hits", "peak / limit", "lost", "peak, %", "out, m/s", "constant")
    return markdown(of_errors, errors) + "\n" + markdown(heads, flown)
