"""What an identification says: estimates with intervals, what became of each trial, and the whole."""

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
        """Return a value and its symmetric interval, both kept within limits."""
        return cls(*(min(max(v, least), most) for v in (value, value - half, value + half)))


class SetAside(NamedTuple):
    """Samples that a fit does not count, of those in its window.

    Attributes:
        free: in free flight, beyond five deviations.
        contact: in the contact: single samples between good neighbours, never more than a tenth.
        in_contact: samples in the contact, of all channels.
    """

    free: int
    contact: int
    in_contact: int


class TrialFit(NamedTuple):
    """What a fit says of one trial.

    Attributes:
        name, mode: of the trial.
        onset_s: time of the onset in the recording.
        normal_m_s, tangential_m_s: velocity at the onset.
        samples_in_contact: position samples in contact.
        push_m_s2: the controller's acceleration along the normal, before and after the contact; 0 where the
            flight was straight.
        used: `samples` where its samples were fitted, `whole` where only speeds, peak and duration count.
        normal_out_m_s, tangential_out_m_s: velocity after the contact, measured without a law.
        peak_force_n: as measured; None where no force was recorded, or it was cut off.
        force_delay_s: by how much the force's clock is late against the positions'; None without both.
        misfit: residual in contact over the noise in free flight, of the worst channel.
        set_aside: samples that do not count.
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
    def of_hit(cls, hit: MeasuredImpact) -> TrialFit:
        """Return what is said of a trial whose samples are not fitted."""
        return cls(
            name=hit.name,
            mode=hit.mode,
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
    """Median size of the error on held-out hits; None where it cannot be judged.

    Attributes:
        peak_force: as a share of the measured peak.
        outgoing_speed: as a share of the speed in.
    """

    peak_force: float | None
    outgoing_speed: float | None


class HeldOut(NamedTuple):
    """The comparison of one mode.

    Attributes:
        mode: of the hits.
        held_out: `speed` where all hits of one speed (or height) are left out together, else `trial`.
        hits: how many were predicted.
        law: errors of the paper's law; None where the hits cannot tell its coefficients.
        baselines: errors by baseline; each predicts one of the two.
        scatter: of repeats at one speed, the same measure; None without repeats.
        earned: whether the law predicts better than the baselines in everything that could be judged.
        sentence: this in words.
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
    """A fit, judged.

    Attributes:
        good: nothing is further off than expected; None where there is nothing to judge by.
        expected: quantity -> the most that a good fit is off, in its own unit.
        says: a sentence per quantity that is not good; what to look at.
    """

    good: bool | None
    expected: dict[str, float]
    says: list[str]


class Identification(NamedTuple):
    """Result of `identify`.

    Attributes:
        coefficients: mode -> k, f, mu, nu -> estimate, None where the data cannot tell.
        plane_m: position of the plane of first touch in the recordings; None where no samples were fitted.
        residuals: root mean square per quantity, in its own unit.
        trials: one per trial.
        vertical_side: whether the vertical force acts with (1) or against (-1) `vertical_m`; None if unknown.
        notes: what a reader should know, in sentences.
        restitution: mode -> speed out over speed in, along the normal.
        tangential_ratio: mode -> the same along the wall.
        held_out: mode -> how well the law predicts hits it has not seen.
        fit: whether to believe it.
    """

    coefficients: dict[str, dict[str, Estimate | None]]
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
        """The coefficients of a mode; what was not identified is taken from `fallback`, else 0.

        Raises:
            ValueError: k or f is not known.
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
