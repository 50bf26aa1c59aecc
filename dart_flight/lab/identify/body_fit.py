"""The fit of the law at the propeller guards to the force readings of flown contacts.

In flight, friction and an oblique wall rotate the vehicle, which the law of a point ignores. The planner's
`ContactFit` models the guards and uses the measured rotation. Here it runs on the readings in the log with a
wide prior, once for each contact, and the contacts of a mode are combined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from dart_flight.base.records import Mode
from dart_flight.base.summary import Z95, student_t
from dart_flight.config.vehicle import Coefficients, VehicleConfig
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.planning.contact_fit import CONTACT_SCATTER, LEVER_SHARE, Belief, ContactFit, ContactFitter

_WIDE: Final = 0.8  # relative standard deviation of the prior about the configured coefficients
_BY_CHANCE: Final = 1.3  # as in `solver`: a scatter between contacts below this ratio is chance
_WIDEST_LOG: Final = math.log(3.0)  # a coefficient with a wider interval than a factor of three is unknown
_ONLY: Final = np.array([0])  # number of the only mode of a fit
_FINE: Final = 4  # integration steps per reading of a prediction


class BodyImpact(NamedTuple):
    """The fit of one contact.

    Attributes:
        prior: the coefficients about which the fit began.
        belief: the fitted coefficients with their relative standard deviations.
        misfit: mean square of the normalised residuals.
        onset_s, normal_m_s: time of the onset in the recording, and the normal velocity there.
        plane_m: recorded normal position of the vehicle's centre at first touch.
        force_errors_n: model minus reading of the normal force.
        vertical_side: direction of the vertical force: 1 up, -1 down.
    """

    prior: Belief
    belief: Belief
    misfit: float
    onset_s: float
    normal_m_s: float
    plane_m: Estimate
    force_errors_n: Array
    vertical_side: int


def fit_bodies(problem: LawProblem) -> tuple[dict[MeasuredImpact, BodyImpact], list[str]]:
    """Fit every contact whose flight recorded its force readings; return notes on failures, too."""
    found: dict[MeasuredImpact, BodyImpact] = {}
    notes = []
    for hit in problem.hits:
        try:
            fitted = _fit_body(hit, problem.mass_kg)
        except (ValueError, np.linalg.LinAlgError) as error:
            notes.append(f"{hit.trial.name}: the force readings of the contact are not usable: {error}")
            continue
        if fitted is not None:
            found[hit] = fitted
    return found, notes


class _Readings(NamedTuple):
    """The readings of a contact, prepared for the law at the guards in the mode of the trial."""

    fit: ContactFit
    vehicle: VehicleConfig
    begin_us: int


def _readings(hit: MeasuredImpact, mass_kg: float | None = None) -> _Readings | None:
    """Return the readings of a contact with a planned wall, or None if its flight did not record them."""
    request, flown = hit.trial.contact, hit.trial.flown
    if request is None or request.wall is None or flown is None:
        return None
    vehicle = flown.config
    if mass_kg is not None:
        airframe = msgspec.structs.replace(vehicle.airframe, mass_kg=mass_kg)
        vehicle = msgspec.structs.replace(vehicle, airframe=airframe)
    modes = (Mode(hit.trial.mode),)
    fit, begin_us = ContactFitter(vehicle).make_fit(request, _WIDE, 0.0, modes)
    return _Readings(fit, vehicle, begin_us)


def predict_body(hit: MeasuredImpact, coefficients: Coefficients) -> tuple[float, float] | None:
    """Predict peak normal force, N, and outgoing normal velocity, m/s, from the velocity at the onset.

    PX4 tilts the vehicle during a contact, and friction rotates it. The prediction uses the measured thrust
    and rotation, but no force reading. Return None if the flight did not record them.
    """
    read = _readings(hit)
    if read is None:
        return None
    fit, vehicle, _ = read
    ticks, (normal, along) = fit.contact.ticks, fit.contact.velocity
    prior = fit.before[0]
    lead_s = coefficients.lead_s if Onset(vehicle.onset) is Onset.LCP else 0.0
    k, f, mu = coefficients.k / prior.k, coefficients.f / prior.f, coefficients.mu / prior.mu
    theta = np.array([k, f, -normal * (fit.contact.touched_s + lead_s), normal, 0.0, mu, along, LEVER_SHARE])
    force = fit.forces(ticks, theta[:, None], _ONLY, _FINE)[0][:, :, 0]
    impulse = ticks.h @ (force.mean(axis=1) + ticks.push_normal)
    return float(force.max()), normal + float(impulse) / vehicle.airframe.mass_kg


def _fit_body(hit: MeasuredImpact, mass_kg: float) -> BodyImpact | None:
    with np.errstate(all="ignore"):
        read = _readings(hit, mass_kg)
        if read is None:
            return None
        fit, vehicle, begin_us = read
        (result,) = fit.run()
        ticks = fit.contact.ticks
        force = fit.forces(ticks, result.theta[:, None], _ONLY, 2)[0].mean(axis=1)[:, 0]
    normal_m_s = float(result.theta[3])
    if not math.isfinite(result.evidence) or normal_m_s >= 0.0:
        raise ValueError("no solution")
    request = hit.trial.contact
    assert request is not None
    begin_s = (begin_us - request.onset.t_us) * 1e-6
    lead_s = result.belief.f / result.belief.k if Onset(vehicle.onset) is Onset.LCP else 0.0
    recorded = hit.trial.normal
    plane_m = float(np.interp(begin_s, recorded.time_s, recorded.value)) - result.place_m
    return BodyImpact(
        fit.before[0],
        result.belief,
        result.misfit,
        onset_s=begin_s - result.place_m / normal_m_s - lead_s,
        normal_m_s=normal_m_s,
        plane_m=Estimate.about(plane_m, Z95 * result.place_sd),
        force_errors_n=(force - ticks.normal[:, 0])[~ticks.bound],
        vertical_side=-vehicle.vertical_force_sign,
    )


def combine(impacts: Sequence[BodyImpact]) -> tuple[dict[str, Estimate | None], list[str]]:
    """Return the coefficients of the contacts of one mode, and a note for each unknown coefficient."""
    found: dict[str, Estimate | None] = {}
    for name in ("k", "f", "mu", "nu"):
        base = getattr(impacts[0].prior, name)
        values = np.array([getattr(one.belief, name) for one in impacts])
        sds = values * np.array([getattr(one.belief, f"{name}_sd") for one in impacts])
        priors = np.array([getattr(one.prior, name) for one in impacts])
        found[name] = _combined(values, sds, priors) if base > 0.0 else None
    return found, [f"these contacts do not determine {name}" for name, e in found.items() if e is None]


def mean_plane(impacts: Sequence[BodyImpact]) -> Estimate:
    """Return the mean position of the plane, with the wider of the fits' interval and that of the scatter."""
    values = np.array([one.plane_m.value for one in impacts])
    half = float(np.mean([one.plane_m.high - one.plane_m.low for one in impacts])) / 2.0
    n = len(values)
    drawn = student_t(n - 1) * float(values.std(ddof=1)) if n > 1 else 0.0
    return Estimate.about(float(values.mean()), max(half, drawn) / math.sqrt(n))


