"""Fit of the contact law to the readings of one contact.

The fit estimates the wall's coefficients, the wall's plane and the arms' mode. The fit integrates the contact
law numerically, because the closed-form solution covers a point contact only. The measured rotation loads the
two guards unequally.

Here x is the signed distance of the vehicle's centre to the wall's plane. The angle of incidence i is
positive if the vehicle is turned left. Each side of the vehicle has a right guard (g = 1) and a left guard
(g = -1). Each guard is a distance a (`guard_along_m`) from the middle of its side. The side is a distance d
(`contact_distance_m`) from the vehicle's centre:

    x_g = x - g a sin i + d (1 - cos i)                         depth of a guard
    F   = sum of max(0, -(k x_g + f dx_g/dt)/2)                 normal force, over both guards
    T   = -mu F (v_t + b d di/dt)                               friction; its lever is b d
    M   = a cos(i) (F_1 - F_-1) - d sin(i) F - b d T            torque, positive turns to the right
    m dv/dt = force + push by thrust and drag

Attitude and gyro give the angle of incidence to the planned wall. This angle minus the angle between the real
and the planned wall is i. The fit estimates k, f and mu as multiples of their prior values. The fit also
estimates the wall's angle, the initial distance and velocity, and b. Rigid and flexible arms obey the same
law with different coefficients, so both modes are fitted. From several start values of the angle,
Levenberg-Marquardt steps lead to the most probable values. One array holds all combinations of mode, start
value, damping and shifted parameter; a combination is called a lane. The evidence is Laplace's approximation:

    2 ln p(readings) = -(misfit + prior) - ln det(curvature) + ln det(curvature of the prior)

`ContactFitter` answers the core's `ContactRequest` (docs/contact_fit.md, docs/torque.md). In flights over
MAVSDK the fitter runs in its own process (`run.planner_process`). In the fast world the fitter runs in the
flight's process (`run.fast`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.base.geometry import Quaternion, Vec2, wrap_angle, yaw_ned_of
from dart_flight.base.records import (
    ContactAnswer,
    ContactRequest,
    ContactSide,
    ImpactBody,
    Mode,
    WallEstimate,
)
from dart_flight.base.walls import Wall
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.core.sense.arm_vibration import ArmFilter
from dart_flight.core.sense.contact_recorder import undecided

FIT_US: Final = 50_000  # simulated duration of a fit (docs/contact_fit.md)
CONTACT_SCATTER: Final = 0.05  # relative scatter of k, f, mu and nu between contacts with the same wall
SURE_LOG_ODDS: Final = 5.3  # a mode is decided at odds of 200 to 1; 1 of 1000 is wrong (docs/contact_fit.md)
_FEWEST: Final = 4  # a fit needs at least this number of readings in contact
_SLOWEST_M_S: Final = 0.02
_POSITION_M: Final = 0.01  # standard deviation of PX4's position in the walls' frame
_PLACE_M: Final = 0.1  # least prior deviation of a wall's position; the force locates the wall precisely
_WALL_RAD: Final = math.radians(4.0)  # minimum prior deviation of a planned wall's direction
_UNPLANNED_RAD: Final = math.radians(15.0)  # of an unplanned wall, about the force's direction
_UNKNOWN_SPREAD: Final = 0.8  # relative deviation of the coefficients if the material is unknown
_KNOWN_MATERIAL: Final = 6.0  # a material matches if its squared deviations in k, f and mu have a smaller sum
_MAX_MISFIT: Final = 2.0  # the law does not fit if the normalised residuals have a larger mean square
_VELOCITY_M_S: Final = 0.04  # standard deviation of PX4's velocity at rest
_VELOCITY_SHARE: Final = 0.02  # increase of `_VELOCITY_M_S` per speed
_VERTICAL_N: Final = 1.0  # standard deviation of a contact's mean vertical force
LEVER_SHARE: Final = 0.3  # prior mean of b, the lever arm of the friction divided by d
_LEVER_SD: Final = 0.3  # prior standard deviation of b: both 0 and twice the mean are plausible
# Errors of the model, relative to the largest force, to the largest friction, and to the largest torque.
_MODEL_ERROR: Final = 0.015
_FRICTION_ERROR: Final = 0.03
_TORQUE_ERROR: Final = 0.05  # includes that the errors of neighbouring ticks are correlated
_SURE_SIGMA: Final = 5.0  # a contact's readings sum to more than this many standard deviations
_MIN_FACTOR: Final = 0.1  # lower bound of a coefficient relative to its prior
_MAX_ANGLE_RAD: Final = 0.6
# Angles of incidence from which the fits start.
_STARTS_RAD = np.radians([-19, -14, -10, -7, -4, -1.5, 0, 1.5, 4, 7, 10, 14, 19])
_SCREENED: Final = 3  # after so many steps, only the best starts are kept
_KEPT: Final = 4
_STEPS: Final = 10
_SETTLED: Final = 1e-2  # the search ends when a step reduces the cost by less
_DAMPINGS = np.array([1.0, 10.0, 100.0])  # damping factors, all tried at every step
_DIFFERENCE: Final = 1e-5  # change of a parameter for its numerical derivative
_SUBSTEPS: Final = 2  # integration steps per tick
_FINE: Final = 4  # integration steps per tick when the torque's peak is computed
_MAX_TICKS: Final = 36  # if there are more ticks, neighbouring ticks are merged
_QUADRATIC = np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0
_NEAR_TOP: Final = 0.6  # samples above this fraction of the modelled peak determine the torque's size
_SURE_TORQUE: Final = 4.0  # a torque below this multiple of its noise does not use the model's shape
_QUARTER: Final = 0.5 * math.pi
_K, _F, _X, _V, _D, _MU, _W, _B = range(8)  # k, f, place, velocity, angle, mu, tangential velocity, lever
_FACTORS = [_K, _F, _MU]
# Fields of a `WallEstimate` in the order of a `Belief`.
_ESTIMATED = ("k_n_per_m", "f_ns_per_m", "mu_s_per_m", "nu_n", "k_sd", "f_sd", "mu_sd", "nu_sd")


class Belief(NamedTuple):
    """Estimated coefficients of a wall in one mode, each with its relative standard deviation."""

    k: float
    f: float
    mu: float
    nu: float
    k_sd: float
    f_sd: float
    mu_sd: float
    nu_sd: float


class Ticks(NamedTuple):
    """The readings of a contact, averaged over short intervals (ticks): arrays (T,) for T ticks.

    Attributes:
        h: duration of the tick, s.
        normal, along: mean force along the planned wall's axes, N, for each of M modes: (T, M).
        up: mean vertical force, N.
        push_normal, push_along: force of thrust and drag, N.
        turned, turning: rotation since the middle of the first tick, rad, and its rate, rad/s; positive to
            the left.
        torque: torque about the vertical, N m; a positive torque turns the vehicle to the right.
        samples: number of samples in the tick.
        bound: whether the reading is at full scale, so that the true force may be larger.
    """

    h: Array
    normal: Array
    along: Array
    up: Array
    push_normal: Array
    push_along: Array
    turned: Array
    turning: Array
    torque: Array
    samples: Array
    bound: NDArray[np.bool_]

    def merged(self) -> Ticks:
        """Merge neighbouring ticks until about `_MAX_TICKS` remain; leave ticks at full scale unmerged."""
        size = -(-len(self.h) // _MAX_TICKS)
        if size == 1:
            return self
        alone = self.bound | np.roll(self.bound, 1)
        starts = np.flatnonzero(alone | (np.arange(len(self.h)) % size == 0))
        h = np.add.reduceat(self.h, starts)

        def mean(values: Array) -> Array:
            return (np.add.reduceat((values.T * self.h).T, starts).T / h).T

        count, bound = np.add.reduceat(self.samples, starts), np.logical_or.reduceat(self.bound, starts)
        return Ticks._make([h, *map(mean, self[1:9]), count, bound])


class ContactReadings(NamedTuple):
    """The readings of one contact, and the prior information for its fit.

    Attributes:
        ticks: readings, from a few ticks before the first touch until shortly after the release.
        touched_s: approximate time of the first touch after the beginning of the first tick.
        velocity: PX4's velocity at the touch along the planned wall's axes, m/s.
        incidence_rad: angle of incidence to the planned wall at the touch.
        noise_n, noise_nm: standard deviation of a force reading and of a torque reading.
        place_sd, angle_sd: prior standard deviation of the wall's position (m) and direction (rad).
    """

    ticks: Ticks
    touched_s: float
    velocity: Vec2
    incidence_rad: float
    noise_n: float
    noise_nm: float
    place_sd: float = _PLACE_M
    angle_sd: float = _WALL_RAD


class Hypothesis(NamedTuple):
    """The result of fitting the law of one mode to a contact.

    Attributes:
        evidence: natural logarithm of the probability of the readings in this mode. A constant, equal for
            both modes, is left out.
        misfit: mean square of the normalised residuals (residual divided by its standard deviation).
        belief: posterior coefficients of the wall in this mode.
        incidence_rad, incidence_sd: angle of incidence at the first tick and its standard deviation.
        place_m, place_sd: signed distance of the centre to the wall's plane at the first tick's beginning.
        theta: all fitted parameters (8,).
    """

    evidence: float
    misfit: float
    belief: Belief
    incidence_rad: float
    incidence_sd: float
    place_m: float
    place_sd: float
    theta: Array


class ContactFit:
    """Fits of the contact law to the readings of one contact, one fit for each mode.

    `before` is the prior of the wall in each mode, `scatter` the relative scatter of the coefficients between
    contacts. A force that is too small for a contact raises ValueError.
    """

    def __init__(
        self,
        contact: ContactReadings,
        before: list[Belief],
        vehicle: VehicleConfig,
        scatter: float = CONTACT_SCATTER,
    ) -> None:
        self.contact, self.before, self._vehicle, self._scatter = contact, before, vehicle, scatter
        self._mass, self._along = vehicle.airframe.mass_kg, vehicle.airframe.guard_along_m
        self._out = vehicle.airframe.contact_distance_m
        self._ticks = t = contact.ticks.merged()
        noise2, count = contact.noise_n**2 / t.samples[:, None], t.samples.sum()
        with np.errstate(all="ignore"):
            sure = t.samples @ t.normal > _SURE_SIGMA * contact.noise_n * math.sqrt(count)
        if not (sure.all() and np.isfinite(np.concatenate([c.ravel() for c in t])).all()):
            raise ValueError("no force")
        top, rub = t.normal.max(axis=0), np.abs(t.along).max(axis=0)
        model2 = (_MODEL_ERROR * top) ** 2
        along2 = (_FRICTION_ERROR * rub) ** 2 + 0.04 * model2
        torque2 = (_TORQUE_ERROR * self._along * top) ** 2
        torque_noise2 = contact.noise_nm**2 / t.samples[:, None]
        self._weights = [e**-0.5 for e in (noise2 + model2, noise2 + along2, torque_noise2 + torque2)]
        vn, vt = contact.velocity
        speed_sd = _VELOCITY_M_S + _VELOCITY_SHARE * math.hypot(vn, vt)
        spread = np.hypot([[b.k_sd, b.f_sd, b.mu_sd] for b in before], scatter).T
        self._sd = np.full((8, len(before)), speed_sd)
        self._sd[_FACTORS], self._sd[_X], self._sd[_D] = spread, contact.place_sd, contact.angle_sd
        self._sd[_B] = _LEVER_SD

    def run(self) -> list[Hypothesis]:
        modes, starts = len(self.before), 2 * len(_STARTS_RAD)
        mode = np.repeat(np.arange(modes), starts)
        believed = np.tile(np.arange(starts) < len(_STARTS_RAD), modes)
        theta = self._begin(np.tile(_STARTS_RAD, 2 * modes), believed, mode)
        cost, jacobian, residuals = self._linearized(theta[:, :, None], mode)
        cost, jacobian, residuals = cost[:, 0], jacobian[..., 0], residuals[..., 0]
        damping = np.full(len(mode), 1e-3)
        for step in range(_STEPS):
            if step == _SCREENED:
                order = np.argsort(cost.reshape(modes, starts), axis=1)[:, :_KEPT]
                kept = (order + starts * np.arange(modes)[:, None]).ravel()
                theta, mode, cost, damping = theta[:, kept], mode[kept], cost[kept], damping[kept]
                jacobian, residuals = jacobian[:, :, kept], residuals[:, kept]
            curvature = np.einsum("prl,qrl->lpq", jacobian, jacobian)
            gradient = -np.einsum("prl,rl->lp", jacobian, residuals)
            tried_damping = damping[:, None] * _DAMPINGS[: 1 if step < _SCREENED else None]
            scale = np.einsum("lpp->lp", curvature)[:, None] * tried_damping[:, :, None]
            damped = curvature[:, None] + scale[..., None] * np.eye(8)
            steps = np.linalg.solve(damped, gradient[:, None, :, None])[..., 0]
            tried = _moved(theta[:, :, None], np.moveaxis(steps, 2, 0))
            costs, jacobians, new = self._linearized(tried, mode)
            best, lane = costs.argmin(axis=1), np.arange(len(mode))
            better = costs[lane, best] <= cost
            gain = np.where(better, cost - costs[lane, best], 0.0)
            damping = np.where(better, 0.1 * tried_damping[lane, best], 1e3 * damping)
            took, of = np.flatnonzero(better), best[better]
            theta[:, took], cost[took] = tried[:, took, of], costs[took, of]
            jacobian[:, :, took], residuals[:, took] = jacobians[:, :, took, of], new[:, took, of]
            if step > _SCREENED and (gain <= _SETTLED * (1.0 + 0.01 * cost))[damping < 1e4].all():
                break
        found = []
        for m in range(modes):
            lanes = np.flatnonzero(mode == m)
            one = lanes[cost[lanes].argmin()]
            found.append(self._hypothesis(m, theta[:, one], float(cost[one]), jacobian[:, :, one]))
        return found

    def _begin(self, lead: Array, believed: NDArray[np.bool_], mode: NDArray[np.intp]) -> Array:
        """Return start parameters. The wall's angle starts where the angle of incidence equals `lead`.

        The starts flagged in `believed` use the prior of k. For the other starts, k is computed from the peak
        force. A point mass has the peak force v (k m)^0.5.
        """
        c, (vn, vt), before = self.contact, self.contact.velocity, np.array(self.before)[mode].T
        angle = c.incidence_rad - lead
        normal, along = _turned(vn, vt, np.cos(angle), np.sin(angle))
        k = (self._ticks.normal.max(axis=0)[mode] / vn) ** 2 / self._mass
        k = np.where(believed, before[0], np.clip(k, 0.5 * before[0], 2.0 * before[0]))
        place = -normal * (c.touched_s + before[1] / k) + self._along * np.sin(np.abs(lead))
        one = np.ones_like(lead)
        return np.stack([k / before[0], one, place, normal, angle, one, along, LEVER_SHARE * one])

    def _linearized(self, theta: Array, mode: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """Return cost (L, D), Jacobian (8, R, L, D) and residuals (R, L, D) at parameters (8, L, D).

        L counts the starts in all modes, D the dampings and R the residuals.
        """
        shifts = np.concatenate([np.zeros((8, 1)), _DIFFERENCE * np.eye(8)], axis=1)
        shifted = theta[..., None] + shifts[:, None, None, :]
        lanes = np.broadcast_to(mode[:, None, None], shifted.shape[1:])
        residuals = self._residuals(shifted.reshape(8, -1), lanes.ravel()).reshape(-1, *shifted.shape[1:])
        at = residuals[..., 0]
        cost = np.nan_to_num((at * at).sum(axis=0), nan=math.inf)
        jacobian = np.moveaxis((residuals[..., 1:] - at[..., None]) / _DIFFERENCE, 3, 0)
        return cost, jacobian, at

    def _residuals(self, theta: Array, mode: NDArray[np.intp]) -> Array:
        """Return (readings - model), then (parameters - prior), each divided by its standard deviation."""
        t, c = self._ticks, self.contact
        co, so = np.cos(theta[_D]), np.sin(theta[_D])
        force, along, torque = (part.mean(axis=1) for part in self.forces(t, theta, mode, _SUBSTEPS))
        # Rotate the readings to the axes of the real wall.
        read_n, read_t = _turned(t.normal[:, mode], t.along[:, mode], co, so)
        bound = t.bound[:, None]
        off = np.where(bound & (read_n <= force), 0.0, read_n - force)
        turning = np.where(bound, 0.0, t.torque[:, None] - torque)
        parts = [w[:, mode] * r for w, r in zip(self._weights, (off, read_t - along, turning), strict=True)]
        # Rotate the measured velocity to the same axes.
        (vn, vt), one = c.velocity, np.ones_like(co)
        normal, sliding = _turned(vn, vt, co, so)
        means = np.stack(
            [one, one, -vn * c.touched_s * one, normal, 0.0 * one, one, sliding, LEVER_SHARE * one]
        )
        return np.concatenate([*parts, (theta - means) / self._sd[:, mode]])

    def forces(
        self, t: Ticks, theta: Array, mode: NDArray[np.intp], substeps: int
    ) -> tuple[Array, Array, Array]:
        """Integrate the motion by leapfrog steps with implicit damping.

        Return normal force and friction, N, and torque, N m, each (T, S, L) for S `substeps` per tick and L
        lanes, with parameters (8, L) and modes (L,).
        """
        m, a, out, touch = self._mass, self._along, self._out, Onset(self._vehicle.onset) is Onset.TOUCH
        before = np.array(self.before)[mode].T
        k, f, mu = 0.5 * before[0] * theta[_K], 0.5 * before[1] * theta[_F], before[2] * theta[_MU]
        x, v, w = theta[_X], theta[_V], theta[_W]
        co, so = np.cos(theta[_D]) / m, np.sin(theta[_D]) / m
        push, drive = _turned(t.push_normal[:, None], t.push_along[:, None], co, so)
        i = self.contact.incidence_rad - theta[_D] + t.turned[:, None]
        si, ci, turning = np.sin(i), np.cos(i), t.turning[:, None]
        # Depth and speed of each guard relative to the centre; the right guard is first.
        sides = np.array([-1.0, 1.0])[:, None]
        depth = (out * (1.0 - ci))[:, None] + sides * (a * si)[:, None]
        own = k * depth + f * ((out * si)[:, None] + sides * (a * ci)[:, None]) * turning[:, None]
        h = t.h / substeps
        bears = np.empty((len(h), substeps, 2, len(mode)))
        half_f = 0.5 * f
        for n, h_n in enumerate(h.tolist()):  # multiplying by Python numbers is faster than by NumPy scalars
            half, per_mass, own_n, push_n = 0.5 * h_n, h_n / m, own[n], h_n * push[n]
            damp, moved = half / m * f, half * v
            for s in range(substeps):
                mid = x + moved
                pull = k * mid + own_n
                touches = pull + f * v < 0.0
                if touch:
                    touches &= mid + depth[n] < 0.0
                on = touches.astype(np.float64)
                held, beta = on * pull, damp * (on[0] + on[1])
                new = (v * (1.0 - beta) - per_mass * (held[0] + held[1]) + push_n) / (1.0 + beta)
                np.multiply(on, pull + half_f * (v + new), out=bears[n, s])
                v, moved = new, half * new
                x = mid + moved
        bears = -bears
        force = bears.sum(axis=2)
        # Friction: the speed along the wall decays with the normal impulse.
        h_s = h[:, None, None]
        decay = np.exp(-mu / m * h_s * np.maximum(0.0, force))
        lever = theta[_B] * out
        slip = (lever * turning * ci)[:, None]
        added = h_s * drive[:, None] * np.sqrt(decay) - slip * (1.0 - decay)
        speeds = np.empty((len(h) * substeps + 1, len(mode)))
        speeds[0] = w
        kept, gained = decay.reshape(-1, len(mode)), added.reshape(-1, len(mode))
        for n, (kept_n, gained_n) in enumerate(zip(kept, gained, strict=True), start=1):
            speeds[n] = w = w * kept_n + gained_n
        along = m * (np.diff(speeds, axis=0).reshape(force.shape) / h_s - drive[:, None])
        uneven = a * ci[:, None] * (bears[:, :, 0] - bears[:, :, 1]) - out * si[:, None] * force
        return force, along, uneven - lever * along

    def _hypothesis(self, m: int, theta: Array, cost: float, jacobian: Array) -> Hypothesis:
        t, b, sd = self._ticks, self.before[m], self._sd[:, m]
        misfit = cost / (3 * len(t.h))
        curvature = jacobian @ jacobian.T
        # If the residuals exceed the noise model, widen the posterior by the same factor.
        spread = np.minimum(max(1.0, misfit) * np.diag(np.linalg.inv(curvature)), sd * sd)
        evidence = -0.5 * (cost + np.linalg.slogdet(curvature)[1]) - np.log(sd).sum()
        force = self.forces(t, theta[:, None], np.array([m]), _SUBSTEPS)[0].mean(axis=1)[:, 0]
        (k, k_sd), (f, f_sd), (mu, mu_sd) = (
            self._wall_factor(theta[p], spread[p], before) for p, before in zip(_FACTORS, b[4:7], strict=True)
        )
        nu, nu_sd, seen = self._vertical(b, force)
        belief = Belief(b.k * k, b.f * f, b.mu * mu, b.nu * nu, k_sd, f_sd, mu_sd, nu_sd)
        incidence = self.contact.incidence_rad - theta[_D]
        at = (float(incidence), math.sqrt(spread[_D]), float(theta[_X]), math.sqrt(spread[_X]))
        return Hypothesis(float(evidence + seen), misfit, belief, *at, theta)

    def _wall_factor(self, factor: float, variance: float, before_sd: float) -> tuple[float, float]:
        """Return a wall's posterior after a contact: coefficient factor and relative standard deviation.

        `factor` and `variance` are the estimate from this contact, and `before_sd` is the wall's prior
        standard deviation.

        A contact's coefficient is the wall's coefficient times a random factor, the scatter. Let sd2 be the
        wall's prior variance, s2 the sum of sd2 and the scatter's variance, and G = sd2/s2. The wall's
        posterior variance is then sd2 - G^2 (s2 - variance).
        """
        wall2 = before_sd * before_sd
        hit2 = wall2 + (self._scatter * factor) ** 2
        gain = wall2 / hit2
        mean = max(_MIN_FACTOR, 1.0 + gain * (factor - 1.0))
        after = wall2 - gain * gain * max(0.0, hit2 - variance)
        return float(mean), math.sqrt(after) / float(mean)

    def _vertical(self, b: Belief, force: Array) -> tuple[float, float, float]:
        """Fit nu to the mean vertical force; return the factor on nu, its deviation, and the evidence.

        At the normal force F, the vertical force is nu F/(1 + F).
        """
        t, touching = self._ticks, force > 0.0
        time_s = float(t.h[touching].sum())
        if time_s <= 0.0 or b.nu <= 0.0:
            return 1.0, b.nu_sd, 0.0
        share = (t.h * force / (1.0 + force))[touching].sum() / time_s
        slope = -self._vehicle.vertical_force_sign * b.nu * float(share)
        prior2 = b.nu_sd**2 + self._scatter**2
        variance = _VERTICAL_N**2 + prior2 * slope * slope
        off = float((t.h * t.up)[touching].sum()) / time_s - slope
        factor = 1.0 + prior2 * slope / variance * off
        nu, nu_sd = self._wall_factor(factor, prior2 - prior2 * prior2 * slope * slope / variance, b.nu_sd)
        return nu, nu_sd, -0.5 * (off * off / variance + math.log(variance))


class ContactFitter:
    """Fits the contacts of one flight.

    The posterior coefficients after a contact are the prior of the next contact with the same wall and mode.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle = vehicle
        self._beliefs: dict[tuple[str, Mode], Belief] = {}

    def answer(self, request: ContactRequest) -> ContactAnswer:
        """Return the fit of a contact, or an answer with a `problem` if the fit fails.

        An exception in the fit also becomes a `problem`, so that the flight continues. The receiver
        of the answer sets `received_us`.
        """
        answer = ContactAnswer(0, request.number)
        try:
            with np.errstate(all="ignore"):
                body, wall = self._estimate(request)
        except Exception as error:
            return msgspec.structs.replace(answer, problem=f"contact not fitted: {error}")
        return msgspec.structs.replace(answer, body=body, wall=wall)

    def _estimate(self, request: ContactRequest) -> tuple[ImpactBody, WallEstimate | None]:
        modes, reported = self._vehicle.modes, request.mode_reported
        fit, begin_us = self.make_fit(request)
        fits = fit.run()
        if not all(math.isfinite(h.evidence) for h in fits):
            raise ValueError("no solution")
        odds, sure = 0.0, None
        if len(fits) == len(Mode):  # a vehicle without a lock has one mode and no odds
            misfit = min(h.misfit for h in fits)
            odds = (fits[0].evidence - fits[1].evidence) / max(1.0, misfit)
            if abs(odds) >= SURE_LOG_ODDS and misfit <= _MAX_MISFIT:
                sure = Mode.RIGID if odds > 0.0 else Mode.FLEXIBLE
        likely = Mode.RIGID if odds > 0.0 else modes[-1]
        mode = sure or reported or likely
        index = modes.index(mode)
        found, onset, wall = fits[index], request.onset, request.wall
        lead = 2.0 * self._vehicle.airframe.guard_along_m * math.sin(found.incidence_rad)
        top = _torque_peak(request, fit, found, index)
        body = ImpactBody(
            t_us=request.t_us,
            first_us=onset.first_us,
            side=ContactSide.from_lead(lead),
            lead_m=lead,
            incidence_rad=found.incidence_rad,
            incidence_sigma_rad=found.incidence_sd,
            torque_peak_frd=(float(top[0]), float(top[1]), float(top[2])),
            peak_torque_nm=float(np.linalg.norm(top)),
        )
        if wall is None:
            return body, None
        # If the readings contradict the lock's mode, but too weakly to decide, do not learn from them.
        if mode is likely:
            self._beliefs[wall.name, mode] = found.belief
        c = fit.contact
        back_s = (onset.t_us - begin_us) * 1e-6
        there = wall.signed_distance(onset.position_mission) - c.velocity[0] * back_s
        normal = wall.rotated(c.incidence_rad - found.incidence_rad).normal
        (x, y, _), (vx, vy, _), away = onset.position_mission, onset.velocity_mission, found.place_m
        estimate = msgspec.structs.replace(
            undecided(request, wall, self._vehicle),
            mode_felt=sure,
            log_odds=odds,
            incidence_rad=found.incidence_rad,
            incidence_sigma_rad=found.incidence_sd,
            plane_offset_m=there - found.place_m,
            plane_offset_sigma_m=math.hypot(found.place_sd, _POSITION_M),
            plane_point_mission=(x - back_s * vx - away * normal[0], y - back_s * vy - away * normal[1]),
            plane_normal_mission=normal,
            plane_normal_sigma_rad=found.incidence_sd,
            material=None if wall.material_known else self._likely_material(found.belief, mode),
            **dict(zip(_ESTIMATED, found.belief, strict=True)),
        )
        return body, estimate

    def make_fit(
        self,
        request: ContactRequest,
        spread: float | None = None,
        scatter: float = CONTACT_SCATTER,
        modes: Sequence[Mode] | None = None,
    ) -> tuple[ContactFit, int]:
        """Return the fit of a request's samples, and the stamp at which the first tick begins.

        `spread` replaces the relative standard deviations of the prior, `modes` the vehicle's modes.
        If the readings are too few, or the vehicle did not fly towards the wall, this raises ValueError.
        """
        onset, wall, imu = request.onset, request.wall, self._vehicle.imu
        modes = modes or self._vehicle.modes
        (nx, ny), (vx, vy, _) = request.normal, onset.velocity_mission
        velocity = (vx * nx + vy * ny, vx * ny - vy * nx)
        if sum(t_us >= onset.first_us for t_us in request.sample_us) < _FEWEST:
            raise ValueError("there are too few force readings")
        if velocity[0] > -_SLOWEST_M_S:
            raise ValueError("the vehicle did not fly towards the wall")
        begin_us = request.sample_us[0] - round((imu.tick_s + imu.filter_lag_s) * 1e6)
        place_sd, angle_sd = _PLACE_M, _UNPLANNED_RAD
        if wall is not None:
            place_sd = max(_PLACE_M, float(wall.plane_sd_m(onset.position_mission)))
            angle_sd = max(_WALL_RAD, wall.yaw_sd_rad or 0.0)
        contact = ContactReadings(
            self._ticks(request, modes),
            (onset.first_us - begin_us) * 1e-6 - 0.75 * imu.tick_s,
            velocity,
            measure_incidence(request.frame_heading_rad, request.q_frd_to_ned[0], request.normal),
            max(1e-2, request.noise_n),
            max(1e-4, abs(request.noise_frd_nm[2])),
            place_sd,
            angle_sd,
        )
        before = [self._belief(wall, mode) for mode in modes]
        if spread is not None:
            before = [Belief(*belief[:4], *4 * (spread,)) for belief in before]
        return ContactFit(contact, before, self._vehicle, scatter), begin_us

    def _ticks(self, request: ContactRequest, modes: Sequence[Mode]) -> Ticks:
        """Return the readings; the arms' vibration is removed only from the flexible mode's readings."""
        arms, mass = self._vehicle.estimation.arm_vibration, self._vehicle.airframe.mass_kg
        tick_s, (nx, ny) = self._vehicle.imu.tick_s, request.normal
        t_us, force = np.array(request.sample_us), np.array(request.force_mission)
        h = np.diff(t_us, prepend=t_us[0] - round(tick_s * 1e6)) * 1e-6
        force[:, :2] -= request.slow_force
        push = np.array(request.push_mission) + request.slow_force
        down = _down(request.q_frd_to_ned)
        turning = -(down * request.rate_frd).sum(axis=1)  # the mission's z points up
        read = np.empty((len(h), len(modes), 2))
        taken_out = request.mode_reported is not Mode.RIGID
        for m, mode in enumerate(modes):
            read[:, m], swings = force[:, :2], mode is Mode.FLEXIBLE
            if arms is not None and taken_out != swings:
                turn, moved = ArmFilter(arms, tick_s), force[:, :2] / mass
                for n, ((ax, ay), h_n) in enumerate(zip(moved.tolist(), h.tolist(), strict=True)):
                    read[n, m] = turn.remove(ax, ay, h_n) if swings else turn.add(ax, ay)
                read[:, m] *= mass
        return Ticks(
            h,
            read @ (nx, ny),
            read @ (ny, -nx),
            force[:, 2],
            push @ (nx, ny),
            push @ (ny, -nx),
            np.cumsum(h * turning) - 0.5 * h * turning,
            turning,
            (down * request.torque_frd).sum(axis=1),
            np.ones(len(h)),
            np.array(request.clipped),
        )

    def _belief(self, wall: Wall | None, mode: Mode) -> Belief:
        found = None if wall is None else self._beliefs.get((wall.name, mode))
        if found is not None:
            return found
        if wall is None or not wall.material_known:
            c, sd = (
                mean_coefficients(m.coefficients(mode) for m in self._vehicle.materials.values()),
                _UNKNOWN_SPREAD,
            )
        else:
            c, sd = (
                self._vehicle.materials[wall.material].coefficients(mode),
                self._vehicle.estimation.walls.spread,
            )
        return Belief(c.k, c.f, c.mu, c.nu, sd, sd, sd, sd)

    def _likely_material(self, belief: Belief, mode: Mode) -> str | None:
        """Return the material with the coefficients nearest to `belief`, or None if none is near."""
        spread2 = self._vehicle.estimation.walls.spread**2

        def misfit(name: str) -> float:
            c = self._vehicle.materials[name].coefficients(mode)
            pairs = (
                (belief.k, belief.k_sd, c.k),
                (belief.f, belief.f_sd, c.f),
                (belief.mu, belief.mu_sd, c.mu),
            )
            return sum_in_order(
                math.log(value / of) ** 2 / (sd * sd + spread2) for value, sd, of in pairs if of > 0.0
            )

        best = min(self._vehicle.materials, key=misfit)
        return best if misfit(best) <= _KNOWN_MATERIAL else None


