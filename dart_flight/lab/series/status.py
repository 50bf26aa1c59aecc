"""The state of a series: coefficients with their intervals, held-out hits, and what is still missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import Mode
from dart_flight.base.summary import Z95
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.body_fit import combine, predict_body
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.fit import identify
from dart_flight.lab.identify.flight_trials import ALLOWANCE
from dart_flight.lab.identify.next_hits import (
    FITTED,
    Known,
    ModeFit,
    NextHitLimits,
    fastest_m_s,
)
from dart_flight.lab.series.evidence import Evidence, SeriesFlight, SeriesHit
from dart_flight.lab.series.series_file import SeriesSettings

PRIOR_SD: Final = 0.3  # of the logarithms, about the configured coefficients
PEAK_SHARE: Final = 0.8  # largest planned peak, as a share of the force limit
FEWEST_HITS: Final = 3  # for an aim: the scatter between hits is not known from fewer
_MASS_CHANGED = 0.005
_BATTERY_CHANGED_V = 0.8
_IMU_MOVED_M = 0.005


class Coefficient(msgspec.Struct, frozen=True):
    """A coefficient of one mode.

    Attributes:
        statistical: the estimate with its statistical 95 % interval, prior included.
        whole: the same with the allowance for systematic errors.
        prior_share: share of the configured value in the estimate, 0 to 1.
        aim: intended half width of the statistical interval, relative; None without an aim.
        more_hits: further used hits that the aim needs, if they are as informative as the hits so far; 0 if
            the aim is reached; None without hits.
    """

    statistical: Estimate
    whole: Estimate
    prior_share: float
    aim: float | None
    more_hits: int | None


class HeldOutPrediction(msgspec.Struct, frozen=True):
    """A hit that was held out: predicted by the fit of the others, and measured."""

    hit: str
    normal_m_s: float
    peak_n: float
    peak_measured_n: float
    out_m_s: float
    out_measured_m_s: float
    out_constant_m_s: float  # with the constant restitution of the used hits


class HeldOutErrors(msgspec.Struct, frozen=True):
    """Root mean square errors on held-out hits.

    Attributes:
        peak: error of the peak force, relative to the measured peak.
        out_m_s, out_constant_m_s: errors of the outgoing speed by the law, and by a constant restitution.
    """

    hits: list[HeldOutPrediction]
    peak: float | None
    out_m_s: float | None
    out_constant_m_s: float | None


class ModeStatus(msgspec.Struct, frozen=True):
    """The state of one mode; `coefficients` has k, f, mu and nu."""

    coefficients: dict[str, Coefficient]
    flown: int
    used: int
    held_out: HeldOutErrors
    aside: dict[str, str]

    @property
    def more_hits(self) -> int | None:
        """Further used hits until all aims are reached; None if this cannot be estimated yet."""
        needed = [one.more_hits for one in self.coefficients.values() if one.aim is not None]
        return None if None in needed else max(n for n in needed if n is not None)

    @property
    def fit(self) -> ModeFit:
        """What the plan of the next hits may rely on: the intervals with allowance."""
        return self._fit([self.coefficients[n].whole for n in FITTED])

    @property
    def statistical_fit(self) -> ModeFit:
        """What more hits improve: the statistical intervals."""
        return self._fit([self.coefficients[n].statistical for n in FITTED])

    def _fit(self, found: list[Estimate]) -> ModeFit:
        k, f, mu = (Known(e.value, 0.5 * math.log(e.high / max(e.low, 1e-6))) for e in found)
        return ModeFit(k, f, mu, self.coefficients["nu"].whole.value)


class SeriesStatus(msgspec.Struct, frozen=True):
    """The state of a series.

    Attributes:
        flights: flight -> its problem, or how it ended.
        changes: what differs between the last day and the day before, in sentences.
    """

    wall: str
    material: str
    modes: dict[str, ModeStatus]
    flights: dict[str, str]
    changes: list[str]

    @property
    def is_complete(self) -> bool:
        return all(mode.more_hits == 0 for mode in self.modes.values())


def status_of(settings: SeriesSettings, mission: Mission, evidence: Evidence) -> SeriesStatus:
    """Return the state of a series; `mission` has the vehicle, whose materials are the prior."""
    material = wall_material(mission, settings.wall)
    return SeriesStatus(
        wall=settings.wall,
        material=material,
        modes={
            mode.value: _mode_status(settings, mission, evidence, mode, material) for mode in settings.modes
        },
        flights={one.name: one.problem or one.outcome for one in evidence.flights},
        changes=_changes(evidence),
    )


def wall_material(mission: Mission, name: str) -> str:
    """Return the material of a wall; in a series of drops, the name is the ground's material."""
    if name in mission.vehicle.materials and not mission.flat_walls:
        return name
    return next(wall.material for wall in mission.flat_walls if wall.name == name)


