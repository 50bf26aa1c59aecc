"""A contact in time, in closed form: the trajectory of one hit, and where a hit leaves the vehicle.

`contact_map` says what comes out of a contact; this module says what happens meanwhile: for plots, for
fitting recorded trials, and to continue from the point of the peak force or of the release.
Normal position, velocity and force are elementary (`dart_flight.contact.oscillator`); the way along the wall
and the vertical impulse are integrals of smooth functions of them, by quadrature to the bounds stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.law import Onset
from dart_flight.contact.oscillator import enter, find_contact_times, motion

# The integrals over a contact are Chebyshev series in y, t = end (1 + tanh(c y)/tanh(c))/2: crowded towards
# both ends, because the vertical force turns within a thousandth of the contact there. 80 terms leave less
# than 1e-9 of an integral (force up to 500 N, mu |v| up to 20), 1e-4 in a contact that never ends.
_TERMS = 80
_CROWDING = 3.0
# A contact that never ends is followed for this many time constants of its slower decay.
_SETTLED = 40.0


class _Nodes(NamedTuple):
    place: Array  # on [0, 1]
    stretch: Array  # its derivative by y
    to_integral: Array  # matrix from values to the Chebyshev coefficients of their integral from the onset
    at_nodes: Array  # matrix from such coefficients to values


@lru_cache(maxsize=1)
def _nodes() -> _Nodes:
    y = -np.cos(np.pi * np.arange(_TERMS + 1) / _TERMS)
    end = math.tanh(_CROWDING)
    place = 0.5 * (1.0 + np.tanh(_CROWDING * y) / end)
    stretch = 0.5 * _CROWDING / (end * np.cosh(_CROWDING * y) ** 2)
    to_series = np.linalg.inv(chebyshev.chebvander(y, _TERMS))
    to_integral = chebyshev.chebint(to_series, lbnd=-1.0, axis=0)
    at_nodes = chebyshev.chebvander(y, _TERMS + 1)
    return _Nodes(*(np.asarray(v, dtype=float) for v in (place, stretch, to_integral, at_nodes)))


class _Integral:
    """Running integral, and that of it, of a function on [0, end] with constant values before and after."""

    def __init__(self, function: Callable[[Array], Array], end: float, before: float, after: float) -> None:
        nodes = _nodes()
        self._end, self._before, self._after = end, before, after
        self._once = self._primitive(function(end * nodes.place))

    def _primitive(self, values: ArrayLike) -> Array:
        nodes = _nodes()
        series: Array = nodes.to_integral @ (np.asarray(values) * nodes.stretch * self._end)
        return series

    def once(self, t: Array) -> Array:
        """Integral from 0 to t (of any sign)."""
        early, late = self._outside(t)
        return np.asarray(self._inside(self._once, t) + self._before * early + self._after * late)

    def twice(self, t: Array) -> Array:
        """Integral from 0 to t of the integral from 0."""
        early, late = self._outside(t)
        at_nodes, series = self._twice
        outside = 0.5 * self._before * early**2 + (at_nodes[-1] + 0.5 * self._after * late) * late
        return np.asarray(self._inside(series, t) + outside)

    @cached_property
    def _twice(self) -> tuple[Array, Array]:
        """The integral at the nodes, and the series of its own."""
        at_nodes = _nodes().at_nodes @ self._once
        return at_nodes, self._primitive(at_nodes)

    def _inside(self, series: Array, t: Array) -> Array:
        """A series in the contact; 0 before, and after it its value at the end."""
        value = np.where(t > 0.0, series.sum(), 0.0)
        inside = (t > 0.0) & (t < self._end)
        x = 2.0 * t[inside] / self._end - 1.0
        y = np.arctanh(x * math.tanh(_CROWDING)) / _CROWDING
        # Most times asked for are outside; inside all terms at once are sooner done than by their recurrence.
        value[inside] = np.cos(np.arccos(np.clip(y, -1.0, 1.0))[..., None] * np.arange(series.size)) @ series
        return value

    def _outside(self, t: Array) -> tuple[Array, Array]:
        """The time before the contact (negative) and after it."""
        return np.minimum(t, 0.0), np.maximum(t - self._end, 0.0)


class ContactMotion:
    """One hit, prepared for evaluation at any time; times count from the onset.

    Args:
        coefficients: of material and mode.
        mass_kg: vehicle mass.
        normal_m_s: normal velocity at the onset, collision frame, not positive.
        onset: onset rule.
        acceleration_m_s2: constant other acceleration along the normal, before, in and after the contact.

    Attributes:
        end_s: release; infinite where the wall is never left, 0 where it is not met.
        peak_s: time of the largest normal force.
        turn_s: time of the largest outward speed in contact.
        onset_m: position at the onset.
    """

    def __init__(
        self,
        coefficients: Coefficients,
        mass_kg: float,
        normal_m_s: float,
        onset: Onset,
        *,
        acceleration_m_s2: float = 0.0,
    ) -> None:
        self.coefficients, self.mass_kg = coefficients, mass_kg
        self.normal_m_s, self.acceleration_m_s2 = normal_m_s, acceleration_m_s2
        state = (np.asarray(mass_kg, dtype=float), np.asarray(normal_m_s, dtype=float))
        push = np.asarray(acceleration_m_s2, dtype=float)
        self._course = enter(CoefficientArrays.of(coefficients), *state, onset, push)
        events = find_contact_times(self._course)
        self._omega = float(self._course.omega)
        self.met = bool(self._course.hits)
        self.end_s = float(events.end) / self._omega if self.met else 0.0
        self.peak_s = float(events.peak) / self._omega if self.met else 0.0
        self.turn_s = float(events.turn) / self._omega if self.met else 0.0
        early = onset is Onset.LCP
        self.onset_m = -coefficients.lead_s * normal_m_s if early else 0.0
        # Where quadrature stops: at the release, or when everything has settled (near critical damping the
        # release comes thousands of times later than the force dies away).
        zeta = float(self._course.zeta)
        slowest = min(zeta, 1.0 / (zeta + math.sqrt(max(zeta * zeta - 1.0, 0.0)))) if zeta > 0.0 else 1.0
        self._horizon = min(self.end_s, _SETTLED / (slowest * self._omega))

    def normal(self, time_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Position m, velocity m/s and force N along the normal; free flight before and after."""
        t = np.asarray(time_s, dtype=float)
        a = self.acceleration_m_s2
        if not self.met:
            still = np.zeros_like(t)
            return self.onset_m + (self.normal_m_s + 0.5 * a * t) * t, self.normal_m_s + a * t, still
        c = self._course
        phi, _, xi1 = motion(c, self._omega * np.clip(t, 0.0, self.end_s))
        inside = (t >= 0.0) & (t <= self.end_s)
        position = c.speed / c.omega * (c.alpha - phi - 2.0 * c.zeta * xi1)
        speed = c.speed * xi1
        force = c.mass * c.speed * c.omega * np.maximum(phi - c.alpha, 0.0)
        free = np.where(inside, 0.0, np.where(t < 0.0, t, t - self.end_s))
        return position + (speed + 0.5 * a * free) * free, speed + a * free, np.where(inside, force, 0.0)

    def impulse(self, time_s: ArrayLike) -> Array:
        """Normal impulse N s since the onset."""
        t = np.asarray(time_s, dtype=float)
        if not self.met:
            return np.zeros_like(t)
        c = self._course
        tau = self._omega * np.clip(t, 0.0, self.end_s)
        impulse: Array = np.maximum(c.mass * c.speed * (motion(c, tau)[2] + c.u - c.alpha * tau), 0.0)
        return impulse

    def slip(self, time_s: ArrayLike) -> Array:
        """Velocity m/s along the wall per m/s at the onset."""
        t = np.asarray(time_s, dtype=float)
        if not self.met:
            return np.ones_like(t)
        left: Array = np.exp(-self.coefficients.mu / self.mass_kg * self.impulse(t))
        return left

    def way(self, time_s: ArrayLike) -> Array:
        """Way m along the wall per m/s of velocity along the wall at the onset."""
        t = np.asarray(time_s, dtype=float)
        return self._slipped.once(t) if self.met else t.copy()

    def rise(self, time_s: ArrayLike) -> Array:
        """Velocity m/s that the vertical force gives per newton of nu, along that force."""
        t = np.asarray(time_s, dtype=float)
        return self._raised.once(t) if self.met else np.zeros_like(t)

    def lift(self, time_s: ArrayLike) -> Array:
        """Way m that the vertical force gives per newton of nu, along that force."""
        t = np.asarray(time_s, dtype=float)
        return self._raised.twice(t) if self.met else np.zeros_like(t)

    # Prepared once, and only where they are asked for: a fit asks at many times.
    @cached_property
    def _slipped(self) -> _Integral:
        out = float(self.slip(np.array([self._horizon]))[0])
        return _Integral(self.slip, self._horizon, 1.0, out)

    @cached_property
    def _raised(self) -> _Integral:
        held = float(self._share(np.array([self._horizon]))[0]) if self._horizon < self.end_s else 0.0
        return _Integral(self._share, self._horizon, 0.0, held)

    def _share(self, time_s: Array) -> Array:
        """Acceleration m/s2 by the vertical force per newton of nu."""
        force = self.normal(time_s)[2]
        return force / (1.0 + force) / self.mass_kg


