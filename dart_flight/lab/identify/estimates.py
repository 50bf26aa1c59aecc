"""The result of `identify` and its parts: estimates, fits of single trials, and assessments of the fit."""

from __future__ import annotations

import math
from typing import NamedTuple

from dart_flight.config.vehicle import Coefficients
from dart_flight.lab.identify.measured_impacts import MeasuredImpact


class Estimate(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def about(cls, value: float, half: float, least: float = -math.inf, most: float = math.inf) -> Estimate:
        """Return `value` with the interval `value` +- `half`, both clipped to the range `least` to `most`."""
        return cls(*(min(max(v, least), most) for v in (value, value - half, value + half)))


class SetAside(NamedTuple):
    """Numbers of samples that the fit of a trial excluded, for comparison with the samples in contact.

    Attributes:
        free: number of excluded samples in free flight, which are off by more than five standard deviations.
        contact: number of excluded samples in contact, at most a tenth of `in_contact`. A sample in contact
            is excluded only if the samples before and after it fit well.
        in_contact: number of samples in contact, excluded or not, summed over the channels.
    """

    free: int
    contact: int
    in_contact: int


class TrialFit(NamedTuple):
    """The fit of one trial.

    Attributes:
        name, mode: name and mode of the trial.
        onset_s: time of the onset in the recording.
        normal_m_s, tangential_m_s: velocity at the onset.
        samples_in_contact: number of position samples in contact.
        push_m_s2: controller's acceleration along the normal before and after the contact; (0, 0) if the free
            flight was straight.
        used: `guards` if a model of the guards was fitted to the force readings, `samples` if the samples
            were fitted, `whole` if only speeds, peak and duration were used.
        normal_out_m_s, tangential_out_m_s: velocity after the contact, measured without a contact law.
        peak_force_n: measured peak; None if no force was recorded, or the sensor clipped.
        force_delay_s: delay of the force samples' clock relative to the position samples' clock; None if
            forces or positions were not recorded.
        misfit: ratio of the residual in contact to the noise in free flight, for the worst channel. If `used`
            is `guards`, it is the mean square of the residuals relative to their expected deviations.
        set_aside: numbers of excluded samples.
    """

    name: str
    mode: str
    onset_s: float
    normal_m_s: float
    tangential_m_s: float | None
    samples_in_contact: int
    push_m_s2: tuple[float, float]
    used: str
    normal_out_m_s: float | None
    tangential_out_m_s: float | None
    peak_force_n: float | None
    force_delay_s: float | None
    misfit: float | None
    set_aside: SetAside

    @classmethod
    def from_hit(cls, hit: MeasuredImpact) -> TrialFit:
        """Return the result for a trial whose samples are not fitted."""
        return cls(
            name=hit.trial.name,
            mode=hit.trial.mode,
            onset_s=hit.begin_s,
            normal_m_s=-hit.normal_in_m_s,
            tangential_m_s=hit.tangential_in_m_s,
            samples_in_contact=hit.samples_in_contact,
            push_m_s2=(0.0, 0.0),
            used="whole",
            normal_out_m_s=hit.normal_out_m_s,
            tangential_out_m_s=hit.tangential_out_m_s,
            peak_force_n=hit.peak_force_n,
            force_delay_s=None,
            misfit=None,
            set_aside=SetAside(0, 0, hit.samples_in_contact),
        )


class Errors(NamedTuple):
    """Median absolute errors on held-out hits; an error that cannot be assessed is None.

    Attributes:
        peak_force: error of the peak force, relative to the measured peak.
        outgoing_speed: error of the outgoing speed, relative to the incoming speed.
    """

    peak_force: float | None
    outgoing_speed: float | None


class HeldOut(NamedTuple):
    """The prediction errors of the law and of the baselines on held-out hits of one mode.

    Attributes:
        mode: mode of the hits.
        held_out: `speed` if all hits of one speed (or height) are held out together, otherwise `trial`.
        hits: number of predicted hits.
        law: errors of the paper's law; None if the hits do not determine the law's coefficients.
        baselines: baseline -> errors; each baseline predicts only one of the two quantities.
        scatter: errors if each hit is predicted by the median of all hits at its speed; None if no speed has
            three hits.
        earned: whether the law predicts better than the baselines in every assessable quantity.
        sentence: the comparison as a sentence.
    """

    mode: str
    held_out: str
    hits: int
    law: Errors | None
    baselines: dict[str, Errors]
    scatter: Errors
    earned: bool
    sentence: str


class FitQuality(NamedTuple):
    """The result of `assess_fit`: whether the fit is good, and why not.

    Attributes:
        good: False if a residual exceeds its limit in `expected`; None if nothing can be assessed.
        expected: quantity -> largest residual of a good fit, in the unit of the quantity.
        messages: a sentence with advice for each quantity whose residual exceeds its limit.
    """

    good: bool | None
    expected: dict[str, float]
    messages: list[str]


class Identification(NamedTuple):
    """The result of `identify`.

    Attributes:
        coefficients: mode -> coefficient (k, f, mu, nu) -> estimate. An estimate is None if the data do not
            determine the coefficient.
        statistical: `coefficients` without the allowance for systematic errors.
        plane_m: recorded normal position of the vehicle's centre at first touch; None if no samples were
            fitted.
        residuals: quantity -> root mean square of its residuals, in the unit of the quantity.
        trials: fit of each trial.
        vertical_side: direction of the vertical force: 1 along `vertical_m`, -1 against it, None if unknown.
        notes: remarks for the reader, in sentences.
        restitution: mode -> outgoing speed / incoming speed along the normal.
        tangential_ratio: mode -> outgoing velocity / incoming velocity along the wall.
        held_out: mode -> prediction errors on held-out hits.
        fit: assessment of the fit.
    """

    coefficients: dict[str, dict[str, Estimate | None]]
    statistical: dict[str, dict[str, Estimate | None]]
    plane_m: Estimate | None
    residuals: dict[str, float]
    trials: list[TrialFit]
    vertical_side: int | None
    notes: list[str]
    restitution: dict[str, Estimate | None]
    tangential_ratio: dict[str, Estimate | None]
    held_out: dict[str, HeldOut]
    fit: FitQuality

    def is_known(self, mode: str) -> bool:
        """Whether k and f of a mode are identified."""
        return all(self.coefficients[mode][name] is not None for name in ("k", "f"))

    def fitted(self, mode: str, fallback: Coefficients | None = None) -> Coefficients:
        """Return the coefficients of a mode.

        Unknown coefficients come from `fallback`. Without `fallback`, an unknown mu or nu is 0.

        Raises:
            ValueError: k or f is unknown, and there is no `fallback`.
        """
        values = {}
        for name, estimate in self.coefficients[mode].items():
            if estimate is not None:
                values[name] = max(estimate.value, 0.0)
            elif fallback is not None:
                values[name] = getattr(fallback, name)
            elif name in ("k", "f"):
                raise ValueError(f"{name} of {mode} was not identified")
            else:
                values[name] = 0.0
        return Coefficients(**values)
