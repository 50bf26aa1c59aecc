"""The residuals of the law at the samples of all trials of an identification.

One parameter vector describes all trials. They share one plane, whose position is known to one or two
centimetres and is estimated too. The trials of a mode share its coefficients. Every trial has its own onset
time and approach velocity, and a clock delay if it has both positions and forces. The law is the paper's
closed form in time (`dart_flight.lab.predict.path`): free flight, contact, free flight.

In real flights the controller accelerates the vehicle before and after a wall contact. If this curves the
recorded free flight, every wall hit gets three unknown constant accelerations: before, in and after the
contact. Otherwise straight flight is assumed, because fewer unknowns are determined more accurately.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.lab.identify.measured_impacts import MeasuredImpact
from dart_flight.lab.identify.recorded_impact import free_spans_s
from dart_flight.lab.identify.solver import HIGHEST_F, HIGHEST_K, LOWEST_F, LOWEST_K, difference
from dart_flight.lab.identify.trials import Trial
from dart_flight.lab.identify.windows import cut, weigh
from dart_flight.lab.predict.path import ContactMotion

_PLANE_SD_M = 0.015  # prior standard deviation of the plane's position
_PUSH_SD_M_S2 = 5.0
PUSHES = ("before", "after")
# Standard deviation of the controller's change in contact, which is shorter than its lag. Positions alone
# cannot separate this change from stiffness.
_PUSH_CHANGE_SD_M_S2 = 1.0
_DELAY_SD_S = 0.01  # between the clocks of positions and forces
_FREE_S = (0.25, 0.15)  # free flight used before and after a wall contact; later the recovery acts
_ENOUGH_TRIALS = 5  # trials of a call from which whole trials are resampled
_STRETCH = 12  # samples of free flight resampled together; a contact is resampled in thirds
# Initial standard deviations of the channels, replaced by those of the residuals.
_FIRST_SD = {
    "normal_m_s": 0.05, "normal_force_n": 2.0, "tangential_m_s": 0.05, "tangential_force_n": 2.0,
}  # fmt: skip


class Parameters:
    """The layout of the parameter vector."""

    def __init__(self, trials: Sequence[Trial], pushed: bool) -> None:
        self.modes = list(dict.fromkeys(trial.mode for trial in trials))
        self.size = 1 + 4 * len(self.modes)  # plane; ln k, ln f, mu, nu per mode
        self.own: list[dict[str, int]] = []
        for trial in trials:
            names = ["onset", "speed"]
            if any(name.startswith("tangential") for name in trial.series):
                names += ["y0", "vy"]
            if "vertical_m" in trial.series:
                names += ["z0", "vz"]
            if pushed and trial.acceleration_m_s2 == 0.0:
                axes = [
                    name[0] for name in ("normal_m", "tangential_m", "vertical_m") if name in trial.series
                ]
                names += [f"{axis}_{when}" for axis in axes for when in PUSHES] + ["n_in"]
            if "normal_force_n" in trial.series:
                names.append("delay")
            self.own.append({name: self.size + i for i, name in enumerate(names)})
            self.size += len(names)

    def mode_indices(self, mode: str) -> dict[str, int]:
        """Return the indices of a mode's unknowns (log k, log f, mu, nu) in the parameter vector."""
        first = 1 + 4 * self.modes.index(mode)
        return {name: first + i for i, name in enumerate(("k", "f", "mu", "nu"))}

    def trial_indices(self, i: int, mode: str) -> list[int]:
        """Return the indices of the parameters that trial i depends on."""
        return [0, *self.mode_indices(mode).values(), *self.own[i].values()]


@functools.lru_cache(maxsize=64)  # most parameters of a Jacobian do not change the contact
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


