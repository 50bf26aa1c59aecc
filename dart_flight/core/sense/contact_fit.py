"""The contact law fitted to the readings of one contact, in the mode that is supposed.

With x the signed distance of the vehicle's centre to the wall's plane, a side's two guards g = 1 (right), -1
(left) at `guard_along_m` (a) beside its middle, `contact_distance_m` (d) ahead, and i the angle of incidence,
positive turned left,

    x_g = x - g a sin i + d (1 - cos i)        depth of a guard
    F   = sum of max(0, -(k x_g + f dx_g/dt)/2)
    T   = -mu F (v_t + b d di/dt)              b the share of the lever at which friction acts
    M   = a cos(i) (F_1 - F_-1) - d sin(i) F - b d T              torque, positive turns to the right
    m dv/dt = force + push by thrust and drag

i is what the attitude and the gyro give, less the angle by which the wall stands off the plan. Unknown are
k, f and mu over what is believed of them, that angle, and distance and velocity at the beginning. The most
probable values are sought by Gauss-Newton steps (Levenberg's damping) with a numerical Jacobian; the motion
is integrated by leapfrog steps, as the readings are means over ticks. The evidence is Laplace's:

    2 ln p(readings) = -(misfit + prior) - ln det(curvature) + ln det(curvature of the prior)

Scalar floats and `math` only.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from dart_flight.base.geometry import Vec2
from dart_flight.base.linear_algebra import cholesky, inverse_diagonal, solve
from dart_flight.contact.law import Onset

PLACE_M: Final = 0.1  # at least: how far off the plan a wall may stand: loosely held, the force tells
WALL_RAD = math.radians(4.0)  # at least: how well a wall's direction is known, with that of the attitude
_VELOCITY_M_S: Final = 0.04  # deviation of PX4's velocity, at rest and of the speed
_VELOCITY_SHARE: Final = 0.02
_VERTICAL_N: Final = 1.0  # deviation of the vertical force's mean over a contact
_LEVER_SHARE: Final = 0.3  # at which friction is expected to act, as in `body.Known`
# What the model is off by, of the largest force, and of the largest friction.
_MODEL_ERROR: Final = 0.015
_FRICTION_ERROR: Final = 0.03
_TORQUE_ERROR: Final = 0.1  # of the largest torque that the normal force can have: much the same in all ticks
_LEVER_SD: Final = 0.3  # of the lever of friction, in distances to the wall
_SURE_SIGMA: Final = 5.0  # of the sum of the readings: below it they are of no contact
_MIN_FACTOR: Final = 0.1  # no coefficient is believed to be below this share of what was believed
_MAX_ANGLE_RAD: Final = 0.6
_STEPS: Final = 8  # one a sample, so that 60 ms after the contact's end all is said
_SETTLED: Final = 1e-2  # a smaller gain of the cost ends the search
_MAX_DAMPING: Final = 1e4
_DIFFERENCE: Final = 1e-5  # of a parameter, for the derivatives
_SUBSTEPS: Final = 2  # of a tick
_MAX_TICKS: Final = 36  # more are merged
_GUESS_SHARE: Final = 0.15  # of the largest force: readings that a first guess is made of
_INCIDENCES_RAD = tuple(math.radians(d) for d in (4.0, 7.0, 10.0))  # at which a fit may begin
_UNKNOWN_RAD = math.radians(10.0)  # a wall's direction with such a deviation is not known
_STEEP_RAD = tuple(math.radians(d) for d in (13.0, 19.0))
_K, _F, _X, _V, _D, _MU, _W = range(7)  # k, f, place, velocity, angle, mu, velocity along
_ALL: Final = 7


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


class ContactReading(NamedTuple):
    """What one IMU sample says of a contact.

    Attributes:
        h: its length, s.
        normal, along: mean force along the planned wall's axes, N; `up`: vertical.
        push_normal, push_along: force of thrust and drag, N.
        bound: at full scale: the true force is larger.
        turned: angle since the first tick at its middle, rad, positive to the left; `turning`: its rate.
        torque: about the vertical, N m, positive where it turns the vehicle to the right.
        samples: how many are in it.
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
    torque: float
    samples: int = 1


