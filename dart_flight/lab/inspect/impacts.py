"""Estimator and detector over one log, and what they felt."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2, MissionFrame, Vec2, Vec3, rotate
from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    OdometrySample,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.detector import SHORT_WINDOW_S, ExpectedContact, ImpactDetector
from dart_flight.core.sense.force import ForceEstimator
from dart_flight.core.sense.state import FlightState
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.inspect.content import height_at, landings_of
from dart_flight.lab.inspect.log_samples import Sample
from dart_flight.lab.inspect.specific_thrust import SpecificThrust, is_thrust_known
from dart_flight.lab.track import Track
from dart_flight.lab.ulog import ULogFile

_BEYOND_THRUST = 0.5  # of the impulse: what pushes against a vehicle tilted by up to 45 degrees has as much
REMEMBERED = 256  # samples: as long as the detector waits for a peak
_BORNE_OUT = 0.3  # of the threshold: a short pulse just over it is fitted too low, to about a third at worst
_HOVERS_M_S = 1.0  # an assumed thrust is that of hovering
_TOUCHDOWN_S = 3.0  # an impact this long before PX4 says landed is the ground
_FALLING_M_S2 = 0.6 * GRAVITY_M_S2  # felt in all: less than what carries the vehicle
_FALLING_S = 0.25  # ... in the mean over so long
_FALLEN_S = 1.0  # ... within so long before the ground
_JOLT_S = 0.02
_CRASH_M_S2 = 5.0 * GRAVITY_M_S2
_CRASH_LASTS_S = 3.0  # bounces and all
_TOLD_SD = 4.0  # standard deviations from nothing
_ASSUMED_THRUST_SD = 0.5  # share of gravity by which an assumed thrust of hovering may be off


class InspectedImpact(msgspec.Struct):
    """One impact.

    Attributes:
        t_s: since the log's beginning, first contact.
        acceleration_m_s2: peak of the normal force over mass.
        acceleration_sd_m_s2: its standard deviation, by noise and by how well the thrust is known.
        force_n: peak of the normal force; None without a mass.
        force_sd_n: its standard deviation.
        direction_deg: where the force points, clockwise from north.
        clipped: the accelerometer was at full scale: a lower bound.
        kind: `impact`; `touch-down` where PX4 says landed shortly after; `crash` where the vehicle fell, and
            what follows within seconds; `untold` where a manoeuvre would look the same, because the thrust
            is not known there (`is_thrust_known`) and the vehicle does not hover, or because it is after a
            crash, and where it is less than four standard deviations.
        speed_m_s: horizontal, before it.
        height_m: above where the log begins, by PX4's estimate; None where it has none.
    """

    t_s: float
    acceleration_m_s2: float
    acceleration_sd_m_s2: float
    force_n: float | None
    force_sd_n: float | None
    direction_deg: float
    clipped: bool
    kind: str
    speed_m_s: float
    height_m: float | None


class Estimated(NamedTuple):
    """An estimate with what it took for the thrust.

    Attributes:
        force: the estimate.
        flying: whether the vehicle was in the air.
        up: direction of the thrust, mission frame.
        thrust_n: that was taken off.
        along_n: what the accelerometer felt along it.
        full_n: the most that the motors give.
    """

    force: ForceEstimate
    flying: bool
    up: Vec3
    thrust_n: float
    along_n: float
    full_n: float

    def beyond_thrust(self) -> Vec2:
        """The part of the horizontal force that is there whatever the motors gave, newton, mission frame.

        A log's thrust is fitted or assumed, from commands at 10 Hz. Along its axis the accelerometer may feel
        anything from nothing to full thrust without any contact.
        """
        could_n = max(0.0, min(self.full_n, self.along_n)) - self.thrust_n
        x, y, _ = self.force.force_mission
        return (x - could_n * self.up[0], y - could_n * self.up[1])


Listener = Callable[[Estimated], object]


class ThresholdCrossing(msgspec.Struct):
    """The force was over its threshold, and what came of it.

    Attributes:
        onset: the moment.
        threshold_n: that was crossed.
        peak: None where the log ends before it is known.
        beyond_thrust: whether no thrust of the motors explains it: half of the impulse up to the peak, or
            what alone is over the threshold in a mean over the detector's short window.
        noise_n: of the mean over the detector's short window.
        level: horizontal part of the direction of the thrust, 0 where the vehicle was level.
    """

    onset: ImpactOnset
    threshold_n: float
    peak: ImpactPeak | None = None
    beyond_thrust: bool = True
    noise_n: float = 0.0
    level: float = 0.0

    def ends(self, peak: ImpactPeak, newest: Iterable[Estimated], short: int) -> None:
        """Its peak is known.

        Args:
            peak: the peak.
            newest: the newest estimates, in order.
            short: samples of the detector's short window.
        """
        self.peak = peak
        since = [e for e in newest if e.force.t_us >= self.onset.first_us]
        whole = np.array([e.force.force_mission[:2] for e in since])
        beyond = np.array([e.beyond_thrust() for e in since])
        share = _BEYOND_THRUST * float(np.sum(whole @ peak.normal))
        n = min(short, len(since))
        means = np.cumsum(np.concatenate((np.zeros((1, 2)), beyond)), axis=0)
        largest = float(np.max(np.hypot(*(means[n:] - means[:-n]).T))) / n
        self.beyond_thrust = float(np.sum(beyond @ peak.normal)) >= share or largest >= self.threshold_n

    @property
    def is_impact(self) -> bool:
        """Whether the fitted peak bears out what crossed the threshold, and the thrust does not explain it.

        Else it was noise, or a manoeuvre.
        """
        if self.peak is None:
            return True
        size = math.hypot(self.peak.normal_force_n, self.peak.tangential_force_n)
        return size >= _BORNE_OUT * self.threshold_n and self.beyond_thrust


def short_samples(vehicle: VehicleConfig) -> int:
    """Samples in the detector's short window."""
    return max(1, round(SHORT_WINDOW_S / vehicle.imu.tick_s))