class SampleFit:
    """The `LawProblem` of the samples of several trials.

    Args:
        trials: trials with enough position samples in contact.
        hits: hits of the trials, in the same order.
        pushed: whether the fit also estimates constant accelerations before, in and after each wall contact.
    """

    robust_from = 2.0

    def __init__(
        self, trials: Sequence[Trial], hits: Sequence[MeasuredImpact], mass_kg: float, onset: Onset,
        pushed: bool = False,
    ) -> None:  # fmt: skip
        self.trials, self.hits, self.mass_kg, self.onset = list(trials), list(hits), mass_kg, onset
        self.parameters = Parameters(trials, pushed)
        self.impacts = [hit.turn for hit in hits if hit.turn is not None]
        self.sd = dict(_FIRST_SD)
        position = float(np.median([impact.noise_m for impact in self.impacts]))
        for name in ("normal_m", "tangential_m", "vertical_m"):
            self.sd[name] = max(position, 1e-5)
        self.windows = []
        for trial, impact in zip(self.trials, self.impacts, strict=True):
            drop = trial.acceleration_m_s2 < 0.0
            before, after = self._free_s(trial, -impact.approach_m_s, impact.rebound_m_s)
            begin_s = impact.turn_s - (0.03 if drop else 0.05) - before
            self.windows.append(cut(trial, begin_s, impact.turn_s + (0.04 if drop else 0.06) + after))

    @staticmethod
    def _free_s(trial: Trial, speed_in_m_s: float, speed_out_m_s: float) -> tuple[float, float]:
        """Return the durations before and after the contact in which free flight is fitted."""
        longest = (_FREE_S[0], _FREE_S[0]) if trial.acceleration_m_s2 < 0.0 else _FREE_S
        return free_spans_s(trial.acceleration_m_s2, speed_in_m_s, speed_out_m_s, longest)

    def contact(self, theta: Array, i: int) -> ContactMotion:
        shared, own = self.parameters.mode_indices(self.trials[i].mode), self.parameters.own[i]
        law = (float(theta[shared[name]]) for name in ("k", "f", "mu"))
        push = float(theta[own["n_in"]]) if "n_in" in own else 0.0
        push += self.trials[i].acceleration_m_s2
        return _contact(*law, float(theta[own["speed"]]), push, self.mass_kg, self.onset)

    def predict(self, theta: Array, i: int) -> dict[str, Array]:
        """Return the model at the samples of trial i, by channel."""
        shared, own = self.parameters.mode_indices(self.trials[i].mode), self.parameters.own[i]
        contact, onset = self.contact(theta, i), float(theta[own["onset"]])
        delay = float(theta[own["delay"]]) if "delay" in own else 0.0
        out: dict[str, Array] = {}
        for name, series in self.windows[i].series.items():
            since = series.time_s - (onset + delay if name.endswith("_n") else onset)
            values = _shape(contact, name, since)
            if name == "normal_m":
                values = theta[0] + values
            elif name == "vertical_m":
                free = theta[own["z0"]] + theta[own["vz"]] * (series.time_s - theta[own["onset"]])
                values = free + theta[shared["nu"]] * values
            elif name == "tangential_m":
                values = theta[own["y0"]] + theta[own["vy"]] * values
            elif name.startswith("tangential"):
                values = theta[own["vy"]] * values
            if f"{name[0]}_after" in own and not name.endswith("_n"):
                values = values + self._pushed(theta, own, name, since, contact.end_s)
            out[name] = values
        return out

    @staticmethod
    def _pushed(theta: Array, own: dict[str, int], name: str, since: Array, end_s: float) -> Array:
        """Return what the controller's accelerations before and after the contact add to a channel."""
        late, early = np.maximum(since - end_s, 0.0), np.minimum(since, 0.0)
        after, before = theta[own[f"{name[0]}_after"]], theta[own[f"{name[0]}_before"]]
        if name.startswith("n"):  # the contact's shape already includes its own acceleration
            after, before = after - theta[own["n_in"]], before - theta[own["n_in"]]
        if name.endswith("_s"):
            return np.asarray(after * late + before * early)
        return np.asarray(0.5 * (after * late * late + before * early * early))

    def block(self, theta: Array, i: int) -> Array:
        """Return the weighted residuals of trial i."""
        counts, errors = self.windows[i].counts, self.errors(theta, i)
        return np.concatenate([counts[name] * error / self.sd[name] for name, error in errors.items()])

    def prior(self, theta: Array) -> Array:
        """Return the residuals of the priors on plane, coefficients (weak), accelerations and delays."""
        weak = []
        for mode in self.parameters.modes:
            at = self.parameters.mode_indices(mode)
            weak += [
                (theta[at["k"]] - 7.5) / 20.0, (theta[at["f"]] - 2.5) / 20.0,
                theta[at["mu"]] / 1e3, theta[at["nu"]] / 1e4,
            ]  # fmt: skip
        for own in self.parameters.own:
            weak += [theta[j] / _PUSH_SD_M_S2 for name, j in own.items() if name.endswith(PUSHES)]
            if "delay" in own:
                weak.append(theta[own["delay"]] / _DELAY_SD_S)
            if "n_in" in own:
                weak.append((theta[own["n_in"]] - theta[own["n_before"]]) / _PUSH_CHANGE_SD_M_S2)
        return np.array([theta[0] / _PLANE_SD_M, *weak])

    def residuals(self, theta: Array) -> Array:
        return np.concatenate([self.block(theta, i) for i in range(len(self.trials))] + [self.prior(theta)])

    def jacobian(self, theta: Array) -> Array:
        """Return the Jacobian by central differences; each trial is evaluated only for its own parameters."""
        blocks = []
        for i, trial in enumerate(self.trials):
            rows = self.block(theta, i).size
            block = np.zeros((rows, theta.size))
            for j in self.parameters.trial_indices(i, trial.mode):
                block[:, j] = difference(theta, j, functools.partial(self.block, i=i))
            blocks.append(block)
        prior = np.stack([difference(theta, j, self.prior) for j in range(theta.size)], axis=1)
        return np.concatenate([*blocks, prior])

    def span(self, theta: Array, i: int) -> tuple[float, float, ContactMotion]:
        """Return (onset, release, contact) of trial i by the law; both times count as in the recording."""
        contact = self.contact(theta, i)
        begin = float(theta[self.parameters.own[i]["onset"]])
        return begin, begin + (contact.end_s if math.isfinite(contact.end_s) else 0.3), contact

    def in_contact(self, theta: Array, i: int) -> int:
        """Return the number of samples of trial i between the fitted onset and release."""
        begin, end, _ = self.span(theta, i)
        return self.trials[i].samples_between(begin, end)

    def errors(self, theta: Array, i: int) -> dict[str, Array]:
        """Return model minus recording for trial i, by channel."""
        return {
            name: predicted - self.windows[i].series[name].value
            for name, predicted in self.predict(theta, i).items()
        }

    def reweight(self, theta: Array) -> None:
        """Cut windows around the fitted contacts, then weight each channel by its residuals."""
        names: dict[str, list[int]] = {}
        for i, trial in enumerate(self.trials):
            begin, end, contact = self.span(theta, i)
            out = float(contact.normal(end - begin)[1])
            before, after = self._free_s(trial, -contact.normal_m_s, out)
            # The contact includes the interval measured without the law.
            begin, end = min(begin, self.hits[i].begin_s), max(end, self.hits[i].end_s)
            window = self.windows[i] = cut(trial, begin - before, end + after)
            for name, series in window.series.items():
                window.contact[name][:] = (series.time_s >= begin) & (series.time_s <= end)
                names.setdefault(name, []).append(i)
        for name, members in names.items():
            errors = [self.errors(theta, i)[name] for i in members]
            contacts = [self.windows[i].contact[name] for i in members]
            counts, self.sd[name] = weigh(errors, contacts)
            for i, weights in zip(members, counts, strict=True):
                self.windows[i].counts[name][:] = weights

    def variance(self, theta: Array) -> float:
        """Return the mean square of the residuals, increased if the samples are correlated (by a filter)."""
        data = sum(int(sum((c > 0.0).sum() for c in window.counts.values())) for window in self.windows)
        misfit = sum(float(np.sum(self.block(theta, i) ** 2)) for i in range(len(self.trials)))
        squares, products, n = 0.0, 0.0, 0
        for i, window in enumerate(self.windows):
            for name, error in self.errors(theta, i).items():
                e = window.counts[name] * error / self.sd[name]
                products += float(np.sum(e[1:] * e[:-1]))
                squares += float(np.sum(e * e))
                n += e.size
        rho = min(products / squares if squares > 0.0 else 0.0, 0.95)  # between neighbours
        sure = rho - 2.0 / math.sqrt(n)  # correlation beyond chance
        correlated = (1.0 + rho) / (1.0 - rho) if sure > 0.0 else 1.0
        return max(misfit / max(data - self.parameters.size, 1), 1e-12) * correlated

    def resampling_groups(self) -> list[NDArray[np.intp]]:
        """Return the rows of each trial as one group; with few trials, of each segment of each channel."""
        found: list[NDArray[np.intp]] = []
        row = 0
        for window in self.windows:
            first, stretches = row, []
            for contact in window.contact.values():
                inside, outside = np.flatnonzero(contact), np.flatnonzero(~contact)
                parts = np.array_split(inside, min(3, max(inside.size, 1)))
                parts += np.array_split(outside, max(outside.size // _STRETCH, 1))
                stretches += [row + part for part in parts if part.size]
                row += contact.size
            found += [np.arange(first, row)] if len(self.trials) >= _ENOUGH_TRIALS else stretches
        return found

    def bounds(self) -> tuple[Array, Array]:
        """Return bounds that contain every plausible impact and keep the search near the data."""
        low, high = np.full(self.parameters.size, -np.inf), np.full(self.parameters.size, np.inf)
        for mode in self.parameters.modes:
            at = self.parameters.mode_indices(mode)
            low[at["k"]], high[at["k"]] = math.log(LOWEST_K), math.log(HIGHEST_K)
            low[at["f"]], high[at["f"]] = math.log(LOWEST_F), math.log(HIGHEST_F)
            low[at["mu"]], high[at["mu"]] = 0.0, 1e3
        low[0], high[0] = -0.2, 0.2
        for own, impact in zip(self.parameters.own, self.impacts, strict=True):
            low[own["onset"]], high[own["onset"]] = impact.turn_s - 0.2, impact.turn_s + 0.02
            if "delay" in own:
                low[own["delay"]], high[own["delay"]] = -0.05, 0.05
            low[own["speed"]], high[own["speed"]] = 0.4 * -impact.approach_m_s, 2.0 * -impact.approach_m_s
        return low, high

    def start(self) -> Array:
        """Return a starting point: lines through each approach, and coefficients from a coarse search."""
        theta = np.zeros(self.parameters.size)
        for i, impact in enumerate(self.impacts):
            own = self.parameters.own[i]
            theta[own["speed"]] = -impact.approach_m_s
            theta[own["onset"]] = impact.turn_s
            for name, place in (("tangential_m", "y0"), ("vertical_m", "z0")):
                if name in self.windows[i].series:
                    line = self._line_before(i, name)
                    theta[own[place]], theta[own["v" + place[0]]] = line
        for mode in self.parameters.modes:
            at = self.parameters.mode_indices(mode)
            members = [i for i, trial in enumerate(self.trials) if trial.mode == mode]
            theta[at["mu"]] = 1.0
            best, cost = theta, math.inf
            for k in np.geomspace(200.0, 16_000.0, 10):
                for zeta in (0.03, 0.09, 0.2, 0.4):
                    trial_theta = theta.copy()
                    trial_theta[at["k"]] = math.log(k)
                    trial_theta[at["f"]] = math.log(2.0 * zeta * math.sqrt(k * self.mass_kg))
                    for i in members:
                        self._place_onset(trial_theta, i)
                    total = sum(self._rough_cost(trial_theta, i) for i in members)
                    if total < cost:
                        best, cost = trial_theta, total
            theta = best
        return theta

    def _line_before(self, i: int, name: str) -> tuple[float, float]:
        series, impact = self.windows[i].series[name], self.impacts[i]
        t = series.time_s - impact.turn_s
        before = t < -0.03
        if before.sum() < 2:
            return float(series.value[0]), 0.0
        slope, offset = np.polyfit(t[before], series.value[before], 1)
        return float(offset), float(slope)

    def _place_onset(self, theta: Array, i: int) -> None:
        """Set the onset so that the vehicle reverses at the recorded time."""
        contact = self.contact(theta, i)
        end = contact.end_s if math.isfinite(contact.end_s) else 0.3
        t = np.linspace(0.0, end, 60)
        theta[self.parameters.own[i]["onset"]] = self.impacts[i].turn_s - float(
            t[np.argmin(contact.normal(t)[0])]
        )

    def _rough_cost(self, theta: Array, i: int) -> float:
        series = self.windows[i].series["normal_m"]
        since = series.time_s - theta[self.parameters.own[i]["onset"]]
        error = series.value - self.contact(theta, i).normal(since)[0]
        # The plane may be wrong by centimetres, which adds a constant to the error.
        return float(np.mean(np.abs(error - np.median(error))))
