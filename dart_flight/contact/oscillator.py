"""A contact as a damped oscillator: initial state, motion in time, and times of its events.

This is the only evaluation of the point law over time. `contact_map` uses a contact's outcome,
`planning/contact_stage.py` its events and speeds, and `lab/predict/path.py` its whole course. The simulated
vehicle integrates `law.py` instead.

The symbols are those of `contact_map`. V is the speed scale, the force is lx = m V omega (phi - alpha), and
the normal velocity is V xi'. The functions phi, xi and xi' all solve z'' + 2 zeta z' + z = 0 in tau = omega
t. Any damping is covered, from none to far above critical.

All arguments and results are float64 arrays of one shape (or shapes that broadcast).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.law import Onset

_NEWTON_STEPS = 60


def oscillator(c: CoefficientArrays, mass: Array) -> tuple[Array, Array, Array]:
    """Return omega, zeta and w^2 = 1 - zeta^2, the latter without numerical cancellation."""
    omega = np.sqrt(c.k / mass)
    zeta = 0.5 * c.f / np.sqrt(c.k * mass)
    return omega, zeta, (1.0 - zeta) * (1.0 + zeta)


def quarter_time(zeta: Array, w2: Array) -> Array:
    """Return A = acos(zeta)/sqrt(1 - zeta^2), or acosh(zeta)/sqrt(zeta^2 - 1) above critical damping."""
    w = np.sqrt(np.abs(w2))
    near = w < 1e-5  # A = 1 +- w^2/6 + ... differs from 1 by at most 1e-11 here
    safe = np.where(near, 1.0, w)
    angle = np.where(w2 < 0.0, np.arcsinh(safe), np.arctan2(safe, zeta))
    return np.where(near, 1.0 + w2 / 6.0, angle / safe)


class NormalMotion(NamedTuple):
    """Position (m), velocity (m/s) and contact force (N) along the normal, collision frame."""

    position_m: Array
    velocity_m_s: Array
    force_n: Array


class Oscillation(NamedTuple):
    """A contact in dimensionless units: force phi - alpha, normal velocity xi' (see the module).

    V is |v| + |a|/omega. V is 0 only if the vehicle is at rest and nothing pushes it.
    """

    omega: Array
    zeta: Array
    w2: Array
    mass: Array
    speed: Array  # V, m/s
    u: Array  # -xi' at the onset
    alpha: Array
    phi0: Array
    slope0: Array  # phi' at the onset
    hits: NDArray[np.bool_]

    def at(self, tau: Array) -> NormalMotion:
        phi, _, xi1 = motion(self, tau)
        return NormalMotion(
            self.speed / self.omega * (self.alpha - phi - 2.0 * self.zeta * xi1),
            self.speed * xi1,
            self.mass * self.speed * self.omega * np.maximum(phi - self.alpha, 0.0),
        )

    def impulse(self, tau: Array) -> Array:
        """Return the time integral of the force since the onset, N s; infinite for an endless push."""
        ends = np.isfinite(tau)
        gained = motion(self, tau)[2] + self.u - self.alpha * np.where(ends, tau, 0.0)
        endless = np.where(ends | (self.alpha >= 0.0), 0.0, math.inf)
        return np.asarray(self.mass * self.speed * (np.maximum(gained, 0.0) + endless))


def begin_contact(
    c: CoefficientArrays, mass: Array, normal: Array, onset: Onset, acceleration: Array
) -> Oscillation:
    """Return the contact after an approach at `normal` (m/s, < 0) under a constant `acceleration` (m/s2)."""
    omega, zeta, w2 = oscillator(c, mass)
    speed = np.maximum(-normal, 0.0) + np.abs(acceleration) / omega
    safe = np.where(speed > 0.0, speed, 1.0)
    u = np.maximum(-normal, 0.0) / safe
    alpha = acceleration / (safe * omega)
    phi0 = alpha + (2.0 * zeta * u if onset is Onset.TOUCH else 0.0)
    slope0 = u - 2.0 * zeta * phi0
    # With the rule `lcp`, a strong outward acceleration can reverse the approach before the first force.
    starts = (acceleration < 0.0) | (phi0 > alpha) | (slope0 > 0.0)
    hits = (normal <= 0.0) & (speed > 0.0) & starts
    # An input without a hit gets the events of an ordinary hit, so that all events are defined.
    rest = 2.0 * zeta if onset is Onset.TOUCH else 0.0 * zeta
    return Oscillation(
        omega,
        zeta,
        w2,
        mass,
        speed,
        np.where(hits, u, 1.0),
        np.where(hits, alpha, 0.0),
        np.where(hits, phi0, rest),
        np.where(hits, slope0, 1.0 - 2.0 * zeta * rest),
        hits,
    )


def _basis(c: Oscillation, tau: Array) -> tuple[Array, Array]:
    """Return exp(-zeta tau) cos(w tau) and exp(-zeta tau) sin(w tau)/w, at any damping; 0 at tau = inf."""
    finite = np.isfinite(tau)
    t = np.where(finite, tau, 0.0)
    w = np.sqrt(np.abs(c.w2))
    near = w < 1e-9
    safe = np.where(near, 1.0, w)
    damp = np.exp(-c.zeta * t)
    even, odd = damp * np.cos(w * t), damp * np.where(near, t, np.sin(w * t) / safe)
    over = (c.w2 < 0.0) & ~near
    if np.any(over):
        # cosh and sinh alone would overflow.
        b = np.where(over, w, 1.0)
        slow = np.exp(-t / (c.zeta + b))
        even = np.where(over, 0.5 * slow * (1.0 + np.exp(-2.0 * b * t)), even)
        odd = np.where(over, -0.5 * slow * np.expm1(-2.0 * b * t) / b, odd)
    return np.where(finite, even, 0.0), np.where(finite, odd, 0.0)


def first_zero(c: Oscillation, z0: Array, dz0: Array) -> Array:
    """Return the first zero tau > 0 of the solution with z(0) = z0, z'(0) = dz0; inf if there is none."""
    w = np.sqrt(np.abs(c.w2))
    near = w < 1e-9
    safe = np.where(near, 1.0, w)
    b = dz0 + c.zeta * z0
    angle = np.arctan2(-safe * z0, b)
    angle = np.where(angle <= 0.0, angle + math.pi, angle)
    under = np.where(angle <= 0.0, math.pi, angle) / safe
    none = np.abs(b) < 1e-290  # zero, or so small that the division overflows
    ratio = np.where(none, -1.0, -z0 / np.where(none, 1.0, b))
    reach = ratio * safe
    inside = (reach > 0.0) & (reach < 1.0)
    over = np.where(inside, np.arctanh(np.where(inside, reach, 0.5)) / safe, math.inf)
    critical = np.where(ratio > 0.0, ratio, math.inf)
    return np.where(near, critical, np.where(c.w2 < 0.0, over, under))


