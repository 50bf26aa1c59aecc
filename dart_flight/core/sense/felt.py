"""What a contact says of its wall and of the arms: coefficients in either mode, and which mode it was.

Both modes are the same contact law with other coefficients, so both are fitted to the same readings: the
means of the force over the ticks of the whole contact, normal and tangential. With x the signed distance of
the vehicle's centre to the wall's plane, a side's two guards g = 1 (right), -1 (left) at `guard_along_m` (a)
beside its middle, `contact_distance_m` (d) ahead, and i the angle of incidence, positive turned left,

    x_g = x - g a sin i + d (1 - cos i)        depth of a guard
    F   = sum of max(0, -(k x_g + f dx_g/dt)/2)
    T   = -mu F (v_t + b d di/dt)              b the share of the lever at which friction acts
    m dv/dt = force + push by thrust and drag

i is what the attitude and the gyro give, less the angle by which the wall stands off the plan. Unknown are
k, f and mu over what is believed of them, that angle, and distance and velocity at the beginning. The most
probable values are sought by Gauss-Newton steps (Levenberg's damping), the evidence for a mode is Laplace's:

    2 ln p(readings | mode) = -(misfit + prior) - ln det(curvature) + ln det(curvature of the prior)

Unlocked arms swing, and the IMU feels that. The force estimate has it taken out where the lock says
unlocked; a mode that the lock does not say gets its own readings. docs/felt.md.

Scalar floats and `math` only, once per contact.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.law import Onset
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.body import Felt
from dart_flight.core.sense.detector import Expected
from dart_flight.core.sense.state import FlightState
from dart_flight.geometry import Vec2, Wall, rotate, wrap_angle, yaw_ned_of
from dart_flight.samples import (
    ContactEnd,
    DetectionFloor,
    ImpactOnset,
    ImpactPeak,
    LockPhase,
    Mode,
    WallFelt,
)

_MOST = 160  # samples of a contact
_BEFORE = 4  # samples of the contact from before the first one that was over the noise
_FEWEST = 4  # readings in contact
_STEPS = 12
_SETTLED = 1e-3
_SUBSTEPS = 2  # of a tick
_QUARTER = 0.5 * math.pi
_LEAST_FACTOR = 0.1  # no coefficient is believed to be below this share of what was believed
_SLOWEST_M_S = 0.02
_VELOCITY_M_S, _VELOCITY_SHARE = 0.04, 0.02  # deviation of PX4's velocity, at rest and of the speed
_PLACE_M = 0.1  # how far off the plan a wall may stand: loosely held, the force tells
_POSITION_M = 0.01  # deviation of PX4's position against the walls' frame
_WALL_RAD = math.radians(4.0)  # of a wall's direction
_LEVER_SHARE = 0.3
# What the model is off by, of the largest force, and of the largest friction.
_MODEL_ERROR, _FRICTION_ERROR = 0.015, 0.03
_VERTICAL_N = 1.0  # deviation of the vertical force's mean over a contact
_K, _F, _X, _V, _D, _MU, _W = range(7)
_NORMAL, _ALL = 5, 7  # parameters of the normal motion come first


class Belief(NamedTuple):
    """Coefficients of a wall in a mode (`Coefficients`), each with its relative standard deviation."""

    k: float
    f: float
    mu: float
    nu: float
    k_sd: float
    f_sd: float
    mu_sd: float
    nu_sd: float


class Tick(msgspec.Struct, gc=False):
    """What one IMU sample says of a contact.

    Attributes:
        h: its length, s.
        normal, along: mean force along the planned wall's axes, N; `up`: vertical.
        push_normal, push_along: force of thrust and drag, N.
        bound: at full scale: the true force is larger.
        turned: angle since the first tick at its middle, rad, positive to the left; `turning`: its rate.
    """

    h: float
    normal: float
    along: float
    up: float
    push_normal: float
    push_along: float
    bound: bool
    turned: float
    turning: float


class Contact(NamedTuple):
    """A contact as the fit takes it.

    Attributes:
        ticks: its readings from a few before the first touch to a little after the last.
        touched_s: first touch after the first tick's beginning, about.
        velocity: along the planned wall's axes at the first tick's beginning, as PX4 has it, m/s.
        incidence_rad: leading edge against the planned wall then.
        noise_n: of a reading.
    """

    ticks: list[Tick]
    touched_s: float
    velocity: Vec2
    incidence_rad: float
    noise_n: float


class Body(NamedTuple):
    """Of the vehicle: mass, where the guards are, how a contact begins, the sign of the vertical force."""

    mass: float
    along: float
    out: float
    onset: Onset
    vertical_sign: int


class Hypothesis(NamedTuple):
    """A mode fitted to a contact.

    Attributes:
        evidence: natural logarithm, up to what both modes share.
        belief: of the wall in this mode, after the contact.
        incidence_rad, incidence_sd: at the first tick.
        place_m, place_sd: signed distance of the centre to the wall's plane at the first tick's beginning.
    """

    evidence: float
    belief: Belief
    incidence_rad: float
    incidence_sd: float
    place_m: float
    place_sd: float


class WallSense:
    """Follows the planned contacts and says at the end of each what was felt of the wall."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle, self._prior = vehicle, vehicle.estimation.walls
        a = vehicle.airframe
        self._body = Body(
            a.mass_kg,
            a.guard_along_m,
            a.contact_distance_m,
            Onset(vehicle.onset),
            vehicle.vertical_force_sign,
        )
        self._beliefs: dict[tuple[str, Mode], Belief] = {}
        self._samples: deque[Felt] = deque(maxlen=_MOST)
        self._slow: Vec2 = (0.0, 0.0)
        self._onset: ImpactOnset | None = None
        self._wall: Wall | None = None
        self._reported: Mode | None = None

    def take(
        self,
        sample: Felt,
        state: FlightState,
        slow: Vec2,
        events: Iterable[ImpactOnset | ImpactPeak | ContactEnd | DetectionFloor],
        expected: Expected,
    ) -> WallFelt | None:
        """The next IMU sample, and what the detector made of its force; arguments as of `BodySense.take`."""
        self._samples.append(sample)
        for event in events:
            if isinstance(event, ImpactOnset):
                self._wall = expected.wall if event.planned else None
                self._onset, self._slow = event, slow
                lock = state.lock
                self._reported = lock.mode if lock.phase is LockPhase.SETTLED else None
            elif isinstance(event, ContactEnd) and self._onset is not None and self._wall is not None:
                onset, self._onset = self._onset, None
                return self._judge(onset, self._wall, state)
        return None

    def _judge(self, onset: ImpactOnset, wall: Wall, state: FlightState) -> WallFelt:
        assert wall is not None
        before = {mode: self._belief(wall, mode) for mode in Mode}
        fits: dict[Mode, Hypothesis] = {}
        contacts = self._contacts(onset, wall, state)
        if contacts is not None:
            for mode in Mode:
                fit = fit_mode(contacts[mode], before[mode], self._prior.scatter, self._body)
                if fit is not None:
                    fits[mode] = fit
        odds, felt = 0.0, None
        if len(fits) == len(Mode):
            odds = fits[Mode.RIGID].evidence - fits[Mode.FLEXIBLE].evidence
            if abs(odds) >= self._prior.sure_log_odds:
                felt = Mode.RIGID if odds > 0.0 else Mode.FLEXIBLE
        likely = Mode.RIGID if odds > 0.0 else Mode.FLEXIBLE
        told = felt or self._reported or likely
        belief, fitted = before[told], fits.get(told)
        angle, angle_sd, offset, offset_sd = 0.0, _WALL_RAD, 0.0, _PLACE_M
        if fitted is not None and contacts is not None:
            if told is likely:
                belief = self._beliefs[wall.name, told] = fitted.belief
            angle, angle_sd = fitted.incidence_rad, fitted.incidence_sd
            contact = contacts[told]
            at = onset.position_mission
            back_s = contact.touched_s + (onset.t_us - onset.first_us) * 1e-6
            offset = wall.signed_distance(at) - contact.velocity[0] * back_s - fitted.place_m
            offset_sd = math.hypot(fitted.place_sd, _POSITION_M)
        return WallFelt(
            self._samples[-1].force.t_us,
            onset.first_us,
            wall.name,
            self._reported,
            felt,
            odds,
            *belief,
            angle,
            angle_sd,
            offset,
            offset_sd,
        )

    def _belief(self, wall: Wall, mode: Mode) -> Belief:
        found = self._beliefs.get((wall.name, mode))
        if found is not None:
            return found
        c, sd = self._vehicle.materials[wall.material].of(mode), self._prior.spread
        return Belief(c.k, c.f, c.mu, c.nu, sd, sd, sd, sd)

    def _contacts(self, onset: ImpactOnset, wall: Wall, state: FlightState) -> dict[Mode, Contact] | None:
        """The readings as each mode would have them; None where they are too few."""
        frame = state.frame
        inside = [s for s in self._samples if s.force.t_us >= onset.first_us]
        samples = [s for s in self._samples if s.force.t_us < onset.first_us][-_BEFORE:] + inside
        velocity = wall.to_collision(onset.velocity_mission)
        if frame is None or len(inside) < _FEWEST or velocity[0] > -_SLOWEST_M_S:
            return None
        tick_s = self._vehicle.imu.tick_s
        yaw = frame.yaw_from_ned(yaw_ned_of(samples[0].q))
        seen = wrap_angle(yaw - math.atan2(-wall.normal[1], -wall.normal[0]))
        seen -= _QUARTER * round(seen / _QUARTER)
        begin_us = samples[0].force.t_us - round(tick_s * 1e6)
        touched_s = (onset.first_us - begin_us) * 1e-6 - 0.75 * tick_s
        taken_out = self._reported is not Mode.RIGID
        noise_n = max(1e-2, inside[0].force.noise_n)
        return {
            mode: Contact(
                self._ticks(samples, wall, taken_out, mode is Mode.FLEXIBLE),
                touched_s,
                (velocity[0], velocity[1]),
                seen,
                noise_n,
            )
            for mode in Mode
        }

    def _ticks(self, samples: list[Felt], wall: Wall, taken_out: bool, swings: bool) -> list[Tick]:
        """The readings, with the arms' swinging taken out where they swing."""
        arms = self._vehicle.estimation.arm_vibration
        tick_s, mass = self._vehicle.imu.tick_s, self._body.mass
        turn = ArmFilter(arms, tick_s) if arms is not None and taken_out != swings else None
        nx, ny = wall.normal
        turned, last_us = 0.0, samples[0].force.t_us - round(tick_s * 1e6)
        ticks = []
        for force, _, q, rate in samples:
            h = (force.t_us - last_us) * 1e-6
            last_us = force.t_us
            fx, fy = force.force_mission[0] - self._slow[0], force.force_mission[1] - self._slow[1]
            if turn is not None:
                ax, ay = fx / mass, fy / mass
                ax, ay = turn.remove(ax, ay, h) if swings else turn.add(ax, ay)
                fx, fy = mass * ax, mass * ay
            px, py = force.push_mission
            px, py = px + self._slow[0], py + self._slow[1]
            turning = -rotate(q, rate)[2]  # the mission's z points up
            turned += h * turning
            ticks.append(
                Tick(
                    h,
                    fx * nx + fy * ny,
                    fx * ny - fy * nx,
                    force.force_mission[2],
                    px * nx + py * ny,
                    px * ny - py * nx,
                    force.clipped,
                    turned - 0.5 * h * turning,
                    turning,
                )
            )
        return ticks


