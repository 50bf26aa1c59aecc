"""Campaign: force, torque, contact side and incidence of a body's hits against the truth
(docs/results/torque.md).

Mode and approach are drawn for every seed; a flight ends with its contact.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec3, wrap_angle, yaw_ned_of
from dart_flight.base.records import (
    AttitudeSample,
    ContactSide,
    ForceEstimate,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    Mode,
    TorqueEstimate,
    TruthContact,
)
from dart_flight.config.mission import Mission
from dart_flight.lab.campaign.campaign_spec import Point
from dart_flight.lab.campaign.flight_job import JudgedRow
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import draw_world
from tools.campaigns.results import NoResultError, markdown

_AFTER_US = 60_000
_LONGEST_S = 30.0
_CLEAR_LEAD_M = 0.005  # with a larger lead, the estimated side must be right
SETS: dict[str, dict[str, float]] = {
    "nothing": {},
    "off": {"wall_yaw_deg": 4.0},
    "all": {
        "contact": 0.2, "contact_scatter": 0.05, "wall_yaw_deg": 4.0, "guard_height_m": 0.02, "mass": 0.03,
        "wind_m_s": 0.5, "battery": 0.05,
    },
    "imu": {"imu": 0.02},
}  # fmt: skip


class BodyHit(msgspec.Struct, frozen=True):
    """One hit: the estimate and the truth.

    Attributes:
        force_error: relative error of the peak, as force over mass.
        over_bound: error of the peak force, divided by its Cramér-Rao bound for the estimated noise level.
        friction_error: relative error of the peak friction; None if the true peak is below 3 N.
        raw_torque_nm: largest single sample of the torque.
        by_yaw_rad: incidence computed from attitude and planned wall.
        lead_m: distance by which the right contact point is ahead of the left one.
    """

    mode: Mode
    force_error: float
    over_bound: float
    fitted: bool
    friction_error: float | None
    torque_nm: float
    true_torque_nm: float
    raw_torque_nm: float
    incidence_rad: float
    sigma_rad: float
    true_incidence_rad: float
    by_yaw_rad: float
    side: ContactSide
    lead_m: float

    def torque_is_right(self, torque_nm: float) -> bool:
        """Return whether a torque is within 10 % or 0.15 N m of the truth."""
        return abs(torque_nm - self.true_torque_nm) <= max(0.15, 0.1 * self.true_torque_nm)

    def is_first(self, side: ContactSide) -> bool:
        """Return whether a side touched first."""
        return side is (ContactSide.RIGHT if self.lead_m > 0.0 else ContactSide.LEFT)


def drawn_mission(mission: Mission, seed: int) -> Mission:
    """Return the single-wall mission with mode and approach of a seed."""
    rng = random.Random(f"torque {seed}")
    approach = (-rng.uniform(0.4, 1.5), rng.uniform(-0.6, 0.6))
    mode = rng.choice(list(Mode))
    collision = msgspec.structs.replace(mission.collisions[0], mode=mode, approach_m_s=approach)
    return msgspec.structs.replace(mission, collisions=(collision,))


def fly(point: Point, seed: int) -> BodyHit:
    """Fly until the end of the first contact.

    Raises:
        NoResultError: there was no contact.
    """
    mission = drawn_mission(point.mission, seed)
    world = draw_world(mission, seed, SETS[point.case["set"]])
    records = _ContactRecords()
    flight = FastFlight(mission, seed, observe=records, world=world)
    plant = flight.autopilot.plant
    records.contact_n = lambda: plant.frame.vector_from_ned(plant.contact_force_ned)
    records.touching = lambda: plant.in_contact
    while flight.core.end is None and not records.done and flight.autopilot.now_s < _LONGEST_S:
        flight.tick()
    return _evaluate(mission, world.mission, records)


class _ContactRecords:
    """The records of one contact, and the true force at every IMU sample."""

    def __init__(self) -> None:
        self.onset: ImpactOnset | None = None
        self.peak: ImpactPeak | None = None
        self.bodies: list[ImpactBody] = []
        self.contacts: list[TruthContact] = []
        self.forces: list[ForceEstimate] = []
        self.torques: list[TorqueEstimate] = []
        self.attitude: AttitudeSample | None = None
        self.onset_attitude: AttitudeSample | None = None
        self.true_n: list[tuple[int, Vec3]] = []
        self.contact_n: Callable[[], Vec3] = lambda: (0.0, 0.0, 0.0)
        self.touching: Callable[[], bool] = lambda: False
        self.done = False
        self._ended_us: int | None = None
        self._touched_us = 0

    def __call__(self, record: object, number: int) -> None:
        if isinstance(record, ImuSample):
            self.true_n.append((record.t_us, self.contact_n()))
            if self.touching():  # the truth of a contact is complete only after its end
                self._touched_us = record.t_us
            if self._ended_us is not None:
                self.done = record.t_us > max(self._ended_us, self._touched_us) + _AFTER_US
        elif isinstance(record, AttitudeSample):
            self.attitude = record
        elif isinstance(record, ForceEstimate):
            self.forces.append(record)
        elif isinstance(record, TorqueEstimate):
            self.torques.append(record)
        elif isinstance(record, TruthContact):
            self.contacts.append(record)
        elif isinstance(record, ImpactOnset) and self.onset is None:
            self.onset, self.onset_attitude = record, self.attitude
        elif isinstance(record, ImpactPeak) and self.peak is None:
            self.peak = record
        elif isinstance(record, ImpactBody) and self._ended_us is None:
            self.bodies.append(record)
            self._ended_us = record.t_us


def _evaluate(planned: Mission, true: Mission, records: _ContactRecords) -> BodyHit:
    onset, peak, attitude = records.onset, records.peak, records.onset_attitude
    if onset is None or peak is None or attitude is None or not records.bodies:
        raise NoResultError("no contact")
    body = records.bodies[-1]
    # A rotating vehicle may touch again with its other side within one impact.
    near = [c for c in records.contacts if c.t_us <= body.t_us and c.end_us >= onset.first_us - 20_000]
    if not near:
        raise NoResultError("no true contact")
    yaw = planned.frame_at((0.0, 0.0, 0.0)).yaw_from_ned(yaw_ned_of(attitude.q_frd_to_ned))
    inside = [t for t in records.torques if onset.first_us <= t.t_us <= body.t_us]
    factor = true.vehicle.airframe.mass_kg / planned.vehicle.airframe.mass_kg
    force, true_force = peak.normal_force_n * factor, near[0].peak_normal_force_n
    friction, true_friction = abs(peak.tangential_force_n) * factor, near[0].peak_friction_force_n
    return BodyHit(
        mode=planned.collisions[0].mode,
        force_error=force / true_force - 1.0,
        over_bound=(force - true_force) / _bound_n(records, peak, onset),
        fitted=peak.fitted,
        friction_error=friction / true_friction - 1.0 if true_friction > 3.0 else None,
        torque_nm=body.peak_torque_nm,
        true_torque_nm=max(c.peak_torque_nm for c in near),
        raw_torque_nm=max(math.hypot(*t.torque_frd) for t in inside),
        incidence_rad=body.incidence_rad,
        sigma_rad=body.incidence_sigma_rad,
        true_incidence_rad=near[0].incidence_rad,
        by_yaw_rad=wrap_angle(yaw - planned.collisions[0].wall.parallel_yaw(yaw)),
        side=body.side,
        lead_m=near[0].lead_m,
    )


def _bound_n(records: _ContactRecords, peak: ImpactPeak, onset: ImpactOnset) -> float:
    nx, ny = peak.normal
    until = [
        (t, f[0] * nx + f[1] * ny)
        for t, f in records.true_n
        if onset.first_us - 40_000 < t <= peak.detected_us
    ]
    noise = next(f.noise_n for f in records.forces if f.t_us >= onset.first_us)
    return cramer_rao_n(np.array([t * 1e-6 for t, _ in until]), np.array([f for _, f in until]), noise)


def cramer_rao_n(time_s: NDArray[np.float64], pulse_n: NDArray[np.float64], noise_n: float) -> float:
    """Return the smallest standard deviation of a pulse's height with unknown time and duration, newton.

    Args:
        time_s: times of the readings available when the peak is estimated, shape (n,).
        pulse_n: true force at these times.
        noise_n: standard deviation of one reading, white.
    """
    slope = np.gradient(pulse_n, time_s)
    top = int(np.argmax(pulse_n))
    # Derivatives of the readings by relative height, time and relative duration.
    changes = np.stack([pulse_n, -slope, -(time_s - time_s[top]) * slope], axis=1)
    information = changes.T @ changes / noise_n**2
    return float(pulse_n[top] * math.sqrt(np.linalg.pinv(information)[0, 0]))


def page(rows: Sequence[JudgedRow]) -> str:
    """Return a table with a column for every set."""
    sets: dict[str, list[BodyHit]] = {}
    for r in rows:
        sets.setdefault(r.values["set"], []).append(r.row)
    return markdown(("", *sets), zip(_NAMES, *(_cells(mine) for mine in sets.values()), strict=True))


_NAMES = (
    "hits", "force peak error, median, 95th", "peak read from the fitted pulse", "error over the bound, rms",
    "friction peak over 3 N, median error", "torque peak right", "torque by its largest sample right",
    "side right, with a clear lead", "incidence error, rms",
    "incidence error by yaw and planned wall, rms", "incidence error over its reported deviation, rms",
)  # fmt: skip


def _cells(mine: Sequence[BodyHit]) -> list[str]:
    clear = [h for h in mine if abs(h.lead_m) >= _CLEAR_LEAD_M]
    forces = np.abs([h.force_error for h in mine])
    frictions = [abs(h.friction_error) for h in mine if h.friction_error is not None]
    off = [h.incidence_rad - h.true_incidence_rad for h in mine]
    return [
        str(len(mine)),
        f"{100 * np.median(forces):.1f} %, {100 * np.percentile(forces, 95):.1f} %",
        f"{sum(h.fitted for h in mine)} of {len(mine)}",
        f"{_rms([h.over_bound for h in mine]):.2f}",
        f"{100 * np.median(frictions):.1f} %" if frictions else "-",
        f"{sum(h.torque_is_right(h.torque_nm) for h in mine)} of {len(mine)}",
        f"{sum(h.torque_is_right(h.raw_torque_nm) for h in mine)} of {len(mine)}",
        f"{sum(h.is_first(h.side) for h in clear)} of {len(clear)}",
        f"{math.degrees(_rms(off)):.2f}°",
        f"{math.degrees(_rms([h.by_yaw_rad - h.true_incidence_rad for h in mine])):.2f}°",
        f"{_rms([error / h.sigma_rad for error, h in zip(off, mine, strict=True)]):.2f}",
    ]


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / max(1, len(values)))
