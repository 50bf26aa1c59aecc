"""Candidate contact laws behind one interface, and hits under them in closed steps of time.

A law says the normal force from compression and its rate. The paper's (`kelvin` in the literature, a spring
and a damper) is the reference and the only one that the rest of the software flies with; the others are there
to find out whether real hits ask for more. All parameters are positive and are searched by their logarithm.

A law never creates energy: what does not return as speed is dissipated, because every one is a potential plus
a damping that opposes the motion, cut off where it would pull.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset

_STEPS_PER_CONTACT = 24  # of an undamped contact's duration
_LONGEST = 3.0  # durations; what has not left by then stays


class Parameter(NamedTuple):
    """One parameter of a law: its unit and the range that is searched."""

    name: str
    unit: str
    low: float
    high: float


class ContactLaw(Protocol):
    """A law for the normal force.

    A law with more state than the compression (rotation of the vehicle about the point of contact) can bring
    it in through `force`, as a parameter that differs from hit to hit; `collide` then hands it on unseen.

    Attributes:
        name: as `--law` takes it.
        parameters: what is to be identified, in order.
    """

    @property
    def name(self) -> str:
        """As `--law` takes it."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is to be identified, in order."""

    def force(self, p: Array, compression: Array, rate: Array) -> Array:
        """Force in N, before it is cut off at 0.

        Args:
            p: parameters, shape (parameters, n).
            compression: m, (n,); may be negative before the plane is reached, where a law reaches out.
            rate: of the compression, m/s, (n,).
        """

    def reach(self, p: Array, speed: Array) -> Array:
        """How far before the plane the force begins, m, for an approach at `speed` (n,)."""

    def duration_s(self, p: Array, mass_kg: Array, speed: Array) -> Array:
        """Scale of a contact's duration: half a period without damping."""

    def start(self, force_per_speed: float, restitution: float, mass_kg: float, speed: float) -> list[float]:
        """Parameters to begin a search with, from the peak force per speed and the restitution of hits."""


def _spring_and_damper(force_per_speed: float, restitution: float, mass_kg: float) -> tuple[float, float]:
    """k and f of about this peak force per speed and restitution."""
    e = min(max(restitution, 0.02), 0.98)
    zeta = -math.log(e) / math.hypot(math.pi, math.log(e)) * 0.9
    omega = force_per_speed / mass_kg * math.exp(0.7 * zeta)
    return mass_kg * omega * omega, 2.0 * zeta * mass_kg * omega


K = Parameter("k", "N/m", 10.0, 1e6)
F = Parameter("f", "N s/m", 1e-3, 1e4)


class PaperLaw:
    """`k x + f v`: the paper's spring and damper."""

    name = "paper"
    parameters: tuple[Parameter, ...] = (K, F)

    def __init__(self, onset: Onset) -> None:
        self.onset = onset

    def force(self, p: Array, compression: Array, rate: Array) -> Array:
        """See `ContactLaw`."""
        result: Array = p[0] * compression + p[1] * rate
        return result

    def reach(self, p: Array, speed: Array) -> Array:
        """See `ContactLaw`; `lcp` reaches out by f v / k."""
        result: Array = p[1] / p[0] * speed if self.onset is Onset.LCP else np.zeros_like(speed)
        return result

    def duration_s(self, p: Array, mass_kg: Array, speed: Array) -> Array:
        """See `ContactLaw`."""
        result: Array = math.pi * np.sqrt(mass_kg / p[0])
        return result

    def start(self, force_per_speed: float, restitution: float, mass_kg: float, speed: float) -> list[float]:
        """See `ContactLaw`."""
        return list(_spring_and_damper(force_per_speed, restitution, mass_kg))


class PreloadLaw(PaperLaw):
    """`F0 + k x + f v`: nothing gives before a floor of force is reached."""

    name = "preload"
    parameters = (K, F, Parameter("f0", "N", 1e-2, 1e4))

    def __init__(self) -> None:
        super().__init__(Onset.TOUCH)

    def force(self, p: Array, compression: Array, rate: Array) -> Array:
        """See `ContactLaw`."""
        result: Array = np.where(compression >= 0.0, p[2] + p[0] * compression + p[1] * rate, 0.0)
        return result

    def start(self, force_per_speed: float, restitution: float, mass_kg: float, speed: float) -> list[float]:
        """See `ContactLaw`."""
        k, f = _spring_and_damper(0.8 * force_per_speed, restitution, mass_kg)
        return [k, f, 0.15 * force_per_speed * speed]


class HertzLaw:
    """`k x^n (1 + d v)`: stiffening with compression, damping with it (Hunt and Crossley)."""

    name = "hertz"
    parameters = (
        Parameter("k", "N/m^n", 10.0, 1e9),
        Parameter("d", "s/m", 1e-4, 1e2),
        Parameter("n", "", 0.5, 3.0),
    )

    def force(self, p: Array, compression: Array, rate: Array) -> Array:
        """See `ContactLaw`."""
        result: Array = p[0] * np.maximum(compression, 0.0) ** p[2] * np.maximum(1.0 + p[1] * rate, 0.0)
        return result

    def reach(self, p: Array, speed: Array) -> Array:
        """See `ContactLaw`."""
        return np.zeros_like(speed)

    def duration_s(self, p: Array, mass_kg: Array, speed: Array) -> Array:
        """See `ContactLaw`."""
        deepest = ((p[2] + 1.0) * mass_kg * speed * speed / (2.0 * p[0])) ** (1.0 / (p[2] + 1.0))
        result: Array = 3.0 * deepest / np.maximum(speed, 1e-3)
        return result

    def start(self, force_per_speed: float, restitution: float, mass_kg: float, speed: float) -> list[float]:
        """See `ContactLaw`."""
        k, _ = _spring_and_damper(force_per_speed, restitution, mass_kg)
        n, deepest = 1.2, speed * math.sqrt(mass_kg / k)
        e = min(max(restitution, 0.05), 0.95)
        return [k * deepest ** (1.0 - n), 1.5 * (1.0 - e) / (e * speed), n]


