"""A planned contact: the contact law, and PX4's controller, which remains active during the contact.

The contact law of a point (paper, Sec. IV-B; `contact/oscillator.py`) determines the duration T, the time t_p
of the force peak and, with the detector's rule, the time t_e of the recovery setpoint. All three depend on
coefficients and mass, not on the speed. The feed-forward (`core/mission/contact_feedforward.py`) keeps PX4
from pushing against the wall. Until t_e, the setpoint is the measured motion, so the controller's error e is
0. After t_e, the error e is kp (s - x) - x', where s is the recovery setpoint. The feed-forward also cancels
the D term's response to the wall's force, before and after t_e. The symbols a, b and i are those of
`planning/flight_model.py`. Along the normal, PX4's loop gives

    x'' = -(k x + f x')/m + a - b x'
    a'  = (kv e + i - kd (a - b x') - a) / tau,      i' = ki e

Along the wall, friction dominates. By the contact law alone, the velocity u follows u' = -(mu/m) lx u, and q
is the distance along the wall since the onset. The controller's error is e = kp (s - q) - u, and the
controller's thrust adds a velocity d:

    a' = (kv e + i - kd a - a) / tau,      i' = ki e
    d' = -(mu/m) lx d + a,                 velocity u + d

In these equations, lx is the normal force of the contact law alone, at the speed of the onset. The force lx
also determines the peak friction force. The recovery setpoint (`core/mission/recovery.py`) is the position at
the force peak, plus each peak force (normal and friction) times its gain. All equations along the normal are
linear. One constant matrix per material and mode therefore describes the motion along the normal. The matrix
exponential gives this constant matrix exactly.

The motion along the wall needs only integrals of exp(-c (1 + xi')). Here c is mu times the normal speed at
the onset, and xi' is the normal velocity divided by this speed. Gauss quadrature is accurate to about 1e-10.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from dart_flight.base.arithmetic import sum_in_order
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import friction_per_speed
from dart_flight.contact.law import Onset
from dart_flight.contact.oscillator import Oscillation, begin_contact, find_contact_times, time_of_drop
from dart_flight.core.mission.position_loop import PositionLoop
from dart_flight.core.mission.recovery import recovery_offset
from dart_flight.core.sense.detector import PEAK_DROP_FRACTION

_NODES = 10  # Gauss nodes in each of the two phases of a contact
_SUB = 12
# Delay from the detected force drop (PEAK_DROP_FRACTION) until PX4 uses the setpoint: one IMU sample plus, on
# average, half a period of PX4's position controller (125 Hz).
_SETPOINT_USED_S = 0.004
_MIN_AFTER_PEAK_S = 0.008  # minimum delay, because the detector needs two samples after the maximum


class _Quadrature(NamedTuple):
    """Gauss-Legendre rule on [0, 1], with weights for the integrals from 0 to each of its nodes and to 1."""

    nodes: Array  # (J,)
    weights: Array  # (J,)
    sub_nodes: Array  # (L,)
    sub_weights: Array  # (L,)
    upper: Array  # (J + 1,): upper ends of the integrals, at the nodes and at 1
    lagrange: Array  # (J + 1, L, J): Lagrange polynomials at upper * sub_nodes
    integral: Array  # (J + 1, J)


def _gauss(count: int) -> tuple[Array, Array]:
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1.0), 0.5 * w


def _lagrange(nodes: Array, at: Array) -> Array:
    """Return the J Lagrange polynomials of `nodes` at the points `at`; shape `at.shape + (J,)`."""
    others = ~np.eye(nodes.size, dtype=bool)
    away = np.where(others, (at[..., None] - nodes)[..., None, :], 1.0)
    apart = np.where(others, nodes[:, None] - nodes, 1.0)
    out: Array = away.prod(axis=-1) / apart.prod(axis=-1)
    return out


@lru_cache(maxsize=1)
def _quadrature() -> _Quadrature:
    nodes, weights = _gauss(_NODES)
    sub_nodes, sub_weights = _gauss(_SUB)
    upper = np.append(nodes, 1.0)
    lagrange = _lagrange(nodes, upper[:, None] * sub_nodes)
    integral = upper[:, None] * np.einsum("l,jlk->jk", sub_weights, lagrange)
    return _Quadrature(nodes, weights, sub_nodes, sub_weights, upper, lagrange, integral)


def expm(matrix: Array) -> Array:
    """Return the matrix exponential of (..., n, n) by scaling, Taylor series and squaring, to about 1e-15."""
    size = float(np.abs(matrix).sum(axis=-1).max(initial=0.0))
    halvings = max(0, math.ceil(math.log2(max(size, 1e-300) / 0.5)))
    scaled = matrix * 0.5**halvings
    identity = np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape)
    result = identity + scaled / 14.0
    for n in range(13, 0, -1):
        result = identity + scaled @ result / n
    for _ in range(halvings):
        result = result @ result
    return np.asarray(result)


class NormalOut(NamedTuple):
    """Result of a contact along the wall's normal: position at the onset, peak force, state at the release.

    Positions are distances from the wall's plane, metres.
    """

    onset_m: Array
    peak_force_n: Array
    release_m: Array
    velocity: Array
    acceleration: Array
    integral: Array
    setpoint_m: Array


class TangentialOut(NamedTuple):
    """Result of a contact along the wall: signed friction, and the state's change from onset to release."""

    release_m: Array
    velocity: Array
    acceleration: Array
    integral: Array
    friction_n: Array
    setpoint_m: Array