class InspectedFlight(msgspec.Struct):
    """What one log felt; newtons are None without a mass.

    `weak` counts crossings of the threshold whose fitted peak stayed below it, or that an error of the thrust
    explains: they are no impacts. `untold` counts the impacts of that kind: manoeuvre or contact, nothing
    tells.
    """

    log: str
    px4_version: str | None
    begin_s: float  # of the log, on the autopilot's clock
    duration_s: float
    flight_s: float
    noise_n: float | None
    noise_m_s2: float  # of one sample and axis, median over the flight
    noise_short_m_s2: float  # of the means over the detector's two windows
    noise_long_m_s2: float
    threshold_n: float | None
    threshold_m_s2: float  # lowest in force, median over the flight
    floor_rigid_m_s2: float  # peaks from which on contacts are found for certain
    floor_flexible_m_s2: float
    drag_per_s: float
    thrust: SpecificThrust | None
    impacts: list[InspectedImpact]
    weak: int
    untold: int
    unknown: list[str]
    series: InspectedSeries | None = None  # not in JSON

    @property
    def nothing_found(self) -> str:
        """What to say instead of impacts; without a flight there cannot be one."""
        return "no impact" if self.flight_s > 0.0 else "0 s in the air: no impact can be found"


class InspectedSeries(msgspec.Struct):
    """Force over mass in flight, north, east and down, and the threshold; for the report and for trials."""

    time_s: Array
    force_m_s2: Array  # (n, 3)
    threshold_m_s2: Array
    position_s: Array
    position_ned: Array  # (m, 3)


