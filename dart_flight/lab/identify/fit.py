"""`identify`: contact coefficients and restitution from recorded trials.

Every trial is first measured as a whole, without a contact law: incoming and outgoing speed, peak and
duration. Then `solver` fits the law and computes the intervals:

- to the samples of all trials jointly (`joint_fit`), if enough position samples show the contact;
- to the measurements of whole hits (`hit_fit`), if the law misses the samples by several times the noise, or
  if the trials recorded only speeds or only an accelerometer.

A coefficient that the data do not determine is None.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.estimates import Estimate, Identification, TrialFit
from dart_flight.lab.identify.fit_quality import assess_fit, errors_of, expected_residuals
from dart_flight.lab.identify.held_out import hold_out
from dart_flight.lab.identify.hit_fit import fit_hits
from dart_flight.lab.identify.joint_fit import SampleResult, conclude, solve
from dart_flight.lab.identify.measured_impacts import MeasuredImpact, measure_impact
from dart_flight.lab.identify.speed_ratios import friction, restitution, tangential_ratio
from dart_flight.lab.identify.systematic_error import widen_intervals
from dart_flight.lab.identify.trials import Trial, without_derived

_MIN_IN_CONTACT = 4
_SLOW_SAMPLING_S = 0.006
_PREDICTS = 0.1  # error of peak and outgoing speed up to which a fit with large residuals is kept
_COEFFICIENTS = ("k", "f", "mu", "nu")


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
    hits = [measure_impact(trial, mass_kg) for trial in usable]
    notes += [note for hit in hits for note in hit.notes]
    result = _fit_samples(usable, hits, mass_kg, onset)
    notes += result.notes
    members = {hit.mode: [other for other in hits if other.mode == hit.mode] for hit in hits}
    held_out = {mode: hold_out(own, mass_kg, onset) for mode, own in members.items()}
    notes += [found.sentence for found in held_out.values() if found.hits]
    coefficients = {}
    for mode, own in members.items():
        found = _coefficients(mode, result, own, mass_kg, onset, notes)
        coefficients[mode], more = widen_intervals(
            found, [trial for trial in usable if trial.mode == mode], own
        )
        notes += [f"{mode}: {note}" for note in more]
    whole = [hit for i, hit in enumerate(hits) if i not in result.trials]
    expected = expected_residuals(trials, hits)
    return Identification(
        coefficients=coefficients,
        plane_m=result.plane_m,
        residuals=result.residuals,
        trials=[result.trials.get(i) or TrialFit.from_hit(hit) for i, hit in enumerate(hits)],
        vertical_side=result.vertical_side,
        notes=notes,
        restitution={mode: restitution(own) for mode, own in members.items()},
        tangential_ratio={mode: tangential_ratio(own) for mode, own in members.items()},
        held_out=held_out,
        fit=assess_fit(coefficients, whole, result.residuals, expected, mass_kg, onset),
    )


def _fit_samples(
    trials: Sequence[Trial], hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset
) -> SampleResult:
    positions = [i for i, trial in enumerate(trials) if hits[i].turn is not None and trial.position_measured]
    # With slow sampling the measured extent of the hit, widened to whole samples, decides. With fast sampling
    # that extent begins too late, so the fit decides.
    few = {
        i: max(trials[i].samples_between(hits[i].begin_s, hits[i].end_s) - 2, 0)
        for i in positions
        if float(np.median(np.diff(trials[i].normal.time_s))) > _SLOW_SAMPLING_S
    }
    few = {i: n for i, n in few.items() if n < _MIN_IN_CONTACT}
    chosen = [i for i in positions if i not in few]
    result = SampleResult()
    while chosen:
        fit, theta, notes = solve(
            [trials[i] for i in chosen], [hits[i] for i in chosen], mass_kg, onset, least=_MIN_IN_CONTACT
        )
        counts = {i: fit.in_contact(theta, j) for j, i in enumerate(chosen)}
        less = {i: n for i, n in counts.items() if n < _MIN_IN_CONTACT}
        if not less:
            result = conclude(fit, theta, chosen)
            result.notes[:0] = notes
            break
        few |= less
        chosen = [i for i in chosen if i not in less]
    for i, n in few.items():
        result.notes.append(
            f"{trials[i].name}: {n} sample{'' if n == 1 else 's'} in contact, at least "
            f"{_MIN_IN_CONTACT} are needed for stiffness: only the trial's speeds are used"
        )
    return result


def _coefficients(
    mode: str,
    result: SampleResult,
    hits: Sequence[MeasuredImpact],
    mass_kg: float,
    onset: Onset,
    notes: list[str],
) -> dict[str, Estimate | None]:
    """Return the coefficients of a mode, from the samples if the law fits them, else from whole hits."""
    sampled = result.coefficients.get(mode)
    bad = mode in result.bad
    if bad and sampled is not None:
        # Keep a fit that misses the samples if it predicts peak and outgoing speed well.
        known = [e for e in errors_of(sampled, hits, mass_kg, onset) if e is not None]
        bad = not known or max(known) >= _PREDICTS
    found = dict.fromkeys(_COEFFICIENTS) if sampled is None else dict(sampled)
    if sampled is None or bad:
        whole, more = fit_hits(hits, mass_kg, onset)
        notes += [f"{mode}: {note}" for note in more]
        if any(e is not None for e in whole.values()):
            found |= whole
            notes.append(f"{mode}: k and f are from speeds, peaks and durations of whole hits")
        elif not bad:
            notes.append(f"{mode}: neither forces nor enough samples in contact: k and f are unknown")
        found["mu"] = friction(hits) or found["mu"]
    for name, what in (
        (
            "mu",
            "mu (friction) is unknown, because no trial shows friction that slows a motion along the wall",
        ),
        (
            "nu",
            "nu (vertical force) is unknown, because no trial shows a contact that changes a vertical motion",
        ),
    ):
        if found[name] is None:
            notes.append(f"{mode}: {what}")
    return found
