"""Selection of the records that a display of a flight needs, applied before anything is encoded."""

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

SCENE_US = 36_000  # period of scene and transforms: at most 28 Hz
SCALARS_US = 20_000  # period of plots: at most 50 Hz

# One record of each of these kinds is enough per period.
_EVERY: dict[type[Record], int] = {OdometrySample: SCENE_US, AttitudeSample: SCENE_US, Setpoint: SCENE_US}
# Of these records, the strongest in a period is kept, so that a peak of a few milliseconds stays visible.
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
    """A filter that receives the records of a flight in order and passes on those that a display needs.

    Periods are measured in the autopilot's time. At the end of each period, the filter passes on the period's
    strongest force sample. Newer records of other kinds may therefore precede this sample.
    """

    def __init__(self) -> None:
        self._last_us: dict[type[Record], int] = {}
        self._held: dict[type[Record], tuple[int, float, Record]] = {}

    def select(self, record: Record) -> Iterable[Record]:
        """Return the records to pass on (at most one)."""
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
