"""The data of a report on one flight, computed from its log; `figures` draws the figures."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import (
    ClockOffset,
    ImuSample,
    Phase,
    PhaseChange,
    PlanAnswer,
    PlanRequest,
    PlanTaken,
    Setpoint,
    SetpointSent,
)
from dart_flight.contact.law import Onset
from dart_flight.core.mission.planned_impact import expected_hit
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.lab.flight_arrays import Array, FlightArrays
from dart_flight.lab.map_model import planned_lines
from dart_flight.lab.predict.path import ContactHistory, ContactMotion, trajectory
from dart_flight.lab.report.tracks import Angles, angles
from dart_flight.planning.predicted_flight import PredictedFlight, predict_mission
from dart_flight.recording.about import armed_span, flown_mission
from dart_flight.recording.flown_impact import FlownImpact, Velocities
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.verdict import evaluate
from dart_flight.run.replay import Replay, replay

_STEP_S = 0.0005
_SHOWN_BEFORE_S, _SHOWN_AFTER_S = 0.05, 0.2
_MIN_M_S = 0.05
_MIN_FRICTION_N = 5.0
_FRICTION = "peak friction force"
_PATH_POINTS = 60


class Compared(msgspec.Struct):
    """One quantity of a collision from every available source; a missing value is None.

    Attributes:
        planned: value from the mission and the flight model.
        predicted: value from the contact law at the measured velocity.
        measured: value from the flight core, or from PX4's estimate.
        true: value of the simulated vehicle.
    """

    name: str
    unit: str
    planned: float | None
    predicted: float | None
    measured: float | None
    true: float | None

    @property
    def error_percent(self) -> float | None:
        """The measured value's error relative to the first known of the true, predicted and planned values.

        It is None for a velocity near 0, because the ratio is meaningless.
        """
        sources = (self.true, self.predicted, self.planned)
        reference = next((v for v in sources if v is not None), None)
        least = _MIN_M_S if self.unit == "m/s" else 0.0
        if self.measured is None or reference is None or abs(reference) <= least:
            return None
        return 100.0 * (self.measured / reference - 1.0)


class Impact:
    """One impact of a flight, with the contact law's prediction for the measured velocity.

    Attributes:
        at_s: time of detection, s, counted as in `FlightArrays`.
        prediction: the predicted hit over time; its times count from the predicted onset.
        onset_s: time of the predicted onset, s, counted as in `FlightArrays`. The predicted and the measured
            peak coincide. If no peak was measured, the predicted force reaches the detection threshold at
            `at_s`.
        compared: planned, predicted, measured and true figures.
    """

    def __init__(self, impact: FlownImpact, flight: RecordedFlight) -> None:
        self.verdict, self.collision = impact, impact.collision
        self.material = self.collision.wall.material
        self.at_s = self.onset_s = flight.course.time_of(impact.t_us)
        self.prediction: ContactHistory | None = None
        self.predicted = Velocities()
        self._contact_ms: float | None = None  # predicted duration of the contact
        hit = expected_hit(flight.mission, self.collision)
        self._planned_friction_n = None if hit is None else hit.peak_friction_force_n
        if (impact.measured.normal_m_s or 0.0) < 0.0:
            self._predict(flight)
        self.compared = self._compare()

    def _predict(self, flight: RecordedFlight) -> None:
        vehicle, measured, peak = flight.mission.vehicle, self.verdict.measured, self.verdict.peak
        normal, tangential = measured.normal_m_s or 0.0, measured.tangential_m_s or 0.0
        coefficients = vehicle.materials[self.material].coefficients(self.collision.mode)
        contact = ContactMotion(coefficients, vehicle.airframe.mass_kg, normal, Onset(vehicle.onset))
        time = np.arange(-_SHOWN_BEFORE_S, _SHOWN_AFTER_S, _STEP_S)
        path = self.prediction = trajectory(contact, time, tangential, vehicle.vertical_force_sign)
        self.predicted.peak_force_n = float(path.normal_force_n.max())
        if math.isfinite(contact.end_s):  # an endless contact has no exit velocity
            end = np.array([contact.end_s])
            slowed = math.exp(-coefficients.mu * float(contact.impulse(contact.end_s)) / contact.mass_kg)
            self.predicted.normal_out_m_s = float(contact.normal(end)[1][0])
            self.predicted.tangential_out_m_s = tangential * slowed
            self._contact_ms = 1e3 * contact.end_s
        horizontal = np.hypot(path.normal_force_n, path.tangential_force_n)
        over = np.flatnonzero(horizontal >= vehicle.detection.force_threshold_n)
        if peak is not None:
            self.onset_s = flight.course.time_of(peak.t_us) - contact.peak_s
        elif over.size:
            self.onset_s = self.at_s - float(time[over[0]])

    def _compare(self) -> list[Compared]:
        v, path, peak, true = self.verdict, self.prediction, self.verdict.peak, self.verdict.contact

        def row(name: str, unit: str, figure: str) -> Compared:
            sources = (v.planned, self.predicted, v.measured, v.truth)
            return Compared(name, unit, *(getattr(source, figure, None) for source in sources))

        friction = (
            self._planned_friction_n,
            None if path is None else float(np.abs(path.tangential_force_n).max()),
            None if peak is None else abs(peak.tangential_force_n),
            None if true is None else abs(true.peak_friction_force_n),
        )
        normal = row("peak normal force", "N", "peak_force_n")
        total = [
            None if n is None or f is None else math.hypot(n, f)
            for n, f in zip(
                (normal.planned, normal.predicted, normal.measured, normal.true), friction, strict=True
            )
        ]
        true_ms = None if true is None else (true.end_us - true.t_us) * 1e-3
        return [
            row("normal velocity", "m/s", "normal_m_s"),
            row("tangential velocity", "m/s", "tangential_m_s"),
            Compared("peak force", "N", *total),
            normal,
            Compared(_FRICTION, "N", *friction),
            Compared("contact time", "ms", None, self._contact_ms, v.contact_time_ms, true_ms),
            row("normal velocity out", "m/s", "normal_out_m_s"),
            row("tangential velocity out", "m/s", "tangential_out_m_s"),
        ]

    @property
    def title(self) -> str:
        return f"Collision {self.verdict.index}: {self.verdict.wall}, {self.verdict.mode}"

    @property
    def disagreement(self) -> float | None:
        """Measured peak normal force / predicted peak - 1; None if a peak is unknown or clipped."""
        return self._excess("peak normal force", 0.0)

    @property
    def friction_disagreement(self) -> float | None:
        """Measured peak friction / predicted peak - 1; None if a peak is unknown, clipped or too small."""
        return self._excess(_FRICTION, _MIN_FRICTION_N)

    def _excess(self, name: str, least_n: float) -> float | None:
        row = next(row for row in self.compared if row.name == name)
        if row.measured is None or not row.predicted or row.predicted < least_n or self.verdict.clipped:
            return None
        return row.measured / row.predicted - 1.0


class GuardAct(NamedTuple):
    """A guard rule that fired. `place` is the vehicle's position, or None if unknown."""

    at_s: float
    rule: str
    action: str
    place: Vec2 | None


