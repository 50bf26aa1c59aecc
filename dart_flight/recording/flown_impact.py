"""The planned collisions of a flight as flown: `FlownImpact`, built by `ImpactCollector`.

Verdict, deviations, report, figures and animation get a flight's impacts only from this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import (
    ContactEnd,
    ContactSide,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    LockPhase,
    LockState,
    Mode,
    OdometrySample,
    Phase,
    PhaseChange,
    Setpoint,
    SetpointSent,
    TruthContact,
    WallEstimate,
)
from dart_flight.config.mission import Collision, Mission
from dart_flight.recording.anchor import MissionFrameReader

_TRUTH_MATCH_US = 60_000  # maximum time between a measured impact and its true contact


class Velocities(msgspec.Struct):
    """Velocities before and after a contact in the collision frame, peaks, and the geometry of the contact.

    Attributes:
        normal_m_s, tangential_m_s: last velocity before the contact.
        peak_force_n: peak normal force.
        contact_side: guard that touched first: left, right or both, as seen by a person who faces the wall.
        incidence_deg: angle of the leading edge to the wall at the first touch, positive if the vehicle is
            turned to the left.
        peak_torque_nm: largest external torque about the centre of mass.
        normal_out_m_s, tangential_out_m_s: first velocity after the contact. In measured values, this
            velocity is from odometry.
    """

    normal_m_s: float | None = None
    tangential_m_s: float | None = None
    peak_force_n: float | None = None
    contact_side: ContactSide | None = None
    incidence_deg: float | None = None
    peak_torque_nm: float | None = None
    normal_out_m_s: float | None = None
    tangential_out_m_s: float | None = None


class LockTimes(msgspec.Struct):
    """Times at which the lock changes mode after a collision, autopilot time."""

    contact_end_us: int | None = None
    relaxed_us: int | None = None
    commanded_us: int | None = None
    settled_us: int | None = None


class CollisionVerdict(msgspec.Struct):
    """Planned, measured and true values of one collision."""

    index: int
    wall: str
    mode: str
    t_us: int
    clipped: bool = False
    planned: Velocities = msgspec.field(default_factory=Velocities)
    measured: Velocities = msgspec.field(default_factory=Velocities)
    truth: Velocities | None = None
    lock: LockTimes | None = None  # None if the vehicle has no lock
    detection_latency_ms: float | None = None
    setpoint_latency_ms: float | None = None
    contact_time_ms: float | None = None
    mode_felt: Mode | None = None  # estimated (docs/contact_fit.md); None if undecided
    mode_log_odds: float | None = None  # log odds of the rigid over the flexible mode; None if not reported
    mode_true: Mode | None = None  # mode of the simulated arms

    @property
    def force_error(self) -> float | None:
        """Relative error of the measured peak normal force; None if the measured or true peak is unknown."""
        measured, true = self.measured.peak_force_n, self.truth and self.truth.peak_force_n
        return None if measured is None or not true else measured / true - 1.0


class OtherContact(msgspec.Struct):
    """A contact that was not planned, for example after the guard broke off.

    Attributes:
        t_us: autopilot time of the detection; if the contact was not detected, its true beginning.
        phase: phase of the mission.
        speed_m_s: horizontal speed before the contact; None if the contact was not detected.
        peak_force_n: peak normal force; None if it was not measured.
        truth: true values in simulation; None on the drone.
        wall: the touched wall in simulation; None on the drone.
    """

    t_us: int
    phase: Phase
    speed_m_s: float | None = None
    peak_force_n: float | None = None
    truth: Velocities | None = None
    wall: str | None = None


class FlownImpact(CollisionVerdict, kw_only=True):
    """A planned collision as flown: its verdict, and additional data for figures.

    Attributes:
        onset, peak: records of the flight core; peak is None if not measured.
        contact: simulated contact, or None on the drone.
        lock_mode: mode in which the lock was settled at the onset; rigid if the vehicle has no lock.
        recovery: recovery setpoint, mission frame, metres.
    """

    collision: Collision
    onset: ImpactOnset
    peak: ImpactPeak | None = None
    contact: TruthContact | None = None
    lock_mode: Mode | None = None
    recovery: Vec3 | None = None

    @property
    def force(self) -> Vec2 | None:
        """Measured peaks of normal force and friction as a vector, mission frame, newton."""
        if self.peak is None:
            return None
        peaks = self.peak.normal_force_n, self.peak.tangential_force_n, 0.0
        x, y, _ = self.collision.wall.from_collision(peaks)
        return x, y

    def verdict(self) -> CollisionVerdict:
        return CollisionVerdict(*(getattr(self, name) for name in CollisionVerdict.__struct_fields__))


class ImpactCollector:
    """Assembles the impacts of one flight, in the order flown, from its records.

    `anchor`, the reader of the mission frame, must process each record before the collector.
    """

    def __init__(self, mission: Mission, anchor: MissionFrameReader) -> None:
        self._mission, self._anchor = mission, anchor
        lock = mission.vehicle.lock
        self._relaxation_us = None if lock is None else round(lock.relaxation_s * 1e6)
        self._sought = {c.wall.name for c in mission.collisions if c.wall.sought}  # found by probes
        self.impacts: list[FlownImpact] = []
        self._others: list[OtherContact] = []  # contacts as detected
        self._phase = Phase.READYING
        self._overruled_us: int | None = None
        self._truths: list[TruthContact] = []
        self._onset: ImpactOnset | None = None
        self._lock_mode: Mode | None = Mode.RIGID if lock is None else None
        self._left_us: int | None = None  # end of the last contact; None once its outgoing velocity is known
        self.handlers: dict[type, Callable[[Any], None]] = {
            ImpactOnset: self._handle_onset,
            PhaseChange: self._handle_phase,
            ImpactPeak: self._handle_peak,
            ImpactBody: self._handle_body,
            ContactEnd: self._handle_end,
            WallEstimate: self._handle_wall_estimate,
            OdometrySample: self._handle_odometry,
            Setpoint: self._handle_setpoint,
            SetpointSent: self._handle_sent,
            LockState: self._handle_lock,
            TruthContact: self._truths.append,
        }

    def match_truth(self) -> None:
        """Assign to every impact the nearest simulated contact in time, if one with the same wall exists."""
        for impact in self.impacts:
            near = [
                t
                for t in self._truths
                if (t.wall == impact.wall or impact.wall in self._sought)
                and t.t_us - _TRUTH_MATCH_US <= impact.t_us <= t.end_us + _TRUTH_MATCH_US
            ]
            true = impact.contact = min(near, key=lambda t: abs(t.t_us - impact.t_us), default=None)
            if true is None:
                continue
            impact.mode_true = true.mode
            impact.detection_latency_ms = (impact.t_us - true.t_us) * 1e-3
            impact.truth = _true_velocities(true)

    def other_contacts(self) -> list[OtherContact]:
        """Return the contacts that were not planned, in order; call `match_truth` before.

        In simulation, the values of each contact are the ground truth of the matching simulated contact.
        After the guard has overruled the mission, the list also includes contacts that were not detected.
        """
        found = list(self._others)
        planned = [impact.contact for impact in self.impacts]
        for true in self._truths:
            if true in planned:
                continue
            begin_us, end_us = true.t_us - _TRUTH_MATCH_US, true.end_us + _TRUTH_MATCH_US
            mine = next((one for one in found if begin_us <= one.t_us <= end_us), None)
            if mine is None:
                if self._overruled_us is None or true.t_us < self._overruled_us:
                    continue
                mine = OtherContact(true.t_us, Phase.OVERRULED)
                found.append(mine)
            mine.truth, mine.wall = _true_velocities(true), true.wall
        return sorted(found, key=lambda one: one.t_us)

    def _newest(self) -> FlownImpact | None:
        """Return the impact of the last detected contact; None if this contact was not planned."""
        return self.impacts[-1] if self.impacts and self.impacts[-1].onset is self._onset else None

    def _handle_onset(self, record: ImpactOnset) -> None:
        self._onset = record
        self._others.append(OtherContact(record.t_us, self._phase, math.hypot(*record.velocity_mission[:2])))

    def _handle_phase(self, record: PhaseChange) -> None:
        self._phase = record.after
        if record.after is Phase.OVERRULED:
            self._overruled_us = record.t_us
        if record.after is Phase.CONTACT and record.collision is not None and self._onset is not None:
            self._open(self._mission.collisions[record.collision - 1], self._onset)

    def _open(self, collision: Collision, onset: ImpactOnset) -> None:
        self._others = [other for other in self._others if other.t_us != onset.t_us]  # it was planned
        normal, tangential, _ = collision.wall.to_collision(onset.velocity_mission)
        self.impacts.append(
            FlownImpact(
                index=collision.index,
                wall=collision.wall.name,
                mode=collision.mode.value,
                t_us=onset.t_us,
                measured=Velocities(normal, tangential),
                lock=None if self._relaxation_us is None else LockTimes(),
                detection_latency_ms=(onset.t_us - onset.first_us) * 1e-3,
                collision=collision,
                onset=onset,
                lock_mode=self._lock_mode,
            )
        )

    def _handle_peak(self, record: ImpactPeak) -> None:
        impact = self._newest()
        if impact is not None:
            impact.peak, impact.clipped = record, record.clipped
            impact.measured.peak_force_n = record.normal_force_n
        elif self._others:
            self._others[-1].peak_force_n = record.normal_force_n

    def _handle_body(self, record: ImpactBody) -> None:
        impact = self._newest()
        if impact is not None:
            impact.measured.contact_side = record.side
            impact.measured.incidence_deg = math.degrees(record.incidence_rad)
            impact.measured.peak_torque_nm = record.peak_torque_nm

    def _handle_end(self, record: ContactEnd) -> None:
        if not self.impacts or self.impacts[-1].contact_time_ms is not None:
            return
        impact, self._left_us = self.impacts[-1], record.t_us
        impact.contact_time_ms = (record.t_us - record.first_us) * 1e-3
        if impact.lock is not None and self._relaxation_us is not None:
            impact.lock.contact_end_us = record.t_us
            impact.lock.relaxed_us = record.t_us + self._relaxation_us

    def _handle_wall_estimate(self, record: WallEstimate) -> None:
        impact = self._newest()
        if impact is not None and impact.lock is not None and impact.onset.first_us == record.first_us:
            impact.mode_felt, impact.mode_log_odds = record.mode_felt, record.log_odds

    def _handle_odometry(self, record: OdometrySample) -> None:
        frame = self._anchor.frame
        if frame is not None and self._left_us is not None and record.t_us >= self._left_us:
            self._left_us, impact = None, self.impacts[-1]
            velocity = frame.vector_from_ned(record.velocity_ned)
            normal, tangential, _ = impact.collision.wall.to_collision(velocity)
            impact.measured.normal_out_m_s, impact.measured.tangential_out_m_s = normal, tangential

    def _handle_setpoint(self, record: Setpoint) -> None:
        impact = self._newest() if record.recovery else None
        if impact is not None and impact.recovery is None and self._anchor.frame is not None:
            impact.recovery = self._anchor.frame.point_from_ned(record.position_ned)

    def _handle_sent(self, record: SetpointSent) -> None:
        if self.impacts and self.impacts[-1].setpoint_latency_ms is None:
            self.impacts[-1].setpoint_latency_ms = record.latency_us * 1e-3

    def _handle_lock(self, record: LockState) -> None:
        self._lock_mode = record.mode if record.phase is LockPhase.SETTLED else None
        times = self.impacts[-1].lock if self.impacts else None
        if times is None or times.contact_end_us is None or (record.commanded_us or 0) < times.contact_end_us:
            return
        if times.commanded_us is None:
            times.commanded_us = record.commanded_us
        if record.phase is LockPhase.SETTLED and times.settled_us is None:
            times.settled_us = record.settled_us


def _true_velocities(true: TruthContact) -> Velocities:
    return Velocities(
        true.normal_in_m_s,
        true.tangential_in_m_s,
        true.peak_normal_force_n,
        ContactSide.from_lead(true.lead_m),
        math.degrees(true.incidence_rad),
        true.peak_torque_nm,
        true.normal_out_m_s,
        true.tangential_out_m_s,
    )
