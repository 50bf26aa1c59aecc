"""What a report says of one flight: everything computed, nothing drawn."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from dart_flight.config.mission import Collision, Mission
from dart_flight.contact.course import Contact, Trajectory, trajectory
from dart_flight.contact.law import Onset
from dart_flight.geometry import Vec3
from dart_flight.recording.about import flown_mission
from dart_flight.recording.course import Array, Course
from dart_flight.recording.reader import Log, read_log
from dart_flight.recording.replay import Replay, replay
from dart_flight.samples import ClockOffset, ImuSample, SetPoint, SetPointSent
from dart_flight.verdict import CollisionVerdict, Verdict, VerdictBuilder

_STEP_S = 0.0005
_SHOWN_BEFORE_S, _SHOWN_AFTER_S = 0.05, 0.2
PX4_LOG = "px4.ulg"


class Impact:
    """One collision of a flight: the verdict on it and what the contact law predicts for it.

    Attributes:
        index, wall, mode, material: which.
        verdict: planned, measured and true.
        at_s: detection, seconds of the flight's `Course`.
        prediction: the contact law at the measured velocity, in time since its onset.
        onset_s: when the predicted contact begins: so that its force reaches the threshold at `at_s`.
        predicted_n: its peak normal force.
    """

    def __init__(
        self, verdict: CollisionVerdict, collision: Collision, mission: Mission, at_s: float
    ) -> None:
        self.verdict, self.collision, self.at_s = verdict, collision, at_s
        self.material = collision.wall.material
        self.prediction: Trajectory | None = None
        self.predicted_n: float | None = None
        self.onset_s = at_s
        normal, tangential = verdict.measured.normal_m_s, verdict.measured.tangential_m_s
        if normal is None or tangential is None or normal >= 0.0:
            return
        vehicle = mission.vehicle
        coefficients = vehicle.materials[self.material].of(collision.mode)
        contact = Contact(coefficients, vehicle.airframe.mass_kg, normal, Onset(vehicle.onset))
        time = np.arange(-_SHOWN_BEFORE_S, _SHOWN_AFTER_S, _STEP_S)
        path = trajectory(contact, time, tangential, vehicle.vertical_force_sign)
        horizontal = np.hypot(path.normal_force_n, path.tangential_force_n)
        over = np.flatnonzero(horizontal >= vehicle.detection.force_threshold_n)
        if over.size:
            self.onset_s = at_s - float(time[over[0]])
        self.prediction, self.predicted_n = path, float(path.normal_force_n.max())

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


class Timing(msgspec.Struct):
    """Latencies and jitter of a flight, milliseconds; arrays (n,).

    Attributes:
        setpoint_interval_ms: between the receipts of the samples that led to successive set-points.
        imu_delay_ms: from the IMU's stamp to its receipt, by the clock estimate, less the least of them.
        recovery_ms: from the receipt of the sample that triggered a recovery to its set-point leaving.
    """

    setpoint_interval_ms: Array
    imu_delay_ms: Array
    recovery_ms: Array


class Flight:
    """A recorded flight, judged again and replayed.

    Raises:
        InputError: the log does not hold its mission.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self.mission = flown_mission(log.about, log.source)
        self.course = Course(log, self.mission)
        builder = VerdictBuilder(self.mission)
        for record in self.course.records:
            builder.take(record)
        beside = Path(log.source).with_name(PX4_LOG)
        px4_log = str(beside) if beside.exists() else None
        self.verdict: Verdict = builder.build(log.world, log.seed, log.source, px4_log)
        self.replay: Replay = replay(log)
        self.impacts = [
            Impact(v, self.mission.collisions[v.index - 1], self.mission, self.course.time_of(v.t_us))
            for v in self.verdict.collisions
        ]
        self.timing = _timing(self.course)

    @classmethod
    def read(cls, path: str | Path) -> Flight:
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

    def planned_path(self) -> list[list[Vec3]]:
        """Lines of the plan, mission frame: the approaches, then each recovery to its set-point."""
        lines: list[list[Vec3]] = []
        z = self.mission.altitude_m
        for collision in self.mission.collisions:
            if collision.impact_point is not None:
                x, y = collision.impact_point
                lines.append([(*self.mission.start, z), (x, y, z)])
            elif collision.predicted is not None and lines:
                x, y = collision.predicted.position_m
                lines.append([lines[-1][-1], (x, y, z)])
        return lines

    def recovery_points(self) -> list[Vec3]:
        """The recovery set-points, mission frame."""
        frame = self.course.frame
        if frame is None:
            return []
        return [frame.point_from_ned(s.position_ned) for s in self.course.all(SetPoint) if s.recovery]


def _timing(course: Course) -> Timing:
    received = np.array([s.trigger_received_us for s in course.all(SetPoint) if not s.recovery], dtype=float)
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
        interval[interval < 1e3],
        delay - delay.min() if delay.size else delay,
        np.array([s.latency_us * 1e-3 for s in course.all(SetPointSent)], dtype=float),
    )


def percentile(values: Array, share: float) -> float:
    """A percentile; NaN of nothing."""
    return float(np.percentile(values, share)) if values.size else math.nan
