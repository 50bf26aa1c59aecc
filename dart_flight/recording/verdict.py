"""The verdict on a flight: a pure function of its records (decisions, samples, truth).

Every world, `--json`, the terminal and the report use only this verdict. For a recorded flight use
`verdict_of`. During a flight, pass every record to `VerdictBuilder.add`, in order, and then call `build`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.geometry import Vec3, tilt_of
from dart_flight.base.records import (
    AttitudeSample,
    EstimatorSample,
    FrameAnchor,
    GoalPassed,
    GuardEvent,
    ImuSample,
    LockPhase,
    LockState,
    MissionEnd,
    Mode,
    OdometrySample,
    Outcome,
    Phase,
    PhaseChange,
    Tick,
    TruthContact,
    TruthSample,
    WallEstimate,
    World,
)
from dart_flight.config.mission import Mission
from dart_flight.config.provenance import VehicleSource
from dart_flight.core.guard.estimator_resets import EstimatorReset, EstimatorResets
from dart_flight.core.mission.phases import ON_GROUND
from dart_flight.recording.about import flown_mission
from dart_flight.recording.anchor import MissionFrameReader
from dart_flight.recording.flown_impact import CollisionVerdict, FlownImpact, ImpactCollector, OtherContact
from dart_flight.recording.found import PX4_LOG
from dart_flight.recording.measured_walls import MeasuredWall, WallMeasurements
from dart_flight.recording.plan_versus_flight import Deviation, deviations, predict_flight
from dart_flight.recording.reader import IN_MEMORY, Log
from dart_flight.recording.uncontrolled import TruthExtremes, find_uncontrolled

_TICK_US = 20_000
_KEPT = 1024  # maximum number of estimates or true positions that wait for a counterpart: 8 s at 125 Hz


class ResetFigures(msgspec.Struct):
    """One reset of PX4's estimator.

    Each figure is the largest step of one estimate within 0.1 s of the change of PX4's reset counter.

    Attributes:
        position_m: step of the estimated position, relative to its prediction from the previous sample.
        velocity_m_s: step of the estimated velocity.
        heading_deg: step of the heading, minus the rotation that the gyro measured; positive clockwise seen
            from above.
    """

    t_us: int
    position_m: float
    velocity_m_s: float
    heading_deg: float


class Px4Figures(msgspec.Struct):
    """Figures from PX4's log for the time in which the vehicle was armed.

    Attributes:
        version: version of PX4, or None if not reported.
        ekf_resets: number of resets of position and velocity.
        clipped_samples: accelerometer samples at full scale, sum of the three axes.
        failsafe: whether a failsafe of PX4 was active at any time.
        attitude_failure: whether PX4's failure detector reported an attitude failure.
    """

    version: str | None = None
    ekf_resets: int | None = None
    clipped_samples: int | None = None
    failsafe: bool | None = None
    attitude_failure: bool | None = None


class TimeKind(StrEnum):
    """The clock of a simulated world."""

    LOCKSTEP = "lockstep"  # simulated time waits for the application
    REALTIME = "realtime"  # simulated time does not wait for the application
    SIMULATED = "simulated"  # simulated time; core and vehicle run in one process


class Verdict(msgspec.Struct):
    """The result of a flight in one object (`docs/interfaces.md`); unknown values are null."""

    mission: str
    world: World | None
    seed: int | None
    outcome: Outcome
    reason: str | None
    collisions: list[CollisionVerdict]
    guard: list[GuardEvent]
    goal_miss_m: float | None = None
    final_error_m: float | None = None
    max_tilt_deg: float | None = None
    flight_time_s: float | None = None
    log: str | None = None
    log_failure: str | None = None  # missing part of the log, with the reason
    own_lateness_ms: float | None = None  # worst scheduling latency of the program; None if not measured
    px4_log: str | None = None
    ekf_error_m: float | None = None  # largest distance between estimated and true position, in the air
    px4: Px4Figures | None = None
    drawn: dict[str, float | str] = msgspec.field(default_factory=dict)  # simulated world (`--vary`)
    vehicle: VehicleSource | None = None
    plan_followed: bool | None = None  # None without a prediction, as in a rehearsal
    goal_reached: bool | None = None  # within the capture radius; None if the log lacks the end
    goal_miss_planned_m: float | None = None  # None if unknown, or if the vehicle flies to the goal from rest
    deviations: list[Deviation] = msgspec.field(default_factory=list)
    walls: list[MeasuredWall] = msgspec.field(default_factory=list)  # as measured by the contacts
    estimator_resets: list[ResetFigures] = msgspec.field(default_factory=list)  # in the air
    arms_moved: bool | None = None  # whether simulated arms followed the lock; None if the lock never moved
    time: TimeKind | None = None  # None for a real vehicle
    speed: float | None = None  # achieved real-time factor
    uncontrolled: list[str] = msgspec.field(default_factory=list)  # reasons, found in the ground truth
    other_contacts: list[OtherContact] = msgspec.field(default_factory=list)  # contacts that were not planned


class PositionError:
    """Largest distance between the estimated and the true position at the same stamp, mission frame, metres.

    The true position is interpolated between two samples. Estimate and truth arrive on separate threads, in
    either order. Each estimate waits until a true position of the same or a later time arrives. At most
    `_KEPT` samples wait, so memory is bounded.
    """

    def __init__(self) -> None:
        self.worst_m: float | None = None
        self._estimates: deque[tuple[int, Vec3]] = deque(maxlen=_KEPT)
        self._truths: deque[tuple[int, Vec3]] = deque(maxlen=_KEPT)

    def add_estimate(self, t_us: int, position: Vec3) -> None:
        self._estimates.append((t_us, position))

    def add_truth(self, t_us: int, position: Vec3) -> None:
        truths, estimates = self._truths, self._estimates
        if truths and t_us <= truths[-1][0]:
            truths.clear()  # the clock jumped back
        truths.append((t_us, position))
        while estimates and estimates[0][0] <= t_us:
            self._compare(*estimates.popleft())

    def _compare(self, t_us: int, estimated: Vec3) -> None:
        after = None
        for before in reversed(self._truths):
            if after is not None and before[0] <= t_us <= after[0]:
                (t0, a), (t1, b) = before, after
                share = (t_us - t0) / (t1 - t0)
                true = (
                    a[0] + share * (b[0] - a[0]),
                    a[1] + share * (b[1] - a[1]),
                    a[2] + share * (b[2] - a[2]),
                )
                error = math.dist(estimated, true)
                self.worst_m = error if self.worst_m is None else max(self.worst_m, error)
                return
            after = before


class VerdictBuilder:
    """Builds the verdict of one flight from its records, in order."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._so_far = Verdict(  # a flight without an end counts as aborted
            mission.name, None, None, Outcome.ABORTED, "program terminated during the flight", [], []
        )
        self.end: MissionEnd | None = None
        self._phase = Phase.READYING
        self._airborne_us: int | None = None
        self._landed_us: int | None = None
        self._anchor = MissionFrameReader(mission)
        self._impacts = ImpactCollector(mission, self._anchor)
        self._walls = WallMeasurements(mission)
        self._position_error = PositionError()
        self._estimator = EstimatorResets()
        self._resets: list[EstimatorReset] = []
        self._extremes = TruthExtremes(mission.bounds)
        self._tilt_rad: float | None = None
        self._ticked_us: int | None = None
        self._late_us: int | None = None  # largest delay of a tick after its due time
        self._settled: set[Mode] = set()
        self._true_modes: set[Mode] = set()
        anchor, walls = self._anchor.add, self._walls.add
        # Handlers by kind of record, so that one look-up skips the many irrelevant records.
        self.handlers = _merge_handlers(
            {OdometrySample: anchor, PhaseChange: anchor, FrameAnchor: anchor},
            {WallEstimate: walls, TruthContact: walls, FrameAnchor: walls},
            self._impacts.handlers,
            {
                ImuSample: self._estimator.add_imu,
                EstimatorSample: self._handle_estimator,
                AttitudeSample: self._handle_attitude,
                OdometrySample: self._handle_odometry,
                TruthSample: self._handle_truth,
                PhaseChange: self._handle_phase,
                LockState: self._handle_lock,
                GuardEvent: self._so_far.guard.append,
                GoalPassed: self._handle_passed,
                MissionEnd: self._handle_end,
                Tick: self._handle_tick,
            },
        )

    def add(self, record: Any) -> None:
        handler = self.handlers.get(type(record))
        if handler is not None:
            handler(record)

    @property
    def _is_airborne(self) -> bool:
        return self._airborne_us is not None and self._landed_us is None

    def _handle_estimator(self, record: EstimatorSample) -> None:
        counter, flies = record.reset_counter, self._is_airborne
        if counter is not None and self._estimator.update_counter(counter, record.t_us) and flies:
            assert self._estimator.newest is not None
            self._resets.append(self._estimator.newest)

    def _handle_attitude(self, record: AttitudeSample) -> None:
        self._estimator.add_attitude(record)
        if self._is_airborne:
            self._tilt_rad = max(self._tilt_rad or 0.0, tilt_of(record.q_frd_to_ned))

    def _handle_tick(self, record: Tick) -> None:
        if self._ticked_us is not None and self.end is None:
            late_us = max(0, record.host_us - self._ticked_us - _TICK_US)
            self._late_us = max(self._late_us or 0, late_us)
        self._ticked_us = record.host_us

    def _handle_truth(self, record: TruthSample) -> None:
        self._position_error.add_truth(record.t_us, record.position_mission)
        self._true_modes.add(record.mode)
        self._extremes.update(record)

    def _handle_passed(self, record: GoalPassed) -> None:
        self._so_far.goal_miss_m = record.miss_m

    def _handle_end(self, record: MissionEnd) -> None:
        so_far, self.end = self._so_far, record
        so_far.outcome, so_far.reason, so_far.final_error_m = (
            record.outcome,
            record.reason,
            record.final_error_m,
        )
        if self._airborne_us is not None:
            self._landed_us = record.t_us
            so_far.flight_time_s = (record.t_us - self._airborne_us) * 1e-6

    def _handle_odometry(self, record: OdometrySample) -> None:
        self._estimator.add_odometry(record)
        frame = self._anchor.frame
        if frame is not None and self._is_airborne:
            self._position_error.add_estimate(record.t_us, frame.point_from_ned(record.position_ned))

    def _handle_phase(self, record: PhaseChange) -> None:
        if self._phase in ON_GROUND and record.after is Phase.CLIMB:
            self._airborne_us = record.t_us
        self._phase = record.after

    def _handle_lock(self, record: LockState) -> None:
        if record.phase is LockPhase.SETTLED and record.mode is not None:
            self._settled.add(record.mode)

    def impacts(self) -> list[FlownImpact]:
        self._impacts.match_truth()
        return self._impacts.impacts

    def build(
        self,
        world: World | None,
        seed: int | None,
        log: str | None = None,
        px4_log: str | None = None,
        drawn: Mapping[str, float | str] | None = None,
    ) -> Verdict:
        """Return the verdict on the records so far; a flight without an end counts as aborted.

        `drawn` contains random values of the simulated world.
        """
        planned, impacts, so_far = predict_flight(self._mission), self.impacts(), self._so_far
        for impact in impacts:
            impact.planned = planned.velocities[impact.index]
        differ = deviations(self._mission, planned, impacts, so_far.goal_miss_m)
        return msgspec.structs.replace(
            so_far,
            world=world,
            seed=seed,
            collisions=[impact.verdict() for impact in impacts],
            other_contacts=self._impacts.other_contacts(),
            max_tilt_deg=None if self._tilt_rad is None else math.degrees(self._tilt_rad),
            log=log,
            px4_log=px4_log,
            own_lateness_ms=None if self._late_us is None else self._late_us * 1e-3,
            ekf_error_m=self._position_error.worst_m,
            vehicle=self._mission.flown_vehicle(),
            plan_followed=(
                so_far.outcome is Outcome.COMPLETED and all(one.within for one in differ) if differ else None
            ),
            deviations=differ,
            drawn=dict(drawn or {}),
            walls=self._walls.build(self.end.t_us if self.end else 0, drawn or {}),
            arms_moved=self._arms_moved(),
            time=TimeKind.SIMULATED if world is World.FAST else None,
            estimator_resets=[
                ResetFigures(r.t_us, r.position_m, r.velocity_m_s, math.degrees(r.heading_rad))
                for r in self._resets
            ],
            uncontrolled=self._find_uncontrolled(),
            goal_reached=self._goal_reached(),
            goal_miss_planned_m=planned.goal_miss_m if self._mission.standoff_m is None else None,
        )

    def _goal_reached(self) -> bool | None:
        """Return whether the vehicle came within the goal's capture radius, or None before the flight's end.

        If the vehicle passed the goal, the miss distance decides. Otherwise, after a completed flight, the
        final distance decides.
        """
        if self.end is None:
            return None
        nearest_m = self._so_far.goal_miss_m
        if nearest_m is None and self.end.outcome is Outcome.COMPLETED:
            nearest_m = self.end.final_error_m
        return nearest_m is not None and nearest_m <= self._mission.goal.capture_radius_m

    def _find_uncontrolled(self) -> list[str]:
        if self._extremes.last is None:
            return []
        completed = self._so_far.outcome is Outcome.COMPLETED
        return list(find_uncontrolled(self._extremes, completed, bool(self._so_far.reason)))

    def _arms_moved(self) -> bool | None:
        if len(self._settled) < len(Mode) or not self._true_modes:
            return None
        return len(self._true_modes) == len(Mode)


