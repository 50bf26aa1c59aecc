"""The collision map in closed form: approach in, rebound, times, forces and impulse out, vectorised.

In contact the law (paper, Sec. IV-B) is a damped oscillator with a one-sided force. With x the signed
distance to the plane of first touch, a the other acceleration along the normal (gravity in a drop, the
controller's push in flight), and

    omega = sqrt(k/m),  zeta = f / (2 sqrt(k m)),  x = m a / k + (V/omega) xi(tau),  tau = omega t,

the force is lx = m V omega (phi - alpha), phi = xi'', alpha = a / (V omega), and phi, xi, xi' all solve
z'' + 2 zeta z' + z = 0. So every event (peak, deepest point, release) is a zero of such a solution.

Without a, V is the approach speed and the whole contact depends on zeta alone: with theta = acos(zeta),
w = sqrt(1 - zeta^2) and A = theta / w,

                       onset lcp                     onset touch
    contact time       pi / w                        2 A
    restitution        exp(-zeta pi / w)             exp(-2 zeta A)
    deepest point      exp(-zeta (pi / w - A))       exp(-zeta A)
    peak force         exp(-zeta A)                  exp(-zeta (3 A - pi / w)), from zeta = 1/2 on 2 zeta

(in units of 1/omega, 1, V/omega and m V omega). From critical damping on an `lcp` contact never lets go: its
time is infinite, its exit speed 0. The peak of the friction force and, with a, the release have no elementary
form; both are found by a safeguarded Newton iteration to machine precision.

All arrays are float64. Frame: the wall's collision frame (`dart_flight.geometry`); normal < 0 approaches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.law import Onset
from dart_flight.geometry import GRAVITY_M_S2

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
T = TypeVar("T")

# Collisions worked on at a time: the temporaries of one chunk stay in the processor's second-level cache.
_CHUNK = 4096
_NEWTON_STEPS = 60


class CoefficientArrays(NamedTuple):
    """Contact coefficients as arrays of one shape: k N/m, f N s/m, mu s/m, nu N."""

    k: Array
    f: Array
    mu: Array
    nu: Array

    @classmethod
    def of(cls, table: Coefficients | Sequence[Coefficients]) -> CoefficientArrays:
        """One set as arrays without dimension, or a table of n sets (mode, material) as arrays (n,)."""
        if isinstance(table, Coefficients):
            return cls(*(np.asarray(v, dtype=float) for v in (table.k, table.f, table.mu, table.nu)))
        return cls(*(np.array([getattr(row, name) for row in table], dtype=float) for name in cls._fields))

    def take(self, rows: Rows) -> CoefficientArrays:
        """The sets of the given rows, one per collision."""
        return CoefficientArrays(*(values[rows] for values in self))


class Collision(NamedTuple, Generic[T]):
    """What comes out of a wall hit, in the collision frame; `T` is an array or a float.

    Attributes:
        normal_out_m_s, tangential_out_m_s: velocity when the force returns to zero.
        contact_time_s: how long the force is above zero; infinite where the wall is never left.
        penetration_m: how far the vehicle's centre goes behind its plane of first touch.
        peak_normal_force_n: largest lx.
        peak_friction_force_n: largest |ly|.
        impulse_n_s: time integral of lx.
        peak_vertical_force_n: largest |lz|.
    """

    normal_out_m_s: T
    tangential_out_m_s: T
    contact_time_s: T
    penetration_m: T
    peak_normal_force_n: T
    peak_friction_force_n: T
    impulse_n_s: T
    peak_vertical_force_n: T


class Drop(NamedTuple, Generic[T]):
    """What comes out of a drop; `T` is an array or a float.

    Attributes:
        contact_time_s: how long the force is above zero; infinite where the vehicle stays down.
        max_rebound_speed_m_s: largest upward speed, reached in contact where lx = m g.
        peak_force_n: largest lx.
        penetration_m: how far the vehicle's centre goes below its plane of first touch.
        impulse_n_s: time integral of lx.
        onset_s: from the release to the first force.
        onset_speed_m_s: speed (positive) at the first force.
    """

    contact_time_s: T
    max_rebound_speed_m_s: T
    peak_force_n: T
    penetration_m: T
    impulse_n_s: T
    onset_s: T
    onset_speed_m_s: T


# --- without other acceleration: everything but the friction peak is linear in the approach speed ----------


class _Shape(NamedTuple):
    """What depends on coefficients and mass alone, one value per set."""

    restitution: Array
    contact_time: Array
    depth_per_speed: Array
    force_per_speed: Array
    impulse_per_speed: Array
    friction_scale: Array  # m omega
    mu: Array
    nu: Array
    zeta: Array
    scale: Array  # `touch` is the `lcp` course entered late, at a speed this many times higher
    entry: Array  # the largest r = phi'/phi that occurs, at the onset (infinite for lcp)


def _oscillator(c: CoefficientArrays, mass: Array) -> tuple[Array, Array, Array]:
    """omega, zeta, and w^2 = 1 - zeta^2 without cancellation."""
    omega = np.sqrt(c.k / mass)
    zeta = 0.5 * c.f / np.sqrt(c.k * mass)
    return omega, zeta, (1.0 - zeta) * (1.0 + zeta)


def _quarter(zeta: Array, w2: Array) -> Array:
    """A = acos(zeta)/sqrt(1 - zeta^2), continued through critical damping: acosh(zeta)/sqrt(zeta^2 - 1)."""
    w = np.sqrt(np.abs(w2))
    near = w < 1e-5  # there A = 1 + w^2/6 + ... up to the sign, 1e-11 from 1 at most
    safe = np.where(near, 1.0, w)
    angle = np.where(w2 < 0.0, np.arcsinh(safe), np.arctan2(safe, zeta))
    return np.where(near, 1.0 + w2 / 6.0, angle / safe)


def _shape(c: CoefficientArrays, mass: Array, onset: Onset) -> _Shape:
    omega, zeta, w2 = _oscillator(c, mass)
    quarter = _quarter(zeta, w2)
    half = np.where(w2 > 0.0, math.pi / np.sqrt(np.where(w2 > 0.0, w2, 1.0)), math.inf)
    if onset is Onset.LCP:
        time = half
        depth = np.exp(-zeta * (half - quarter))
        peak = np.exp(-zeta * quarter)
        scale, entry = np.ones_like(zeta), np.full_like(zeta, math.inf)
    else:
        light = zeta < 0.5  # else the force falls from the onset on
        time = 2.0 * quarter
        depth = np.exp(-zeta * quarter)
        scale = np.exp(zeta * np.where(light, half - time, 0.0))
        peak = np.where(light, np.exp(-zeta * quarter) * scale, 2.0 * zeta)
        undamped = zeta < 1e-150
        entry = np.where(undamped, math.inf, (1.0 - 4.0 * zeta * zeta) / np.where(undamped, 1.0, 2.0 * zeta))
    restitution = np.exp(-zeta * time)
    return _Shape(
        restitution=restitution,
        contact_time=time / omega,
        depth_per_speed=depth / omega,
        force_per_speed=mass * omega * peak,
        impulse_per_speed=mass * (1.0 + restitution),
        friction_scale=mass * omega,
        mu=c.mu + 0.0 * zeta,
        nu=c.nu + 0.0 * zeta,
        zeta=zeta,
        scale=scale,
        entry=entry,
    )


def _friction_peak(mu_speed: Array, s: _Shape) -> Array:
    """Largest phi exp(-mu V (1 + xi')) of a contact, to machine precision.

    The stationary point is r = c phi with r = phi'/phi and c = mu V. As r falls monotonically in time, take
    it as the unknown: phi and xi' are elementary in it,
        tau = acot((zeta + r)/w)/w,   Q = 1 + 2 zeta r + r^2,   phi = exp(-zeta tau)/sqrt(Q),
        xi' = -phi (r + 2 zeta),
    and Newton solves r Q = c sqrt(Q) exp(-zeta tau), at any damping. `touch` is the same course at c * scale,
    cut off at its entry.
    """
    zeta = s.zeta
    w2 = (1.0 - zeta) * (1.0 + zeta)
    heavy = w2 < 1e-8
    w = np.sqrt(np.where(heavy, 1.0, w2))
    inverse_w = 1.0 / w
    any_heavy = bool(np.any(heavy))

    def decay(r: Array) -> Array:
        y = zeta + r
        tau = np.arctan(w / y) * inverse_w
        if any_heavy:
            tau = np.where(heavy, _acot_heavy(y, w2), tau)
        return np.exp(-zeta * tau)

    c = mu_speed * s.scale
    # The solution without damping, an upper bound; 1e-150 keeps y above 0 where neither damps nor rubs.
    r = math.sqrt(2.0) * c / np.sqrt(1.0 + np.sqrt(1.0 + 4.0 * c * c)) + 1e-150
    for _ in range(_NEWTON_STEPS):
        q = 1.0 + r * (2.0 * zeta + r)
        step = (r * q - c * np.sqrt(q) * decay(r)) / (q + r * r)
        r = np.maximum(r - step, 1e-150)
        # Newton squares the error and the value is stationary in r: 1e-4 now is 1e-8 in r, 1e-16 in the value.
        if bool(np.all(np.abs(step) <= 1e-4 * r + 1e-12)):
            break
    late = r >= s.entry
    q = 1.0 + r * (2.0 * zeta + r)
    phi = s.scale * decay(r) / np.sqrt(q)
    value = phi * np.exp(-mu_speed * np.maximum(1.0 - phi * (2.0 * zeta + r), 0.0))
    return np.where(late, 2.0 * zeta, value)


def _acot_heavy(y: Array, w2: Array) -> Array:
    """acot(y/w)/w for y >= zeta where w^2 is tiny (a series) or negative (acoth)."""
    b = np.sqrt(np.maximum(-w2, 1e-16))
    over = 0.5 * np.log1p(2.0 * b / np.maximum(y - b, 1e-300)) / b
    near = np.abs(w2) < 1e-8
    safe = np.where(near, y, 1.0)
    return np.where(near, (1.0 - w2 / (3.0 * safe * safe)) / safe, over)


def _free(s: _Shape, normal: Array, tangential: Array) -> tuple[Array, ...]:
    speed = np.maximum(-normal, 0.0)
    hits = normal < 0.0
    mu_speed = s.mu * speed
    peak = s.force_per_speed * speed
    return (
        np.where(hits, s.restitution * speed, normal),
        tangential * np.exp(-(1.0 + s.restitution) * mu_speed),
        np.where(hits, s.contact_time, 0.0),
        s.depth_per_speed * speed,
        peak,
        _friction_peak(mu_speed, s) * (s.friction_scale * mu_speed * np.abs(tangential)),
        s.impulse_per_speed * speed,
        s.nu * peak / (1.0 + peak),
    )


# --- with a constant other acceleration along the normal ------------------------------------------------


class _Course(NamedTuple):
    """A contact in its own units: phi - alpha is the force, xi' the normal velocity (module docstring).

    V is |v| + |a|/omega, so that neither a vehicle at rest nor one without push is special.
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


def _course(c: CoefficientArrays, mass: Array, normal: Array, onset: Onset, acceleration: Array) -> _Course:
    omega, zeta, w2 = _oscillator(c, mass)
    speed = np.maximum(-normal, 0.0) + np.abs(acceleration) / omega
    safe = np.where(speed > 0.0, speed, 1.0)
    u = np.maximum(-normal, 0.0) / safe
    alpha = acceleration / (safe * omega)
    phi0 = alpha + (2.0 * zeta * u if onset is Onset.TOUCH else 0.0)
    slope0 = u - 2.0 * zeta * phi0
    # Pulled away hard enough, an lcp approach turns around before the first force.
    starts = (acceleration < 0.0) | (phi0 > alpha) | (slope0 > 0.0)
    hits = (normal <= 0.0) & (speed > 0.0) & starts
    return _Course(omega, zeta, w2, mass, speed, u, alpha, phi0, slope0, hits)


def _basis(c: _Course, tau: Array) -> tuple[Array, Array]:
    """exp(-zeta tau) cos(w tau) and exp(-zeta tau) sin(w tau)/w, at any damping; 0 at tau = inf."""
    finite = np.isfinite(tau)
    t = np.where(finite, tau, 0.0)
    w = np.sqrt(np.abs(c.w2))
    near = w < 1e-9
    safe = np.where(near, 1.0, w)
    damp = np.exp(-c.zeta * t)
    even, odd = damp * np.cos(w * t), damp * np.where(near, t, np.sin(w * t) / safe)
    over = (c.w2 < 0.0) & ~near
    if np.any(over):
        # cosh and sinh would overflow before the damping brings them down.
        b = np.where(over, w, 1.0)
        slow = np.exp(-t / (c.zeta + b))
        even = np.where(over, 0.5 * slow * (1.0 + np.exp(-2.0 * b * t)), even)
        odd = np.where(over, -0.5 * slow * np.expm1(-2.0 * b * t) / b, odd)
    return np.where(finite, even, 0.0), np.where(finite, odd, 0.0)


def _first_zero(c: _Course, z0: Array, dz0: Array) -> Array:
    """First tau > 0 at which the solution with z(0) = z0, z'(0) = dz0 is zero; inf where there is none."""
    w = np.sqrt(np.abs(c.w2))
    near = w < 1e-9
    safe = np.where(near, 1.0, w)
    b = dz0 + c.zeta * z0
    angle = np.arctan2(-safe * z0, b)
    angle = np.where(angle <= 0.0, angle + math.pi, angle)
    under = np.where(angle <= 0.0, math.pi, angle) / safe
    ratio = -z0 / np.where(b == 0.0, 1.0, b)
    reach = np.where(b == 0.0, -1.0, ratio * safe)
    inside = (reach > 0.0) & (reach < 1.0)
    over = np.where(inside, np.arctanh(np.where(inside, reach, 0.5)) / safe, math.inf)
    critical = np.where((b != 0.0) & (ratio > 0.0), ratio, math.inf)
    return np.where(near, critical, np.where(c.w2 < 0.0, over, under))


def _solution(basis: tuple[Array, Array], zeta: Array, z0: Array, dz0: Array) -> Array:
    return z0 * basis[0] + (dz0 + zeta * z0) * basis[1]


def _phi(c: _Course, tau: Array) -> tuple[Array, Array, Array]:
    """phi, phi' and xi' at tau."""
    basis = _basis(c, tau)
    curve0 = -(2.0 * c.zeta * c.slope0 + c.phi0)
    return (
        _solution(basis, c.zeta, c.phi0, c.slope0),
        _solution(basis, c.zeta, c.slope0, curve0),
        _solution(basis, c.zeta, -c.u, c.phi0),
    )


def _falling_root(
    function: Callable[[Array], tuple[Array, Array]], low: Array, high: Array, start: Array
) -> Array:
    """Where a function that is >= 0 at `low` and <= 0 at `high` crosses zero: Newton kept in its bracket.

    Args:
        function: value and derivative.
        low, high: the bracket.
        start: first guess, in the bracket.
    """
    x = start
    for _ in range(_NEWTON_STEPS):
        value, slope = function(x)
        low, high = np.where(value >= 0.0, x, low), np.where(value <= 0.0, x, high)
        newton = x - value / np.where(slope == 0.0, -1.0, slope)
        good = (slope < 0.0) & (newton >= low) & (newton <= high)
        new = np.where(good, newton, 0.5 * (low + high))
        done = bool(np.all(np.abs(new - x) <= 2e-16 * np.abs(new)))
        x = new
        if done:
            break
    return x


class _Events(NamedTuple):
    """Times (in 1/omega) of what happens in a contact."""

    peak: Array  # largest force
    turn: Array  # lx equals -m a: the largest outward speed where a pushes in
    end: Array  # force back to zero; inf where never


def _events(c: _Course) -> _Events:
    curve0 = -(2.0 * c.zeta * c.slope0 + c.phi0)
    falls = (c.slope0 < 0.0) | ((c.slope0 == 0.0) & (c.phi0 > 0.0))
    peak = np.where(falls, 0.0, _first_zero(c, c.slope0, curve0))
    phi, slope, _ = _phi(c, peak)
    slope = np.where(falls, slope, 0.0)  # rounding must not decide on which side of the peak we are
    turn = peak + _first_zero(c, phi, slope)
    half = np.where(c.w2 > 0.0, math.pi / np.sqrt(np.where(c.w2 > 0.0, c.w2, 1.0)), math.inf)
    trough = peak + np.where(falls, _first_zero(c, slope, -(2.0 * c.zeta * slope + phi)), half)
    pulled = c.alpha > 0.0
    at_trough = _phi(c, trough)[0]
    ends = pulled | (c.alpha == 0.0) | (np.isfinite(turn) & (at_trough <= c.alpha))
    low = np.where(pulled, peak, np.where(np.isfinite(turn), turn, 0.0))
    high = np.where(pulled, turn, np.where(np.isfinite(trough), trough, 0.0))
    # Overdamped and pulled away: the force falls below m a somewhere, but phi has no zero to bound it.
    open_end = pulled & ~np.isfinite(high)
    high = np.where(open_end, peak + 1.0, high)
    while np.any(open_end):
        open_end &= _phi(c, high)[0] > c.alpha
        high = np.where(open_end, 2.0 * high, high)

    def force(tau: Array) -> tuple[Array, Array]:
        phi, slope, _ = _phi(c, tau)
        return phi - c.alpha, slope

    end = _falling_root(force, low, high, np.where(pulled, high, low))
    end = np.where(c.alpha == 0.0, turn, np.where(ends, end, math.inf))
    return _Events(peak, turn, end)


def _pushed(
    c: CoefficientArrays, mass: Array, normal: Array, tangential: Array, onset: Onset, acceleration: Array
) -> tuple[tuple[Array, ...], Array]:
    """The eight arrays of `Collision`, and the largest outward speed in contact."""
    course = _course(c, mass, normal, onset, acceleration)
    events = _events(course)
    hits, zeta, v = course.hits, course.zeta, course.speed
    stays = ~np.isfinite(events.end)

    phi_end, _, xi1_end = _phi(course, events.end)
    out = np.where(hits, v * xi1_end, normal)
    held = np.where(stays & (acceleration < 0.0), math.inf, 0.0)
    end = np.where(stays, 0.0, events.end)
    gained = np.maximum(xi1_end + course.u - course.alpha * end, 0.0) + held
    impulse = np.where(hits, mass * v * gained, 0.0)
    rubs = c.mu > 0.0
    slip_out = tangential * np.exp(-np.where(rubs & hits, c.mu * v, 0.0) * np.where(rubs, gained, 0.0))

    deepest = np.minimum(_first_zero(course, -course.u, course.phi0), events.end)
    phi, _, xi1 = _phi(course, deepest)
    depth = np.maximum(v / course.omega * (phi + 2.0 * zeta * xi1 - course.alpha), 0.0)

    scale = mass * v * course.omega
    peak = np.where(hits, scale * np.maximum(_phi(course, events.peak)[0] - course.alpha, 0.0), 0.0)
    friction = _pushed_friction_peak(course, events, c.mu * v) * scale * c.mu * np.abs(tangential)
    fastest = np.where(hits, np.maximum(v * _phi(course, events.turn)[2], 0.0), 0.0)
    return (
        out,
        slip_out,
        np.where(hits, events.end / course.omega, 0.0),
        np.where(hits, depth, 0.0),
        peak,
        np.where(hits, friction, 0.0),
        impulse,
        c.nu * peak / (1.0 + peak),
    ), fastest


def _pushed_friction_peak(c: _Course, events: _Events, rub: Array) -> Array:
    """Largest l exp(-rub P), l = phi - alpha, P its integral: stationary where l' = rub l^2, before the peak."""

    def excess(tau: Array) -> tuple[Array, Array]:
        phi, slope, _ = _phi(c, tau)
        force = phi - c.alpha
        return slope - rub * force * force, -(2.0 * c.zeta * slope + phi) - 2.0 * rub * force * slope

    peak = np.where(np.isfinite(events.peak), events.peak, 0.0)
    start = np.zeros_like(peak)
    first = peak / (1.0 + np.sqrt(rub))
    tau = np.where(excess(start)[0] <= 0.0, start, _falling_root(excess, start, peak, first))
    phi, _, xi1 = _phi(c, tau)
    return (phi - c.alpha) * np.exp(-rub * np.maximum(xi1 + c.u - c.alpha * tau, 0.0))


# --- the public functions -------------------------------------------------------------------------------


def _require(c: CoefficientArrays, mass: Array, *inputs: Array) -> None:
    if not all(bool(np.isfinite(v).all()) for v in (*c, mass, *inputs)):
        raise ValueError("velocities, accelerations, masses and coefficients must be finite")
    if bool((c.k <= 0.0).any()) or bool((mass <= 0.0).any()):
        raise ValueError("mass and k must be positive")
    if any(bool((v < 0.0).any()) for v in (c.f, c.mu, c.nu)):
        raise ValueError("f, mu and nu must not be negative")


class _Batch:
    """Inputs of any shapes as flat arrays of one length, handed out in chunks."""

    def __init__(
        self, c: CoefficientArrays, mass: Array, rows: Rows | None, inputs: tuple[Array, ...]
    ) -> None:
        own = np.broadcast_shapes(mass.shape, *(v.shape for v in c))
        shapes = [v.shape for v in inputs]
        self.shape = np.broadcast_shapes(*shapes, own if rows is None else rows.shape)
        self.size = math.prod(self.shape)
        self.table = CoefficientArrays(*(np.broadcast_to(v, own).reshape(-1) for v in c))
        self.mass = np.broadcast_to(mass, own).reshape(-1)
        self.rows = None if rows is None else np.broadcast_to(rows, self.shape).reshape(-1)
        self.inputs = [np.broadcast_to(v, self.shape).reshape(-1) for v in inputs]
        if rows is None and self.mass.size != 1:  # one set per collision
            self.table = CoefficientArrays(*(np.broadcast_to(v, self.shape).reshape(-1) for v in c))
            self.mass = np.broadcast_to(mass, self.shape).reshape(-1)

    @property
    def is_table(self) -> bool:
        """Whether what depends on coefficients alone is worth computing once per set."""
        return self.rows is not None or self.mass.size == 1

    def parts(self) -> list[slice]:
        return [slice(i, min(i + _CHUNK, self.size)) for i in range(0, self.size, _CHUNK)]

    def coefficients(self, part: slice) -> tuple[CoefficientArrays, Array]:
        if self.rows is not None:
            rows = self.rows[part]
            return self.table.take(rows), self.mass[rows]
        if self.mass.size == 1:
            return self.table, self.mass
        return CoefficientArrays(*(v[part] for v in self.table)), self.mass[part]


def collision_map(
    coefficients: CoefficientArrays,
    mass_kg: ArrayLike,
    normal_m_s: ArrayLike,
    tangential_m_s: ArrayLike,
    onset: Onset,
    *,
    rows: Rows | None = None,
    acceleration_m_s2: ArrayLike | None = None,
) -> Collision[Array]:
    """Wall hits (paper, Sec. IV-B) in closed form.

    Args:
        coefficients: one set, one set per collision (any shape that broadcasts with the velocities), or with
            `rows` a table (n,).
        mass_kg: vehicle mass; broadcasts with `coefficients`.
        normal_m_s: velocity along the outward normal at the onset, collision frame. One that does not
            approach does not meet the wall: it comes out as it went in, with no force and no contact time.
        tangential_m_s: velocity along the wall at the onset.
        onset: onset rule.
        rows: for each collision the row of its (mode, material) in the table; broadcasts with the velocities.
        acceleration_m_s2: constant other acceleration along the normal during contact, negative into the wall
            (the controller's push); None for none. A vehicle that is pushed can come to rest at the wall:
            contact time and impulse are then infinite, the speeds 0.

    Returns:
        Arrays of the broadcast shape. Nothing in them is NaN.

    Raises:
        ValueError: an input is not finite, mass or k is not positive, or f, mu or nu is negative.
    """
    normal, tangential, mass = (np.asarray(v, dtype=float) for v in (normal_m_s, tangential_m_s, mass_kg))
    inputs = (normal, tangential)
    if acceleration_m_s2 is not None:
        inputs = (normal, tangential, np.asarray(acceleration_m_s2, dtype=float))
    _require(coefficients, mass, *inputs)
    batch = _Batch(coefficients, mass, rows, inputs)
    out = tuple(np.empty(batch.size) for _ in Collision._fields)
    shape = _shape(batch.table, batch.mass, onset) if batch.is_table else None
    for part in batch.parts():
        values = [v[part] for v in batch.inputs]
        if acceleration_m_s2 is not None:
            c, m = batch.coefficients(part)
            results, _ = _pushed(c, m, values[0], values[1], onset, values[2])
        elif shape is None:
            results = _free(_shape(*batch.coefficients(part), onset), values[0], values[1])
        elif batch.rows is None:
            results = _free(shape, values[0], values[1])
        else:
            results = _free(_Shape(*(v[batch.rows[part]] for v in shape)), values[0], values[1])
        for target, result in zip(out, results, strict=True):
            target[part] = result
    return Collision(*(v.reshape(batch.shape) for v in out))


def collide(
    coefficients: Coefficients,
    mass_kg: float,
    normal_m_s: float,
    tangential_m_s: float,
    onset: Onset,
    acceleration_m_s2: float = 0.0,
) -> Collision[float]:
    """One wall hit; arguments, results and errors as `collision_map`."""
    push = acceleration_m_s2 or None
    table = CoefficientArrays.of(coefficients)
    result = collision_map(table, mass_kg, normal_m_s, tangential_m_s, onset, acceleration_m_s2=push)
    return Collision(*(float(v) for v in result))


def fall(
    coefficients: CoefficientArrays, mass_kg: ArrayLike, height_m: ArrayLike, onset: Onset
) -> tuple[Array, Array]:
    """Time from the release at rest to the onset of contact, s, and the speed then, m/s (positive).

    By `lcp` the force begins above the plane, where k x = f |v|.
    """
    height = np.asarray(height_m, dtype=float)
    mass = np.asarray(mass_kg, dtype=float)
    g = GRAVITY_M_S2
    if onset is Onset.TOUCH:
        speed = np.sqrt(2.0 * g * height) + 0.0 * (coefficients.k + mass)
    else:
        # k (h - v^2 / 2g) = f v
        rate = coefficients.f / coefficients.k + 0.0 * mass
        speed = 2.0 * height / (rate + np.sqrt(rate * rate + 2.0 * height / g))
    return speed / g, speed


def drop_map(
    coefficients: CoefficientArrays, mass_kg: ArrayLike, height_m: ArrayLike, onset: Onset
) -> Drop[Array]:
    """Drops on the ground (paper, Sec. III and IV-B) in closed form: gravity along the normal.

    Args:
        coefficients: one set, or one per drop (broadcasts with the heights).
        mass_kg: vehicle mass.
        height_m: of the vehicle's centre above its plane of first touch, where it is released at rest; > 0.
        onset: onset rule.

    Raises:
        ValueError: as `collision_map`, or a height is not positive.
    """
    height, mass = np.asarray(height_m, dtype=float), np.asarray(mass_kg, dtype=float)
    _require(coefficients, mass, height)
    if bool((height <= 0.0).any()):
        raise ValueError("the height of a drop must be positive")
    time, speed = fall(coefficients, mass, height, onset)
    batch = _Batch(coefficients, mass, None, (-speed,))
    out = tuple(np.empty(batch.size) for _ in range(5))
    for part in batch.parts():
        c, m = batch.coefficients(part)
        normal = batch.inputs[0][part]
        still, g = np.zeros_like(normal), np.full_like(normal, -GRAVITY_M_S2)
        hit, fastest = _pushed(c, m, normal, still, onset, g)
        r = Collision(*hit)
        results = (r.contact_time_s, fastest, r.peak_normal_force_n, r.penetration_m, r.impulse_n_s)
        for target, result in zip(out, results, strict=True):
            target[part] = result
    return Drop(*(v.reshape(batch.shape) for v in (*out, np.ravel(time), np.ravel(speed))))


def drop(coefficients: Coefficients, mass_kg: float, height_m: float, onset: Onset) -> Drop[float]:
    """One drop; arguments, results and errors as `drop_map`."""
    result = drop_map(CoefficientArrays.of(coefficients), mass_kg, height_m, onset)
    return Drop(*(float(v) for v in result))