def hit_limits(settings: SeriesSettings, mission: Mission) -> NextHitLimits:
    low, high = settings.speeds_m_s
    peak_n = min(settings.peak_force_n, mission.limits.peak_force_n)
    vehicle = mission.vehicle
    return NextHitLimits(
        low,
        high,
        mission.limits.speed_m_s,
        PEAK_SHARE * peak_n,
        vehicle.airframe.mass_kg,
        Onset(vehicle.onset),
    )


def next_heights(settings: SeriesSettings, mission: Mission, fit: ModeFit) -> list[float]:
    """Return the heights of the next drops in one mode, m, in equal steps of the impact speed.

    No peak, with gravity's share, exceeds 0.8 of the force limit by the upper end of the interval. The list
    is empty if no height is safe.
    """
    assert settings.heights_m is not None
    weight_n = GRAVITY_M_S2 * mission.vehicle.airframe.mass_kg
    low, high = (math.sqrt(2.0 * GRAVITY_M_S2 * height) for height in settings.heights_m)
    limits = hit_limits(settings, mission)._replace(
        slowest_m_s=low,
        fastest_m_s=high,
        speed_m_s=high,
        peak_n=PEAK_SHARE * settings.peak_force_n - 2.0 * weight_n,
    )
    top = fastest_m_s(fit, limits, 0.0)
    if top is None:
        return []
    speeds = np.linspace(low, top, settings.hits_per_flight)
    heights: list[float] = (speeds**2 / (2.0 * GRAVITY_M_S2)).tolist()
    return heights


def _mode_status(
    settings: SeriesSettings, mission: Mission, evidence: Evidence, mode: Mode, material: str
) -> ModeStatus:
    hits = [hit for hit in evidence.hits if hit.mode is mode]
    used = evidence.used(mode)
    bodies = [hit.body for hit in used if hit.body is not None]
    found = combine(bodies)[0] if bodies else _fit_drops(used, mission)
    # The first flight's vehicle has the prior: `series apply` may have changed the configuration since.
    first = next((one.vehicle for one in evidence.flights if one.vehicle is not None), mission.vehicle)
    configured = first.materials.get(material, mission.vehicle.materials[material]).coefficients(mode)
    coefficients = {
        name: _coefficient(
            found.get(name),
            getattr(configured, name),
            ALLOWANCE[name] if settings.heights_m is None else 0.0,
            None if name == "mu" and settings.heights_m is not None else getattr(settings.aims, name, None),
            len(used),
        )
        for name in ("k", "f", "mu", "nu")
    }
    fitted = Coefficients(**{name: one.statistical.value for name, one in coefficients.items()})
    return ModeStatus(
        coefficients,
        flown=len(hits),
        used=len(used),
        held_out=predict_held_out(fitted, used, evidence.held_out(mode), mission),
        aside={hit.name: hit.aside for hit in hits if hit.aside},
    )


def _fit_drops(used: Sequence[SeriesHit], mission: Mission) -> dict[str, Estimate | None]:
    """Fit the drops of one mode."""
    trials = [hit.measured.trial for hit in used if hit.measured is not None]
    if not trials:
        return {}
    vehicle = mission.vehicle
    found = identify(trials, vehicle.airframe.mass_kg, Onset(vehicle.onset))
    return found.statistical[used[0].mode.value]


def _coefficient(
    measured: Estimate | None, prior: float, allowance: float, aim: float | None, hits: int
) -> Coefficient:
    """Combine the prior with the measurement, both normal in the logarithm."""
    prior = max(prior, 1e-3)
    log, variance = math.log(prior), PRIOR_SD**2
    if measured is not None:
        sd2 = (math.log(measured.high / measured.low) / (2.0 * Z95)) ** 2
        share = sd2 / (sd2 + variance)
        log = share * log + (1.0 - share) * math.log(measured.value)
        variance *= share
    else:
        share = 1.0
    half = Z95 * math.sqrt(variance)
    value = math.exp(log)
    more = None
    if measured is not None and aim is not None:
        more = max(0, FEWEST_HITS - hits, math.ceil(hits * ((half / aim) ** 2 - 1.0) - 1e-9))
    statistical = Estimate(value, math.exp(log - half), math.exp(log + half))
    whole = Estimate(
        value, max(statistical.low - allowance * value, 0.05 * value), statistical.high + allowance * value
    )
    return Coefficient(statistical, whole, share, aim, more)


