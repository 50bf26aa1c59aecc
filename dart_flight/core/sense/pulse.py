"""Peaks of a contact, from a fit of the contact model's pulse to the IMU readings (docs/force.md).

The contact model is a damped oscillator driven by the vehicle's own thrust. The coefficients of the contact
are k, f and mu, and m is the vehicle's mass. B is the force that pushes towards the wall, and C is the slope
of the normal force at the onset. With sigma = f/(2m) and w^2 = k/m, the normal force F obeys

    F'' + 2 sigma F' + w^2 F = w^2 B,   F(0) = 0, F'(0) = C

The impulse of F has the closed form P = B t + (C - F' - 2 sigma F)/w^2. A reading is the mean over a tick.
The fit compares a reading with the model's mean over the same tick, (P(b) - P(a))/(b - a), so averaging needs
no correction. The anti-alias filter delays the pulse by its lag and lowers the top by the fraction
(w lag)^2/2. The fit corrects both. A reading at full scale is a lower bound, so the fit uses this reading
only if the model is below the bound. Friction is -mu F v_t, and the tangential velocity v_t decays with the
impulse. The mean friction over a tick follows from the change of v_t.

The impact detector uses this module once per impact, for some tens of samples. The module has its own closed
form and Gauss-Newton steps in scalar floats, because the core's step may not wait for array functions.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from dart_flight.base.arithmetic import sum_in_order

_MAX_BINS: Final = 13
_STEPS: Final = 8
# The model's own error, relative to the top. Without this error, a quiet sensor would get too much weight.
_MODEL_ERROR: Final = 0.01
_PRIOR_LOG_OMEGA: Final = 0.25
_PRIOR_LOG_KAPPA: Final = 1.0
_MIN_OMEGA: Final = 8.0
_MAX_OMEGA: Final = 400.0
_MAX_MISFIT: Final = 0.12  # the model does not fit if the root mean square exceeds this fraction of the peak


class TickReading(NamedTuple):
    """Mean force over a tick from `a` to `b` seconds, newton; if `bound`, the true mean may be larger."""

    a: float
    b: float
    normal: float
    tangential: float
    bound: bool


class PulsePrior(NamedTuple):
    """Prior of a contact: sqrt(k/m) and f/(2m) in 1/s, mu/m in 1/(N s)."""

    omega: float
    sigma: float
    kappa: float

    @property
    def half_period_s(self) -> float:
        """Half a period of the damped oscillation, the approximate duration of a contact."""
        return math.pi / math.sqrt(max(self.omega**2 - self.sigma**2, 0.01 * self.omega**2))


class NormalPulse(NamedTuple):
    """A fitted pulse of the normal force: its parameters, and its peak with time and standard error.

    The parameters are onset, slope of the force at the onset, frequency, damping and push. `misfit` is the
    mean square of the residuals. Each residual is divided by its standard deviation, which includes the
    reading's noise and the model's own error.
    """

    start_s: float
    slope: float
    omega: float
    sigma: float
    push: float
    peak_n: float
    peak_s: float
    sigma_n: float
    misfit: float = 0.0


def _terms(s: float, omega: float, sigma: float) -> tuple[float, float, float, float]:
    """Return force and impulse for a push of 1, then for a slope of 1, `s` seconds after the onset."""
    if s <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    w2 = omega * omega
    return _solution(s, math.exp(-sigma * s), w2, math.sqrt(w2 - sigma * sigma), sigma)


def _solution(
    s: float, decay: float, w2: float, wd: float, sigma: float
) -> tuple[float, float, float, float]:
    """Return the result of `_terms`, given the decay exp(-sigma s), w^2 and the damped frequency wd."""
    sine = decay * math.sin(wd * s) / wd
    force = 1.0 - decay * math.cos(wd * s) - sigma * sine
    return force, s - (w2 * sine + 2.0 * sigma * force) / w2, sine, force / w2


def fit_normal(
    readings: list[TickReading], push: float, prior: PulsePrior, noise_n: float, onset_s: float, lag_s: float
) -> NormalPulse | None:
    """Return the fitted normal pulse, or None if the readings are too few or the pulse does not fit.

    Args:
        readings: in order, from a few ticks before the onset until shortly after the peak.
        push: mean force of thrust and drag towards the wall over the contact, newton.
        prior: the fit may change the frequency within a wide tolerance; the damping is fixed.
        noise_n: standard deviation of one reading.
        onset_s: first guess of the onset.
        lag_s: lag of the anti-alias filter, 1 / (2 pi f).
    """
    bins = _binned(readings)
    top = max((r.normal for r, _ in bins), default=0.0)
    inside = sum(r.b > onset_s for r, _ in bins)
    if inside < 3 or top <= 0.0:
        return None
    fit = _PulseFit(bins, push, prior, noise_n, top)
    if not fit.run(onset_s):
        return None
    return fit.result(lag_s)


def _binned(readings: list[TickReading]) -> list[tuple[TickReading, int]]:
    """Return about a dozen readings, each with its number of samples; bounds and gaps are not merged."""
    size = -(-len(readings) // _MAX_BINS)
    if size == 1:
        return [(r, 1) for r in readings]
    out: list[tuple[TickReading, int]] = []
    for r in readings:
        if out:
            last, n = out[-1]
            if n < size and not r.bound and not last.bound and abs(r.a - last.b) < 1e-6:
                share = (r.b - r.a) / (r.b - last.a)
                out[-1] = (
                    TickReading(
                        last.a,
                        r.b,
                        last.normal + share * (r.normal - last.normal),
                        last.tangential + share * (r.tangential - last.tangential),
                        False,
                    ),
                    n + 1,
                )
                continue
        out.append((r, 1))
    return out


class _Ends:
    """The pulse at a reading's end: force, impulse for a slope of 1, impulse, and impulse's derivative.

    The derivative is with respect to the log frequency. The derivative is a finite difference between two
    frequencies whose logarithms differ by 1e-4, with the same damping and decay. Each frequency's constants
    are computed only once, because the setpoint after an impact waits for the fit.
    """

    def __init__(self, omega: float, sigma: float, push: float, slope: float) -> None:
        up = omega * 1.0001
        self._w2, self._up2 = omega * omega, up * up
        self._wd = math.sqrt(self._w2 - sigma * sigma)
        self._upd = math.sqrt(self._up2 - sigma * sigma)
        self._sigma, self._push, self._slope = sigma, push, slope

    def at(self, s: float) -> tuple[float, float, float, float]:
        """Return the four quantities `s` seconds after the onset."""
        if s <= 0.0:
            return 0.0, 0.0, 0.0, 0.0
        sigma, push, slope = self._sigma, self._push, self._slope
        decay = math.exp(-sigma * s)
        force, per_push, sine, per_slope = _solution(s, decay, self._w2, self._wd, sigma)
        _, up_push, _, up_slope = _solution(s, decay, self._up2, self._upd, sigma)
        impulse = push * per_push + slope * per_slope
        return push * force + slope * sine, per_slope, impulse, push * up_push + slope * up_slope - impulse


class _PulseFit:
    """Gauss-Newton fit of (onset, slope, log frequency), with the frequency's prior as a residual."""

    def __init__(
        self, bins: list[tuple[TickReading, int]], push: float, prior: PulsePrior, noise_n: float, top: float
    ) -> None:
        self._bins, self._push, self._prior, self._top = bins, push, prior, top
        self._weights = [1.0 / (noise_n * noise_n / n + (_MODEL_ERROR * top) ** 2) for _, n in bins]
        self.start = 0.0
        self.slope = 0.0
        self.omega = min(_MAX_OMEGA, max(_MIN_OMEGA, prior.omega))
        self.sigma = min(prior.sigma, 0.7 * self.omega)
        self._curvature: list[list[float]] = []  # lower triangle of the normal equations
        self._gradient: list[float] = []
        self._used, self._squares = 0, 0.0  # readings that constrain the fit: number, squared residuals

    def run(self, onset_s: float) -> bool:
        """Minimise the squares; return False if the iteration fails."""
        self.start = onset_s
        self.slope = self._best_slope()
        if self.slope <= 0.0:
            return False
        cost = self._linearise()
        for _ in range(_STEPS):
            try:
                step = _solve(self._curvature, self._gradient)
            except ValueError:
                return False
            before = (self.start, self.slope, self.omega)
            share = 1.0
            for _ in range(4):
                self.start = before[0] + max(-0.01, min(0.01, share * step[0]))
                self.slope = max(1e-3, before[1] + share * step[1])
                moved = math.exp(max(-0.3, min(0.3, share * step[2])))
                self.omega = min(_MAX_OMEGA, max(_MIN_OMEGA, before[2] * moved, 1.2 * self.sigma))
                new = self._linearise()
                if new <= cost * (1.0 + 1e-9):
                    break
                share *= 0.3
            settled = abs(new - cost) <= 1e-3 * (1.0 + cost)
            cost = new
            if settled:
                break
        self._cost = cost
        return math.isfinite(cost)

    def _best_slope(self) -> float:
        above = below = 0.0
        for (r, _), weight in zip(self._bins, self._weights, strict=True):
            pa, ca = self._impulses(r.a)
            pb, cb = self._impulses(r.b)
            h = r.b - r.a
            unit = (cb - ca) / h
            above += weight * unit * (r.normal - self._push * (pb - pa) / h)
            below += weight * unit * unit
        return above / below if below > 0.0 else 0.0

    def _impulses(self, t: float) -> tuple[float, float]:
        _, p, _, c = _terms(t - self.start, self.omega, self.sigma)
        return p, c

    def _linearise(self) -> float:
        """Return the cost at the current parameters and store the normal equations."""
        start, slope, omega, sigma, push = self.start, self.slope, self.omega, self.sigma, self._push
        ends = _Ends(omega, sigma, push, slope)
        cost = squares = 0.0
        used = 0
        h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = 0.0
        last_b = math.nan
        fb = ub = qb = vb = 0.0
        for (r, _), weight in zip(self._bins, self._weights, strict=True):
            fa, ua, qa, va = (fb, ub, qb, vb) if r.a == last_b else ends.at(r.a - start)
            fb, ub, qb, vb = ends.at(r.b - start)
            last_b = r.b
            h = r.b - r.a
            model = (qb - qa) / h
            if r.bound and model >= r.normal:
                continue
            residual = r.normal - model
            j0, j1, j2 = -(fb - fa) / h, (ub - ua) / h, (vb - va) / (h * 1e-4)
            used += 1
            squares += residual * residual
            cost += weight * residual * residual
            w0, w1, w2 = weight * j0, weight * j1, weight * j2
            h00 += w0 * j0
            h01 += w0 * j1
            h02 += w0 * j2
            h11 += w1 * j1
            h12 += w1 * j2
            h22 += w2 * j2
            g0 += w0 * residual
            g1 += w1 * residual
            g2 += w2 * residual
        off = math.log(self._prior.omega / omega) / _PRIOR_LOG_OMEGA
        h22 += 1.0 / _PRIOR_LOG_OMEGA**2
        g2 += off / _PRIOR_LOG_OMEGA
        self._curvature = [[h00], [h01, h11], [h02, h12, h22]]
        self._gradient = [g0, g1, g2]
        self._used, self._squares = used, squares
        return cost + off * off

    def result(self, lag_s: float) -> NormalPulse | None:
        omega, sigma, push, slope = self.omega, self.sigma, self._push, self.slope
        wd = math.sqrt(omega * omega - sigma * sigma)
        # The slope is positive (see `run`), so the first extremum is the peak.
        at = math.atan2(slope * wd, sigma * slope - omega * omega * push) / wd
        fp, _, fs, _ = _terms(at, omega, sigma)
        peak = push * fp + slope * fs
        gp, _, gs, _ = _terms(at, omega * 1.0001, sigma)
        dw = (push * gp + slope * gs - peak) / 1e-4
        freedom = self._used
        try:
            _, x, y = _solve(self._curvature, [0.0, fs, dw])
        except ValueError:
            return None  # the readings do not determine the peak
        variance = (fs * x + dw * y) * max(1.0, self._cost / max(1, freedom - 3))
        top = peak * (1.0 + 0.5 * (omega * lag_s) ** 2)
        misfit = math.sqrt(self._squares / max(1, freedom)) / peak
        if misfit > _MAX_MISFIT + 3.0 / math.sqrt(self._weights[0]) / peak:
            return None
        return NormalPulse(
            start_s=self.start,
            slope=slope,
            omega=omega,
            sigma=sigma,
            push=push,
            peak_n=top,
            peak_s=self.start + at,
            sigma_n=math.sqrt(max(0.0, variance)),
            misfit=self._cost / max(1, freedom - 3),
        )


