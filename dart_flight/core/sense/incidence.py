"""How an impact met the vehicle's body: which point of a side came first, and at what angle (docs/torque.md).

A side touches a wall with two points, `airframe.guard_along_m` (a) to the right and left of its middle, which
is `airframe.contact_distance_m` (d) ahead. With i the angle of incidence (positive: turned to the left, the
right point is nearer), the right point leads by 2 a sin i, and the normal forces of the two differ by

    D = k/2 lead + f/2 d(lead)/dt,  at most by their sum F,

so that the torque about the vertical, positive where it turns the vehicle to the right, is

    D a cos i - F d sin i - c T

with T the friction along the wall and c the lever at which it acts. F, T and the torque are estimated, the
change of i since the first touch is the gyro's, k and f are the expected wall's. What is sought is i at the
first touch. The attitude gives it as well as the wall's direction is known; a wall may stand a few degrees
off the plan. The force's direction tells, too: T = -mu F v, with v the speed along the wall. For a given i,
c and mu follow in closed form, both loosely held; the best i is sought on a grid and refined.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Final, NamedTuple

from dart_flight.base.geometry import (
    MissionFrame,
    Quaternion,
    Vec2,
    Vec3,
    norm,
    quaternion_conjugate,
    rotate,
    wrap_angle,
    yaw_ned_of,
)
from dart_flight.base.records import (
    ContactEnd,
    ContactSide,
    ForceEstimate,
    ImpactBody,
    ImpactOnset,
    ImpactPeak,
    Mode,
    TorqueEstimate,
)
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.core.sense.detector import Events, ExpectedContact
from dart_flight.core.sense.state import FlightState

MIN_LEAD_M: Final = 0.002  # a smaller lead is none: both points at once
_BEFORE: Final = 3  # samples of the contact from before the first one that was over the noise
_MAX: Final = 160  # samples of a contact
_MAX_BINS: Final = 18
_GRID_RAD = math.radians(3.0)
_GRID_REACH: Final = 5  # steps to either side of what the attitude says
_GUESSES = (0.6, 1.0, 1.6, 2.5)  # of the angle that a line gives
_REFINE: Final = 4
_FINE: Final = 4  # points of the fitted torque in a tick
_QUADRATIC = (-3.0 / 35.0, 12.0 / 35.0, 17.0 / 35.0, 12.0 / 35.0, -3.0 / 35.0)
_NEAR_TOP: Final = 0.6  # share of the torque's top from which on a sample says how large it is
_SURE_SIGMA: Final = 4.0  # a fitted torque below this many times the noise says nothing of the peak's shape
_COMMON: Final = 1.5  # more than the samples say: what the model is off by is much the same in all of them
_QUARTER = 0.5 * math.pi


class Known(NamedTuple):
    """How well things are known beforehand: standard deviations (docs/torque.md says how they were found).

    Attributes:
        wall_rad: direction of a planned wall, together with that of the attitude.
        unplanned_rad: of another one, whose normal is the force's direction.
        lever_share: of the distance to the wall: at which friction turns the vehicle, expected.
        lever_share_sd: likewise, deviation.
        friction: of mu, relative.
        torque_share: error of the model, of the largest torque that the normal force can have.
        force_share: ... of the friction, of the largest normal force.
    """

    wall_rad: float = math.radians(4.0)
    unplanned_rad: float = math.radians(15.0)
    lever_share: float = 0.3
    lever_share_sd: float = 0.3
    friction: float = 0.5
    torque_share: float = 0.05
    force_share: float = 0.05


class _FitSample(NamedTuple):
    """A sample, or the mean of some, along the normal and the tangent believed in."""

    samples: int
    normal: float  # force, N
    along: float
    torque: float  # about the vertical, positive turns to the right
    turned: float  # since the first touch, positive to the left
    turning: float  # its rate
    towards: float  # speed along the normal, m/s
    sliding: float


class ContactSample:
    """What an IMU sample has given: force, torque, attitude, mean rate over its tick (rad/s, FRD)."""

    __slots__ = ("force", "q", "rate", "torque")

    def __init__(self, force: ForceEstimate, torque: TorqueEstimate, q: Quaternion, rate: Vec3) -> None:
        self.force, self.torque, self.q, self.rate = force, torque, q, rate


class ContactSampleBuffer:
    """The newest samples, as many as a contact has: one memory for all that look at contacts."""

    def __init__(self) -> None:
        self._samples: deque[ContactSample] = deque(maxlen=_MAX)

    def add(self, sample: ContactSample) -> None:
        """The next IMU sample."""
        self._samples.append(sample)

    @property
    def newest(self) -> ContactSample:
        """The last one added.

        Raises:
            IndexError: there is none.
        """
        return self._samples[-1]

    def since(self, first_us: int, before: int) -> tuple[list[ContactSample], list[ContactSample]]:
        """The samples from a stamp on, and at most so many just before it: (before, since)."""
        since = [s for s in self._samples if s.force.t_us >= first_us]
        earlier = [s for s in self._samples if s.force.t_us < first_us]
        return earlier[-before:], since


class IncidenceEstimator:
    """Follows force and torque through a contact and says how it met the body.

    Args:
        vehicle: its body and what materials it meets.
        samples: of force and torque; whoever owns them adds each before `take`.
        known: how well things are known beforehand.

    Attributes:
        due: there is something to be said after the next sample, whatever the detector makes of it.
    """

    def __init__(
        self, vehicle: VehicleConfig, samples: ContactSampleBuffer, known: Known | None = None
    ) -> None:
        self._vehicle, self._known = vehicle, known or Known()
        self._mass = vehicle.airframe.mass_kg
        self._along, self._out = vehicle.airframe.guard_along_m, vehicle.airframe.contact_distance_m
        self._typical = {
            mode: middle_of(m.of(mode) for m in vehicle.materials.values()) for mode in vehicle.modes
        }
        self._samples = samples
        self._slow: Vec2 = (0.0, 0.0)
        self._onset: ImpactOnset | None = None
        self._peak: ImpactPeak | None = None
        self.due = False
        self._coefficients: Coefficients | None = None

    def update(
        self, state: FlightState, slow: Vec2, events: Events, expected: ExpectedContact
    ) -> ImpactBody | None:
        """What the detector made of the newest sample's force.

        Args:
            state: lock and frame.
            slow: horizontal force that is there all the time, mission frame, newton.
            events: of the detector.
            expected: what the mission expects; counts at the onset.
        """
        told = None
        if self.due:
            # One sample after the peak: the recovery's setpoint does not wait for it.
            self.due = False
            told = self._judge(state, final=False)
        for event in events:
            if isinstance(event, ImpactOnset):
                self._onset, self._peak, self._slow = event, None, slow
                self._coefficients = self._coefficients_of(
                    expected if event.planned else ExpectedContact(), state
                )
            elif isinstance(event, ImpactPeak):
                self._peak, self.due = event, True
            elif isinstance(event, ContactEnd) and self._peak is not None:
                told, self.due = self._judge(state, final=True), False
        return told

    def _coefficients_of(self, expected: ExpectedContact, state: FlightState) -> Coefficients:
        mode = Mode.RIGID if state.lock_is_in(Mode.RIGID) else Mode.FLEXIBLE
        if expected.material is None:
            return self._typical[mode]
        return self._vehicle.materials[expected.material].of(mode)

    def _judge(self, state: FlightState, final: bool) -> ImpactBody | None:
        onset, peak, frame, c = self._onset, self._peak, state.frame, self._coefficients
        assert onset is not None  # before any peak
        assert peak is not None
        assert c is not None
        if frame is None:
            return None
        before, inside = self._samples.since(onset.first_us, _BEFORE)
        if len(inside) < 2:
            return None
        samples = [*before, *inside]
        rows = _fit_samples(samples, peak.normal, self._slow, onset.velocity_mission, self._mass)
        seen = seen_incidence(frame, samples[0].q, peak.normal)
        noise = (max(1e-4, norm(inside[0].torque.noise_frd_nm) * 0.6), max(1e-3, inside[0].force.noise_n))
        fit = _IncidenceFit(rows, seen, c, noise, self._along, self._out, self._known, onset.planned)
        incidence, sigma = fit.run()
        lead = 2.0 * self._along * math.sin(incidence)
        top = _torque_peak(samples, fit.torques(incidence), noise[0])
        return ImpactBody(
            t_us=inside[-1].force.t_us,
            first_us=onset.first_us,
            final=final,
            side=side_of(lead),
            lead_m=lead,
            incidence_rad=incidence,
            incidence_sigma_rad=sigma,
            torque_peak_frd=top,
            peak_torque_nm=norm(top),
        )


def seen_incidence(frame: MissionFrame, q: Quaternion, normal: Vec2) -> float:
    """Angle of incidence of the edge that is nearest to a wall, by attitude and the wall's normal."""
    seen = wrap_angle(frame.yaw_from_ned(yaw_ned_of(q)) - math.atan2(-normal[1], -normal[0]))
    return seen - _QUARTER * round(seen / _QUARTER)