class ImpactScan:
    """Estimator and detector over one log.

    Args:
        vehicle: as `vehicle_for` has it.
        flying: stretches in which an impact is one, seconds.
        listener: takes every estimate, with whether it was in the air.
    """

    def __init__(
        self,
        vehicle: VehicleConfig,
        flying: list[tuple[float, float]],
        listener: Listener | None = None,
    ) -> None:
        self._mass, self._flying, self._listener = vehicle.airframe.mass_kg, flying, listener
        self.estimator, self.detector = ForceEstimator(vehicle), ImpactDetector(vehicle)
        self.state = FlightState()
        self.state.anchor(MissionFrame())
        self._place = 0
        self._full_n = len(vehicle.airframe.motors) * vehicle.thrust.max_thrust_n
        self._newest: deque[Estimated] = deque(maxlen=REMEMBERED)
        self._short = short_samples(vehicle)
        self.rows: list[tuple[float, float, float, float, float]] = []  # time, north, east, down, threshold
        self._noise: list[tuple[float, float, float, float, float]] = []
        self.crossings: list[ThresholdCrossing] = []

    def in_the_air(self, t_s: float) -> bool:
        """Whether this is within one of the flights; moments do not go back."""
        while self._place < len(self._flying) and self._flying[self._place][1] < t_s:
            self._place += 1
        return self._place < len(self._flying) and self._flying[self._place][0] <= t_s

    def take(self, sample: Sample) -> None:
        """The next sample of the log."""
        if isinstance(sample, AttitudeSample):
            if self.state.take_attitude(sample):
                self.estimator.take_attitude(sample)
        elif isinstance(sample, OdometrySample):
            self.state.take_odometry(sample)
        elif isinstance(sample, ActuatorSample):
            self.estimator.thrust.take_actuator(sample)
        elif self.state.take_imu(sample):
            self._feel(sample)

    def _feel(self, sample: ImuSample) -> None:
        detector, flying = self.detector, self.in_the_air(sample.t_us * 1e-6)
        # What is learnt on the ground says nothing of the flight.
        estimate = self.estimator.estimate(sample, self.state, detector.in_contact or not flying)
        if estimate is None:
            return
        felt = self._with_thrust(estimate, sample, flying)
        self._newest.append(felt)
        if self._listener is not None:
            self._listener(felt)
        for event in detector.update(estimate, sample.t_us, self.state, ExpectedContact(flying)):
            if isinstance(event, ImpactOnset):
                level = math.hypot(felt.up[0], felt.up[1])
                noise = detector.noise_n[0]
                self.crossings.append(
                    ThresholdCrossing(event, detector.crossed_n, noise_n=noise, level=level)
                )
            elif isinstance(event, ImpactPeak):
                self.crossings[-1].ends(event, self._newest, self._short)
        if flying:
            self._keep(estimate)

    def _with_thrust(self, estimate: ForceEstimate, sample: ImuSample, flying: bool) -> Estimated:
        attitude, frame = self.estimator.attitude, self.state.frame
        assert attitude is not None
        assert frame is not None
        up = frame.vector_from_ned(rotate(attitude, (0.0, 0.0, -1.0)))
        along_n = -self._mass * sample.specific_force_frd[2]
        return Estimated(estimate, flying, up, self.estimator.thrust_n, along_n, self._full_n)

    def _keep(self, estimate: ForceEstimate) -> None:
        fx, fy, fz = estimate.force_mission
        m, thresholds = self._mass, self.detector.thresholds_n()
        # The mission frame here is north, west, up.
        self.rows.append((estimate.t_us * 1e-6, fx / m, -fy / m, -fz / m, min(thresholds) / m))
        if len(self.rows) % 50 == 0:
            short, long = self.detector.noise_n
            self._noise.append(
                (
                    self.estimator.hover.noise_m_s2,
                    short / m,
                    long / m,
                    self.detector.floor_n(0.05) / m,
                    self.detector.floor_n(0.15) / m,
                )
            )

    def result(
        self,
        log: ULogFile,
        track: Track,
        curve: SpecificThrust | None,
        drag: float,
        mass_kg: float | None,
        unknown: list[str],
    ) -> InspectedFlight:
        """The result."""
        begin = float(track.imu_s[0])
        table = np.array(self.rows).reshape(-1, 5)
        noise = (
            np.median(np.array(self._noise).reshape(-1, 5), axis=0) if self._noise else np.full(5, math.nan)
        )
        threshold = float(np.median(table[:, 4])) if len(table) else math.nan
        landings = landings_of(log, track)
        found = [
            self._impact(c, track, _thrust_sd(track, curve, c.onset.first_us * 1e-6), landings)
            for c in self.crossings
            if c.is_impact
        ]
        crashes = [self._crash(t, track, table, float(noise[0])) for t in falls(track, self._flying)]
        impacts = _with_crashes(found, crashes)
        for one in impacts:
            known = is_thrust_known(track, curve, begin + one.t_s)
            if one.kind == "impact" and not _is_told(one, known, track.position_s):
                one.kind = "untold"
        for one in impacts:
            if mass_kg is not None:
                one.force_n = mass_kg * one.acceleration_m_s2
                one.force_sd_n = mass_kg * one.acceleration_sd_m_s2
        return InspectedFlight(
            log=log.source,
            px4_version=".".join(str(v) for v in log.version) if log.version else None,
            begin_s=begin,
            duration_s=float(track.imu_s[-1]) - begin,
            flight_s=sum(b - a for a, b in self._flying),
            noise_n=None if mass_kg is None else mass_kg * float(noise[0]),
            noise_m_s2=float(noise[0]),
            noise_short_m_s2=float(noise[1]),
            noise_long_m_s2=float(noise[2]),
            threshold_n=None if mass_kg is None else mass_kg * threshold,
            threshold_m_s2=threshold,
            floor_rigid_m_s2=float(noise[3]),
            floor_flexible_m_s2=float(noise[4]),
            drag_per_s=drag,
            thrust=curve,
            impacts=impacts,
            weak=sum(not c.is_impact for c in self.crossings),
            untold=sum(i.kind == "untold" for i in impacts),
            unknown=unknown,
            series=InspectedSeries(
                table[:, 0] - begin, table[:, 1:4], table[:, 4], track.position_s - begin, track.position
            ),
        )

    def _impact(
        self,
        crossing: ThresholdCrossing,
        track: Track,
        thrust_sd: float,
        landings: list[tuple[float, float]],
    ) -> InspectedImpact:
        onset, peak = crossing.onset, crossing.peak
        fx, fy = onset.force_mission[:2] if peak is None else peak.normal
        size = math.hypot(fx, fy) if peak is None else peak.normal_force_n
        noise = max(crossing.noise_n, 0.0 if peak is None else peak.normal_sigma_n)
        t = onset.first_us * 1e-6
        down = any(a - _TOUCHDOWN_S <= t <= b for a, b in landings)
        return InspectedImpact(
            t_s=t - float(track.imu_s[0]),
            acceleration_m_s2=size / self._mass,
            acceleration_sd_m_s2=math.hypot(noise / self._mass, thrust_sd * GRAVITY_M_S2 * crossing.level),
            force_n=None,
            force_sd_n=None,
            direction_deg=math.degrees(math.atan2(-fy, fx)) % 360.0,
            clipped=peak is not None and peak.clipped,
            kind="touch-down" if down else "impact",
            speed_m_s=math.hypot(onset.velocity_mission[0], onset.velocity_mission[1]),
            height_m=_height(track, t),
        )

    def _crash(
        self,
        t_s: float,
        track: Track,
        table: Array,
        noise_m_s2: float,
    ) -> InspectedImpact:
        """The end of a fall: what the accelerometer felt in all, whatever the thrust."""
        near = slice(*np.searchsorted(track.imu_s, (t_s, t_s + _FALLING_S)))
        felt = np.linalg.norm(track.specific_force[near], axis=1)
        rows = table[slice(*np.searchsorted(table[:, 0], (t_s, t_s + _FALLING_S)))]
        north, east = rows[np.argmax(np.hypot(rows[:, 1], rows[:, 2])), 1:3] if len(rows) else (0.0, 0.0)
        return InspectedImpact(
            t_s=t_s - float(track.imu_s[0]),
            acceleration_m_s2=float(np.nanmax(felt)),
            acceleration_sd_m_s2=noise_m_s2,
            force_n=None,
            force_sd_n=None,
            direction_deg=math.degrees(math.atan2(east, north)) % 360.0,
            clipped=False,
            kind="crash",
            speed_m_s=_speed(track, t_s),
            height_m=_height(track, t_s),
        )


