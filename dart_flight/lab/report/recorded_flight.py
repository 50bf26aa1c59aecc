"""What a report says of one flight: everything computed, nothing drawn."""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np

from dart_flight.base.records import (
    ClockOffset,
    ContactEnd,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    PlanAnswer,
    PlanRequest,
    PlanTaken,
    Setpoint,
    SetpointSent,
    StatusSample,
    TruthContact,
    World,
)
from dart_flight.config.mission import Collision, Mission
from dart_flight.contact.law import Onset
from dart_flight.core.mission.approach import transit_segments
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.lab.flight_arrays import Array, FlightArrays
from dart_flight.lab.predict.path import ContactMotion, HitHistory, trajectory
from dart_flight.planning.predicted_flight import PredictedFlight, predict_mission
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import CollisionVerdict, Velocities, Verdict, verdict_of
from dart_flight.run.replay import Replay, replay

_STEP_S = 0.0005
_SHOWN_BEFORE_S, _SHOWN_AFTER_S = 0.05, 0.2
_MIN_M_S = 0.05
_MIN_FRICTION_N = 5.0
_FRICTION = "peak friction force"
_WAY_POINTS = 60


class Compared(msgspec.Struct):
    """One quantity of a collision, from every source that has it; None where it has not.

    Attributes:
        name, unit: what it is.
        planned: by the mission and the flight model.
        predicted: by the contact law at the measured velocity.
        measured: by the flight core, or from PX4's estimate.
        true: of the simulated vehicle.
    """

    name: str
    unit: str
    planned: float | None
    predicted: float | None
    measured: float | None
    true: float | None

    @property
    def error_percent(self) -> float | None:
        """Of the measured value, against the true one where there is one, else predicted, else planned.

        None of a velocity near 0, where a share says nothing.
        """
        sources = (self.true, self.predicted, self.planned)
        reference = next((v for v in sources if v is not None), None)
        least = _MIN_M_S if self.unit == "m/s" else 0.0
        if self.measured is None or reference is None or abs(reference) <= least:
            return None
        return 100.0 * (self.measured / reference - 1.0)


