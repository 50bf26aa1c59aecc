"""The fit of the law to the samples of several trials.

One parameter vector describes all trials. All trials share one plane. Its recorded position may be wrong by
one or two centimetres, so the fit estimates it. The trials of a mode share the mode's coefficients. Every
trial has its own onset time and approach velocity, and a clock delay if it has both positions and forces. The
law is the paper's closed form in time (`dart_flight.lab.predict.path`): free flight, contact, free flight.

In real flights the controller accelerates the vehicle before and after a wall contact. If the recorded free
flight is curved, the fit adds constant accelerations before, during and after the contact of every wall hit.
Otherwise straight flight is assumed, because fewer unknowns are determined more accurately.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.problem import LawProblem
from dart_flight.lab.identify.recorded_impact import TrialImpact, free_spans_s, noise_of
from dart_flight.lab.identify.solver import HIGHEST_F, HIGHEST_K, LOWEST_F, LOWEST_K, LawFit, difference
from dart_flight.lab.identify.trials import Trial
from dart_flight.lab.identify.windows import Channel, cut, weigh
from dart_flight.lab.predict.path import ContactMotion

_PLANE_SD_M = 0.015  # prior standard deviation of the plane's position
_PUSH_SD_M_S2 = 5.0
PUSHES = ("before", "after")
# Standard deviation of the controller's change of acceleration during a contact; small, because the contact
# is shorter than the controller's lag. Positions alone cannot separate this change from stiffness.
_PUSH_CHANGE_SD_M_S2 = 1.0
_DELAY_SD_S = 0.01  # prior standard deviation of the delay between position and force clocks
_FREE_S = (0.25, 0.15)  # durations of fitted free flight before and after a wall contact
_ENOUGH_TRIALS = 5  # minimum number of trials for resampling whole trials
_STRETCH = 12  # number of free-flight samples resampled together; a contact is resampled in thirds
_CURVED = 4.5  # number of standard deviations beyond which a curvature in free flight is not noise
_SETTLED_S = 0.3  # assumed duration of a contact that never ends
_POSITIONS = ("normal_m", "tangential_m", "vertical_m")
# Initial standard deviations of the channels that are not positions; `reweight` replaces them.
_FIRST_SD = {
    "normal_m_s": 0.05, "normal_force_n": 2.0, "tangential_m_s": 0.05, "tangential_force_n": 2.0,
}  # fmt: skip


@functools.lru_cache(maxsize=64)  # most unknowns of a Jacobian do not change the contact
def _contact(
    log_k: float, log_f: float, mu: float, speed: float, acceleration: float, mass_kg: float, onset: Onset
) -> ContactMotion:
    k, f = math.exp(min(max(log_k, -5.0), 20.0)), math.exp(min(max(log_f, -12.0), 12.0))
    c = Coefficients(k=k, f=f, mu=mu, nu=1.0)
    return ContactMotion(c, mass_kg, -max(speed, 1e-4), onset, acceleration_m_s2=acceleration)


def _shape(contact: ContactMotion, name: str, time_s: Array) -> Array:
    """Return the contribution of the contact to a channel; `time_s` counts from the onset."""
    if name.startswith("normal"):
        return contact.normal(time_s)[("normal_m", "normal_m_s", "normal_force_n").index(name)]
    if name == "vertical_m":
        return contact.lift(time_s)
    if name == "tangential_force_n":
        return -contact.coefficients.mu * contact.normal(time_s)[2] * contact.slip(time_s)
    return contact.slide(time_s) if name == "tangential_m" else contact.slip(time_s)


def _duration_s(contact: ContactMotion) -> float:
    return contact.end_s if math.isfinite(contact.end_s) else _SETTLED_S


def _free_s(trial: Trial, speed_in_m_s: float, speed_out_m_s: float) -> tuple[float, float]:
    """Return the durations before and after the contact in which free flight is fitted."""
    longest = (_FREE_S[0], _FREE_S[0]) if trial.acceleration_m_s2 < 0.0 else _FREE_S
    return free_spans_s(trial.acceleration_m_s2, speed_in_m_s, speed_out_m_s, longest)


def _own_unknowns(trial: Trial, pushed: bool) -> list[str]:
    names = ["onset", "speed"]
    if any(name.startswith("tangential") for name in trial.series):
        names += ["y0", "vy"]
    if "vertical_m" in trial.series:
        names += ["z0", "vz"]
    if pushed and trial.acceleration_m_s2 == 0.0:
        axes = [name[0] for name in _POSITIONS if name in trial.series]
        names += [f"{axis}_{when}" for axis in axes for when in PUSHES] + ["n_in"]
    if "normal_force_n" in trial.series:
        names.append("delay")
    return names


class FittedImpact:
    """A hit in a fit of samples.

    Attributes:
        at: index of each unknown of the hit in the parameter vector. All hits share `plane`; the hits of a
            mode share the logarithms `k` and `f`, `mu` and `nu`. The other unknowns belong to one hit.
        window: the fitted samples, by channel.
    """

    def __init__(self, hit: MeasuredImpact, at: dict[str, int], problem: LawProblem) -> None:
        assert hit.turn is not None
        self.hit, self.trial, self.at = hit, hit.trial, at
        self._turn: TrialImpact = hit.turn
        self._problem = problem
        drop = self.trial.acceleration_m_s2 < 0.0
        before, after = _free_s(self.trial, -self._turn.approach_m_s, self._turn.rebound_m_s)
        begin_s = self._turn.turn_s - (0.03 if drop else 0.05) - before
        self.window = cut(self.trial, begin_s, self._turn.turn_s + (0.04 if drop else 0.06) + after)

    def contact(self, theta: Array) -> ContactMotion:
        law = (float(theta[self.at[name]]) for name in ("k", "f", "mu", "speed"))
        push = float(theta[self.at["n_in"]]) if "n_in" in self.at else 0.0
        return _contact(*law, push + self.trial.acceleration_m_s2, self._problem.mass_kg, self._problem.onset)

    def span(self, theta: Array) -> tuple[float, float, ContactMotion]:
        """Return (onset, release, contact) according to the law; the times are those of the recording."""
        contact = self.contact(theta)
        begin = float(theta[self.at["onset"]])
        return begin, begin + _duration_s(contact), contact

    def in_contact(self, theta: Array) -> int:
        """Return the number of samples between the fitted onset and release."""
        begin, end, _ = self.span(theta)
        return self.trial.samples_between(begin, end)

    def errors(self, theta: Array) -> dict[str, Array]:
        """Return model minus recording at the samples, by channel."""
        at, contact = self.at, self.contact(theta)
        onset = theta[at["onset"]]
        delay = theta[at["delay"]] if "delay" in at else 0.0
        out: dict[str, Array] = {}
        for name, channel in self.window.items():
            since = channel.time_s - (onset + delay if name.endswith("_n") else onset)
            values = _shape(contact, name, since)
            if name == "normal_m":
                values = theta[at["plane"]] + values
            elif name == "vertical_m":
                values = theta[at["z0"]] + theta[at["vz"]] * since + theta[at["nu"]] * values
            elif name == "tangential_m":
                values = theta[at["y0"]] + theta[at["vy"]] * values
            elif name.startswith("tangential"):
                values = theta[at["vy"]] * values
            if f"{name[0]}_after" in at and not name.endswith("_n"):
                values = values + self._pushed(theta, name, since, contact.end_s)
            out[name] = values - channel.value
        return out

    def _pushed(self, theta: Array, name: str, since: Array, end_s: float) -> Array:
        """Return what the controller's accelerations before and after the contact add to a channel."""
        late, early = np.maximum(since - end_s, 0.0), np.minimum(since, 0.0)
        before, after = (theta[self.at[f"{name[0]}_{when}"]] for when in PUSHES)
        if name.startswith("n"):  # the contact's shape includes the acceleration in the contact
            after, before = after - theta[self.at["n_in"]], before - theta[self.at["n_in"]]
        if name.endswith("_s"):
            return np.asarray(after * late + before * early)
        return np.asarray(0.5 * (after * late * late + before * early * early))

    def cut_around_contact(self, theta: Array) -> None:
        """Replace the window by the samples around the fitted contact."""
        begin, end, contact = self.span(theta)
        out = float(contact.normal(end - begin)[1])
        before, after = _free_s(self.trial, -contact.normal_m_s, out)
        # The contact is at least as long as the interval that was measured without the contact law.
        begin, end = min(begin, self.hit.begin_s), max(end, self.hit.end_s)
        self.window = cut(self.trial, begin - before, end + after)
        for channel in self.window.values():
            channel.contact[:] = (channel.time_s >= begin) & (channel.time_s <= end)

    def is_curved(self, theta: Array) -> bool:
        """Return whether free flight before or after a wall hit curves more than the noise explains."""
        if self.trial.acceleration_m_s2 != 0.0:
            return False
        begin, end, _ = self.span(theta)
        errors = self.errors(theta)
        for name in _POSITIONS:
            if name not in errors:
                continue
            channel = self.window[name]
            # Third differences estimate the noise independently of the curvature.
            sd = noise_of(self.trial.series[name].value)
            for part in (channel.time_s < begin, channel.time_s > end):
                part &= (channel.counts > 0.0) & ~channel.contact
                if part.sum() < 8:
                    continue
                t = channel.time_s[part] - channel.time_s[part].mean()
                bend = np.stack((np.ones_like(t), t, 0.5 * t * t), axis=1)
                inverse = np.linalg.pinv(bend.T @ bend)
                curvature = float((inverse @ bend.T @ errors[name][part])[2])
                if abs(curvature) > _CURVED * sd * math.sqrt(float(inverse[2, 2])):
                    return True
        return False

    def bound(self, low: Array, high: Array) -> None:
        """Set the limits of the hit's own unknowns."""
        low[self.at["onset"]], high[self.at["onset"]] = self._turn.turn_s - 0.2, self._turn.turn_s + 0.02
        if "delay" in self.at:
            low[self.at["delay"]], high[self.at["delay"]] = -0.05, 0.05
        speed = -self._turn.approach_m_s
        low[self.at["speed"]], high[self.at["speed"]] = 0.4 * speed, 2.0 * speed

    def start(self, theta: Array) -> None:
        """Set first guesses of the hit's own unknowns, from the reversal and lines through the approach."""
        theta[self.at["speed"]], theta[self.at["onset"]] = -self._turn.approach_m_s, self._turn.turn_s
        for name, place in (("tangential_m", "y0"), ("vertical_m", "z0")):
            if name in self.window:
                channel = self.window[name]
                t = channel.time_s - self._turn.turn_s
                before = t < -0.03
                slope, offset = 0.0, channel.value[0]
                if before.sum() >= 2:
                    slope, offset = np.polyfit(t[before], channel.value[before], 1)
                theta[self.at[place]], theta[self.at["v" + place[0]]] = offset, slope

    def place_onset(self, theta: Array) -> float:
        """Set the onset so that the vehicle reverses at the recorded time; return the position error, m."""
        contact = self.contact(theta)
        t = np.linspace(0.0, _duration_s(contact), 60)
        theta[self.at["onset"]] = self._turn.turn_s - float(t[np.argmin(contact.normal(t)[0])])
        channel = self.window["normal_m"]
        error = channel.value - contact.normal(channel.time_s - theta[self.at["onset"]])[0]
        # The plane may be wrong by centimetres, which adds a constant to the error.
        return float(np.mean(np.abs(error - np.median(error))))


