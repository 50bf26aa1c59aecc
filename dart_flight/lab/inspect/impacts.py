"""Detection of the impacts in one log, by the flight core's force estimator and impact detector."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2, MissionFrame, Vec2, Vec3
from dart_flight.base.records import (
    ForceEstimate,
    ImpactOnset,
    ImpactPeak,
    ImuSample,
    LandedState,
    StatusSample,
)
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.core.sense.detector import SHORT_WINDOW_S, ExpectedContact
from dart_flight.core.sense.senses import Senses
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.inspect.content import height_at, landings_of
from dart_flight.lab.inspect.log_samples import Sample
from dart_flight.lab.inspect.specific_thrust import SpecificThrust, is_thrust_known
from dart_flight.lab.track import Track
from dart_flight.lab.ulog import ULogFile

_BEYOND_THRUST = 0.5  # fraction of a contact's impulse that thrust cannot explain at 45 degrees tilt or less
REMEMBERED = 256  # number of kept estimates; the detector waits at most so many samples for a peak
_CONFIRMED = 0.3  # minimum ratio of fitted peak to threshold; the fit may reduce a short pulse to a third
_HOVERS_M_S = 1.0  # highest speed at which the assumed hover thrust holds
_TOUCHDOWN_S = 3.0  # maximum time from the touch-down until PX4 reports a landing
_FALLING_M_S2 = 0.6 * GRAVITY_M_S2  # maximum magnitude of the specific force of a falling vehicle
_FALLING_S = 0.25  # averaging window of the specific force in a fall
_FALLEN_S = 1.0  # look for a fall within this time before the ground contact
_JOLT_S = 0.02
_CRASH_M_S2 = 5.0 * GRAVITY_M_S2
_CRASH_LASTS_S = 3.0  # duration of a crash, including bounces
_CERTAIN_SD = 4.0  # minimum peak of a certain impact, in standard deviations
_ASSUMED_THRUST_SD = 0.5  # standard deviation of an assumed hover thrust, as a fraction of gravity


class InspectedImpact(msgspec.Struct):
    """One impact.

    Attributes:
        t_s: time of first contact since the start of the log.
        acceleration_m_s2: peak of the normal force over mass.
        acceleration_sd_m_s2: standard deviation of that peak, from noise and the uncertainty of the thrust.
        force_n: peak of the normal force; None without a mass.
        force_sd_n: standard deviation of `force_n`.
        direction_deg: direction of the force, clockwise from north.
        clipped: whether the accelerometer saturated, so that the peak is a lower bound.
        kind: `impact`, or one of the following. `touch-down`: PX4 reports a landing shortly after the impact.
            `crash`: the impact ends a fall, or follows a crash within 3 s. `untold`: a manoeuvre cannot be
            excluded, because the peak is below four standard deviations, the vehicle has crashed before, or
            the vehicle does not hover and its thrust is unknown (`is_thrust_known`).
        speed_m_s: horizontal speed before the impact.
        height_m: height above the first position in the log, by PX4's estimate; None without an estimate.
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
    """A force estimate, and the thrust that the estimate assumes.

    Attributes:
        up: direction of the thrust, mission frame.
        thrust_n: subtracted thrust.
        along_n: measured force along the thrust axis.
        full_n: largest thrust of the motors.
    """

    force: ForceEstimate
    flying: bool
    up: Vec3
    thrust_n: float
    along_n: float
    full_n: float

    def beyond_thrust(self) -> Vec2:
        """Return the horizontal force that no thrust explains, N, mission frame.

        The thrust is fitted or assumed, and the log contains the motor commands at only 10 Hz. A force along
        the thrust axis between zero and full thrust may therefore be thrust and not a contact.
        """
        could_n = max(0.0, min(self.full_n, self.along_n)) - self.thrust_n
        x, y, _ = self.force.force_mission
        return (x - could_n * self.up[0], y - could_n * self.up[1])


Listener = Callable[[Estimated], object]