def _thrust_sd(track: Track, curve: SpecificThrust | None, t_s: float) -> float:
    """Standard deviation of the thrust at a moment, share of gravity."""
    if curve is None or not is_thrust_known(track, curve, t_s):
        return _ASSUMED_THRUST_SD
    return curve.held_out_percent / 100.0


def falls(track: Track, flying: list[tuple[float, float]]) -> list[float]:
    """Moments at which a fall ends in a jolt, in means that leave vibration out; of several the first."""
    found: list[float] = []
    jolt = _mean_size(track, _JOLT_S)
    carried = _mean_size(track, _FALLING_S)
    for i in np.flatnonzero(jolt > _CRASH_M_S2):
        t = float(track.imu_s[i])
        if not any(a <= t <= b for a, b in flying) or (found and t - found[-1] < _CRASH_LASTS_S):
            continue
        # As it falls faster the air carries it, so that the fall is at the beginning of the second.
        before = slice(*np.searchsorted(track.imu_s, (t - _FALLEN_S, t - _FALLING_S)))
        if (carried[before] < _FALLING_M_S2).any():
            found.append(t)
    return found


def _mean_size(track: Track, window_s: float) -> Array:
    """Size of the mean specific force over a window that begins at each sample, m/s2."""
    sums = np.cumsum(np.concatenate((np.zeros((1, 3)), np.nan_to_num(track.specific_force))), axis=0)
    begin = np.arange(len(track.imu_s))
    end = np.maximum(np.searchsorted(track.imu_s, track.imu_s + window_s), begin + 1)
    return np.asarray(np.linalg.norm((sums[end] - sums[begin]) / (end - begin)[:, None], axis=1))