class HitHistory(NamedTuple):
    """A hit with the free flight before and after it, in the collision frame; arrays (n,).

    Attributes:
        time_s: since the onset of the contact.
        normal_m: signed distance of the vehicle's centre to its plane of first touch.
        tangential_m, vertical_m: way along Y and Z since the onset (Z points down at a wall).
        normal_m_s, tangential_m_s, vertical_m_s: velocity.
        normal_force_n, tangential_force_n, vertical_force_n: contact force.
    """

    time_s: Array
    normal_m: Array
    tangential_m: Array
    vertical_m: Array
    normal_m_s: Array
    tangential_m_s: Array
    vertical_m_s: Array
    normal_force_n: Array
    tangential_force_n: Array
    vertical_force_n: Array


def trajectory(
    contact: ContactMotion, time_s: ArrayLike, tangential_m_s: float = 0.0, vertical_sign: int = -1
) -> HitHistory:
    """Return a hit at the given times (s, since the onset).

    Args:
        contact: the hit.
        time_s: times (n,), of any sign.
        tangential_m_s: velocity along the wall at the onset.
        vertical_sign: -1 as the paper writes lz (against Z of the collision frame), or 1.
    """
    t = np.asarray(time_s, dtype=float)
    x, vx, force = contact.normal(t)
    way, slip = contact.way(t), contact.slip(t)
    lift, rise = contact.lift(t), contact.rise(t)
    c = contact.coefficients
    return HitHistory(
        time_s=t,
        normal_m=x,
        tangential_m=tangential_m_s * way,
        vertical_m=vertical_sign * c.nu * lift,
        normal_m_s=vx,
        tangential_m_s=tangential_m_s * slip,
        vertical_m_s=vertical_sign * c.nu * rise,
        normal_force_n=force,
        tangential_force_n=-c.mu * force * tangential_m_s * slip,
        vertical_force_n=vertical_sign * c.nu * force / (1.0 + force),
    )
