"""Impact detection: threshold, peak of each component, end of contact, one event of each per impact.

A collision is registered when the horizontal force reaches the threshold (ours; the paper tests each axis,
switchable). The forces of the recovery are the peaks: of the normal and of the tangential component each its
own, since the onset, by a parabola through the top of the pulse, because the maximum of noisy samples is
biased upward. States: watching -> rising -> falling -> refractory -> watching.
"""

from __future__ import annotations

from collections import deque
from enum import Enum, auto

import msgspec

from dart_flight.config.vehicle import Detection, ThresholdTest
from dart_flight.flight.state import FlightState
from dart_flight.geometry import Vec2, horizontal
from dart_flight.samples import ContactEnd, ForceEstimate, ImpactOnset, ImpactPeak

_RISE_SHARE = 0.3  # of the threshold: above it a sample before the crossing belongs to the contact
_PEAK_DROP_SHARE = 0.25  # of the threshold: a smaller drop is noise
_TOP_SHARE = 0.7  # samples above this share of the maximum are the top of the pulse
_TOP_REACH = 4  # samples on either side, at most


class _Sample(msgspec.Struct, gc=False):
    t_us: int
    normal: float
    tangential: float
    clipped: bool


class _Stage(Enum):
    WATCHING = auto()
    RISING = auto()
    FALLING = auto()
    REFRACTORY = auto()


class ImpactDetector:
    """One impact, one onset, one peak, one end.

    `watching` is set by the executive: on the ground, in the climb and on landing no contact is an impact.
    `expected_normal` is the outward normal of the wall that the plan hits next; without one the normal is
    taken along the force.
    """

    def __init__(self, config: Detection) -> None:
        self._config = config
        self._stage = _Stage.WATCHING
        self._before: deque[ForceEstimate] = deque(maxlen=8)
        self._samples: list[_Sample] = []
        self._normal: Vec2 = (1.0, 0.0)
        self._onset: ImpactOnset | None = None
        self._quiet_since_us: int | None = None
        self._ended_us = 0
        self.watching = False
        self.expected_normal: Vec2 | None = None

    @property
    def in_contact(self) -> bool:
        """Between onset and end of contact."""
        return self._stage in (_Stage.RISING, _Stage.FALLING)

    def update(
        self, estimate: ForceEstimate, received_us: int, state: FlightState
    ) -> list[ImpactOnset | ImpactPeak | ContactEnd]:
        """Take the next force estimate; returns the events it brings, none at most times."""
        events: list[ImpactOnset | ImpactPeak | ContactEnd] = []
        over = estimate.t_us - self._ended_us >= self._config.refractory_s * 1e6
        if self._stage is _Stage.REFRACTORY and over:
            self._stage = _Stage.WATCHING
        if self._stage is _Stage.WATCHING:
            if self.watching and self._crosses(estimate):
                events.append(self._begin(estimate, received_us, state))
            else:
                self._before.append(estimate)
        elif self._stage is _Stage.RISING:
            self._append(estimate)
            if self._peak_is_past(estimate.t_us):
                self._stage = _Stage.FALLING
                events.append(self._peak(estimate.t_us, received_us, state))
        elif self._stage is _Stage.FALLING:
            end = self._end(estimate)
            if end is not None:
                events.append(end)
        return events

    # -- onset --

    def _crosses(self, estimate: ForceEstimate) -> bool:
        threshold = self._config.force_threshold_n
        fx, fy, _ = estimate.force_mission
        if self._config.threshold_test is ThresholdTest.PER_AXIS:
            return abs(fx) >= threshold or abs(fy) >= threshold
        return horizontal(estimate.force_mission) >= threshold

    def _begin(self, estimate: ForceEstimate, received_us: int, state: FlightState) -> ImpactOnset:
        fx, fy, _ = estimate.force_mission
        if self.expected_normal is not None:
            self._normal = self.expected_normal
        else:
            size = max(horizontal(estimate.force_mission), 1e-9)
            self._normal = (fx / size, fy / size)
        rise = _RISE_SHARE * self._config.force_threshold_n
        rising: list[ForceEstimate] = []
        for earlier in reversed(self._before):
            if horizontal(earlier.force_mission) < rise:
                break
            rising.insert(0, earlier)
        first_us = rising[0].t_us if rising else estimate.t_us
        self._samples = []
        for one in (*rising, estimate):
            self._append(one)
        self._before.clear()
        self._quiet_since_us = None
        self._stage = _Stage.RISING
        self._onset = ImpactOnset(
            t_us=estimate.t_us,
            first_us=first_us,
            received_us=received_us,
            force_mission=estimate.force_mission,
            velocity_mission=state.velocity_before(first_us),
            position_mission=state.position_at(estimate.t_us),
        )
        return self._onset

    def _append(self, estimate: ForceEstimate) -> None:
        fx, fy, _ = estimate.force_mission
        nx, ny = self._normal
        self._samples.append(_Sample(estimate.t_us, fx * nx + fy * ny, fx * ny - fy * nx, estimate.clipped))

    # -- peak --

    def _peak_is_past(self, now_us: int) -> bool:
        assert self._onset is not None
        if now_us - self._onset.first_us >= self._config.peak_wait_s * 1e6:
            return True
        top = max(self._samples, key=lambda s: s.normal)
        if top.normal < self._config.force_threshold_n * 0.5:
            return False
        drop = max(
            self._config.peak_drop_fraction * top.normal, _PEAK_DROP_SHARE * self._config.force_threshold_n
        )
        after = [s for s in self._samples if s.t_us > top.t_us]
        return len(after) >= 2 and after[-1].normal < top.normal - drop

    def _peak(self, now_us: int, received_us: int, state: FlightState) -> ImpactPeak:
        normal_n, peak_us = _top_of([(s.t_us, s.normal) for s in self._samples])
        tangential_sign = 1.0
        if abs(min(s.tangential for s in self._samples)) > max(s.tangential for s in self._samples):
            tangential_sign = -1.0
        tangential_n, _ = _top_of([(s.t_us, tangential_sign * s.tangential) for s in self._samples])
        return ImpactPeak(
            t_us=peak_us,
            detected_us=now_us,
            received_us=received_us,
            normal=self._normal,
            normal_force_n=normal_n,
            tangential_force_n=tangential_sign * max(0.0, tangential_n),
            position_mission=state.position_at(peak_us),
            clipped=any(s.clipped for s in self._samples),
        )

    # -- end --

    def _end(self, estimate: ForceEstimate) -> ContactEnd | None:
        release = self._config.release_fraction * self._config.force_threshold_n
        fx, fy, _ = estimate.force_mission
        pressing = fx * self._normal[0] + fy * self._normal[1]
        if pressing >= release:
            self._quiet_since_us = None
            return None
        if self._quiet_since_us is None:
            self._quiet_since_us = estimate.t_us
        if estimate.t_us - self._quiet_since_us < self._config.contact_end_s * 1e6:
            return None
        assert self._onset is not None
        self._stage = _Stage.REFRACTORY
        self._ended_us = estimate.t_us
        return ContactEnd(t_us=self._quiet_since_us, first_us=self._onset.first_us)


def _top_of(pulse: list[tuple[int, float]]) -> tuple[float, int]:
    """Height and time of a pulse's top: the least-squares parabola through the samples near its maximum."""
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
    xm = sum(x for x, _ in points) / n
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