class TangentialShape(NamedTuple):
    """Linear response of the motion along the wall to four inputs; one array element per normal speed.

    The inputs are the velocity v, acceleration a and integral i at the onset, and the recovery setpoint s.
    The last letter of a field's name states the input. The input of `distance_to_peak` and `distance` is v.
    """

    distance_to_peak: Array
    distance: Array
    velocity_v: Array
    acceleration_v: Array
    integral_v: Array
    friction_v: Array
    push_a: Array
    push_i: Array
    push_s: Array


class ContactStage:
    """The contact model for one material, mode and pair of gains, prepared for many impacts.

    Attributes:
        duration_s: time from the onset to the release; infinite if the vehicle stays at the wall.
        peak_s: time from the onset to the peak of the normal force.
        engaged_s: time from the onset until PX4 uses the recovery setpoint, at most `duration_s`.
        lead_s: the contact begins when x + lead_s x' becomes 0. `lead_s` is f/k with the onset rule
            `lcp`, and 0 with `touch`.
    """

    def __init__(
        self, coefficients: Coefficients, mass_kg: float, onset: Onset, alphas: tuple[float, float]
    ) -> None:
        self.coefficients, self.mass_kg, self.onset = coefficients, mass_kg, onset
        self.alphas = alphas
        self.lead_s = coefficients.lead_s if onset is Onset.LCP else 0.0
        self.duration_s = self.peak_s = self.engaged_s = math.inf
        self._normal: Array = np.zeros((6, 3))
        self._depths: Array = np.zeros(0)  # 1 + xi' at the nodes
        self._depth_end = 0.0
        # Per unit of u at the nodes: distance to the peak, distance, integral, acceleration.
        self._by_speed: Array = np.zeros((0, 0))
        self._push: Array = np.zeros((0, 0))  # weights times acceleration per input at the nodes
        self._push_speed: Array = np.zeros((0, 0))
        self._ends: Array = np.zeros((2, 3))  # acceleration and integral at T per input a, i, s
        self._friction = friction_per_speed(CoefficientArrays.from_table(coefficients), mass_kg, onset)

    # -- impacts --

    def normal(self, speed: Array, acceleration: Array, integral: Array) -> NormalOut:
        """Return the motion along the normal from values at the onset, m/s (`speed`, negative) and m/s2."""
        inputs = (speed, acceleration, integral)
        rows = [
            sum_in_order(c * v for c, v in zip(row, inputs, strict=True) if c != 0.0) for row in self._normal
        ]
        return NormalOut(-self.lead_s * speed, *(np.asarray(row) for row in rows))

    def tangential_shape(self, speed_m_s: Array) -> TangentialShape:
        """Return the factors of the motion along the wall for normal velocities at the onset (m/s, < 0)."""
        c = self.coefficients.mu * np.maximum(-speed_m_s, 0.0)
        flat = c.reshape(-1, 1)
        slip = np.exp(-flat * self._depths)  # u at the nodes per unit of u at the onset
        slip_end = np.exp(-flat * self._depth_end)
        kept = np.exp(-flat * (self._depth_end - self._depths))  # part of an added speed that is left at T
        values = slip @ self._by_speed.T
        push = kept @ self._push
        push_v = np.einsum("nj,nj->n", kept, slip @ self._push_speed.T)
        shape = c.shape
        return TangentialShape(
            values[:, 0].reshape(shape),
            values[:, 1].reshape(shape),
            (slip_end[:, 0] + push_v).reshape(shape),
            values[:, 3].reshape(shape),
            values[:, 2].reshape(shape),
            self._friction(speed_m_s),
            *(push[:, i].reshape(shape) for i in range(3)),
        )

    def tangential(self, s: TangentialShape, v: Array, a: Array, i: Array) -> TangentialOut:
        """Return the motion along the wall, for `s` from `tangential_shape`.

        At the onset, v is the velocity along the wall, a the acceleration and i the velocity loop's integral.
        """
        friction = -s.friction_v * v
        setpoint = s.distance_to_peak * v + recovery_offset((0.0, friction), self.alphas)[1]
        (aa, ai, a_s), (_, ii, i_s) = self._ends
        return TangentialOut(
            s.distance * v,
            s.velocity_v * v + s.push_a * a + s.push_i * i + s.push_s * setpoint,
            s.acceleration_v * v + aa * a + ai * i + a_s * setpoint,
            s.integral_v * v + ii * i + i_s * setpoint,
            friction,
            setpoint,
        )