class Impact:
    """One collision of a flight: the verdict on it and what the contact law predicts for it.

    Attributes:
        index, wall, mode, material: which.
        verdict: planned, measured and true.
        at_s: detection, seconds of the flight's `FlightArrays`.
        planned: the verdict's.
        peak: the measured peaks; None where there were none.
        prediction: the contact law at the measured velocity, in time since its onset.
        onset_s: when the predicted contact begins: so that its peak is where the measured one is; where none
            was measured, so that its force reaches the threshold at `at_s`.
        predicted_n: its peak normal force.
        compared: planned, predicted, measured and true figures.

    Args:
        verdict: on this collision.
        flight: with its mission, course and plan.
    """

    def __init__(self, verdict: CollisionVerdict, flight: RecordedFlight) -> None:
        mission, course = flight.mission, flight.course
        self.verdict = verdict
        self.collision: Collision = mission.collisions[verdict.index - 1]
        at_s = self.at_s = course.time_of(verdict.t_us)
        self.material = self.collision.wall.material
        self.planned = verdict.planned
        self.peak = _peak_after(course, verdict.t_us)
        self._truth = _truth_near(course, verdict)
        self.prediction: HitHistory | None = None
        self.predicted_n: float | None = None
        self.onset_s = at_s
        self._predict(mission)
        if self.peak is not None and self._contact is not None:
            self.onset_s = course.time_of(self.peak.t_us) - self._contact.peak_s
        self.compared = self._compare(course)

    def _predict(self, mission: Mission) -> None:
        self._contact: ContactMotion | None = None
        measured = self.verdict.measured
        normal, tangential = measured.normal_m_s, measured.tangential_m_s
        if normal is None or tangential is None or normal >= 0.0:
            return
        vehicle = mission.vehicle
        coefficients = vehicle.materials[self.material].of(self.collision.mode)
        contact = ContactMotion(coefficients, vehicle.airframe.mass_kg, normal, Onset(vehicle.onset))
        time = np.arange(-_SHOWN_BEFORE_S, _SHOWN_AFTER_S, _STEP_S)
        path = trajectory(contact, time, tangential, vehicle.vertical_force_sign)
        self._contact, self.prediction = contact, path
        self.predicted_n = float(path.normal_force_n.max())
        horizontal = np.hypot(path.normal_force_n, path.tangential_force_n)
        over = np.flatnonzero(horizontal >= vehicle.detection.force_threshold_n)
        if over.size:
            self.onset_s = self.at_s - float(time[over[0]])

    def _compare(self, course: FlightArrays) -> list[Compared]:
        """The rows of the report's table."""
        v, plan, truth, peak = self.verdict, self.planned, self._truth, self.peak
        true = v.truth if v.truth is not None else Velocities()
        out = self._measured_out(course)
        predicted = self._predicted_out()
        friction = (
            None if self.prediction is None else float(np.abs(self.prediction.tangential_force_n).max())
        )
        duration = None if truth is None else (truth.end_us - truth.t_us) * 1e-3
        return [
            Compared("normal velocity", "m/s", plan.normal_m_s, None, v.measured.normal_m_s, true.normal_m_s),
            Compared(
                "tangential velocity", "m/s", plan.tangential_m_s, None, v.measured.tangential_m_s,
                true.tangential_m_s,
            ),
            Compared(
                "peak normal force", "N", plan.peak_force_n, self.predicted_n, v.measured.peak_force_n,
                true.peak_force_n,
            ),
            Compared(
                _FRICTION, "N", None, friction,
                None if peak is None else abs(peak.tangential_force_n),
                None if truth is None else abs(truth.peak_friction_force_n),
            ),
            Compared("contact time", "ms", None, predicted[2], v.contact_time_ms, duration),
            Compared(
                "normal velocity out", "m/s", None, predicted[0], out[0],
                None if truth is None else truth.normal_out_m_s,
            ),
            Compared(
                "tangential velocity out", "m/s", None, predicted[1], out[1],
                None if truth is None else truth.tangential_out_m_s,
            ),
        ]  # fmt: skip

    def _predicted_out(self) -> tuple[float | None, float | None, float | None]:
        """Normal and tangential velocity at the release, m/s, and the contact time, ms."""
        contact, tangential = self._contact, self.verdict.measured.tangential_m_s
        if contact is None or tangential is None or not math.isfinite(contact.end_s):
            return None, None, None
        end = np.array([contact.end_s])
        slowed = math.exp(-contact.coefficients.mu * float(contact.impulse(contact.end_s)) / contact.mass_kg)
        return float(contact.normal(end)[1][0]), tangential * slowed, 1e3 * contact.end_s

    def _measured_out(self, course: FlightArrays) -> tuple[float | None, float | None]:
        """Normal and tangential velocity by PX4's estimate when the force was gone, m/s."""
        ends = (e.t_us for e in course.all(ContactEnd) if e.t_us >= self.verdict.t_us)
        end_us, motion = next(ends, None), course.estimated
        if end_us is None or not motion.time_s.size:
            return None, None
        at = course.time_of(end_us)
        x, y, z = (float(np.interp(at, motion.time_s, motion.velocity[:, i])) for i in range(3))
        normal, tangential, _ = self.collision.wall.to_collision((x, y, z))
        return normal, tangential

    @property
    def title(self) -> str:
        """Which collision, in words."""
        return f"Collision {self.verdict.index}: {self.verdict.wall}, {self.verdict.mode}"

    @property
    def disagreement(self) -> float | None:
        """Measured over predicted peak normal force, minus one; None where one is unknown or clipped."""
        measured = self.verdict.measured.peak_force_n
        if measured is None or not self.predicted_n or self.verdict.clipped:
            return None
        return measured / self.predicted_n - 1.0

    @property
    def friction_disagreement(self) -> float | None:
        """Likewise of the friction force; None also where it is too small to tell."""
        friction = next(c for c in self.compared if c.name == _FRICTION)
        if friction.measured is None or friction.predicted is None or self.verdict.clipped:
            return None
        return friction.measured / friction.predicted - 1.0 if friction.predicted >= _MIN_FRICTION_N else None

    @property
    def force_error(self) -> float | None:
        """Measured over true peak normal force, minus one; None where one is unknown."""
        measured, truth = self.verdict.measured.peak_force_n, self.verdict.truth
        if measured is None or truth is None or not truth.peak_force_n:
            return None
        return measured / truth.peak_force_n - 1.0


class Timing(msgspec.Struct):
    """Latencies and jitter of a flight, milliseconds; arrays (n,).

    Attributes:
        setpoint_interval_ms: between the receipts of the samples that led to successive setpoints.
        imu_delay_ms: from the IMU's stamp to its receipt, by the clock estimate, less the least of them.
        recovery_ms: from the receipt of the sample that triggered a recovery to its setpoint leaving.
    """

    setpoint_interval_ms: Array
    imu_delay_ms: Array
    recovery_ms: Array