def _solve(h: list[list[float]], g: list[float]) -> list[float]:
    """Return H^-1 g by Cholesky, for the lower triangle of H; ValueError if H is not positive definite."""
    n = len(g)
    low = [[0.0] * n for _ in range(n)]
    for i, row in enumerate(low):
        for j in range(i + 1):
            s = h[i][j]
            for p in range(j):
                s -= row[p] * low[j][p]
            if i == j:
                if not s > 0.0:
                    raise ValueError("the matrix is not positive definite")
                row[i] = math.sqrt(s)
            else:
                row[j] = s / low[j][j]
    y = [0.0] * n
    for i in range(n):
        y[i] = (g[i] - sum_in_order(low[i][p] * y[p] for p in range(i))) / low[i][i]
    for i in range(n - 1, -1, -1):
        y[i] = (y[i] - sum_in_order(low[p][i] * y[p] for p in range(i + 1, n))) / low[i][i]
    return y


# --- friction --------------------------------------------------------------------------------------


def fit_friction(
    readings: list[TickReading],
    pulse: NormalPulse,
    push_m_s2: float,
    mass_kg: float,
    kappa: float,
    noise_n: float,
) -> float | None:
    """Return the friction peak, newton, signed along the tangent, or None if the model does not fit.

    `push_m_s2` is the tangential acceleration by thrust and drag. `kappa` is the expected mu/m, with a wide
    tolerance. `noise_n` is the standard deviation of one reading.
    """
    # Clipped readings are used too, because the axis along the wall is usually not clipped.
    inside = [r for r in readings if r.b > pulse.start_s]
    if len(inside) < 3:
        return None
    ticks = [(r.b - r.a, r.tangential, _impulse(r.b, pulse) - _impulse(r.a, pulse)) for r in inside]
    middle, h = math.log(kappa), 0.05

    def cost(at: float) -> float:
        squares = _tangential(ticks, push_m_s2, mass_kg, at)[1]
        return squares / (noise_n * noise_n) + ((at - middle) / _PRIOR_LOG_KAPPA) ** 2

    log_kappa, here = middle, cost(middle)
    for _ in range(_STEPS):
        # Newton's method in one dimension, with derivatives by differences; `cost` finds the best speed.
        low, high = cost(log_kappa - h), cost(log_kappa + h)
        slope, curve = (high - low) / (2.0 * h), (high - 2.0 * here + low) / (h * h)
        step = -slope / curve if curve > 0.0 else -math.copysign(0.4, slope)
        step = max(-0.6, min(0.6, step))
        log_kappa += step
        if abs(step) < 0.02:
            break
        here = cost(log_kappa)
    speed, squares = _tangential(ticks, push_m_s2, mass_kg, log_kappa)
    peak = _friction_top(inside, pulse, speed, push_m_s2, mass_kg, math.exp(log_kappa))
    rms = math.sqrt(squares / len(inside))
    if rms > max(3.0 * noise_n, 0.2 * abs(peak)):
        return None
    return peak