def _torque_peak(request: ContactRequest, fit: ContactFit, found: Hypothesis, mode: int) -> Array:
    """Return the largest torque, N m, FRD.

    The largest of many noisy samples is biased. A mean over a tick underestimates the peak that occurs when
    the second guard touches the wall. The model therefore gives the shape of the torque about the vertical,
    and the samples near the model's peak give the size. The difference between the measured and the modelled
    torque is smoothed and added.
    """
    torque, down = np.array(request.torque_frd), _down(request.q_frd_to_ned)
    model = fit.forces(fit.contact.ticks, found.theta[:, None], np.array([mode]), _FINE)[2][:, :, 0]
    mean = model.mean(axis=1)
    top = mean[np.abs(mean).argmax()]
    near = mean * top >= _NEAR_TOP * top * top
    share = 0.0
    if abs(top) > _SURE_TORQUE * 0.6 * float(np.linalg.norm(request.noise_frd_nm)):
        share = float((mean * (torque * down).sum(axis=1))[near].sum() / (mean[near] ** 2).sum())
    beside = torque - share * mean[:, None] * down
    smooth = beside.copy()
    if len(beside) > 4:
        smooth[2:-2] = np.stack([np.convolve(column, _QUADRATIC, "valid") for column in beside.T], axis=1)
    peaks = (smooth[:, None] + share * model[:, :, None] * down[:, None]).reshape(-1, 3)
    largest: Array = peaks[np.linalg.norm(peaks, axis=1).argmax()]
    return largest