def side_of(lead_m: float) -> ContactSide:
    """Which point came first, by how much nearer to the wall the right one was."""
    if abs(lead_m) < MIN_LEAD_M:
        return ContactSide.BOTH
    return ContactSide.RIGHT if lead_m > 0.0 else ContactSide.LEFT


def _fit_samples(
    samples: list[ContactSample], normal: Vec2, slow: Vec2, velocity: Vec3, mass_kg: float
) -> list[_FitSample]:
    """The samples as the fit takes them."""
    nx, ny = normal
    turned = 0.0
    vx, vy = velocity[0], velocity[1]
    last_us = samples[0].force.t_us
    rows = []
    for sample in samples:
        force, torque, q, rate = sample.force, sample.torque, sample.q, sample.rate
        dt_s = (force.t_us - last_us) * 1e-6
        last_us = force.t_us
        fx, fy = force.force_mission[0] - slow[0], force.force_mission[1] - slow[1]
        vx += dt_s / mass_kg * (fx + force.push_mission[0])
        vy += dt_s / mass_kg * (fy + force.push_mission[1])
        turning = -rotate(q, rate)[2]  # the mission's z points up
        turned += dt_s * turning
        down = rotate(q, torque.torque_frd)[2]
        rows.append(
            _FitSample(
                1,
                fx * nx + fy * ny,
                fx * ny - fy * nx,
                down,
                turned,
                turning,
                vx * nx + vy * ny,
                vx * ny - vy * nx,
            )
        )
    return rows