# --- preparation ------------------------------------------------------------------------------------------


def build_stages(
    vehicle: VehicleConfig,
    table: Sequence[Coefficients],
    alphas: Sequence[tuple[float, float]],
    drags: Sequence[float],
    extra_delay_s: Sequence[float],
) -> list[ContactStage]:
    """Return one stage for each row of a table; a row belongs to one wall, mode and random draw.

    Args:
        alphas: gains (A_n, A_t) per row, m/N.
        drags: air drag along the normal per row, 1/s.
        extra_delay_s: time per row, added to the expected delay between force peak and recovery setpoint.
    """
    onset, mass = Onset(vehicle.onset), vehicle.airframe.mass_kg
    stages = [ContactStage(c, mass, onset, pair) for c, pair in zip(table, alphas, strict=True)]
    c = CoefficientArrays.from_table(list(table))
    course = begin_contact(
        c, np.full(len(table), mass), np.full(len(table), -1.0), onset, np.zeros(len(table))
    )
    events = find_contact_times(course)
    omega = course.omega
    drop = time_of_drop(course, events, PEAK_DROP_FRACTION)
    delay = np.maximum((drop - events.peak) / omega, _MIN_AFTER_PEAK_S) + 1.0 / vehicle.imu.rate_hz
    engaged = events.peak / omega + np.maximum(delay + _SETPOINT_USED_S + np.asarray(extra_delay_s), 0.0)
    loop = PositionLoop.from_px4(vehicle.px4)
    for i, stage in enumerate(stages):
        if not math.isfinite(events.end[i]):
            continue
        stage.duration_s = float(events.end[i] / omega[i])
        stage.peak_s = float(events.peak[i] / omega[i])
        stage.engaged_s = min(float(engaged[i]), stage.duration_s)
        one = Oscillation(*(np.asarray(v[i]) for v in course))
        _prepare_normal(stage, loop, drags[i])
        _prepare_tangential(stage, loop, one)
    return stages


def _prepare_normal(stage: ContactStage, loop: PositionLoop, drag: float) -> None:
    """Compute the matrix that maps (v, a, i) at the onset to all fields of `NormalOut` except `onset_m`."""
    c, m = stage.coefficients, stage.mass_kg
    kp, kv, ki, kd, tau = loop
    # States x, v, a, i, s; the error e does not exist before PX4 uses the setpoint.
    before = np.zeros((5, 5))
    before[0, 1] = 1.0
    before[1, :3] = (-c.k / m, -c.f / m - drag, 1.0)
    before[2, :4] = np.array([0.0, kd * drag, -1.0 - kd, 1.0]) / tau
    error = np.array([-kp, -1.0, 0.0, 0.0, kp])
    system = before.copy()
    system[2] += kv / tau * error
    system[3] = ki * error
    to_peak, to_engaged, rest = expm(
        np.stack(
            [
                before * stage.peak_s,
                before * stage.engaged_s,
                system * (stage.duration_s - stage.engaged_s),
            ]
        )
    )
    start = np.zeros((5, 3))
    start[0, 0] = -stage.lead_s
    start[1, 0] = start[2, 1] = start[3, 2] = 1.0
    at_peak = to_peak @ start
    force = -c.k * at_peak[0] - c.f * at_peak[1]
    setpoint = at_peak[0] + recovery_offset((force, 0.0), stage.alphas)[0]
    engaged = to_engaged @ start
    engaged[4] = setpoint
    end = rest @ engaged
    stage._normal = np.stack([force, end[0], end[1], end[2], end[3], setpoint])


