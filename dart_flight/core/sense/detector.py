"""Impact detection: one onset, one peak and one end for every impact.

The detector reports a collision when the horizontal force, minus a slow baseline (`bias.py`), reaches the
threshold. The paper tests each axis instead; `threshold_test` selects the test. The recovery uses the peak of
the normal and of the tangential force since the onset. Both peaks come from a fit of the contact model's
pulse (`core/sense/pulse.py`), because the maximum of noisy samples is biased upward. States: watching ->
rising -> falling -> refractory -> watching.

The detector can compare four quantities with a threshold: one sample, the mean of two samples, a mean over a
window for rigid contacts, and a mean over a longer window for flexible contacts (`core/sense/window.py`). If
the vehicle vibrates, the threshold of a quantity is a multiple of the noise of this quantity. Among the
quantities whose noise permits the configured threshold, the detector uses the one with the shortest averaging
time. If the noise of all four quantities is too large, the detector uses all four (docs/force.md).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, Literal, NamedTuple

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import Vec2
from dart_flight.base.records import ContactEnd, DetectionFloor, ForceEstimate, ImpactOnset, ImpactPeak, Mode
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import Coefficients, Detection, ThresholdTest, VehicleConfig
from dart_flight.core.sense.bias import ForceBaseline
from dart_flight.core.sense.pulse import NormalPulse, PulsePrior, TickReading, fit_friction, fit_normal
from dart_flight.core.sense.state import FlightState
from dart_flight.core.sense.window import WindowMean, half_sine_share

RELEASE_FRACTION: Final = 0.4  # a contact ends below this fraction of the threshold
PEAK_DROP_FRACTION: Final = 0.12  # drop, as a fraction of the top, that ends the search for the peak
CONTACT_END_S: Final = 0.012  # a contact ends after this time below the release level: three samples
SURE_SIGMA: Final = 2.5  # one sample detects if it exceeds the threshold by this many deviations
SHORT_WINDOW_S: Final = 0.032  # window whose mean keeps 85 % of the peak of rigid contacts (46 to 54 ms)
LONG_WINDOW_S: Final = 0.1  # window whose mean keeps 83 % of the peak of flexible contacts (145 to 183 ms)
PULSE_MISFIT: Final = 3.0  # the model does not fit if normalised residuals have a larger mean square
_RISE_SHARE: Final = 0.3  # earlier samples belong to the contact if above this fraction of the threshold
_PEAK_DROP_SHARE: Final = 0.25  # a drop below this fraction of the threshold is noise
_DROP_SIGMA: Final = 2.5  # a drop below this many standard deviations of the smoothed force is noise
_SMOOTH_SHARE: Final = 0.02  # enough samples are averaged that their noise is below this fraction of the top
_MAX_SMOOTH: Final = 5
_TOP_SHARE: Final = 0.7  # samples above this fraction of the maximum form the top of the pulse
_TOP_REACH: Final = 4  # the top has at most this many samples on each side of the maximum
_BEFORE: Final = 8  # samples kept before the crossing
_FAR_SIGMA: Final = 4.6  # two samples suffice, not three, if threshold / noise is at least this ratio
# Added to `noise_sigma` for one and two samples, whose noise has more chances to cross a threshold.
_SHORT_SIGMA: Final = 1.0
_MARGIN_SIGMA: Final = 1.0  # detection is guaranteed this many standard deviations above the threshold
_NOISY_BASELINE: Final = 0.4  # factor on the baseline's rate under vibration, which it must not follow
_LONGEST_CONTACT_S: Final = 0.5  # a contact counts as ended after this time, because noise may hide its end
_INTO_WALL: Final = 0.1  # part of a planned onset's force that may point into the wall, from noise


class ExpectedContact(NamedTuple):
    """The next contact that the mission expects; the core passes it from the mission to the detector.

    Attributes:
        watching: whether a contact counts as an impact; False on the ground, in the climb and while landing.
        normal: outward normal of the next planned wall, mission frame, or None if no wall is expected.
        material: key of the materials table; the coefficients are the prior of the pulse fit.
        wall: the next planned wall, with its name and plane. The contact's wall estimate gets the same name.
    """

    watching: bool = False
    normal: Vec2 | None = None
    material: str | None = None
    wall: Wall | None = None


class _Sample(NamedTuple):
    """A sample of the contact; its forces exclude the baseline, newton, mission frame."""

    t_us: int
    dt_us: int
    fx: float
    fy: float
    push: Vec2
    clipped: bool


Stage = Literal["watching", "rising", "falling", "refractory"]
Event = ImpactOnset | ImpactPeak | ContactEnd | DetectionFloor
Events = list[Event]


class ImpactDetector:
    """Detector that reports one onset, one peak and one end for every impact.

    If no wall is expected, or if the force points into the expected wall, the contact is unplanned. Its
    normal is then the direction of the force.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle, self._config = vehicle, vehicle.detection
        self._mass = vehicle.airframe.mass_kg
        self._tick_us = round(vehicle.imu.tick_s * 1e6)
        self._lag_s = vehicle.imu.filter_lag_s
        self._per_axis = self._config.threshold_test is ThresholdTest.PER_AXIS
        self._priors = {
            (name, mode): _prior(material.coefficients(mode), self._mass)
            for name, material in vehicle.materials.items()
            for mode in vehicle.modes
        }
        self._typical = {
            mode: _mean_prior([p for (_, m), p in self._priors.items() if m is mode])
            for mode in vehicle.modes
        }
        # Copies, because every sample uses these values and an attribute look-up is slow.
        c = self._config
        self._threshold_n, self._release_n = c.force_threshold_n, RELEASE_FRACTION * c.force_threshold_n
        self._sigma, self._refractory_us = c.noise_sigma, c.refractory_s * 1e6
        self.slow_force = ForceBaseline(vehicle.estimation)
        self.stage: Stage = "watching"
        tick_s, noise_n = vehicle.imu.tick_s, self._mass * vehicle.estimation.imu_noise_m_s2
        lengths = (0.0, 2.0 * tick_s, SHORT_WINDOW_S, LONG_WINDOW_S)
        self._windows = [WindowMean(s, noise_n, round(s / tick_s)) for s in lengths]
        # A window holds the samples that are younger than its length.
        self._held = [max(1, math.ceil(s / tick_s - 1e-9)) for s in lengths]
        self._detecting_window: WindowMean | None = None  # the window that detected the contact
        self._threshold = self._config.force_threshold_n  # the threshold that detected the contact
        most = max(_BEFORE, round(LONG_WINDOW_S / tick_s) + _BEFORE)
        self._before: deque[_Sample] = deque(maxlen=most)
        self._samples: list[_Sample] = []
        self._last_us = 0
        self._previous: tuple[Vec2, Vec2] = ((0.0, 0.0), (0.0, 0.0))  # forces of the two previous samples
        self._armed = True  # the force has been below the release level since the last contact
        self._noise = 0.0
        self._normal: Vec2 = (1.0, 0.0)
        self._onset: ImpactOnset | None = None
        self._quiet_since_us: int | None = None
        self._ended_us = 0
        self._expected = ExpectedContact()

    @property
    def in_contact(self) -> bool:
        return self.stage in ("rising", "falling")

    @property
    def crossed_threshold_n(self) -> float:
        return self._threshold

    def update(
        self, estimate: ForceEstimate, received_us: int, state: FlightState, expected: ExpectedContact
    ) -> Events:
        t_us = estimate.t_us
        dt_us = t_us - self._last_us if self._last_us else self._tick_us
        self._last_us = t_us
        force, base = estimate.force_mission, self.slow_force.value
        fx, fy = force[0] - base[0], force[1] - base[1]
        stage = self.stage
        if stage == "refractory" and t_us - self._ended_us >= self._refractory_us:
            stage = self.stage = "watching"
        floor = self._report_floor(t_us, expected)
        self._expected = expected
        for window in self._windows:
            window.add(t_us, fx, fy)
        if stage in ("watching", "refractory"):
            self._noise = estimate.noise_n
            return floor + self._watch(estimate, fx, fy, dt_us, received_us, state)
        events: Events = floor
        if stage == "rising":
            self._samples.append(_Sample(t_us, dt_us, fx, fy, estimate.push_mission, estimate.clipped))
            if self._peak_is_past(t_us):
                self.stage = "falling"
                events.append(self._peak(t_us, received_us, state))
        else:
            end = self._end(t_us, fx, fy)
            if end is not None:
                events.append(end)
        return events

    # -- onset --

    def _watch(
        self, estimate: ForceEstimate, fx: float, fy: float, dt_us: int, received_us: int, state: FlightState
    ) -> Events:
        size = max(abs(fx), abs(fy)) if self._per_axis else math.sqrt(fx * fx + fy * fy)
        threshold, release, force = self._threshold_n, self._release_n, estimate.force_mission
        over = size >= threshold
        hidden = self._noise_hides_release(release)
        # A rotating vibration never drops below the release level in a single sample, so compare its mean.
        if size < release or (hidden and self._size_of(2) < release):
            self._armed = True
        sample = _Sample(self._last_us, dt_us, fx, fy, estimate.push_mission, estimate.clipped)
        watching = self._expected.watching and self._armed and self.stage == "watching"
        if watching and self._is_contact(fx, fy, size, over):
            return [self._begin(estimate, sample, received_us, state)]
        self._previous = ((fx, fy), self._previous[0])
        self._before.append(sample)
        if self.stage == "watching":
            for window in self._windows:
                window.learn(dt_us * 1e-6)
        if hidden:
            # Leaving out the samples that noise lifts over the threshold would bias the baseline.
            over = self._size_of(2) >= threshold
            (fx, fy), base = self._windows[2].mean, self.slow_force.value
            fx, fy, seconds = fx + base[0], fy + base[1], _NOISY_BASELINE * dt_us * 1e-6
        else:
            fx, fy, seconds = force[0], force[1], dt_us * 1e-6
        if not over or not self._armed:
            self.slow_force.update(fx, fy, seconds)
        return []

    def _is_contact(self, fx: float, fy: float, size: float, over: bool) -> bool:
        """Return whether a sample, a mean of two or three samples, or a window mean is over its threshold."""
        one, two, short, long = self.thresholds_n()
        threshold = self._threshold_n
        self._detecting_window, self._threshold = None, threshold
        if over:
            # One sample is sufficient if noise cannot have lifted it; otherwise use two or three in a row.
            if size >= max(threshold + SURE_SIGMA * self._noise, one):
                return True
            if self._mean_is_over(fx, fy, two):
                return True
        if two <= threshold:
            return False
        if self._windows[2].full and self._size_of(2) >= short:
            self._detecting_window, self._threshold = self._windows[2], short
        elif short > threshold and self._windows[3].full and self._size_of(3) >= long:
            self._detecting_window, self._threshold = self._windows[3], long
        return self._detecting_window is not None

    def thresholds_n(self) -> tuple[float, float, float, float]:
        """Return the thresholds, newton, of one sample and of the means over two samples and both windows.

        Each is the larger of the configured threshold and a multiple of the learnt noise.
        """
        least, sigma = self._threshold_n, self._sigma
        one, two, short, long = self._windows
        return (
            max(least, (sigma + _SHORT_SIGMA) * one.noise_n),
            max(least, (sigma + _SHORT_SIGMA) * two.noise_n),
            max(least, sigma * short.noise_n),
            max(least, sigma * long.noise_n),
        )

    def detection_floor_n(self, duration_s: float) -> float:
        """Return the smallest peak at which a half-sine of this duration is certainly detected, newton.

        The floor of a window is (threshold + one standard deviation) / (ratio of the window's mean to the
        peak). The result is the lowest floor among the windows in use.
        """
        best = math.inf
        for i, threshold in enumerate(self.thresholds_n()):
            if i >= 2 and self.thresholds_n()[i - 1] <= self._config.force_threshold_n:
                break  # the configured threshold is usable, so longer windows are not in use
            lifted = threshold + _MARGIN_SIGMA * self._windows[i].noise_n
            share = half_sine_share(self._held[i], duration_s, self._tick_us * 1e-6)
            if share > 0.0:
                best = min(best, lifted / share)
        return best

    @property
    def noise_n(self) -> tuple[float, float]:
        """Learnt noise of the force averaged over the short and the long window, per axis, newton."""
        return (self._windows[2].noise_n, self._windows[3].noise_n)

    def _report_floor(self, t_us: int, expected: ExpectedContact) -> Events:
        """Return the detection floors (`detection_floor_n`) if the mission begins to expect a wall."""
        if expected.normal is None or self._expected.normal is not None:
            return []
        thresholds = self.thresholds_n()
        floors = {
            m: self.detection_floor_n(self._prior_of(expected, m).half_period_s) for m in self._vehicle.modes
        }
        return [
            DetectionFloor(
                t_us=t_us,
                threshold_n=min(thresholds),
                noise_short_n=self._windows[2].noise_n,
                noise_long_n=self._windows[3].noise_n,
                rigid_n=floors[Mode.RIGID],
                flexible_n=floors.get(Mode.FLEXIBLE),
            )
        ]

    def _size_of(self, index: int) -> float:
        x, y = self._windows[index].mean
        return max(abs(x), abs(y)) if self._per_axis else math.sqrt(x * x + y * y)

    def _mean_is_over(self, fx: float, fy: float, threshold: float) -> bool:
        x, y = confirmed_force(fx, fy, self._previous, self._noise, self._config)
        size = max(abs(x), abs(y)) if self._per_axis else math.sqrt(x * x + y * y)
        return size >= threshold

    def _begin(
        self, estimate: ForceEstimate, sample: _Sample, received_us: int, state: FlightState
    ) -> ImpactOnset:
        fx, fy = self._detecting_window.mean if self._detecting_window is not None else (sample.fx, sample.fy)
        size = max(math.sqrt(fx * fx + fy * fy), 1e-9)
        expected = self._expected.normal
        # Friction may hide the sign of the normal force. The onset is unplanned only if its force clearly
        # points into the wall. `_peak` repeats the test with the impulse.
        least = -(_INTO_WALL * size + 3.0 * self._noise)
        planned = expected is not None and fx * expected[0] + fy * expected[1] > least
        self._normal = expected if expected is not None and planned else (fx / size, fy / size)
        before = list(self._before)
        if self._detecting_window is None:
            before = before[-_BEFORE:]
            rise = max(_RISE_SHARE * self._config.force_threshold_n, 2.0 * self._noise)
            first_us = sample.t_us
            for earlier in reversed(before):
                if earlier.fx * earlier.fx + earlier.fy * earlier.fy < rise * rise:
                    break
                first_us = earlier.t_us
        else:
            first_us = _onset_of_mean([*before, sample], (fx / size, fy / size))
        self._samples = [*before, sample]
        self._before.clear()
        for window in self._windows:
            window.forget()
        self._quiet_since_us = None
        self._armed = False
        self.stage = "rising"
        self.slow_force.settle()
        self._onset = ImpactOnset(
            t_us=sample.t_us,
            first_us=first_us,
            received_us=received_us,
            force_mission=estimate.force_mission,
            velocity_mission=state.velocity_before(first_us),
            position_mission=state.position_at(sample.t_us),
            planned=planned,
        )
        return self._onset

    # -- peak --

    def _peak_is_past(self, now_us: int) -> bool:
        """Return whether the normal force has dropped more than noise explains, or `peak_wait_s` is over."""
        assert self._onset is not None
        if now_us - self._onset.first_us >= self._config.peak_wait_s * 1e6:
            return True
        nx, ny = self._normal
        inside = [s.fx * nx + s.fy * ny for s in self._samples if s.t_us >= self._onset.first_us]
        if len(inside) < 3:
            return False
        size = self._smoothing(max(inside))
        smooth = [sum_in_order(inside[i : i + size]) / size for i in range(len(inside) - size + 1)]
        top = max(smooth, default=0.0)
        threshold = self._config.force_threshold_n
        if top < 0.5 * threshold:
            return False
        drop = max(
            PEAK_DROP_FRACTION * top,
            _PEAK_DROP_SHARE * threshold,
            _DROP_SIGMA * self._noise * math.sqrt(2.0 / size),
        )
        return smooth[-1] < top - drop

    def _smoothing(self, top: float) -> int:
        """Return the number of samples to average so that their noise is small compared with `top`."""
        ratio = self._noise / max(_SMOOTH_SHARE * top, 1e-6)
        return max(1, min(_MAX_SMOOTH, round(ratio * ratio)))

    def _peak(self, now_us: int, received_us: int, state: FlightState) -> ImpactPeak:
        assert self._onset is not None
        along = self._direction()
        if not self._onset.planned or along[0] * self._normal[0] + along[1] * self._normal[1] <= 0.0:
            self._normal = along
        nx, ny = self._normal
        reference_us = self._onset.first_us
        readings = self._readings(reference_us)
        pulse = self._fit(readings, state)
        inside = [s for s in self._samples if s.t_us >= reference_us]
        clipped = any(s.clipped for s in inside)
        # A rotated body touches with one point first, which the model's pulse does not describe.
        fits = pulse is not None and (clipped or pulse.misfit <= PULSE_MISFIT)
        if pulse is None or not fits:
            normal_n, peak_us = _top_of([(s.t_us, s.fx * nx + s.fy * ny) for s in inside])
        else:
            normal_n, peak_us = pulse.peak_n, reference_us + round(pulse.peak_s * 1e6)
        tangential = self._friction(readings, pulse, inside, state)
        return ImpactPeak(
            t_us=min(peak_us, now_us),
            detected_us=now_us,
            received_us=received_us,
            normal=self._normal,
            normal_force_n=normal_n,
            tangential_force_n=tangential,
            position_mission=state.position_at(min(peak_us, now_us)),
            clipped=clipped,
            normal_sigma_n=self._noise if pulse is None or not fits else pulse.sigma_n,
            fitted=fits,
        )

    def _direction(self) -> Vec2:
        """Return the direction of the impulse so far, which is steadier than the direction of a sample."""
        sx = sum_in_order(s.fx * s.dt_us for s in self._samples)
        sy = sum_in_order(s.fy * s.dt_us for s in self._samples)
        size = math.hypot(sx, sy)
        return (sx / size, sy / size) if size > 0.0 else self._normal

    def _readings(self, reference_us: int) -> list[TickReading]:
        """Return the contact's samples as mean forces over ticks, in seconds from `reference_us`.

        The lag of the anti-alias filter is subtracted from the ticks.
        """
        nx, ny = self._normal
        lag_us = self._lag_s * 1e6
        out = []
        last = len(self._samples) - 1
        for i, s in enumerate(self._samples):
            # Clipping also lowers the readings before and after the clipped reading.
            bound = (
                s.clipped
                or (i > 0 and self._samples[i - 1].clipped)
                or (i < last and self._samples[i + 1].clipped)
            )
            b = (s.t_us - reference_us - lag_us) * 1e-6
            a = b - self._tick_us * 1e-6
            out.append(TickReading(a, b, s.fx * nx + s.fy * ny, s.fx * ny - s.fy * nx, bound))
        return out

    def _mean_push(self) -> Vec2:
        n = len(self._samples)
        return (
            sum_in_order(s.push[0] for s in self._samples) / n,
            sum_in_order(s.push[1] for s in self._samples) / n,
        )

    def _prior(self, state: FlightState) -> PulsePrior:
        mode = Mode.RIGID if state.lock_is_in(Mode.RIGID) else Mode.FLEXIBLE
        assert self._onset is not None
        return self._prior_of(self._expected if self._onset.planned else ExpectedContact(), mode)

    def _prior_of(self, expected: ExpectedContact, mode: Mode) -> PulsePrior:
        return self._typical[mode] if expected.material is None else self._priors[expected.material, mode]

    def _fit(self, readings: list[TickReading], state: FlightState) -> NormalPulse | None:
        push = self._mean_push()
        towards = -(push[0] * self._normal[0] + push[1] * self._normal[1])
        onset_s = -0.75 * self._tick_us * 1e-6
        return fit_normal(readings, towards, self._prior(state), max(self._noise, 1e-3), onset_s, self._lag_s)

    def _friction(
        self,
        readings: list[TickReading],
        pulse: NormalPulse | None,
        inside: list[_Sample],
        state: FlightState,
    ) -> float:
        nx, ny = self._normal
        if pulse is not None:
            push = self._mean_push()
            along = (push[0] * ny - push[1] * nx) / self._mass
            kappa = self._prior(state).kappa
            fitted = fit_friction(readings, pulse, along, self._mass, kappa, max(self._noise, 1e-3))
            if fitted is not None:
                return fitted
        along_wall = [s.fx * ny - s.fy * nx for s in inside]
        sign = -1.0 if abs(min(along_wall)) > max(along_wall) else 1.0
        top, _ = _top_of([(s.t_us, sign * f) for s, f in zip(inside, along_wall, strict=True)])
        return sign * max(0.0, top)

    # -- end --

    def _end(self, t_us: int, fx: float, fy: float) -> ContactEnd | None:
        release = RELEASE_FRACTION * self._threshold
        if self._detecting_window is not None or self._noise_hides_release(release):
            fx, fy = self._windows[2].mean
        assert self._onset is not None
        lasts = t_us - self._onset.first_us < _LONGEST_CONTACT_S * 1e6
        if lasts and fx * self._normal[0] + fy * self._normal[1] >= release:
            self._quiet_since_us = None
            return None
        if self._quiet_since_us is None:
            self._quiet_since_us = t_us
        if t_us - self._quiet_since_us < CONTACT_END_S * 1e6:
            return None
        self.stage = "refractory"
        self._ended_us = t_us
        return ContactEnd(t_us=self._quiet_since_us, first_us=self._onset.first_us)

    def _noise_hides_release(self, release: float) -> bool:
        """Return whether the noise of a sample often exceeds the release level.

        If so, the mean over the short window is compared with the release level instead.
        """
        return _DROP_SIGMA * self._noise > release


