"""The planned collisions of a flight as they were flown: `FlownImpact`, put together by `ImpactCollector`.

Verdict, deviations, report, figures and animation read a flight's impacts here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import (
    ContactEnd,
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

_TRUTH_MATCH_US = 60_000  # an impact and its truth lie this near in time


class LockTimes(msgspec.Struct):
    """The lock's switch that follows a collision, autopilot time."""

    contact_end_us: int | None = None
    relaxed_us: int | None = None
    commanded_us: int | None = None
    settled_us: int | None = None


class FlownImpact(msgspec.Struct):
    """A planned collision as it was flown: its records, each None if the flight does not have it.

    Attributes:
        collision: the collision that was planned.
        onset, peak, body, end: as the flight core measured them.
        lock_mode: mode in which the lock was settled at the onset; rigid without a lock.
        lock: times of the switch that follows; None without a lock.
        wall_estimate: fit of this contact.
        truth: the simulated contact.
        recovery: recovery setpoint, mission frame, metres.
        setpoint_latency_ms: from the sample that triggered the recovery to its setpoint leaving.
        velocity_out: normal and tangential velocity by the first odometry after the contact, m/s.
    """

    collision: Collision
    onset: ImpactOnset
    lock_mode: Mode | None
    lock: LockTimes | None
    peak: ImpactPeak | None = None
    body: ImpactBody | None = None
    end: ContactEnd | None = None
    wall_estimate: WallEstimate | None = None
    truth: TruthContact | None = None
    recovery: Vec3 | None = None
    setpoint_latency_ms: float | None = None
    velocity_out: Vec2 | None = None

    @property
    def velocity(self) -> Vec2:
        """Normal and tangential velocity, the last before the contact, m/s."""
        normal, tangential, _ = self.collision.wall.to_collision(self.onset.velocity_mission)
        return normal, tangential

    @property
    def peak_force_n(self) -> float | None:
        """Measured peak of the normal force."""
        return None if self.peak is None else self.peak.normal_force_n

    @property
    def force(self) -> Vec2 | None:
        """Measured peaks of normal force and friction as a vector, mission frame, newton."""
        if self.peak is None:
            return None
        peaks = self.peak.normal_force_n, self.peak.tangential_force_n, 0.0
        x, y, _ = self.collision.wall.from_collision(peaks)
        return x, y

    @property
    def contact_time_ms(self) -> float | None:
        """Measured contact time."""
        return None if self.end is None else (self.end.t_us - self.end.first_us) * 1e-3

    @property
    def mode_felt(self) -> Mode | None:
        """Mode that the whole contact indicates (docs/felt.md), or None if undecided or without a lock."""
        return None if self.wall_estimate is None or self.lock is None else self.wall_estimate.mode_felt

    @property
    def mode_log_odds(self) -> float | None:
        """Log odds of rigid against flexible, likewise."""
        return None if self.wall_estimate is None or self.lock is None else self.wall_estimate.log_odds