def measure_incidence(frame_heading_rad: float, q: Quaternion, normal: Vec2) -> float:
    """Return the angle of incidence, rad, for the vehicle's side that faces the wall most directly."""
    seen = wrap_angle(frame_heading_rad - yaw_ned_of(q) - math.atan2(-normal[1], -normal[0]))
    return seen - _QUARTER * round(seen / _QUARTER)


def mean_coefficients(coefficients: Iterable[Coefficients]) -> Coefficients:
    """Return the geometric mean over the materials: the prior of an unknown wall or material."""
    every = np.array([[c.k, c.f, c.mu, c.nu] for c in coefficients])
    return Coefficients(*np.exp(np.log(np.maximum(every, 1e-6)).mean(axis=0)).tolist())


def _down(q: Sequence[Quaternion]) -> Array:
    """Return the downward unit vectors in body axes, for quaternions (T, 4)."""
    w, x, y, z = np.array(q).T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


def _turned(normal: Array | float, along: Array | float, co: Array, so: Array) -> tuple[Array, Array]:
    """Convert a vector to the axes of a wall that is rotated counter-clockwise (co: cosine, so: sine)."""
    return normal * co - along * so, along * co + normal * so


def _moved(theta: Array, step: Array) -> Array:
    """Return the parameters after a step, clipped to their bounds.

    One step at most halves or doubles a coefficient (k, f or mu).
    """
    moved = theta + step
    old = theta[_FACTORS]
    moved[_FACTORS] = np.clip(moved[_FACTORS], np.maximum(0.5 * old, _MIN_FACTOR), 2.0 * old)
    moved[_D] = np.clip(moved[_D], -_MAX_ANGLE_RAD, _MAX_ANGLE_RAD)
    moved[_B] = np.clip(moved[_B], 0.0, 1.0)  # the lever is between the centre of mass (0) and the guards (1)
    return moved
