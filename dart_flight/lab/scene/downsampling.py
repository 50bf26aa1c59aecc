"""Which records a picture of a flight needs, and how often: what is left out before anything is encoded."""

from __future__ import annotations

from collections.abc import Iterable

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import (
    AttitudeSample,
    ContactEnd,
    ForceEstimate,
    GoalPassed,
    GuardEvent,
    HealthReport,
    ImpactOnset,
    ImpactPeak,
    LockState,
    MissionEnd,
    OdometrySample,
    PhaseChange,
    PlanAnswer,
    PlanTaken,
    Record,
    Setpoint,
    StatusSample,
    StatusText,
    TruthContact,
    TruthSample,
)

SCENE_US = 36_000  # scene and transforms: 28 Hz at most
SCALARS_US = 20_000  # plots: 50 Hz at most

# Of these the newest of a period is as good as any.
_EVERY: dict[type[Record], int] = {OdometrySample: SCENE_US, AttitudeSample: SCENE_US, Setpoint: SCENE_US}
# Of these the strongest of a period is kept: a peak of a few milliseconds must not fall through.
_STRONGEST = (ForceEstimate, TruthSample)
_ALL: frozenset[type[Record]] = frozenset(
    {
        ContactEnd,
        GoalPassed,
        GuardEvent,
        HealthReport,
        ImpactOnset,
        ImpactPeak,
        LockState,
        MissionEnd,
        PhaseChange,
        PlanAnswer,
        PlanTaken,
        StatusSample,
        StatusText,
        TruthContact,
    }
)
WANTED: frozenset[type[Record]] = frozenset({*_ALL, *_EVERY, *_STRONGEST})


class Downsampler:
    """Takes the records of a flight in order and gives on those that a picture of it needs.

    Periods are of the autopilot's time. A sample that is kept for its strength comes out when its period is
    over, behind records that are up to a period younger.
    """

    def __init__(self) -> None:
        self._last_us: dict[type[Record], int] = {}
        self._held: dict[type[Record], tuple[int, float, Record]] = {}

    def take(self, record: Record) -> Iterable[Record]:
        """What goes on now: nothing, or one record."""
        kind = type(record)
        if kind in _ALL:
            return (record,)
        if isinstance(record, ForceEstimate):
            return self._strongest(record, record.t_us, record.force_mission)
        if isinstance(record, TruthSample):
            return self._strongest(record, record.t_us, record.contact_force_mission)
        period = _EVERY.get(kind)
        if period is None:
            return ()
        t_us: int = record.t_us  # type: ignore[attr-defined]
        if isinstance(record, Setpoint) and record.recovery:
            return (record,)
        if 0 <= t_us - self._last_us.get(kind, -period) < period:
            return ()
        self._last_us[kind] = t_us
        return (record,)

    def _strongest(self, record: Record, t_us: int, force: Vec3) -> Iterable[Record]:
        x, y, z = force
        strength = x * x + y * y + z * z
        kind = type(record)
        held = self._held.get(kind)
        if held is not None and 0 <= t_us - held[0] < SCALARS_US:
            if strength > held[1]:
                self._held[kind] = (held[0], strength, record)
            return ()
        self._held[kind] = (t_us, strength, record)
        return () if held is None else (held[2],)