class _Phases:
    """Quadrature over the two phases of a contact, which the recovery setpoint separates.

    Each phase has J nodes. The integral of a function f is a matrix times f's values at all 2 J nodes.
    """

    def __init__(self, first_s: float, second_s: float) -> None:
        rule = _quadrature()
        self.lengths = (first_s, second_s)
        self.times = np.concatenate((first_s * rule.nodes, first_s + second_s * rule.nodes))
        self.weights = np.concatenate((first_s * rule.weights, second_s * rule.weights))

    def integral(self, decay: float) -> Array:
        """Return the matrix (2 J + 1, 2 J) that integrates exp(-decay (s - r)) f(r) over r from 0 to s.

        The rows are for s at the 2 J nodes and at the end of the contact.
        """
        rule = _quadrature()
        parts = []
        for length in self.lengths:
            span = length * rule.upper[:, None] * (1.0 - rule.sub_nodes)
            kernel = np.exp(-decay * span) * rule.sub_weights
            parts.append(length * rule.upper[:, None] * np.einsum("jl,jlk->jk", kernel, rule.lagrange))
        n = _NODES
        out = np.zeros((2 * n + 1, 2 * n))
        out[:n, :n] = parts[0][:n]
        out[n:, n:] = parts[1]
        faded = np.exp(-decay * self.lengths[1] * rule.upper)
        out[n:, :n] = faded[:, None] * parts[0][n]
        return out

    def to_time(self, t_s: float) -> Array:
        """Return the row (2 J,) that integrates f from 0 to `t_s`, a time in the first phase."""
        rule = _quadrature()
        share = t_s / self.lengths[0] if self.lengths[0] > 0.0 else 0.0
        values = _lagrange(rule.nodes, share * rule.sub_nodes)
        row: Array = t_s * (rule.sub_weights @ values)
        return np.concatenate((row, np.zeros(_NODES)))


def _prepare_tangential(stage: ContactStage, loop: PositionLoop, course: Oscillation) -> None:
    kp, kv, ki, kd, tau = loop
    phases = _Phases(stage.engaged_s, stage.duration_s - stage.engaged_s)
    times, weights = phases.times, phases.weights
    count = times.size
    decay = (1.0 + kd) / tau
    whole = phases.integral(0.0)
    fading = phases.integral(decay) / tau
    place = whole[:count]
    after = (np.arange(count) >= _NODES).astype(float)  # 1 at the nodes after the recovery setpoint
    # Per unit of u at the nodes: distance, integral, acceleration.
    error = after[:, None] * (kp * place + np.eye(count))
    to_integral = -ki * whole @ error
    acceleration = fading @ (to_integral[:count] - kv * error)
    faded = np.exp(-decay * np.append(times, stage.duration_s))
    stage._by_speed = np.stack(
        [phases.to_time(stage.peak_s), whole[count], to_integral[count], acceleration[count]]
    )
    stage._push_speed = weights[:, None] * acceleration[:count]
    # The factors per unit of a, i and s are exact, because the drive is a polynomial in each phase.
    places = np.zeros((count, 3))
    places[:, 2] = after
    integral = ki * kp * whole @ places
    integral[:, 1] += 1.0
    pushed = fading @ (kv * kp * places + integral[:count])
    pushed[:, 0] += faded
    stage._push = weights[:, None] * pushed[:count]
    stage._ends = np.stack([pushed[count], integral[count]])
    omega = float(course.omega)  # the approach speed of `course` is 1 m/s, so its velocity equals xi'
    stage._depths = course.at(omega * times).velocity_m_s + 1.0
    stage._depth_end = float(course.at(np.asarray(omega * stage.duration_s)).velocity_m_s) + 1.0
