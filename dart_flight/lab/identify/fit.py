"""`identify`: contact coefficients and restitution from recorded trials.

Every trial is first measured as a whole, without a contact law: incoming and outgoing speed, peak and
duration. Then `solver` fits the law and computes the intervals:

- to the force readings of flown contacts at the guards (`body_fit`), if all trials of a mode have them;
- to the samples of all trials jointly (`sample_fit`), if enough position samples show the contact;
- to the measurements of whole hits (`impact_fit`), if the law misses the samples by several times the noise,
  or if the trials recorded only speeds or only an accelerometer.

A coefficient that the data do not determine is None.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from dart_flight.config.document import InputError
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.body_fit import (
    BodyImpact,
    combine,
    fit_bodies,
    force_residual_n,
    mean_plane,
)
from dart_flight.lab.identify.estimates import Estimate, Identification, TrialFit
from dart_flight.lab.identify.fit_quality import assess_fit, expected_residuals, hold_out
from dart_flight.lab.identify.impact_fit import fit_impacts
from dart_flight.lab.identify.measured_impacts import MeasuredImpact, measure_impact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.sample_result import SampleResult, fit_samples
from dart_flight.lab.identify.speed_ratios import friction, restitution, tangential_ratio
from dart_flight.lab.identify.trials import Trial, without_derived

_PREDICTS = 0.1  # a poor fit is kept if its relative errors of peak and outgoing speed are at most this
_COEFFICIENTS = ("k", "f", "mu", "nu")
_UNKNOWN = {
    "mu": "(friction) is unknown, because no trial shows friction that slows a motion along the wall",
    "nu": "(vertical force) is unknown, because no trial shows a contact that changes a vertical motion",
}
# Largest change of the guards' sliding speed, divided by the speed that rotation gives the vehicle's edge
# (docs/results/flight_identification.md).
_OF_TURNING = 0.75
_MOST_OF_TURNING = 0.8
_K_OF_TURNING = 0.03  # relative error of k; rotation loads one guard more and lowers k by up to 6 %
_TURNS = 0.1  # a note reports a rotation that changes the sliding speed by more than this fraction


def identify(trials: Sequence[Trial], mass_kg: float, onset: Onset) -> Identification:
    """Identify the coefficients of each mode from trials (paper, Sec. IV-B and V-A).

    Args:
        trials: recordings. The fit assumes one plane for all trials, and one set of coefficients per mode.
        onset: onset rule of the fitted model; the rule affects k and f slightly.

    Raises:
        InputError: SciPy is missing, or a trial cannot be used; the error names the trial and the reason.
    """
    if not trials:
        raise InputError("no trials")
    usable, notes = without_derived(trials)
    problem = LawProblem([measure_impact(trial, mass_kg) for trial in usable], mass_kg, onset)
    notes += [note for hit in problem.hits for note in hit.notes]
    modes = problem.by_mode()
    of_guards = {mode for mode, own in modes.items() if all(hit.trial.contact for hit in own.hits)}
    bodies, unusable = fit_bodies(problem.of([hit for hit in problem.hits if hit.trial.mode in of_guards]))
    notes += unusable
    of_guards &= {hit.trial.mode for hit in bodies}
    result = fit_samples(problem.of([hit for hit in problem.hits if hit.trial.mode not in of_guards]))
    notes += result.notes
    held_out = {mode: hold_out(own) for mode, own in modes.items()}
    notes += [found.sentence for found in held_out.values() if found.hits]
    coefficients, statistical = {}, {}
    for mode, own in modes.items():
        if mode in of_guards:
            found, unknown = combine([bodies[hit] for hit in own.hits if hit in bodies])
            notes += [f"{mode}: {note}" for note in unknown]
        else:
            found = _coefficients(mode, result, own, notes)
        statistical[mode] = found
        coefficients[mode], more = _widen_intervals(found, own.hits, turning=mode not in of_guards)
        notes += [f"{mode}: {note}" for note in more]
    plane_m, residuals, side = result.plane_m, dict(result.residuals), result.vertical_side
    if bodies and plane_m is None:
        plane_m = mean_plane(list(bodies.values()))
    if bodies and "normal_force_n" not in residuals:
        residuals["normal_force_n"] = force_residual_n(list(bodies.values()))
    if side is None and any(statistical[mode]["nu"] is not None for mode in of_guards):
        side = next(iter(bodies.values())).vertical_side
    whole = problem.of([hit for hit in problem.hits if hit not in result.trials])
    expected = expected_residuals(trials, problem.hits)
    return Identification(
        coefficients=coefficients,
        statistical=statistical,
        plane_m=plane_m,
        residuals=residuals,
        trials=[result.trials.get(hit) or _trial_fit(hit, bodies) for hit in problem.hits],
        vertical_side=side,
        notes=notes,
        restitution={mode: restitution(own) for mode, own in modes.items()},
        tangential_ratio={mode: tangential_ratio(own) for mode, own in modes.items()},
        held_out=held_out,
        fit=assess_fit(coefficients, whole, residuals, expected),
    )


def _trial_fit(hit: MeasuredImpact, bodies: Mapping[MeasuredImpact, BodyImpact]) -> TrialFit:
    found = TrialFit.from_hit(hit)
    if hit not in bodies:
        return found
    one = bodies[hit]
    return found._replace(used="guards", misfit=one.misfit, onset_s=one.onset_s, normal_m_s=one.normal_m_s)


def _coefficients(
    mode: str, result: SampleResult, problem: LawProblem, notes: list[str]
) -> dict[str, Estimate | None]:
    """Return the coefficients of a mode, from the samples if the law fits them, otherwise from whole hits."""
    sampled = result.coefficients.get(mode)
    bad = mode in result.bad
    if bad and sampled is not None:
        # Keep a fit that misses the samples if it predicts peak and outgoing speed well.
        known = [e for e in problem.errors_of(sampled) if e is not None]
        bad = not known or max(known) >= _PREDICTS
    found = dict.fromkeys(_COEFFICIENTS) if sampled is None else dict(sampled)
    if sampled is None or bad:
        whole, more = fit_impacts(problem)
        notes += [f"{mode}: {note}" for note in more]
        if any(e is not None for e in whole.values()):
            found |= whole
            notes.append(f"{mode}: k and f are from speeds, peaks and durations of whole hits")
        elif not bad:
            notes.append(f"{mode}: k and f are unknown: no forces, and too few samples in contact")
        found["mu"] = friction(problem) or found["mu"]
    notes += [f"{mode}: {name} {why}" for name, why in _UNKNOWN.items() if found[name] is None]
    return found


def _widen_intervals(
    found: dict[str, Estimate | None], hits: Sequence[MeasuredImpact], *, turning: bool
) -> tuple[dict[str, Estimate | None], list[str]]:
    """Widen the intervals of one mode by the systematic errors of its recordings, and return notes.

    More data do not reduce these errors. If a vehicle turns during the contact, its guards slide faster or
    slower than its centre. In the law the vehicle is a point, so the friction depends on the velocity of the
    centre. Flights at one speed do not determine the lever arm from the centre to the sliding guard
    (docs/results/real_data.md). If `turning`, the intervals therefore include the possible effect of the
    rotation.
    """
    shares = {name: max(hit.trial.allowance.get(name, 0.0) for hit in hits) for name in found}
    notes = []
    rate_rad_s = share = 0.0  # largest turn rate; largest ratio of the edge's speed to the centre's speed
    for hit in hits:
        trial = hit.trial
        if trial.flown is not None and trial.turn_rad_s is not None and hit.tangential_in_m_s:
            sliding = trial.turn_rad_s * trial.flown.config.airframe.contact_distance_m
            rate_rad_s = max(rate_rad_s, trial.turn_rad_s)
            share = max(share, sliding / abs(hit.tangential_in_m_s))
    mu = found["mu"]
    if turning and share > _TURNS:
        slides = min(_OF_TURNING * share, _MOST_OF_TURNING)
        shares["k"] += _K_OF_TURNING
        if mu is not None:
            found = found | {"mu": Estimate(mu.value, mu.low / (1.0 + slides), mu.high / (1.0 - slides))}
        notes.append(
            f"the vehicle turned at up to {math.degrees(rate_rad_s):.0f} deg/s in these contacts, so the "
            f"guards slid up to {100.0 * slides:.0f} % slower or faster than the vehicle's centre; the "
            "contact law ignores rotation, so the interval of mu is widened"
        )
    return {name: _widened(e, shares[name]) for name, e in found.items()}, notes


def _widened(estimate: Estimate | None, share: float) -> Estimate | None:
    if estimate is None:
        return None
    more = share * abs(estimate.value)
    return Estimate(estimate.value, max(estimate.low - more, 0.0), estimate.high + more)