def predict_held_out(
    fitted: Coefficients, used: Sequence[SeriesHit], held: Sequence[SeriesHit], mission: Mission
) -> HeldOutErrors:
    """Predict the held-out hits by the law, and by the median restitution of the used hits."""
    ratios = [
        speeds.normal_out_m_s / -speeds.normal_m_s
        for speeds in (hit.verdict.measured for hit in used)
        if speeds.normal_m_s and speeds.normal_out_m_s is not None
    ]
    restitution = float(np.median(ratios)) if ratios else math.nan
    rows = []
    for hit in held:
        speeds, predicted = hit.verdict.measured, predict_hit(hit, fitted, mission)
        peak_n = None if hit.measured is None else hit.measured.peak_force_n
        if predicted is None or peak_n is None or not speeds.normal_m_s or speeds.normal_out_m_s is None:
            continue
        rows.append(
            HeldOutPrediction(
                hit.name,
                speeds.normal_m_s,
                predicted[0],
                peak_n,
                predicted[1],
                speeds.normal_out_m_s,
                restitution * -speeds.normal_m_s,
            )
        )
    return HeldOutErrors(
        rows,
        _rms([row.peak_n / row.peak_measured_n - 1.0 for row in rows]),
        _rms([row.out_m_s - row.out_measured_m_s for row in rows]),
        _rms([row.out_constant_m_s - row.out_measured_m_s for row in rows]),
    )


def predict_hit(hit: SeriesHit, fitted: Coefficients, mission: Mission) -> tuple[float, float] | None:
    """Return a hit's predicted peak normal force, N, and outgoing speed, m/s, or None if it is not usable."""
    m = hit.measured
    if m is None:
        return None
    if hit.body is not None:
        return predict_body(m, fitted)
    vehicle, push = mission.vehicle, m.trial.acceleration_m_s2 or None
    contact = contact_map(
        CoefficientArrays.from_table(fitted),
        vehicle.airframe.mass_kg,
        -m.normal_in_m_s,
        m.tangential_in_m_s or 0.0,
        Onset(vehicle.onset),
        acceleration_m_s2=push,
    )
    return float(contact.peak_normal_force_n), float(contact.normal_out_m_s)


def _rms(errors: Sequence[float]) -> float | None:
    finite = [e for e in errors if math.isfinite(e)]
    return math.sqrt(sum(e * e for e in finite) / len(finite)) if finite else None


def _changes(evidence: Evidence) -> list[str]:
    """Compare the vehicle of the last day with that of the day before."""
    days: dict[str, list[SeriesFlight]] = {}
    for flight in evidence.flights:
        if flight.began is not None and flight.vehicle is not None:
            days.setdefault(flight.began.date().isoformat(), []).append(flight)
    if len(days) < 2:
        return []
    before, now = sorted(days)[-2:]
    earlier, later = days[before], days[now]
    a, b = earlier[-1], later[-1]
    assert a.vehicle is not None
    assert b.vehicle is not None
    since, found = f"since {before}", []
    mass_a, mass_b = a.vehicle.airframe.mass_kg, b.vehicle.airframe.mass_kg
    if abs(mass_b / mass_a - 1.0) > _MASS_CHANGED:
        found.append(f"{since}, airframe.mass_kg has changed from {mass_a:g} to {mass_b:g} kg")
    if math.dist(a.vehicle.imu.position_m, b.vehicle.imu.position_m) > _IMU_MOVED_M:
        found.append(
            f"{since}, imu.position_m has changed from {list(a.vehicle.imu.position_m)} to "
            f"{list(b.vehicle.imu.position_m)}"
        )
    if a.battery_v and b.battery_v and abs(a.battery_v - b.battery_v) > _BATTERY_CHANGED_V:
        found.append(
            f"{since}, the battery has changed from {a.battery_v:.1f} to {b.battery_v:.1f} V at the start"
        )
    felt = {
        date: [
            hit.verdict.mode_felt == hit.verdict.mode
            for hit in evidence.hits
            if hit.flight in {one.name for one in flights} and hit.verdict.mode_felt is not None
        ]
        for date, flights in ((before, earlier), (now, later))
    }
    if felt[before] and felt[now] and all(felt[before]) and not all(felt[now]):
        found.append(f"{since}, contacts have begun to indicate another mode than the lock reports")
    return found


def describe(status: SeriesStatus) -> str:
    """Return the missing hits in one line."""
    parts = []
    for mode, one in status.modes.items():
        more = one.more_hits
        parts.append(
            f"{mode}: no hit yet"
            if more is None and not one.used
            else f"{mode}: too few hits"
            if more is None
            else f"{mode}: aims reached"
            if more == 0
            else f"{mode}: about {more} more hits"
        )
    return "; ".join(parts)