def _impulse(t: float, pulse: NormalPulse) -> float:
    _, p, _, c = _terms(t - pulse.start_s, pulse.omega, pulse.sigma)
    return max(0.0, pulse.push * p + pulse.slope * c)


def _tangential(
    ticks: list[tuple[float, float, float]], push_m_s2: float, mass_kg: float, log_kappa: float
) -> tuple[float, float]:
    """Return the best tangential speed at the onset for a given friction, and the sum of squared residuals.

    Each tick has its length in seconds, the tangential reading in newton, and the normal impulse over the
    tick.
    """
    kappa = math.exp(log_kappa)
    unit, driven = 1.0, 0.0  # response to an onset speed of 1, and to the push
    sxx = sxy = syy = 0.0
    for h, reading, impulse in ticks:
        left = math.exp(-kappa * impulse)
        middle = math.sqrt(left)
        next_unit = unit * left
        next_driven = driven * left + push_m_s2 * h * middle
        x = mass_kg * (next_unit - unit) / h
        y = reading - mass_kg * ((next_driven - driven) / h - push_m_s2)
        unit, driven = next_unit, next_driven
        sxx += x * x
        sxy += x * y
        syy += y * y
    speed = sxy / sxx if sxx > 0.0 else 0.0
    return speed, max(0.0, syy - speed * sxy)