class SampleFit(LawFit):
    """The fit of the samples of several trials.

    Args:
        problem: hits with enough position samples in contact.
        pushed: whether the fit also estimates constant accelerations before, in and after each wall contact.

    Attributes:
        modes: mode -> indices of its unknowns (log k, log f, mu, nu) in the parameter vector.
        hits: the hits, in the order of the problem.
        size: number of unknowns.
    """

    robust_from = 2.0
    losses = ("soft_l1", "linear", "linear")

    def __init__(self, problem: LawProblem, pushed: bool = False) -> None:
        self.problem, self.pushed = problem, pushed
        self.modes = {
            mode: {name: 1 + 4 * m + i for i, name in enumerate(("k", "f", "mu", "nu"))}
            for m, mode in enumerate(problem.by_mode())
        }
        self.size = 1 + 4 * len(self.modes)
        self.hits: list[FittedImpact] = []
        for hit in problem.hits:
            own = {name: self.size + i for i, name in enumerate(_own_unknowns(hit.trial, pushed))}
            self.size += len(own)
            at = {"plane": 0, **self.modes[hit.trial.mode], **own}
            self.hits.append(FittedImpact(hit, at, problem))
        position = float(np.median([hit.turn.noise_m for hit in problem.hits if hit.turn is not None]))
        self.sd = dict.fromkeys(_POSITIONS, max(position, 1e-5)) | _FIRST_SD
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[0], high[0] = -0.2, 0.2
        for at in self.modes.values():
            low[at["k"]], high[at["k"]] = math.log(LOWEST_K), math.log(HIGHEST_K)
            low[at["f"]], high[at["f"]] = math.log(LOWEST_F), math.log(HIGHEST_F)
            low[at["mu"]], high[at["mu"]] = 0.0, 1e3
        for fitted in self.hits:
            fitted.bound(low, high)
        self.bounds = low, high

    def of_mode(self, mode: str) -> list[FittedImpact]:
        return [fitted for fitted in self.hits if fitted.trial.mode == mode]

    def _block(self, theta: Array, fitted: FittedImpact) -> Array:
        """Return the weighted residuals of a hit."""
        errors = fitted.errors(theta)
        return np.concatenate(
            [fitted.window[name].counts * error / self.sd[name] for name, error in errors.items()]
        )

    def _prior(self, theta: Array) -> Array:
        """Return the residuals of the priors on plane, coefficients (weak), accelerations and delays."""
        weak = []
        for at in self.modes.values():
            weak += [
                (theta[at["k"]] - 7.5) / 20.0, (theta[at["f"]] - 2.5) / 20.0,
                theta[at["mu"]] / 1e3, theta[at["nu"]] / 1e4,
            ]  # fmt: skip
        for fitted in self.hits:
            own = fitted.at
            weak += [theta[j] / _PUSH_SD_M_S2 for name, j in own.items() if name.endswith(PUSHES)]
            if "delay" in own:
                weak.append(theta[own["delay"]] / _DELAY_SD_S)
            if "n_in" in own:
                weak.append((theta[own["n_in"]] - theta[own["n_before"]]) / _PUSH_CHANGE_SD_M_S2)
        return np.array([theta[0] / _PLANE_SD_M, *weak])

    def residuals(self, theta: Array) -> Array:
        return np.concatenate([*(self._block(theta, fitted) for fitted in self.hits), self._prior(theta)])

    def jacobian(self, theta: Array) -> Array:
        """Return the Jacobian by central differences; each hit is evaluated only for its own unknowns."""
        blocks = []
        for fitted in self.hits:
            block = np.zeros((self._block(theta, fitted).size, theta.size))
            for j in fitted.at.values():
                block[:, j] = difference(theta, j, functools.partial(self._block, fitted=fitted))
            blocks.append(block)
        prior = np.stack([difference(theta, j, self._prior) for j in range(theta.size)], axis=1)
        return np.concatenate([*blocks, prior])

    def reweight(self, theta: Array) -> None:
        """Cut windows around the fitted contacts, then weight each channel by its residuals."""
        members: dict[str, list[tuple[Array, Channel]]] = {}
        for fitted in self.hits:
            fitted.cut_around_contact(theta)
            for name, error in fitted.errors(theta).items():
                members.setdefault(name, []).append((error, fitted.window[name]))
        for name, pairs in members.items():
            errors, channels = zip(*pairs, strict=True)
            counts, self.sd[name] = weigh(errors, [channel.contact for channel in channels])
            for channel, weights in zip(channels, counts, strict=True):
                channel.counts[:] = weights

    def variance(self) -> float:
        """Return the mean square of the residuals, increased if the samples are correlated (by a filter)."""
        data = n = 0
        squares = products = 0.0
        for fitted in self.hits:
            for name, error in fitted.errors(self.theta).items():
                counts = fitted.window[name].counts
                e = counts * error / self.sd[name]
                data += int((counts > 0.0).sum())
                products += float(np.sum(e[1:] * e[:-1]))
                squares += float(np.sum(e * e))
                n += e.size
        rho = min(products / squares if squares > 0.0 else 0.0, 0.95)  # correlation between neighbours
        sure = rho - 2.0 / math.sqrt(n)  # correlation beyond chance
        correlated = (1.0 + rho) / (1.0 - rho) if sure > 0.0 else 1.0
        return max(squares / max(data - self.size, 1), 1e-12) * correlated

    def resampling_groups(self) -> list[NDArray[np.intp]]:
        """Return a group of rows for each trial; if trials are few, for each segment of each channel."""
        found: list[NDArray[np.intp]] = []
        row = 0
        for fitted in self.hits:
            first, stretches = row, []
            for channel in fitted.window.values():
                inside, outside = np.flatnonzero(channel.contact), np.flatnonzero(~channel.contact)
                parts = np.array_split(inside, min(3, max(inside.size, 1)))
                parts += np.array_split(outside, max(outside.size // _STRETCH, 1))
                stretches += [row + part for part in parts if part.size]
                row += channel.contact.size
            found += [np.arange(first, row)] if len(self.hits) >= _ENOUGH_TRIALS else stretches
        return found

    def start(self) -> Array:
        """Return a starting point: lines through each approach, and coefficients from a coarse search."""
        theta = np.zeros(self.size)
        for fitted in self.hits:
            fitted.start(theta)
        for mode, at in self.modes.items():
            theta[at["mu"]] = 1.0
            best, cost = theta, math.inf
            for k in np.geomspace(200.0, 16_000.0, 10):
                for zeta in (0.03, 0.09, 0.2, 0.4):
                    tried = theta.copy()
                    tried[at["k"]] = math.log(k)
                    tried[at["f"]] = math.log(2.0 * zeta * math.sqrt(k * self.problem.mass_kg))
                    total = sum(fitted.place_onset(tried) for fitted in self.of_mode(mode))
                    if total < cost:
                        best, cost = tried, total
            theta = best
        return theta