class Timing(msgspec.Struct):
    """Latencies and jitter of a flight, ms; arrays (n,).

    Attributes:
        setpoint_interval_ms: intervals between the times at which the triggers of successive setpoints were
            received. A trigger is the sample that causes a setpoint.
        imu_delay_ms: delays from the stamp of an IMU sample to its receipt, minus the smallest delay.
        recovery_ms: latencies of recoveries: from the receipt of the sample that triggers the recovery until
            the recovery setpoint is sent.
    """

    setpoint_interval_ms: Array
    imu_delay_ms: Array
    recovery_ms: Array


class RecordedFlight:
    """A recorded flight with a newly computed verdict; the log must contain its mission."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.mission = flown_mission(log.about, log.source)
        self.course = FlightArrays(log, self.mission)
        self.verdict, impacts = evaluate(log)
        self.planned: PredictedFlight = predict_mission(self.mission)
        self.impacts = [Impact(impact, self) for impact in impacts]
        self.timing = _timing(self.course)

    @cached_property
    def replay(self) -> Replay:
        """The replay of the flight core's decisions; its computation takes as long as a simulation."""
        return replay(self.log)

    @classmethod
    def read(cls, path: str | Path) -> RecordedFlight:
        return cls(read_log(path))

    @property
    def name(self) -> str:
        """The folder of the flight and, if the flight was simulated, its seed."""
        folder = Path(self.log.source).resolve().parent.name
        return f"{folder} (seed {self.log.seed})" if self.log.seed is not None else folder

    @cached_property
    def heading(self) -> Angles:
        """The estimated attitude, including the heading (`yaw`)."""
        return angles(self.course)

    @cached_property
    def airborne(self) -> tuple[float, float] | None:
        """The interval from the climb to the landing, s; None if the flight did not leave the ground."""
        changes = [(self.course.time_of(c.t_us), c.after) for c in self.course.all(PhaseChange)]
        begin = next((at_s for at_s, after in changes if after is Phase.CLIMB), None)
        ends = (at_s for at_s, after in changes if after in (Phase.LANDING, Phase.DONE))
        return None if begin is None else (begin, next(ends, math.inf))

    @cached_property
    def shown_span(self) -> tuple[float, float]:
        """The time span of whole-flight figures: from the climb to one second after the landing begins."""
        times = self.course.estimated.time_s
        if not times.size:
            return 0.0, 1.0
        begin, end = self.airborne or (0.0, math.inf)
        return begin, min(float(times[-1]), end + 1.0)

    def guard_acts(self) -> list[GuardAct]:
        motion, found = self.course.estimated, []
        for event in self.verdict.guard:
            at_s, place = self.course.time_of(event.t_us), None
            if motion.time_s.size:
                x, y = (float(np.interp(at_s, motion.time_s, motion.position[:, i])) for i in (0, 1))
                place = x, y
            found.append(GuardAct(at_s, event.rule, event.action.value, place))
        return found

    def armed_utc(self) -> str | None:
        """Return the UTC time of arming, from the host's clock. PX4 names its own log after this time."""
        span = armed_span(self.log)
        return None if span is None else f"{span[0]:%Y-%m-%d %H:%M:%S} UTC"

    def replanned(self) -> list[tuple[PlanRequest, PlanAnswer | None, PlanTaken | None]]:
        """Return (request, answer, decision) for each request that the core sent to the planner in flight.

        The answer is None if the planner did not answer. The decision states whether the plan was used; it is
        None if the log contains no decision.
        """
        answers = {a.number: a for a in self.course.all(PlanAnswer)}
        taken = {t.number: t for t in self.course.all(PlanTaken)}
        return [
            (request, answers.get(request.number), taken.get(request.number))
            for request in self.course.all(PlanRequest)
        ]

    def answered_ms(self, request: PlanRequest, answer: PlanAnswer) -> float | None:
        """Return the time from the receipt of the request's trigger to the receipt of the answer.

        The trigger is the IMU sample that caused the request; if it is unknown, the time is None.
        """
        before = [s.received_us for s in self.course.all(ImuSample) if s.t_us <= request.t_us]
        return (answer.received_us - before[-1]) * 1e-3 if before else None

    def planned_trajectories(self) -> list[Array]:
        """Return the trajectories that were planned in flight and used: (n, 3), mission frame, m."""
        found = []
        for _, answer, taken in self.replanned():
            if answer is not None and taken is not None and taken.taken and answer.x_mission:
                path = Trajectory.from_plan(answer, self.mission.altitude_m)
                times = np.linspace(0.0, answer.impact_s or answer.duration_s, _PATH_POINTS)
                found.append(np.array([path.at(float(t)).position for t in times]))
        return found

    def planned_lines(self) -> list[Array]:
        """Return the planned path as lines: (n, 3), mission frame, m."""
        return planned_lines(self.mission, self.planned)


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
        interval[interval < 1e3],  # longer intervals are pauses outside offboard mode
        delay - delay.min() if delay.size else delay,
        np.array([s.latency_us * 1e-3 for s in course.all(SetpointSent)], dtype=float),
    )


def percentile(values: Array, share: float) -> float:
    """Return the percentile `share` (0 to 100) of the values; NaN if there are no values."""
    return float(np.percentile(values, share)) if values.size else math.nan
