"""`identify`: contact coefficients and restitution from recorded trials.

Every trial is first measured as a whole, without a contact law: incoming and outgoing speed, peak and
duration. Then `solver` fits the law and computes the intervals:

- to the samples of all trials jointly (`sample_fit`), if enough position samples show the contact;
- to the measurements of whole hits (`hit_fit`), if the law misses the samples by several times the noise, or
  if the trials recorded only speeds or only an accelerometer.

A coefficient that the data do not determine is None.
"""

from __future__ import annotations

from collections.abc import Sequence

from dart_flight.config.document import InputError
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification, TrialFit
from dart_flight.lab.identify.fit_quality import assess_fit, expected_residuals
from dart_flight.lab.identify.held_out import hold_out
from dart_flight.lab.identify.hit_fit import fit_hits
from dart_flight.lab.identify.measured_impacts import measure_impact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.sample_result import SampleResult, fit_samples
from dart_flight.lab.identify.speed_ratios import friction, restitution, tangential_ratio
from dart_flight.lab.identify.systematic_error import widen_intervals
from dart_flight.lab.identify.trials import Trial, without_derived

_PREDICTS = 0.1  # error of peak and outgoing speed up to which a fit with large residuals is kept
_COEFFICIENTS = ("k", "f", "mu", "nu")
_UNKNOWN = {
    "mu": "(friction) is unknown, because no trial shows friction that slows a motion along the wall",
    "nu": "(vertical force) is unknown, because no trial shows a contact that changes a vertical motion",
}


def identify(trials: Sequence[Trial], mass_kg: float, onset: Onset) -> Identification:
    """Identify the coefficients of each mode from trials (paper, Sec. IV-B and V-A).

    Args:
        trials: recordings. All trials hit the same plane, and trials of one mode have the same coefficients.
        onset: onset rule of the fitted model; the rule affects k and f slightly.

    Raises:
        InputError: SciPy is missing, or a trial cannot be used; the error names the trial and the reason.
    """
    if not trials:
        raise InputError("no trials")
    usable, notes = without_derived(trials)
    problem = LawProblem([measure_impact(trial, mass_kg) for trial in usable], mass_kg, onset)
    notes += [note for hit in problem.hits for note in hit.notes]
    result = fit_samples(problem)
    notes += result.notes
    modes = problem.by_mode()
    held_out = {mode: hold_out(own) for mode, own in modes.items()}
    notes += [found.sentence for found in held_out.values() if found.hits]
    coefficients = {}
    for mode, own in modes.items():
        found = _coefficients(mode, result, own, notes)
        coefficients[mode], more = widen_intervals(found, own.hits)
        notes += [f"{mode}: {note}" for note in more]
    whole = problem.of([hit for hit in problem.hits if hit not in result.trials])
    expected = expected_residuals(trials, problem.hits)
    return Identification(
        coefficients=coefficients,
        plane_m=result.plane_m,
        residuals=result.residuals,
        trials=[result.trials.get(hit) or TrialFit.from_hit(hit) for hit in problem.hits],
        vertical_side=result.vertical_side,
        notes=notes,
        restitution={mode: restitution(own.hits) for mode, own in modes.items()},
        tangential_ratio={mode: tangential_ratio(own.hits) for mode, own in modes.items()},
        held_out=held_out,
        fit=assess_fit(coefficients, whole, result.residuals, expected),
    )


def _coefficients(
    mode: str, result: SampleResult, problem: LawProblem, notes: list[str]
) -> dict[str, Estimate | None]:
    """Return the coefficients of a mode, from the samples if the law fits them, else from whole hits."""
    sampled = result.coefficients.get(mode)
    bad = mode in result.bad
    if bad and sampled is not None:
        # Keep a fit that misses the samples if it predicts peak and outgoing speed well.
        known = [e for e in problem.errors_of(sampled) if e is not None]
        bad = not known or max(known) >= _PREDICTS
    found = dict.fromkeys(_COEFFICIENTS) if sampled is None else dict(sampled)
    if sampled is None or bad:
        whole, more = fit_hits(problem)
        notes += [f"{mode}: {note}" for note in more]
        if any(e is not None for e in whole.values()):
            found |= whole
            notes.append(f"{mode}: k and f are from speeds, peaks and durations of whole hits")
        elif not bad:
            notes.append(f"{mode}: neither forces nor enough samples in contact: k and f are unknown")
        found["mu"] = friction(problem.hits) or found["mu"]
    notes += [f"{mode}: {name} {why}" for name, why in _UNKNOWN.items() if found[name] is None]
    return found