def _binned(rows: list[_FitSample]) -> list[_FitSample]:
    """Means of neighbours where there are many."""
    size = -(-len(rows) // _MAX_BINS)
    return rows if size == 1 else [_mean(rows[i : i + size]) for i in range(0, len(rows), size)]


def _mean(rows: list[_FitSample]) -> _FitSample:
    n = len(rows)
    _, *values = zip(*rows, strict=True)
    return _FitSample(n, *(sum(column) / n for column in values))


def _torque_peak(samples: list[ContactSample], model: list[float], noise_nm: float) -> Vec3:
    """Largest torque, FRD, from samples and fitted torque about the vertical, `_FINE` times in a tick.

    The largest of noisy samples is biased, and a tick's mean cuts the top off where the second point meets
    the wall. So the model gives the shape about the vertical, the samples near its top say how large it is,
    and what they have beside it is smoothed.
    """
    torques = [s.torque.torque_frd for s in samples]
    down = [rotate(quaternion_conjugate(s.q), (0.0, 0.0, 1.0)) for s in samples]
    means = [sum(model[_FINE * i : _FINE * (i + 1)]) / _FINE for i in range(len(samples))]
    top = max(means, key=abs)
    square = gain = 0.0
    for t, d, m in zip(torques, down, means, strict=True):
        if m * top >= _NEAR_TOP * top * top:
            square += m * m
            gain += m * (t[0] * d[0] + t[1] * d[1] + t[2] * d[2])
    share = gain / square if square > 0.0 and abs(top) > _SURE_SIGMA * noise_nm else 0.0
    beside = _smoothed(
        [
            (t[0] - share * m * d[0], t[1] - share * m * d[1], t[2] - share * m * d[2])
            for t, d, m in zip(torques, down, means, strict=True)
        ]
    )
    best, size = (0.0, 0.0, 0.0), -1.0
    for k, fitted in enumerate(model):
        d, b, m = down[k // _FINE], beside[k // _FINE], share * fitted
        found = (b[0] + m * d[0], b[1] + m * d[1], b[2] + m * d[2])
        if (length := norm(found)) > size:
            best, size = found, length
    return best


def _smoothed(values: list[Vec3]) -> list[Vec3]:
    """Quadratic through five neighbours, where there are as many."""
    out = list(values)
    for i in range(2, len(values) - 2):
        part = values[i - 2 : i + 3]
        x, y, z = (sum(w * v[a] for w, v in zip(_QUADRATIC, part, strict=True)) for a in range(3))
        out[i] = (x, y, z)
    return out


class _IncidenceFit:
    """The angle of incidence at the first touch, by force, torque, speed and attitude."""

    def __init__(
        self,
        rows: list[_FitSample],
        seen: float,
        c: Coefficients,
        noise: tuple[float, float],
        along: float,
        out: float,
        known: Known,
        planned: bool,
    ) -> None:
        self._rows, self._seen, self._c = rows, seen, c
        self._along, self._out, self._known = along, out, known
        self._wall = known.wall_rad if planned else known.unplanned_rad
        self._lever = 0.0  # of friction, at the angle looked at last
        self._bins = _binned(rows)
        top = max(0.0, *(r.normal for r in self._bins))
        torque_error, force_error = known.torque_share * along * top, known.force_share * top
        self._weights = [
            (
                1.0 / (noise[0] ** 2 / r.samples + torque_error**2),
                1.0 / (noise[1] ** 2 / r.samples + force_error**2),
            )
            for r in self._bins
        ]

    def run(self) -> tuple[float, float]:
        """Angle and its standard deviation, radians."""
        step = _GRID_RAD
        tried = [self._seen + step * i for i in range(-_GRID_REACH, _GRID_REACH + 1)]
        guess = self._both_touching()
        tried += [factor * guess for factor in _GUESSES]
        least, best = min((self._cost(angle), angle) for angle in tried)
        curve = 0.0
        # Where one point alone has all the force the angle hardly matters: the valley is this wide.
        top = max(r.normal for r in self._bins)
        step = min(step, 0.5 * top / (self._along * self._c.k))
        for _ in range(_REFINE):
            step *= 0.4
            low, high = self._cost(best - step), self._cost(best + step)
            curve = (low - 2.0 * least + high) / (step * step)
            options = [(least, best), (low, best - step), (high, best + step)]
            if curve > 0.0:
                to = best + max(-step, min(step, 0.5 * (low - high) / (curve * step)))
                options.append((self._cost(to), to))
            least, best = min(options)
        sigma = _COMMON * math.sqrt(2.0 / curve) if curve > 0.0 else self._wall
        return wrap_angle(best), min(sigma, self._wall)

    def _both_touching(self) -> float:
        """The angle if both points touched all the time and friction had the expected lever: a line."""
        stiff, damp = self._along**2 * self._c.k, self._along**2 * self._c.f
        lever = self._known.lever_share * self._out
        xx = xy = 0.0
        for r, (weight, _) in zip(self._bins, self._weights, strict=True):
            slope = stiff - max(0.0, r.normal) * self._out
            y = r.torque + lever * r.along - slope * r.turned - damp * r.turning
            xx += weight * slope * slope
            xy += weight * slope * y
        return xy / xx

    def torques(self, incidence: float) -> list[float]:
        """The fitted torque about the vertical, `_FINE` times in every sample's tick."""
        self._cost(incidence)
        off = self._seen - incidence
        co, so = math.cos(off), math.sin(off)
        # The force's noise must not become the torque's.
        forces = _smoothed([(r.normal, r.along, 0.0) for r in self._rows])
        points = [
            (max(0.0, n * co - t * so), t * co + n * so, incidence + r.turned, r.turning)
            for r, (n, t, _) in zip(self._rows, forces, strict=True)
        ]
        out = []
        last = len(points) - 1
        for k in range(_FINE * len(points)):
            # Means stand for the middle of their tick; between two middles they go straight.
            at = min(max((k + 0.5) / _FINE - 0.5, 0.0), float(last))
            i = int(at)
            share = at - i
            (n0, t0, a0, w0), (n1, t1, a1, w1) = points[i], points[min(i + 1, last)]
            normal_n = n0 + share * (n1 - n0)
            angle, turning = a0 + share * (a1 - a0), w0 + share * (w1 - w0)
            si, ci = math.sin(angle), math.cos(angle)
            uneven = self._along * (self._c.k * si + self._c.f * ci * turning)
            uneven = max(-normal_n, min(normal_n, uneven))
            by_normal = uneven * self._along * ci - normal_n * self._out * si
            out.append(by_normal - self._lever * (t0 + share * (t1 - t0)))
        return out

    def _cost(self, incidence: float) -> float:
        """Least cost over lever and friction for this angle at the first touch."""
        known, a, out = self._known, self._along, self._out
        stiff, damp, mu = a * self._c.k, a * self._c.f, self._c.mu
        # The wall against the normal believed in, counter-clockwise.
        off = self._seen - incidence
        co, so = math.cos(off), math.sin(off)
        lever, lever_sd = known.lever_share * out, known.lever_share_sd * out
        mu_sd = known.friction * mu + 1e-3
        txx, fxx = 1.0 / (lever_sd * lever_sd), 1.0 / (mu_sd * mu_sd)
        txy, fxy = lever * txx, mu * fxx
        tyy, fyy = lever * txy, mu * fxy
        for r, (torque_weight, force_weight) in zip(self._bins, self._weights, strict=True):
            normal_n = r.normal * co - r.along * so
            normal_n = max(normal_n, 0.0)
            friction_n = r.along * co + r.normal * so
            angle = incidence + r.turned
            si, ci = math.sin(angle), math.cos(angle)
            uneven = stiff * si + damp * ci * r.turning
            if uneven > normal_n:
                uneven = normal_n
            elif uneven < -normal_n:
                uneven = -normal_n
            y = r.torque - uneven * a * ci + normal_n * out * si
            txx += torque_weight * friction_n * friction_n
            txy -= torque_weight * friction_n * y
            tyy += torque_weight * y * y
            slide = -normal_n * (r.sliding * co + r.towards * so)
            fxx += force_weight * slide * slide
            fxy += force_weight * slide * friction_n
            fyy += force_weight * friction_n * friction_n
        self._lever = txy / txx
        return (off / self._wall) ** 2 + tyy - self._lever * txy + fyy - fxy * fxy / fxx


def middle_of(coefficients: Iterable[Coefficients]) -> Coefficients:
    """Geometric mean over the materials: what is expected of a wall that is in no plan."""
    every = list(coefficients)

    def mean(values: list[float]) -> float:
        return math.exp(sum(math.log(max(v, 1e-6)) for v in values) / max(1, len(values)))

    return Coefficients(
        mean([c.k for c in every]),
        mean([c.f for c in every]),
        mean([c.mu for c in every]),
        mean([c.nu for c in every]),
    )