class ThresholdCrossing(msgspec.Struct):
    """A crossing of the detection threshold by the force, with the peak of the force.

    Attributes:
        peak: the fitted peak; None if the log ends before the peak is known.
        beyond_thrust: whether no thrust of the motors explains the crossing: `Estimated.beyond_thrust`
            contributes at least half of the impulse up to the peak, or has a mean above the threshold in the
            detector's short window.
        noise_n: noise of the mean over the detector's short window.
        level: horizontal component of the thrust's direction, 0 for a level vehicle.
    """

    onset: ImpactOnset
    threshold_n: float
    peak: ImpactPeak | None = None
    beyond_thrust: bool = True
    noise_n: float = 0.0
    level: float = 0.0

    def record_peak(self, peak: ImpactPeak, newest: Iterable[Estimated], short: int) -> None:
        """Record the peak, and compare the force with the possible thrust.

        `newest` are the newest estimates in order; the detector's short window has `short` samples.
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
        """Whether the force over the threshold came from an impact, not from noise or a manoeuvre.

        In an impact the fitted peak is large enough, and the thrust does not explain the force.
        """
        if self.peak is None:
            return True
        size = math.hypot(self.peak.normal_force_n, self.peak.tangential_force_n)
        return size >= _CONFIRMED * self.threshold_n and self.beyond_thrust


def short_samples(vehicle: VehicleConfig) -> int:
    return max(1, round(SHORT_WINDOW_S / vehicle.imu.tick_s))


class InspectedFlight(msgspec.Struct):
    """The impacts and the noise of one log; forces are None without a mass.

    `weak` counts threshold crossings that are not impacts, because the fitted peak is below the threshold or
    an error of the thrust explains the force. `untold` counts the impacts of kind `untold`.
    """

    log: str
    px4_version: str | None
    begin_s: float  # beginning of the log on the autopilot's clock
    duration_s: float
    flight_s: float
    noise_n: float | None
    noise_m_s2: float  # median over the flight of the noise of one sample and axis
    noise_short_m_s2: float  # noise of the means over the detector's two windows
    noise_long_m_s2: float
    threshold_n: float | None
    threshold_m_s2: float  # median over the flight of the lowest threshold
    floor_rigid_m_s2: float  # smallest peaks of reliably detected contacts
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
        """The text that replaces an empty table of impacts."""
        return "no impact" if self.flight_s > 0.0 else "0 s in the air: no impact can be found"


class InspectedSeries(msgspec.Struct):
    """Force over mass (north, east, down), threshold and position in flight, for reports and trials."""

    time_s: Array
    force_m_s2: Array  # (n, 3)
    threshold_m_s2: Array
    position_s: Array
    position_ned: Array  # (m, 3)


class ImpactScan:
    """A scan of one log for impacts with the flight core's estimators (`Senses`).

    Args:
        vehicle: the result of `vehicle_for`.
        flying: intervals in which impacts are searched, s.
        listener: called with every estimate, including those on the ground.
    """

    def __init__(
        self,
        vehicle: VehicleConfig,
        flying: list[tuple[float, float]],
        listener: Listener | None = None,
    ) -> None:
        self._mass, self._flying, self._listener = vehicle.airframe.mass_kg, flying, listener
        self._senses = Senses(vehicle)
        self._senses.state.anchor(MissionFrame())
        self._full_n = len(vehicle.airframe.motors) * vehicle.thrust.max_thrust_n
        self._newest: deque[Estimated] = deque(maxlen=REMEMBERED)
        self._short = short_samples(vehicle)
        self.rows: list[tuple[float, float, float, float, float]] = []  # time, north, east, down, threshold
        self._noise: list[tuple[float, float, float, float, float]] = []
        self.crossings: list[ThresholdCrossing] = []

    def process(self, sample: Sample) -> None:
        senses, detector = self._senses, self._senses.detector
        if not isinstance(sample, ImuSample):
            senses.update(sample, ExpectedContact())
            return
        flying = any(begin <= sample.t_us * 1e-6 <= end for begin, end in self._flying)
        if senses.state.on_ground is flying:
            # The noise on the ground differs from that in flight, so the estimator must not adapt to it.
            landed = LandedState.IN_AIR if flying else LandedState.ON_GROUND
            senses.update(StatusSample(sample.t_us, sample.t_us, landed=landed), ExpectedContact())
        sensed = senses.update(sample, ExpectedContact(flying))
        estimate = sensed.estimate
        if estimate is None:
            return
        motion = senses.motion
        along_n = -self._mass * sample.specific_force_frd[2]
        estimated = Estimated(estimate, flying, motion.up, motion.thrust_n, along_n, self._full_n)
        self._newest.append(estimated)
        if self._listener is not None:
            self._listener(estimated)
        for event in sensed.impacts:
            if isinstance(event, ImpactOnset):
                level = math.hypot(estimated.up[0], estimated.up[1])
                noise = detector.noise_n[0]
                self.crossings.append(
                    ThresholdCrossing(event, detector.crossed_threshold_n, noise_n=noise, level=level)
                )
            elif isinstance(event, ImpactPeak):
                self.crossings[-1].record_peak(event, self._newest, self._short)
        if flying:
            self._keep(estimate)

    def _keep(self, estimate: ForceEstimate) -> None:
        fx, fy, fz = estimate.force_mission
        m, detector = self._mass, self._senses.detector
        # The mission frame here is north, west, up.
        self.rows.append((estimate.t_us * 1e-6, fx / m, -fy / m, -fz / m, min(detector.thresholds_n()) / m))
        if len(self.rows) % 50 == 0:
            short, long = detector.noise_n
            self._noise.append(
                (
                    self._senses.motion.hover.noise_m_s2,
                    short / m,
                    long / m,
                    detector.detection_floor_n(0.05) / m,
                    detector.detection_floor_n(0.15) / m,
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
        for impact in impacts:
            known = is_thrust_known(track, curve, begin + impact.t_s)
            if impact.kind == "impact" and not _is_certain(impact, known, track.position_s):
                impact.kind = "untold"
        for impact in impacts:
            if mass_kg is not None:
                impact.force_n = mass_kg * impact.acceleration_m_s2
                impact.force_sd_n = mass_kg * impact.acceleration_sd_m_s2
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
        """Return the impact at the end of a fall, from the magnitude of the specific force."""
        near = slice(*np.searchsorted(track.imu_s, (t_s, t_s + _FALLING_S)))
        magnitude = np.linalg.norm(track.specific_force[near], axis=1)
        rows = table[slice(*np.searchsorted(table[:, 0], (t_s, t_s + _FALLING_S)))]
        north, east = rows[np.argmax(np.hypot(rows[:, 1], rows[:, 2])), 1:3] if len(rows) else (0.0, 0.0)
        return InspectedImpact(
            t_s=t_s - float(track.imu_s[0]),
            acceleration_m_s2=float(np.nanmax(magnitude)),
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
    """Return the standard deviation of the thrust, as a fraction of gravity."""
    if curve is None or not is_thrust_known(track, curve, t_s):
        return _ASSUMED_THRUST_SD
    return curve.held_out_percent / 100.0


def falls(track: Track, flying: list[tuple[float, float]]) -> list[float]:
    """Return the time of the first jolt at the end of each fall."""
    found: list[float] = []
    jolt = _mean_size(track, _JOLT_S)
    carried = _mean_size(track, _FALLING_S)
    for i in np.flatnonzero(jolt > _CRASH_M_S2):
        t = float(track.imu_s[i])
        if not any(a <= t <= b for a, b in flying) or (found and t - found[-1] < _CRASH_LASTS_S):
            continue
        # Drag grows in a fall, so the specific force is small only in the first part of the interval.
        before = slice(*np.searchsorted(track.imu_s, (t - _FALLEN_S, t - _FALLING_S)))
        if (carried[before] < _FALLING_M_S2).any():
            found.append(t)
    return found


def _mean_size(track: Track, window_s: float) -> Array:
    """Return the magnitude of the mean specific force over a window starting at each sample, m/s2."""
    sums = np.cumsum(np.concatenate((np.zeros((1, 3)), np.nan_to_num(track.specific_force))), axis=0)
    begin = np.arange(len(track.imu_s))
    end = np.maximum(np.searchsorted(track.imu_s, track.imu_s + window_s), begin + 1)
    return np.asarray(np.linalg.norm((sums[end] - sums[begin]) / (end - begin)[:, None], axis=1))


def _with_crashes(impacts: list[InspectedImpact], crashes: list[InspectedImpact]) -> list[InspectedImpact]:
    """Merge impacts and crashes in order.

    A crash replaces the impacts that are within `_FALLING_S` of the crash. Impacts in the next seconds are
    part of the crash, and later impacts are `untold`.
    """
    kept = list(crashes)
    for impact in impacts:
        since_s = [impact.t_s - crash.t_s for crash in crashes if impact.t_s >= crash.t_s - _FALLING_S]
        if since_s and since_s[-1] <= _FALLING_S:
            continue
        if since_s and impact.kind == "impact":
            impact.kind = "crash" if since_s[-1] <= _CRASH_LASTS_S else "untold"
        kept.append(impact)
    return sorted(kept, key=lambda impact: impact.t_s)


def _speed(track: Track, t_s: float) -> float:
    """Return the horizontal speed by PX4's estimate, or NaN."""
    known = np.isfinite(track.velocity[:, :2]).all(axis=1)
    if not known.any():
        return math.nan
    time, velocity = track.position_s[known], track.velocity[known]
    north, east = (float(np.interp(t_s, time, velocity[:, k])) for k in (0, 1))
    return math.hypot(north, east)


def _height(track: Track, t_s: float) -> float | None:
    height = height_at(track, t_s)
    return height if math.isfinite(height) else None


def _is_certain(impact: InspectedImpact, thrust_known: bool, known_s: Array) -> bool:
    """Return whether the peak of an impact exceeds what noise and manoeuvres explain.

    If the thrust is unknown, hover thrust is assumed. The log must then show that the vehicle hovers, or the
    peak must exceed 5 g.
    """
    hovers = bool(known_s.size) and impact.speed_m_s < _HOVERS_M_S
    beyond_motors = impact.acceleration_m_s2 > _CRASH_M_S2
    return impact.acceleration_m_s2 >= _CERTAIN_SD * impact.acceleration_sd_m_s2 and (
        thrust_known or hovers or beyond_motors
    )