def _solution(basis: tuple[Array, Array], zeta: Array, z0: Array, dz0: Array) -> Array:
    return z0 * basis[0] + (dz0 + zeta * z0) * basis[1]


def motion(c: Oscillation, tau: Array) -> tuple[Array, Array, Array]:
    """Return phi, phi' and xi'."""
    basis = _basis(c, tau)
    curve0 = -(2.0 * c.zeta * c.slope0 + c.phi0)
    return (
        _solution(basis, c.zeta, c.phi0, c.slope0),
        _solution(basis, c.zeta, c.slope0, curve0),
        _solution(basis, c.zeta, -c.u, c.phi0),
    )


def falling_root(
    function: Callable[[Array], tuple[Array, Array]], low: Array, high: Array, start: Array
) -> Array:
    """Return the zero of a function that is >= 0 at `low` and <= 0 at `high`, by bracketed Newton steps.

    `function` returns value and derivative; `start` lies inside the bracket.
    """
    x = start
    for _ in range(_NEWTON_STEPS):
        value, slope = function(x)
        low, high = np.where(value >= 0.0, x, low), np.where(value <= 0.0, x, high)
        with np.errstate(over="ignore"):  # an infinite step leaves the bracket and is rejected
            newton = x - value / np.where(slope == 0.0, -1.0, slope)
        good = (slope < 0.0) & (newton >= low) & (newton <= high)
        new = np.where(good, newton, 0.5 * (low + high))
        # A Newton step squares the error: after a step of 1e-9 only rounding is left.
        done = bool((np.abs(new - x) <= np.where(good, 1e-9, 1e-15) * np.abs(new)).all())
        x = new
        if done:
            break
    return x


class ContactTimes(NamedTuple):
    """Times of a contact's events since the onset, in units of 1/omega."""

    peak: Array  # largest force
    turn: Array  # lx falls to -m a, and with an `a` into the wall the outward speed is largest
    end: Array  # time at which the force returns to zero; inf if the force never does


def find_contact_times(c: Oscillation) -> ContactTimes:
    curve0 = -(2.0 * c.zeta * c.slope0 + c.phi0)
    falls = (c.slope0 < 0.0) | ((c.slope0 == 0.0) & (c.phi0 > 0.0))
    peak = np.where(falls, 0.0, first_zero(c, c.slope0, curve0))
    phi, slope, _ = motion(c, peak)
    slope = np.where(falls, slope, 0.0)  # remove rounding errors, which could put the peak before the onset
    turn = peak + first_zero(c, phi, slope)
    half = np.where(c.w2 > 0.0, math.pi / np.sqrt(np.where(c.w2 > 0.0, c.w2, 1.0)), math.inf)
    trough = peak + np.where(falls, first_zero(c, slope, -(2.0 * c.zeta * slope + phi)), half)
    pulled = c.alpha > 0.0
    at_trough = motion(c, trough)[0]
    ends = pulled | (c.alpha == 0.0) | (np.isfinite(turn) & (at_trough <= c.alpha))
    if not np.any(c.alpha):
        return ContactTimes(peak, turn, turn)
    low = np.where(pulled, peak, np.where(np.isfinite(turn), turn, 0.0))
    high = np.where(pulled, turn, np.where(np.isfinite(trough), trough, 0.0))
    # Overdamped with an outward acceleration: the force returns to zero, but no zero of phi bounds this time.
    open_end = pulled & ~np.isfinite(high)
    high = np.where(open_end, peak + 1.0, high)
    while np.any(open_end):
        open_end &= motion(c, high)[0] > c.alpha
        high = np.where(open_end, 2.0 * high, high)

    def force(tau: Array) -> tuple[Array, Array]:
        phi, slope, _ = motion(c, tau)
        return phi - c.alpha, slope

    end = falling_root(force, low, high, np.where(pulled, high, low))
    end = np.where(c.alpha == 0.0, turn, np.where(ends, end, math.inf))
    return ContactTimes(peak, turn, end)


def time_of_drop(c: Oscillation, times: ContactTimes, fraction: float) -> Array:
    """Return the time (1/omega) at which an unpushed contact's force has dropped by a fraction of its
    peak."""
    end = np.where(np.isfinite(times.end), times.end, 2.0 * times.peak + 1.0)
    level = (1.0 - fraction) * motion(c, times.peak)[0]

    def excess(tau: Array) -> tuple[Array, Array]:
        phi, slope, _ = motion(c, tau)
        return phi - level, slope

    return falling_root(excess, times.peak, end, 0.5 * (times.peak + end))