class ImpactCollector:
    """Puts the impacts of one flight together from its records, in order.

    Attributes:
        impacts: so far, in the order flown.
        takers: functions that take a record, by its kind.

    Args:
        mission: the mission flown.
        anchor: reader of the mission frame; takes each record before the collector does.
    """

    def __init__(self, mission: Mission, anchor: MissionFrameReader) -> None:
        self._mission, self._anchor = mission, anchor
        lock = mission.vehicle.lock
        self._relaxation_us = None if lock is None else round(lock.relaxation_s * 1e6)
        self._sought = {c.wall.name for c in mission.collisions if c.wall.sought}  # by names of their own
        self.impacts: list[FlownImpact] = []
        self._truths: list[TruthContact] = []
        self._onset: ImpactOnset | None = None
        self._lock_mode: Mode | None = Mode.RIGID if lock is None else None
        self._left_us: int | None = None  # end of the last contact, until the velocity after it is known
        self.takers: dict[type, Callable[[Any], None]] = {
            ImpactOnset: self._take_onset,
            PhaseChange: self._take_phase,
            ImpactPeak: self._take_peak,
            ImpactBody: self._take_body,
            ContactEnd: self._take_end,
            WallEstimate: self._take_wall_estimate,
            OdometrySample: self._take_odometry,
            Setpoint: self._take_setpoint,
            SetpointSent: self._take_sent,
            LockState: self._take_lock,
            TruthContact: self._truths.append,
        }

    def match_truth(self) -> None:
        """Give every impact the simulated contact at its wall that lies nearest in time, if there is one."""
        for impact in self.impacts:
            at_us, wall = impact.onset.t_us, impact.collision.wall.name
            near = [
                t
                for t in self._truths
                if (t.wall == wall or wall in self._sought)
                and t.t_us - _TRUTH_MATCH_US <= at_us <= t.end_us + _TRUTH_MATCH_US
            ]
            impact.truth = min(near, key=lambda t: abs(t.t_us - at_us), default=None)

    def _newest(self) -> FlownImpact | None:
        """Return the impact of the last onset, or None if that was no planned collision."""
        return self.impacts[-1] if self.impacts and self.impacts[-1].onset is self._onset else None

    def _take_onset(self, record: ImpactOnset) -> None:
        self._onset = record

    def _take_phase(self, record: PhaseChange) -> None:
        if record.after is Phase.CONTACT and record.collision is not None and self._onset is not None:
            collision = self._mission.collisions[record.collision - 1]
            times = None if self._relaxation_us is None else LockTimes()
            self.impacts.append(FlownImpact(collision, self._onset, self._lock_mode, times))

    def _take_peak(self, record: ImpactPeak) -> None:
        impact = self._newest()
        if impact is not None:
            impact.peak = record

    def _take_body(self, record: ImpactBody) -> None:
        impact = self._newest()
        if impact is not None:
            impact.body = record

    def _take_end(self, record: ContactEnd) -> None:
        if not self.impacts or self.impacts[-1].end is not None:
            return
        impact = self.impacts[-1]
        impact.end, self._left_us = record, record.t_us
        if impact.lock is not None and self._relaxation_us is not None:
            impact.lock.contact_end_us = record.t_us
            impact.lock.relaxed_us = record.t_us + self._relaxation_us

    def _take_wall_estimate(self, record: WallEstimate) -> None:
        impact = self._newest()
        if impact is not None and impact.onset.first_us == record.first_us:
            impact.wall_estimate = record

    def _take_odometry(self, record: OdometrySample) -> None:
        frame = self._anchor.frame
        if frame is not None and self._left_us is not None and record.t_us >= self._left_us:
            self._left_us, impact = None, self.impacts[-1]
            velocity = frame.vector_from_ned(record.velocity_ned)
            normal, tangential, _ = impact.collision.wall.to_collision(velocity)
            impact.velocity_out = normal, tangential

    def _take_setpoint(self, record: Setpoint) -> None:
        impact = self._newest() if record.recovery else None
        if impact is not None and impact.recovery is None and self._anchor.frame is not None:
            impact.recovery = self._anchor.frame.point_from_ned(record.position_ned)

    def _take_sent(self, record: SetpointSent) -> None:
        if self.impacts and self.impacts[-1].setpoint_latency_ms is None:
            self.impacts[-1].setpoint_latency_ms = record.latency_us * 1e-3

    def _take_lock(self, record: LockState) -> None:
        self._lock_mode = record.mode if record.phase is LockPhase.SETTLED else None
        times = self.impacts[-1].lock if self.impacts else None
        if times is None or times.contact_end_us is None or (record.commanded_us or 0) < times.contact_end_us:
            return
        if times.commanded_us is None:
            times.commanded_us = record.commanded_us
        if record.phase is LockPhase.SETTLED and times.settled_us is None:
            times.settled_us = record.settled_us