class TwoStageLaw(PaperLaw):
    """`k x + k2 max(x - x1, 0) + f v`: soft parts first, then the frame."""

    name = "two-stage"
    parameters = (K, F, Parameter("k2", "N/m", 1.0, 1e6), Parameter("x1", "m", 1e-4, 0.3))

    def __init__(self) -> None:
        super().__init__(Onset.TOUCH)

    def force(self, p: Array, compression: Array, rate: Array) -> Array:
        """See `ContactLaw`."""
        second = p[2] * np.maximum(compression - p[3], 0.0)
        result: Array = np.where(compression >= 0.0, p[0] * compression + p[1] * rate + second, 0.0)
        return result

    def duration_s(self, p: Array, mass_kg: Array, speed: Array) -> Array:
        """See `ContactLaw`: of the first spring as far as it is compressed, then of both."""
        omega = np.sqrt(p[0] / mass_kg)
        share = np.minimum(omega * p[3] / np.maximum(speed, 1e-6), 1.0)
        result: Array = 2.0 * np.arcsin(share) / omega + math.pi * np.sqrt(mass_kg / (p[0] + p[2]))
        return result

    def start(self, force_per_speed: float, restitution: float, mass_kg: float, speed: float) -> list[float]:
        """See `ContactLaw`."""
        k, f = _spring_and_damper(0.9 * force_per_speed, restitution, mass_kg)
        return [0.7 * k, f, 0.8 * k, 0.4 * speed * math.sqrt(mass_kg / k)]


def candidate_laws(onset: Onset) -> dict[str, ContactLaw]:
    """All candidates by name, the paper's first."""
    laws: tuple[ContactLaw, ...] = (PaperLaw(onset), PreloadLaw(), HertzLaw(), TwoStageLaw())
    return {law.name: law for law in laws}


class LawOutcome(NamedTuple):
    """What hits lead to; arrays (n,).

    Attributes:
        normal_out_m_s: speed away from the wall at the release; 0 where it is never left.
        peak_force_n: largest normal force.
        contact_s: duration of the contact; that of the computation where the wall is never left.
        compression_m: largest compression.
    """

    normal_out_m_s: Array
    peak_force_n: Array
    contact_s: Array
    compression_m: Array


def collide(
    law: ContactLaw, p: Array, mass_kg: float, speed_m_s: Array, acceleration_m_s2: Array
) -> LawOutcome:
    """Hits under a law, all at once.

    Args:
        law: which.
        p: parameters, (parameters, n).
        mass_kg: of the vehicle.
        speed_m_s: towards the wall at the onset, positive, (n,).
        acceleration_m_s2: other acceleration along the outward normal, (n,): -9.81 in a drop.
    """
    mass = np.full_like(speed_m_s, mass_kg)
    step = law.duration_s(p, mass, speed_m_s) / _STEPS_PER_CONTACT
    half, sixth, per_mass = 0.5 * step, step / 6.0, 1.0 / mass_kg
    x, v = -law.reach(p, speed_m_s), speed_m_s.copy()
    push = -acceleration_m_s2
    out, contact, deepest = np.zeros_like(v), np.full_like(v, math.nan), np.zeros_like(v)
    raw = law.force(p, x, v)
    force = np.maximum(raw, 0.0)
    peak = force.copy()
    previous = force
    for i in range(int(_LONGEST * _STEPS_PER_CONTACT)):
        # Runge and Kutta's fourth order; the force cut off at 0 in every stage.
        a1 = push - force * per_mass
        v2 = v + half * a1
        a2 = push - np.maximum(law.force(p, x + half * v, v2), 0.0) * per_mass
        v3 = v + half * a2
        a3 = push - np.maximum(law.force(p, x + half * v2, v3), 0.0) * per_mass
        v4 = v + step * a3
        a4 = push - np.maximum(law.force(p, x + step * v3, v4), 0.0) * per_mass
        after_x = x + sixth * (v + 2.0 * (v2 + v3) + v4)
        after_v = v + sixth * (a1 + 2.0 * (a2 + a3) + a4)
        raw = law.force(p, after_x, after_v)
        now = np.maximum(raw, 0.0)
        inside = np.isnan(contact)
        # The release: moving away, and the law would pull or ends at the plane.
        left = inside & (after_v < 0.0) & ((raw <= 0.0) | (after_x <= 0.0))
        if left.any():
            part = np.where(raw < 0.0, force / np.maximum(force - raw, 1e-12), 1.0)
            gone = (after_x < 0.0) & (x > 0.0)
            part = np.where(gone, np.minimum(part, x / np.maximum(x - after_x, 1e-12)), part)
            out = np.where(left, -(v + part * (after_v - v)), out)
            contact = np.where(left, (i + part) * step, contact)
            inside &= ~left
        # The peak between steps, from the parabola through the last three.
        bend = previous - 2.0 * force + now
        crest = (force >= previous) & (force >= now) & (bend < 0.0)
        top = np.where(crest, force - (now - previous) ** 2 / np.where(crest, 8.0 * bend, 1.0), now)
        peak = np.where(inside, np.maximum(peak, top), peak)
        deepest = np.where(inside, np.maximum(deepest, after_x), deepest)
        x, v, previous, force = after_x, after_v, force, now
        if not inside.any():
            break
    contact = np.where(np.isnan(contact), _LONGEST * _STEPS_PER_CONTACT * step, contact)
    return LawOutcome(np.maximum(out, 0.0), peak, contact, deepest)