def confirmed_force(
    fx: float, fy: float, previous: tuple[Vec2, Vec2], noise_n: float, config: Detection
) -> Vec2:
    """Return the mean force of the newest two samples, or of three if the noise is large, newton."""
    (ax, ay), (bx, by) = previous
    if _FAR_SIGMA * noise_n <= config.force_threshold_n:
        return (0.5 * (fx + ax), 0.5 * (fy + ay))
    return ((fx + ax + bx) / 3.0, (fy + ay + by) / 3.0)


def _onset_of_mean(samples: list[_Sample], along: Vec2) -> int:
    """Return the onset's stamp for a pulse that a window mean has detected.

    Half of the mean of the newest forces is subtracted from each force. The reduced forces are summed from
    each stamp to the newest. The stamp with the largest sum is the onset.
    """
    forces = [s.fx * along[0] + s.fy * along[1] for s in samples]
    rest = 0.5 * sum_in_order(forces[-_BEFORE:]) / min(len(forces), _BEFORE)
    best, total, first = -math.inf, 0.0, len(samples) - 1
    for i in range(len(samples) - 1, -1, -1):
        total += forces[i] - rest
        if total > best:
            best, first = total, i
    return samples[first].t_us


def _prior(c: Coefficients, mass_kg: float) -> PulsePrior:
    return PulsePrior(math.sqrt(c.k / mass_kg), 0.5 * c.f / mass_kg, max(1e-3, c.mu / mass_kg))