def _friction_top(
    inside: list[TickReading],
    pulse: NormalPulse,
    speed: float,
    push_m_s2: float,
    mass_kg: float,
    kappa: float,
) -> float:
    """Return the model's largest friction, newton.

    The model is evaluated about every half tick, and a parabola goes through the largest value and its two
    neighbours.
    """
    newest = inside[-1]
    begin, end = pulse.start_s, newest.b
    count = 2 * max(6, round((end - begin) / (end - newest.a)))
    h = (end - begin) / count
    v, last = speed, 0.0
    force = [0.0]
    for i in range(1, count + 1):
        fp, pp, fs, ps = _terms(i * h, pulse.omega, pulse.sigma)
        impulse = max(0.0, pulse.push * pp + pulse.slope * ps)
        left = math.exp(-kappa * (impulse - last))
        v = v * left + push_m_s2 * h * math.sqrt(left)
        last = impulse
        force.append(-mass_kg * kappa * max(0.0, pulse.push * fp + pulse.slope * fs) * v)
    top = max(range(len(force)), key=lambda i: abs(force[i]))
    if not 0 < top < len(force) - 1:
        return force[top]
    a, b, c = force[top - 1], force[top], force[top + 1]
    curve = a - 2.0 * b + c
    return b - 0.125 * (a - c) ** 2 / curve if curve != 0.0 else b