class ObservedContact(NamedTuple):
    """A contact as the fit takes it.

    Attributes:
        ticks: its readings from a few before the first touch to a little after the last.
        begin_us: where the first tick begins, by the IMU's stamps less the filter's lag.
        touched_s: first touch after that, about.
        velocity: along the planned wall's axes at the first tick's beginning, as PX4 has it, m/s.
        incidence_rad: leading edge against the planned wall then.
        noise_n: of a reading.
        torque_noise_nm: likewise, of its torque.
        place_sd, angle_sd: how well the wall's place (m) and direction (rad) are known beforehand.
    """

    ticks: list[ContactReading]
    begin_us: int
    touched_s: float
    velocity: Vec2
    incidence_rad: float
    noise_n: float
    place_sd: float = PLACE_M
    angle_sd: float = WALL_RAD
    torque_noise_nm: float = 0.1


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
        misfit: mean square of the residuals over their errors.
        belief: of the wall in this mode, after the contact.
        incidence_rad, incidence_sd: at the first tick.
        place_m, place_sd: signed distance of the centre to the wall's plane at the first tick's beginning.
    """

    evidence: float
    misfit: float
    belief: Belief
    incidence_rad: float
    incidence_sd: float
    place_m: float
    place_sd: float


class ContactFit:
    """The contact law fitted to a contact's readings, step by step.

    Args:
        contact: the readings.
        before: what is believed of the wall in this mode.
        scatter: of one hit's coefficients, relative.
        body: of the vehicle.
    """

    def __init__(self, contact: ObservedContact, before: Belief, scatter: float, body: Body) -> None:
        self.contact = contact
        self._begin = (contact, before, scatter, body)
        self._under_way: _ContactLawFit | None = None
        self._best: _ContactLawFit | None = None
        # Of a wall whose direction hardly anything is known of, one guard may have borne all the force: that
        # is another valley, which is not found from where both bear.
        unknown = contact.angle_sd > _UNKNOWN_RAD
        self._starts: list[float | None] = [None, *_STEEP_RAD] if unknown else [None]

    def advance(self) -> bool:
        """Take one step; False once there is none left to take."""
        try:
            if self._under_way is None:
                if not self._starts:
                    return False
                self._under_way = _ContactLawFit(*self._begin, self._starts.pop(0))
            if not self._under_way.step():
                if self._best is None or self._under_way.cost < self._best.cost:
                    self._best = self._under_way
                self._under_way = None
        except (ArithmeticError, ValueError):
            self._under_way = None  # readings that no contact can have: nothing is felt
        return self._under_way is not None or bool(self._starts)

    def result(self) -> Hypothesis | None:
        """The fit as it stands; None where the readings are of no such contact."""
        try:
            found = self._best or self._under_way
            return None if found is None else found.result()
        except (ArithmeticError, ValueError):
            return None


class _ContactLawFit:
    """Gauss-Newton over (k, f, place, velocity, angle, mu, velocity along), the coefficients as factors.

    It begins with the best of some guesses, or with one guard ahead by the incidence `lead`.
    """

    def __init__(
        self,
        contact: ObservedContact,
        before: Belief,
        scatter: float,
        body: Body,
        lead: float | None = None,
    ) -> None:
        self._c, self._before, self._scatter, self._body = contact, before, scatter, body
        self._ticks = _merged(contact.ticks)
        top = max(t.normal for t in self._ticks)
        rub = max(abs(t.along) for t in self._ticks)
        pushed, count = sum(t.normal * t.samples for t in self._ticks), sum(t.samples for t in self._ticks)
        if pushed <= _SURE_SIGMA * contact.noise_n * math.sqrt(count):
            raise ValueError("no force")
        model2 = (_MODEL_ERROR * top) ** 2
        along2 = (_FRICTION_ERROR * rub) ** 2 + 0.04 * model2
        noise2 = contact.noise_n**2
        torque2 = (_TORQUE_ERROR * body.along * top) ** 2 + (_LEVER_SD * body.out * rub) ** 2
        self._scales = [
            (
                1.0 / math.sqrt(noise2 / t.samples + model2),
                1.0 / math.sqrt(noise2 / t.samples + along2),
                1.0 / math.sqrt(contact.torque_noise_nm**2 / t.samples + torque2),
            )
            for t in self._ticks
        ]
        self._top = top
        vn, vt = contact.velocity
        speed_sd = _VELOCITY_M_S + _VELOCITY_SHARE * math.hypot(vn, vt)
        sds = [math.hypot(sd, scatter) for sd in (before.k_sd, before.f_sd, before.mu_sd)]
        # Widths of the priors, in the order of the parameters.
        self._sd = [sds[0], sds[1], contact.place_sd, speed_sd, contact.angle_sd, sds[2], speed_sd]
        self._forces: list[float] = []
        self.cost = math.inf
        self._residuals: list[float] = []
        self.theta: list[float] = []
        self._begin(self._guesses() if lead is None else [self._guard_ahead(lead)])
        self._damping = 1e-3
        self._curvature: list[list[float]] = []
        self.steps = 0

    def _begin(self, guesses: Iterable[list[float]]) -> None:
        """The best of some guesses."""
        for tried in guesses:
            residuals = self._residuals_at(tried)
            cost = sum(r * r for r in residuals)
            if cost < self.cost:
                self.theta, self._residuals, self.cost = tried, residuals, cost
        if not self.theta:
            raise ValueError("not a number")

    def _guesses(self) -> Iterator[list[float]]:
        """Both guards bear alike; as the torque has it, which turns the wall, and again from there; as
        believed, the guard ahead that meets the wall first and turns the vehicle to its own side."""
        angle = 0.0
        for by_torque in (False, True, True, True):
            guess = self._guess(by_torque, angle)
            angle = guess[_D]
            yield guess
        for lead in _INCIDENCES_RAD:
            yield self._guard_ahead(lead)

    def _guard_ahead(self, lead: float) -> list[float]:
        """As believed, with the guard ahead that turns the vehicle to its own side."""
        side = -math.copysign(1.0, self._ticks[-1].turned)
        angle = self._c.incidence_rad - side * lead
        vn, vt = _turned(*self._c.velocity, math.cos(angle), math.sin(angle))
        place = -vn * self._c.touched_s + self._body.along * math.sin(lead)
        return [1.0, 1.0, place, vn, angle, 1.0, vt]

    def step(self) -> bool:
        """One step; False where it was the last."""
        theta, residuals = self.theta, self._residuals
        columns = self._columns()
        curvature = [
            [sum(map(operator.mul, columns[p], columns[q])) for q in range(p + 1)] for p in range(_ALL)
        ]
        self._curvature = curvature
        gradient = [-sum(map(operator.mul, column, residuals)) for column in columns]
        self.steps += 1
        while self._damping < _MAX_DAMPING:
            tried = _moved(theta, solve(curvature, gradient, self._damping))
            new = self._residuals_at(tried)
            cost = sum(r * r for r in new)
            if cost <= self.cost:
                gain, self.cost = self.cost - cost, cost
                self.theta, self._residuals = tried, new
                self._damping *= 0.1
                return gain > _SETTLED * (1.0 + 0.01 * cost) and self.steps < _STEPS
            self._damping *= 10.0
        return False

    def _columns(self) -> list[list[float]]:
        """Derivatives of the residuals by each parameter."""
        columns = []
        for p in range(_ALL):
            moved = list(self.theta)
            moved[p] += _DIFFERENCE
            shifted = self._residuals_at(moved)
            columns.append([(b - a) / _DIFFERENCE for a, b in zip(self._residuals, shifted, strict=True)])
        return columns

    def _guess(self, by_torque: bool, turned: float) -> list[float]:
        """Stiffness, place, angle, friction by linear least squares over the motion that the readings give.

        The wall is taken to be turned by `turned`. A guard that bears F_g then has, with the believed f,
        2 F_g + f v_g = -k (x - g a i) - k x0.
        """
        m, b, a, out = self._body.mass, self._before, self._body.along, self._body.out
        co, so = math.cos(turned), math.sin(turned)
        vn, vt = _turned(*self._c.velocity, co, so)
        x, v, w = 0.0, vn, vt
        # For either guard: number, sums of place, place squared, reading, their product.
        sums = {1.0: [0.0] * 5, -1.0: [0.0] * 5}
        mxx = mxy = 0.0
        least = _GUESS_SHARE * self._top
        for t in self._ticks:
            normal, along = _turned(t.normal, t.along, co, so)
            push, drive = _turned(t.push_normal, t.push_along, co, so)
            acceleration = (normal + push) / m
            middle, speed = x + 0.5 * t.h * v, v + 0.5 * t.h * acceleration
            x += t.h * speed
            v += t.h * acceleration
            slide = t.h * (along + drive) / m
            i = self._c.incidence_rad - turned + t.turned
            by_force = out * math.sin(i) * normal + _LEVER_SHARE * out * along
            uneven = (t.torque + by_force) / (a * math.cos(i)) if by_torque else 0.0
            uneven = max(-normal, min(normal, uneven))
            for g, s in sums.items():
                bears = normal + g * uneven
                if bears > least:
                    at = middle - g * a * t.turned
                    y = bears + b.f * (speed - g * a * t.turning)
                    for row, value in enumerate((1.0, at, at * at, y, at * y)):
                        s[row] += value
            if normal > least:
                unit = -normal * (w + 0.5 * slide)
                mxx += unit * unit
                mxy += unit * along
            w += slide
        det = mixed = 0.0
        for n, sx, sxx, sy, sxy in sums.values():
            if n > 1.0:
                det += sxx - sx * sx / n
                mixed += sx * sy / n - sxy
        k = min(10.0, max(1.2 * _MIN_FACTOR, mixed / det / b.k)) if det > 0.0 else 1.0
        # Where a guard is at the first tick, from the means: y = -k (at + place).
        places = {g: -sy / n / (k * b.k) - sx / n for g, (n, sx, _, sy, _) in sums.items() if n > 1.0}
        place, angle = -vn * (self._c.touched_s + b.f / (k * b.k)), turned
        if by_torque and places:
            right, left = places.get(1.0), places.get(-1.0)
            if right is not None and left is not None:
                place = 0.5 * (right + left)
                angle = self._c.incidence_rad - 0.5 * (left - right) / a
        angle = max(-_MAX_ANGLE_RAD, min(_MAX_ANGLE_RAD, angle))
        # Where nothing slides friction does not show.
        rub2 = (self._sd[_W] * self._top) ** 2
        mu = (mxy + b.mu * rub2) / (mxx + rub2) / b.mu if b.mu > 0.0 else 1.0
        mu = min(10.0, max(1.2 * _MIN_FACTOR, mu))
        return [k, 1.0, place, vn, angle, mu, vt]

    def _residuals_at(self, theta: list[float]) -> list[float]:
        """Readings less model, normal and along, then the parameters less what was believed; over errors."""
        m, before = self._body.mass, self._before
        a, out, touch = self._body.along, self._body.out, self._body.onset is Onset.TOUCH
        k, f, x, v, angle, mu, w = theta
        half_k, half_f, kappa = 0.5 * before.k * k, 0.5 * before.f * f, before.mu * mu / m
        co, so = math.cos(angle), math.sin(angle)
        first, lever = self._c.incidence_rad - angle, _LEVER_SHARE * out
        forces: list[float] = []
        residuals: list[float] = []
        for t, (scale, scale_along, scale_torque) in zip(self._ticks, self._scales, strict=True):
            h = t.h / _SUBSTEPS
            hm, hh = h / m, 0.5 * h
            push = (t.push_normal * co - t.push_along * so) * hm
            drive = (t.push_along * co + t.push_normal * so) * hm
            i = first + t.turned
            si, ci, turning = math.sin(i), math.cos(i), t.turning
            # Depth and speed of either guard beside the centre's.
            even, odd = out * (1.0 - ci), a * si
            even_v, odd_v = out * si * turning, a * ci * turning
            right, left = even - odd, even + odd
            right_v, left_v = even_v - odd_v, even_v + odd_v
            slip = lever * turning * ci
            v_begin, w_begin, bears_r, bears_l = v, w, 0.0, 0.0
            for _ in range(_SUBSTEPS):
                mid = x + hh * v
                count, known = 0, 0.0
                # Drift, kick, drift; the damping of the kick is implicit.
                pull_r = half_k * (mid + right) + half_f * right_v
                pull_l = half_k * (mid + left) + half_f * left_v
                on_right = pull_r + half_f * v < 0.0 and not (touch and mid + right >= 0.0)
                on_left = pull_l + half_f * v < 0.0 and not (touch and mid + left >= 0.0)
                if on_right:
                    count, known = 1, -pull_r
                if on_left:
                    count, known = count + 1, known - pull_l
                if count:
                    beta = 0.5 * half_f * count * hm
                    new = (v * (1.0 - beta) + hm * known + push) / (1.0 + beta)
                    # Friction: the speed along the wall decays with the normal impulse.
                    decay = math.exp(-kappa * max(0.0, m * (new - v - push)))
                    w = w * decay + drive * math.sqrt(decay) - slip * (1.0 - decay)
                    damped = 0.5 * half_f * (v + new)
                    bears_r += on_right * -(pull_r + damped)
                    bears_l += on_left * -(pull_l + damped)
                    v = new
                else:
                    v += push
                    w += drive
                x = mid + hh * v
            share = m / t.h
            force = share * (v - v_begin - _SUBSTEPS * push)
            along = share * (w - w_begin - _SUBSTEPS * drive)
            forces.append(force)
            # The readings along the wall as it stands.
            off = t.normal * co - t.along * so - force
            residuals.append(0.0 if t.bound and off <= 0.0 else scale * off)
            residuals.append(scale_along * (t.along * co + t.normal * so - along))
            # At full scale the force is more than what was read, and turns the vehicle more.
            uneven = (a * ci * (bears_r - bears_l) - out * si * (bears_r + bears_l)) / _SUBSTEPS
            residuals.append(0.0 if t.bound else scale_torque * (t.torque - uneven + lever * along))
        self._forces = forces
        vn, vt = self._c.velocity
        # The measured velocity turns with the wall.
        place = -vn * self._c.touched_s
        means = (1.0, 1.0, place, vn * co - vt * so, 0.0, 1.0, vt * co + vn * so)
        for value, mean, sd in zip(theta, means, self._sd, strict=True):
            residuals.append((value - mean) / sd)
        return residuals

    def result(self) -> Hypothesis:
        """The fit as it stands."""
        self._residuals_at(self.theta)
        misfit = self.cost / (3 * len(self._ticks))
        # Where the model is off by more than it should be, the readings say less.
        worse = max(1.0, misfit)
        spread = [
            min(worse * s, sd * sd) for s, sd in zip(inverse_diagonal(self._curvature), self._sd, strict=True)
        ]
        b, theta = self._before, self.theta
        log_det = sum(2.0 * math.log(row[i]) for i, row in enumerate(cholesky(self._curvature)))
        evidence = -0.5 * (self.cost + log_det) - sum(math.log(sd) for sd in self._sd)
        k, k_sd = self._wall(theta[_K], spread[_K], b.k_sd)
        f, f_sd = self._wall(theta[_F], spread[_F], b.f_sd)
        mu, mu_sd = self._wall(theta[_MU], spread[_MU], b.mu_sd)
        nu, nu_sd, seen = self._vertical()
        return Hypothesis(
            evidence + seen,
            misfit,
            Belief(b.k * k, b.f * f, b.mu * mu, b.nu * nu, k_sd, f_sd, mu_sd, nu_sd),
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
        hit2 = wall2 + (self._scatter * factor) ** 2
        gain = wall2 / hit2
        mean = max(_MIN_FACTOR, 1.0 + gain * (factor - 1.0))
        after = wall2 - gain * gain * max(0.0, hit2 - variance)
        return mean, math.sqrt(after) / mean

    def _vertical(self) -> tuple[float, float, float]:
        """Factor, deviation and evidence by the vertical force, nu F/(1 + F) on the mean over the contact."""
        b, total, share, time_s = self._before, 0.0, 0.0, 0.0
        for t, force in zip(self._ticks, self._forces, strict=True):
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


def _turned(normal: float, along: float, co: float, so: float) -> Vec2:
    """Components along normal and tangent of a wall that is turned counter-clockwise."""
    return normal * co - along * so, along * co + normal * so


def _moved(theta: list[float], step: list[float]) -> list[float]:
    """The parameters a step further, within what can be."""
    moved = [a + b for a, b in zip(theta, step, strict=True)]
    for p in (_K, _F, _MU):
        # A factor at most halves or doubles in a step.
        moved[p] = min(2.0 * theta[p], max(0.5 * theta[p], _MIN_FACTOR, moved[p]))
    moved[_D] = max(-_MAX_ANGLE_RAD, min(_MAX_ANGLE_RAD, moved[_D]))
    return moved


def _merged(ticks: list[ContactReading]) -> list[ContactReading]:
    """Neighbours as one where there are many; what is at full scale stays alone."""
    size = -(-len(ticks) // _MAX_TICKS)
    out: list[ContactReading] = []
    for t in ticks:
        last = out[-1] if out else None
        if last is None or t.bound or last.bound or last.samples >= size:
            out.append(t)
            continue
        h = last.h + t.h
        p, q = last.h / h, t.h / h
        out[-1] = ContactReading(
            h,
            p * last.normal + q * t.normal,
            p * last.along + q * t.along,
            p * last.up + q * t.up,
            p * last.push_normal + q * t.push_normal,
            p * last.push_along + q * t.push_along,
            False,
            p * last.turned + q * t.turned,
            p * last.turning + q * t.turning,
            p * last.torque + q * t.torque,
            last.samples + 1,
        )
    return out
