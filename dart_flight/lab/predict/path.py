"""One contact over time in closed form, for plots and for the fit of recorded trials.

`contact_map` returns the outcome of a contact; this module returns the quantities over time. Normal position,
velocity and force are elementary functions (`dart_flight.contact.oscillator`). The displacement along the
wall and the vertical impulse are integrals of smooth functions, computed by quadrature. The comment above
`_TERMS` states the relative error.
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
from dart_flight.contact.oscillator import begin_contact, find_contact_times

# Integrals over a contact are Chebyshev series in y, with t = end (1 + tanh(c y)/tanh(c))/2. The nodes are
# dense at both ends, where the vertical force changes within a thousandth of the contact. With 80 terms the
# relative error is below 1e-9 (force up to 500 N, mu |v| up to 20), or 1e-4 in a contact that never ends.
_TERMS = 80
_CROWDING = 3.0
_SETTLED = 40.0  # an endless contact is truncated after this number of time constants of the slower decay


class _Nodes(NamedTuple):
    place: Array  # positions of the nodes on [0, 1]
    stretch: Array  # derivatives of the positions by y
    to_integral: Array  # matrix from values to the Chebyshev coefficients of their integral from the onset
    at_nodes: Array  # matrix from Chebyshev coefficients to values


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
    """The integral and the double integral of a function, from time 0 to any time.

    Quadrature computes the integrals from 0 to `end`. Before 0 the function equals `before`, after `end` it
    equals `after`.
    """

    def __init__(self, function: Callable[[Array], Array], end: float, before: float, after: float) -> None:
        nodes = _nodes()
        self._end, self._before, self._after = end, before, after
        self._once = self._primitive(function(end * nodes.place))

    def _primitive(self, values: ArrayLike) -> Array:
        nodes = _nodes()
        series: Array = nodes.to_integral @ (np.asarray(values) * nodes.stretch * self._end)
        return series

    def once(self, t: Array) -> Array:
        """Return the integral from 0 to t; t may be negative."""
        early, late = self._outside(t)
        return np.asarray(self._inside(self._once, t) + self._before * early + self._after * late)

    def twice(self, t: Array) -> Array:
        early, late = self._outside(t)
        at_nodes, series = self._twice
        outside = 0.5 * self._before * early**2 + (at_nodes[-1] + 0.5 * self._after * late) * late
        return np.asarray(self._inside(series, t) + outside)

    @cached_property
    def _twice(self) -> tuple[Array, Array]:
        """Values of the integral at the quadrature nodes, and Chebyshev series of the double integral."""
        at_nodes = _nodes().at_nodes @ self._once
        return at_nodes, self._primitive(at_nodes)

    def _inside(self, series: Array, t: Array) -> Array:
        """Return a series at the times `t`: 0 before the contact, and its last value after the contact."""
        value = np.where(t > 0.0, series.sum(), 0.0)
        inside = (t > 0.0) & (t < self._end)
        x = 2.0 * t[inside] / self._end - 1.0
        y = np.arctanh(x * math.tanh(_CROWDING)) / _CROWDING
        # Few times are within the contact, so evaluating all terms at once is faster than a recurrence.
        value[inside] = np.cos(np.arccos(np.clip(y, -1.0, 1.0))[..., None] * np.arange(series.size)) @ series
        return value

    def _outside(self, t: Array) -> tuple[Array, Array]:
        """Return min(t, 0), and the time since the end of the contact (0 before the end)."""
        return np.minimum(t, 0.0), np.maximum(t - self._end, 0.0)


class ContactMotion:
    """One hit that can be evaluated at any time; times count from the onset.

    Args:
        normal_m_s: normal velocity at the onset, collision frame; negative or 0.
        acceleration_m_s2: constant acceleration along the normal that the contact does not cause, such as
            gravity in a drop. It also acts before and after the contact.

    Attributes:
        end_s: time of the release; infinite if the vehicle never leaves the wall, 0 without a contact.
        peak_s: time of the largest normal force.
        turn_s: time at which the outward speed is largest during the contact.
        onset_m: normal position at the onset.
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
        self._course = begin_contact(CoefficientArrays.from_table(coefficients), *state, onset, push)
        events = find_contact_times(self._course)
        self._omega = float(self._course.omega)
        self.has_contact = bool(self._course.hits)
        self.end_s = float(events.end) / self._omega if self.has_contact else 0.0
        self.peak_s = float(events.peak) / self._omega if self.has_contact else 0.0
        self.turn_s = float(events.turn) / self._omega if self.has_contact else 0.0
        early = onset is Onset.LCP
        self.onset_m = -coefficients.lead_s * normal_m_s if early else 0.0
        # Integrate until the force has decayed, which near critical damping is long before the release.
        zeta = float(self._course.zeta)
        slowest = min(zeta, 1.0 / (zeta + math.sqrt(max(zeta * zeta - 1.0, 0.0)))) if zeta > 0.0 else 1.0
        self._horizon = min(self.end_s, _SETTLED / (slowest * self._omega))

    def normal(self, time_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Return position (m), velocity (m/s) and force (N) along the normal, in contact and free flight."""
        t = np.asarray(time_s, dtype=float)
        a = self.acceleration_m_s2
        if not self.has_contact:
            still = np.zeros_like(t)
            return self.onset_m + (self.normal_m_s + 0.5 * a * t) * t, self.normal_m_s + a * t, still
        position, speed, force = self._course.at(self._omega * np.clip(t, 0.0, self.end_s))
        inside = (t >= 0.0) & (t <= self.end_s)
        free = np.where(inside, 0.0, np.where(t < 0.0, t, t - self.end_s))
        return position + (speed + 0.5 * a * free) * free, speed + a * free, np.where(inside, force, 0.0)

    def impulse(self, time_s: ArrayLike) -> Array:
        """Return the normal impulse since the onset, N s."""
        t = np.asarray(time_s, dtype=float)
        if not self.has_contact:
            return np.zeros_like(t)
        return self._course.impulse(self._omega * np.clip(t, 0.0, self.end_s))

    def slip(self, time_s: ArrayLike) -> Array:
        """Return the velocity along the wall, as a fraction of its value at the onset."""
        t = np.asarray(time_s, dtype=float)
        if not self.has_contact:
            return np.ones_like(t)
        left: Array = np.exp(-self.coefficients.mu / self.mass_kg * self.impulse(t))
        return left

    def slide(self, time_s: ArrayLike) -> Array:
        """Return the displacement along the wall, divided by the tangential velocity at the onset, s."""
        t = np.asarray(time_s, dtype=float)
        return self._slipped.once(t) if self.has_contact else t.copy()

    def rise(self, time_s: ArrayLike) -> Array:
        """Return the velocity that the vertical force causes in its own direction if nu is 1 N, m/s.

        The velocity is proportional to nu.
        """
        t = np.asarray(time_s, dtype=float)
        return self._raised.once(t) if self.has_contact else np.zeros_like(t)

    def lift(self, time_s: ArrayLike) -> Array:
        """Return the displacement that the vertical force causes in its own direction if nu is 1 N, m.

        The displacement is proportional to nu.
        """
        t = np.asarray(time_s, dtype=float)
        return self._raised.twice(t) if self.has_contact else np.zeros_like(t)

    # The integrals are cached because a fit evaluates them at many times.
    @cached_property
    def _slipped(self) -> _Integral:
        out = float(self.slip(np.array([self._horizon]))[0])
        return _Integral(self.slip, self._horizon, 1.0, out)

    @cached_property
    def _raised(self) -> _Integral:
        held = float(self._share(np.array([self._horizon]))[0]) if self._horizon < self.end_s else 0.0
        return _Integral(self._share, self._horizon, 0.0, held)

    def _share(self, time_s: Array) -> Array:
        """Return the acceleration by the vertical force for nu = 1 N, m/s2."""
        force = self.normal(time_s)[2]
        return force / (1.0 + force) / self.mass_kg


class ContactHistory(NamedTuple):
    """A contact with the free flight before and after it, in the collision frame; arrays (n,).

    Attributes:
        time_s: time since the onset of the contact.
        normal_m: signed distance of the vehicle's centre from the plane of first touch.
        tangential_m, vertical_m: displacement along Y and Z since the onset. Z points down at a wall.
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
) -> ContactHistory:
    """Evaluate a hit at times since the onset, (n,), which may be negative.

    Args:
        tangential_m_s: velocity along the wall at the onset.
        vertical_sign: sign of the vertical force along Z of the collision frame. -1 is the paper's sign.
    """
    t = np.asarray(time_s, dtype=float)
    x, vx, force = contact.normal(t)
    slide, slip = contact.slide(t), contact.slip(t)
    lift, rise = contact.lift(t), contact.rise(t)
    c = contact.coefficients
    return ContactHistory(
        time_s=t,
        normal_m=x,
        tangential_m=tangential_m_s * slide,
        vertical_m=vertical_sign * c.nu * lift,
        normal_m_s=vx,
        tangential_m_s=tangential_m_s * slip,
        vertical_m_s=vertical_sign * c.nu * rise,
        normal_force_n=force,
        tangential_force_n=-c.mu * force * tangential_m_s * slip,
        vertical_force_n=vertical_sign * c.nu * force / (1.0 + force),
    )