class RecordedFlight:
    """A recorded flight, judged again, and replayed where that is asked for.

    Raises:
        InputError: the log does not hold its mission.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self.mission = flown_mission(log.about, log.source)
        self.course = FlightArrays(log, self.mission)
        self.verdict: Verdict = verdict_of(log)
        self.planned: PredictedFlight = predict_mission(self.mission)
        self.impacts = [Impact(v, self) for v in self.verdict.collisions]
        self.timing = _timing(self.course)

    @cached_property
    def replay(self) -> Replay:
        """Whether the flight core decides again as it did; takes as long as the flight did to simulate."""
        return replay(self.log)

    @classmethod
    def read(cls, path: str | Path) -> RecordedFlight:
        """From a file.

        Raises:
            InputError: not a flight log, or without its mission.
        """
        return cls(read_log(path))

    @property
    def name(self) -> str:
        """How the flight is called among others."""
        folder = Path(self.log.source).resolve().parent.name
        return f"{folder} (seed {self.log.seed})" if self.log.seed is not None else folder

    def armed_utc(self) -> str | None:
        """When the vehicle was armed, by the host's calendar: PX4 names its own log by it."""
        about = self.log.about
        started, monotonic = about.get("started_utc"), about.get("started_monotonic_us", "")
        armed = next((s for s in self.course.all(StatusSample) if s.armed), None)
        if started is None or armed is None or not monotonic.isdigit() or self.log.world is World.FAST:
            return None
        try:
            moment = datetime.fromisoformat(started) + timedelta(
                microseconds=armed.received_us - int(monotonic)
            )
        except (ValueError, OverflowError):
            return None
        return moment.strftime("%Y-%m-%d %H:%M:%S UTC")

    def replanned(self) -> list[tuple[PlanRequest, PlanAnswer | None, PlanTaken | None]]:
        """What was asked of the planner in flight, what it answered, and what became of that."""
        answers = {a.number: a for a in self.course.all(PlanAnswer)}
        taken = {t.number: t for t in self.course.all(PlanTaken)}
        return [
            (request, answers.get(request.number), taken.get(request.number))
            for request in self.course.all(PlanRequest)
        ]

    def answered_ms(self, request: PlanRequest, answer: PlanAnswer) -> float | None:
        """How long an answer took, from the receipt of the sample that led to the request."""
        before = [s.received_us for s in self.course.all(ImuSample) if s.t_us <= request.t_us]
        return (answer.received_us - before[-1]) * 1e-3 if before else None

    def planned_trajectories(self) -> list[Array]:
        """The ways planned in flight that were flown: (n, 2), mission frame, metres."""
        found = []
        for _, answer, taken in self.replanned():
            if answer is not None and taken is not None and taken.taken and answer.x_mission:
                way = Trajectory.from_plan(answer, self.mission.altitude_m)
                times = np.linspace(0.0, answer.impact_s or answer.duration_s, _WAY_POINTS)
                found.append(np.array([way.at(float(t)).position[:2] for t in times]))
        return found

    def planned_lines(self) -> list[Array]:
        """The planned path from above: (n, 2), mission frame, metres."""
        planned = self.planned
        approaches = [np.array(line) for line in planned.approaches.values()]
        from_rest = [
            np.array([leg.begin[:2], leg.end[:2]])
            for leg in transit_segments(self.mission)
            if leg.begin is not None
        ]
        return [*approaches, *(leg[:, :2] for leg in planned.legs.values()), *from_rest]


def _peak_after(course: FlightArrays, onset_us: int) -> ImpactPeak | None:
    """The peaks of the impact whose onset was then."""
    last: int | None = None
    for record in course.records:
        if isinstance(record, ImpactOnset):
            last = record.t_us
        elif isinstance(record, ImpactPeak) and last == onset_us:
            return record
    return None


def _truth_near(course: FlightArrays, verdict: CollisionVerdict) -> TruthContact | None:
    """The simulated contact that the verdict's truth is of."""
    if verdict.truth is None:
        return None
    same = [t for t in course.all(TruthContact) if t.normal_in_m_s == verdict.truth.normal_m_s]
    return min(same, key=lambda t: abs(t.t_us - verdict.t_us), default=None)


def _timing(course: FlightArrays) -> Timing:
    received = np.array([s.trigger_received_us for s in course.all(Setpoint)], dtype=float)
    interval = np.diff(received) * 1e-3
    delays = []
    offset: int | None = None
    for record in course.records:
        if isinstance(record, ClockOffset):
            offset = record.offset_us
        elif isinstance(record, ImuSample) and offset is not None:
            delays.append((record.received_us + offset - record.t_us) * 1e-3)
    delay = np.array(delays, dtype=float)
    return Timing(
        interval[interval < 1e3],  # longer ones are pauses: not in offboard
        delay - delay.min() if delay.size else delay,
        np.array([s.latency_us * 1e-3 for s in course.all(SetpointSent)], dtype=float),
    )


def percentile(values: Array, share: float) -> float:
    """A percentile; NaN of nothing."""
    return float(np.percentile(values, share)) if values.size else math.nan