def _with_crashes(impacts: list[InspectedImpact], crashes: list[InspectedImpact]) -> list[InspectedImpact]:
    """All in order; what was felt in a crash is the crash, what comes after it is not told."""
    kept = list(crashes)
    for one in impacts:
        since = [one.t_s - crash.t_s for crash in crashes if one.t_s >= crash.t_s - _FALLING_S]
        if since and since[-1] <= _FALLING_S:
            continue
        if since and one.kind == "impact":
            one.kind = "crash" if since[-1] <= _CRASH_LASTS_S else "untold"
        kept.append(one)
    return sorted(kept, key=lambda felt: felt.t_s)


def _speed(track: Track, t_s: float) -> float:
    """Horizontal, by PX4's estimate; NaN where it has none."""
    known = np.isfinite(track.velocity[:, :2]).all(axis=1)
    if not known.any():
        return math.nan
    time, velocity = track.position_s[known], track.velocity[known]
    north, east = (float(np.interp(t_s, time, velocity[:, k])) for k in (0, 1))
    return math.hypot(north, east)


def _height(track: Track, t_s: float) -> float | None:
    height = height_at(track, t_s)
    return height if math.isfinite(height) else None


def _is_told(felt: InspectedImpact, thrust_known: bool, known_s: Array) -> bool:
    """Whether it is a contact for certain: beyond its own error, and no manoeuvre that would look like it.

    Where the thrust is not known that of hovering is assumed, which the log has to say that the vehicle did.
    """
    hovers = bool(known_s.size) and felt.speed_m_s < _HOVERS_M_S
    beyond_motors = felt.acceleration_m_s2 > _CRASH_M_S2
    return felt.acceleration_m_s2 >= _TOLD_SD * felt.acceleration_sd_m_s2 and (
        thrust_known or hovers or beyond_motors
    )