def fit_mode(contact: Contact, before: Belief, scatter: float, body: Body) -> Hypothesis | None:
    """Fit the contact law to a contact's readings.

    Args:
        contact: the readings.
        before: what is believed of the wall in this mode.
        scatter: of one hit's coefficients, relative.
        body: of the vehicle.

    Returns:
        The fit; None where the readings are of no such contact.
    """
    try:
        return _Fit(contact, before, scatter, body).run()
    except (ArithmeticError, ValueError):
        # Readings that no contact can have: nothing is felt.
        return None


class _Fit:
    """Gauss-Newton over (k, f, place, velocity, angle, mu, velocity along), the coefficients as factors."""

    def __init__(self, contact: Contact, before: Belief, scatter: float, body: Body) -> None:
        self._c, self._before, self._scatter, self._body = contact, before, scatter, body
        top = max(t.normal for t in contact.ticks)
        rub = max(abs(t.along) for t in contact.ticks)
        noise2 = contact.noise_n**2
        self._weight = 1.0 / (noise2 + (_MODEL_ERROR * top) ** 2)
        self._weight_along = 1.0 / (noise2 + (_FRICTION_ERROR * rub) ** 2 + (0.2 * _MODEL_ERROR * top) ** 2)
        self._top = top
        vn, vt = contact.velocity
        self._speed_sd = _VELOCITY_M_S + _VELOCITY_SHARE * math.hypot(vn, vt)
        sds = [math.hypot(sd, scatter) for sd in (before.k_sd, before.f_sd, before.mu_sd)]
        # Widths of the priors, in the order of the parameters.
        self._sd = [sds[0], sds[1], _PLACE_M, self._speed_sd, _WALL_RAD, sds[2], self._speed_sd]
        self._gradient = [0.0] * _ALL
        self._curvature = [[0.0] * _ALL for _ in range(_ALL)]
        self._forces: list[float] = []

    def run(self) -> Hypothesis | None:
        theta = self._guess()
        if self._top <= 3.0 * self._c.noise_n:
            return None
        cost = self._linearise(theta)
        damping = 1e-3
        for _ in range(_STEPS):
            gradient, curvature = self._gradient, self._curvature
            while True:
                step = _solve(curvature, gradient, damping)
                tried = self._moved(theta, step)
                self._gradient = [0.0] * _ALL
                self._curvature = [[0.0] * _ALL for _ in range(_ALL)]
                new = self._linearise(tried)
                if new <= cost or damping > 1e4:
                    break
                damping *= 10.0
            if new > cost:
                self._gradient, self._curvature = gradient, curvature
                break
            settled = cost - new < _SETTLED * (1.0 + 0.01 * cost)
            theta, cost, damping = tried, new, 0.1 * damping
            if settled:
                break
        return self._result(theta, cost)

    @staticmethod
    def _moved(theta: list[float], step: list[float]) -> list[float]:
        moved = [a + b for a, b in zip(theta, step, strict=True)]
        for p in (_K, _F, _MU):
            # A factor at most halves or doubles in a step.
            moved[p] = min(2.0 * theta[p], max(0.5 * theta[p], _LEAST_FACTOR, moved[p]))
        moved[_D] = max(-0.6, min(0.6, moved[_D]))
        return moved

    def _guess(self) -> list[float]:
        """Coefficients by linear least squares over the motion that the readings themselves give."""
        c, m, b = self._c, self._body.mass, self._before
        vn, vt = c.velocity
        x, v = 0.0, vn
        f0 = b.f
        # normal + f v = -k x - k x0, with the believed f
        sxx = sx = s = sy = sxy = 0.0
        for t in c.ticks:
            acceleration = (t.normal + t.push_normal) / m
            middle, speed = x + 0.5 * t.h * v, v + 0.5 * t.h * acceleration
            x += t.h * speed
            v += t.h * acceleration
            if t.normal > 0.15 * self._top:
                y = t.normal + f0 * speed
                sxx += middle * middle
                sx += middle
                s += 1.0
                sy += y
                sxy += middle * y
        det = s * sxx - sx * sx
        k = -(s * sxy - sx * sy) / det if det > 0.0 else b.k
        k = min(10.0 * b.k, max(0.12 * b.k, k))
        place = -vn * (c.touched_s + f0 / k)
        return [k / b.k, 1.0, place, vn, 0.0, 1.0, vt]

    def _linearise(self, theta: list[float]) -> float:
        """Cost at `theta`; leaves gradient (down) and curvature."""
        c, before, m = self._c, self._before, self._body.mass
        a, out, touch = self._body.along, self._body.out, self._body.onset is Onset.TOUCH
        k0, f0, mu0 = before.k, before.f, before.mu
        k, f, mu = k0 * theta[_K], f0 * theta[_F], mu0 * theta[_MU]
        x, v, w = theta[_X], theta[_V], theta[_W]
        dx = [0.0, 0.0, 1.0, 0.0, 0.0]
        dv = [0.0, 0.0, 0.0, 1.0, 0.0]
        dw = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        angle = theta[_D]
        co, so = math.cos(angle), math.sin(angle)
        first = c.incidence_rad - angle
        gradient, curvature = self._gradient, self._curvature
        weight, weight_along = self._weight, self._weight_along
        lever = _LEVER_SHARE * out
        cost = 0.0
        self._forces = forces = []
        for t in c.ticks:
            h = t.h / _SUBSTEPS
            push = t.push_normal * co - t.push_along * so
            slide_push = t.push_along * co + t.push_normal * so
            i = first + t.turned
            si, ci, turning = math.sin(i), math.cos(i), t.turning
            xi_even, eta_even = out * (1.0 - ci), out * si * turning
            xi_odd, eta_odd = a * si, a * ci * turning
            v_begin, dv_begin = v, dv
            for _ in range(_SUBSTEPS):
                mid = x + 0.5 * h * v
                count, xi, eta, dxi, deta = 0, 0.0, 0.0, 0.0, 0.0
                for g in (1.0, -1.0):
                    xg, vg = xi_even - g * xi_odd, eta_even - g * eta_odd
                    if k * (mid + xg) + f * (v + vg) < 0.0 and not (touch and mid + xg >= 0.0):
                        count += 1
                        xi += xg
                        eta += vg
                        dxi += g * a * ci - out * si
                        deta -= (g * a * si + out * ci) * turning
                dmid = [p + 0.5 * h * q for p, q in zip(dx, dv, strict=True)]
                if count:
                    ke, fe = 0.5 * k * count, 0.5 * f * count
                    beta = 0.5 * fe * h / m
                    pull = -(ke * mid + 0.5 * (k * xi + f * eta))
                    scale = 1.0 / (1.0 + beta)
                    new = (v * (1.0 - beta) + h / m * (pull + push)) * scale
                    r, q = h / m * scale, (1.0 - beta) * scale
                    dnew = [q * dv[p] - r * ke * dmid[p] for p in range(_NORMAL)]
                    dnew[_K] -= r * 0.5 * k0 * (count * mid + xi)
                    dnew[_F] -= r * 0.5 * f0 * (eta + 0.5 * count * (v + new))
                    dnew[_D] -= r * 0.5 * (k * dxi + f * deta)
                else:
                    new, dnew = v + h / m * push, dv
                x = mid + 0.5 * h * new
                dx = [p + 0.5 * h * q for p, q in zip(dmid, dnew, strict=True)]
                v, dv = new, dnew
            force = m * (v - v_begin) / t.h - push
            share = m / t.h
            dforce = [share * (p - q) for p, q in zip(dv, dv_begin, strict=True)]
            forces.append(force)
            # Friction: the speed along the wall decays with the normal impulse.
            normal = max(0.0, force)
            left = math.exp(-mu * normal * t.h / m)
            root = math.sqrt(left)
            slip = lever * turning * ci
            drive = slide_push * t.h / m
            w_new = w * left + drive * root - slip * (1.0 - left)
            gain = -(w + 0.5 * drive / root + slip) * left * t.h / m  # d w_new / d (mu F)
            dw_new = [left * p for p in dw]
            if normal > 0.0:
                for p in range(_NORMAL):
                    dw_new[p] += gain * mu * dforce[p]
                dw_new[_MU] += gain * mu0 * normal
            along = m * (w_new - w) / t.h - slide_push
            dalong = [share * (p - q) for p, q in zip(dw_new, dw, strict=True)]
            w, dw = w_new, dw_new
            # The readings along the wall as it stands.
            read, read_along = t.normal * co - t.along * so, t.along * co + t.normal * so
            dforce[_D] += read_along
            dalong[_D] -= read
            residual, residual_along = read - force, read_along - along
            if not (t.bound and residual <= 0.0):
                cost += weight * residual * residual
                for p in range(_NORMAL):
                    row, wp = curvature[p], weight * dforce[p]
                    gradient[p] += wp * residual
                    for q in range(p + 1):
                        row[q] += wp * dforce[q]
            cost += weight_along * residual_along * residual_along
            for p in range(_ALL):
                row, wp = curvature[p], weight_along * dalong[p]
                gradient[p] += wp * residual_along
                for q in range(p + 1):
                    row[q] += wp * dalong[q]
        return cost + self._add_priors(theta, co, so)

    def _add_priors(self, theta: list[float], co: float, so: float) -> float:
        vn, vt = self._c.velocity
        place = -vn * self._c.touched_s
        means = [1.0, 1.0, place, vn * co - vt * so, 0.0, 1.0, vt * co + vn * so]
        # The measured velocity turns with the wall.
        turned = {_V: vn * so + vt * co, _W: vt * so - vn * co}
        cost = 0.0
        for p in range(_ALL):
            precision = 1.0 / self._sd[p] ** 2
            off = means[p] - theta[p]
            cost += precision * off * off
            self._gradient[p] += precision * off
            self._curvature[p][p] += precision
            if p in turned:
                slope = turned[p]
                low, high = (p, _D) if p < _D else (_D, p)
                self._gradient[_D] += precision * slope * off
                self._curvature[_D][_D] += precision * slope * slope
                self._curvature[high][low] += precision * slope
        return cost

    def _result(self, theta: list[float], cost: float) -> Hypothesis:
        spread = _inverse_diagonal(self._curvature)
        b = self._before
        log_det = sum(2.0 * math.log(p) for p in _cholesky_diagonal(self._curvature))
        evidence = -0.5 * (cost + log_det) - sum(math.log(sd) for sd in self._sd)
        k, k_sd = self._wall(theta[_K], spread[_K], b.k_sd)
        f, f_sd = self._wall(theta[_F], spread[_F], b.f_sd)
        mu, mu_sd = self._wall(theta[_MU], spread[_MU], b.mu_sd)
        nu, nu_sd, seen = self._vertical(b)
        after = Belief(b.k * k, b.f * f, b.mu * mu, b.nu * nu, k_sd, f_sd, mu_sd, nu_sd)
        return Hypothesis(
            evidence + seen,
            after,
            self._c.incidence_rad - theta[_D],
            math.sqrt(spread[_D]),
            theta[_X],
            math.sqrt(spread[_X]),
        )

    def _wall(self, factor: float, variance: float, before_sd: float) -> tuple[float, float]:
        """Of the wall itself from what one hit had: factor and relative deviation.

        A hit's coefficient is the wall's times its own scatter; with s2 both variances before the hit,
        G = sd2/s2, the wall's variance is sd2 - G2 (s2 - variance).
        """
        wall2 = before_sd * before_sd
        hit2 = wall2 + self._scatter**2
        gain = wall2 / hit2
        mean = max(_LEAST_FACTOR, 1.0 + gain * (factor - 1.0))
        after = wall2 - gain * gain * max(0.0, hit2 - variance)
        return mean, math.sqrt(after) / mean

    def _vertical(self, b: Belief) -> tuple[float, float, float]:
        """Factor, deviation and evidence by the vertical force, nu F/(1 + F) on the mean over the contact."""
        total = share = time_s = 0.0
        for t, force in zip(self._c.ticks, self._forces, strict=True):
            if force > 0.0:
                share += t.h * force / (1.0 + force)
                total += t.h * t.up
                time_s += t.h
        if time_s <= 0.0 or b.nu <= 0.0:
            return 1.0, b.nu_sd, 0.0
        slope = -self._body.vertical_sign * b.nu * share / time_s
        read = total / time_s
        prior2 = b.nu_sd**2 + self._scatter**2
        variance = _VERTICAL_N**2 + prior2 * slope * slope
        off = read - slope
        factor = 1.0 + prior2 * slope / variance * off
        nu, nu_sd = self._wall(factor, prior2 - prior2 * prior2 * slope * slope / variance, b.nu_sd)
        return nu, nu_sd, -0.5 * (off * off / variance + math.log(variance))