def _merge_handlers(*parts: Mapping[type, Callable[[Any], None]]) -> dict[type, Callable[[Any], None]]:
    """Return one function for each kind of record; the function calls the handlers of all parts in order."""
    by_kind: dict[type, list[Callable[[Any], None]]] = {}
    for part in parts:
        for kind, handler in part.items():
            by_kind.setdefault(kind, []).append(handler)
    return {
        kind: handlers[0] if len(handlers) == 1 else _chain(handlers) for kind, handlers in by_kind.items()
    }


def _chain(handlers: Sequence[Callable[[Any], None]]) -> Callable[[Any], None]:
    def handle(record: Any) -> None:
        for handler in handlers:
            handler(record)

    return handle


def evaluate(log: Log) -> tuple[Verdict, list[FlownImpact]]:
    """Return the verdict on a recorded flight, and its impacts.

    The verdict equals the verdict at the end of the flight. Two values differ, because the log does not
    contain them: `px4` and the reason for missing records. A log without its mission raises InputError.
    """
    builder = VerdictBuilder(flown_mission(log.about, log.source))
    for entry in log.entries:
        builder.add(entry.record)
    beside = Path(log.source).with_name(PX4_LOG)
    source = None if log.source == IN_MEMORY else log.source
    drawn = msgspec.json.decode(log.about["drawn"]) if "drawn" in log.about else {}
    verdict = builder.build(log.world, log.seed, source, str(beside) if beside.exists() else None, drawn)
    return verdict, builder.impacts()


def verdict_of(log: Log) -> Verdict:
    """Return the verdict on a recorded flight; raise the same errors as `evaluate`."""
    return evaluate(log)[0]