def force_residual_n(impacts: Sequence[BodyImpact]) -> float:
    """Return the root mean square of the differences between model and readings of the normal force."""
    return math.sqrt(float(np.mean(np.concatenate([one.force_errors_n for one in impacts]) ** 2)))


def _combined(values: Array, sds: Array, priors: Array) -> Estimate | None:
    """Return the mean of the contacts without their priors; None if the interval is too wide.

    A contact's posterior is the product of its prior and of what it measured. The prior is divided out, so
    that many contacts do not count it many times. Contacts also scatter about the mean, so a contact that is
    measured precisely does not count much more than the others.
    """
    prior = (_WIDE * priors) ** -2.0
    precision = np.maximum(sds**-2.0 - prior, 1e-9 * prior)
    measured = (values * sds**-2.0 - priors * prior) / precision
    precision = 1.0 / (1.0 / precision + (CONTACT_SCATTER * np.median(measured)) ** 2)
    total, n = float(precision.sum()), len(values)
    value = float(precision @ measured) / total
    half = Z95 * total**-0.5
    if n > 1:
        drawn = student_t(n - 1) * math.sqrt(float(precision @ (measured - value) ** 2) / total / (n - 1))
        half = drawn if drawn > _BY_CHANCE * half else half
    if value <= 0.0 or half >= _WIDEST_LOG * value:
        return None
    return Estimate(value, value * math.exp(-half / value), value * math.exp(half / value))