def _mean_prior(priors: list[PulsePrior]) -> PulsePrior:
    """Return the prior for an unplanned wall: the geometric mean of the priors of the materials."""
    if not priors:
        return PulsePrior(50.0, 4.0, 1.0)

    def mean(values: list[float]) -> float:
        return math.exp(sum_in_order(math.log(max(v, 1e-6)) for v in values) / len(values))

    return PulsePrior(
        mean([p.omega for p in priors]), mean([p.sigma for p in priors]), mean([p.kappa for p in priors])
    )


def _top_of(pulse: list[tuple[int, float]]) -> tuple[float, int]:
    """Return height and stamp of a pulse's top, from a least-squares parabola near its maximum."""
    top = max(range(len(pulse)), key=lambda i: pulse[i][1])
    t0, height = pulse[top]
    floor = _TOP_SHARE * height
    first = last = top
    while first > 0 and top - first < _TOP_REACH and pulse[first - 1][1] >= floor:
        first -= 1
    while last < len(pulse) - 1 and last - top < _TOP_REACH and pulse[last + 1][1] >= floor:
        last += 1
    points = [((t - t0) * 1e-3, y) for t, y in pulse[first : last + 1]]  # milliseconds from the maximum
    if len(points) < 4:
        return height, t0
    # Normal equations of y = c + b x + a x^2, centred for conditioning.
    n = float(len(points))
    xm = sum_in_order(x for x, _ in points) / n
    s2 = s3 = s4 = p0 = p1 = p2 = 0.0
    for x, y in points:
        d = x - xm
        s2 += d * d
        s3 += d * d * d
        s4 += d * d * d * d
        p0 += y
        p1 += d * y
        p2 += d * d * y
    determinant = n * (s2 * s4 - s3 * s3) - s2 * s2 * s2
    if determinant <= 0.0:
        return height, t0
    c = (p0 * (s2 * s4 - s3 * s3) - s2 * (p2 * s2 - p1 * s3)) / determinant
    b = (n * (p1 * s4 - p2 * s3) - s2 * (p1 * s2 - p0 * s3)) / determinant
    a = (n * (s2 * p2 - s3 * p1) - s2 * s2 * p0) / determinant
    if a >= 0.0:
        return height, t0
    x_top = -0.5 * b / a
    if not points[0][0] <= x_top + xm <= points[-1][0]:
        return height, t0
    return c - 0.25 * b * b / a, t0 + round((x_top + xm) * 1e3)