def _cholesky(h: list[list[float]], damping: float = 0.0) -> list[list[float]]:
    """Lower triangle L of L L' = H + damping diag(H), from the lower triangle of H.

    Raises:
        ValueError: H is not positive definite.
    """
    n = len(h)
    low = [[0.0] * n for _ in range(n)]
    for i in range(n):
        row = low[i]
        for j in range(i + 1):
            other = low[j]
            s = h[i][j]
            if i == j:
                s += damping * s
            for p in range(j):
                s -= row[p] * other[p]
            if i == j:
                if not s > 0.0:
                    raise ValueError("not positive definite")
                row[i] = math.sqrt(s)
            else:
                row[j] = s / other[j]
    return low


def _cholesky_diagonal(h: list[list[float]]) -> list[float]:
    return [row[i] for i, row in enumerate(_cholesky(h))]


def _solve(h: list[list[float]], g: list[float], damping: float) -> list[float]:
    """(H + damping diag(H))^-1 g."""
    low = _cholesky(h, damping)
    n = len(g)
    y = [0.0] * n
    for i in range(n):
        y[i] = (g[i] - sum(low[i][p] * y[p] for p in range(i))) / low[i][i]
    for i in range(n - 1, -1, -1):
        y[i] = (y[i] - sum(low[p][i] * y[p] for p in range(i + 1, n))) / low[i][i]
    return y


def _inverse_diagonal(h: list[list[float]]) -> list[float]:
    """Diagonal of H^-1."""
    low = _cholesky(h)
    n = len(h)
    out = []
    for j in range(n):
        y = [0.0] * n
        for i in range(j, n):
            start = 1.0 if i == j else 0.0
            y[i] = (start - sum(low[i][p] * y[p] for p in range(j, i))) / low[i][i]
        out.append(sum(value * value for value in y))
    return out
