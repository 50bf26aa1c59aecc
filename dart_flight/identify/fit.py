"""Contact coefficients from recorded trials: one joint least-squares fit, with intervals.

All trials of a call share one plane, whose position is known to a centimetre or two and estimated along; all
trials of a mode share its coefficients; every trial has its own onset time and approach velocity. The model
is the closed form in time (`dart_flight.contact.path`): free flight, contact, free flight.

Noise is estimated per quantity from the residuals, outliers beyond five of its deviations are left out, and
the intervals are widened for what correlation is left in the residuals (a filter in the recording). What the
data cannot tell comes back as None.

In real flights the controller pushes before and after a wall contact. Where the recordings show such
curvature, every wall hit gets constant accelerations of its own, one before, one in and one after the
contact, unknown like the rest; where they do not, straight flight is assumed, which tells more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dart_flight.config.document import InputError
from dart_flight.config.vehicle import Coefficients
from dart_flight.contact.coefficients import Array
from dart_flight.contact.law import Onset
from dart_flight.contact.path import Contact
from dart_flight.identify.trials import Series, Trial, TrialImpact, find_impact, noise_of

PLANE_SD_M = 0.015
_T95 = 1.959964
_BEFORE_S, _AFTER_S = 0.25, 0.15  # free flight used at a wall: later the recovery acts
_LEAST_IN_CONTACT = 3
_OUTLIER = 5.0
_REMEMBERED = 8
_CURVED = 4.5  # deviations of a curvature in free flight that is not noise
_PUSH_SD_M_S2 = 5.0
_PUSHES = ("before", "after")
# The controller leans otherwise once it feels the wall: by this much, standard deviation, over a contact
# that is shorter than its own lag. Positions alone could not tell that from stiffness.
_PUSH_CHANGE_SD_M_S2 = 1.0
# Rates of change this small in the model make a coefficient unknown rather than zero.
_WIDEST_LOG = math.log(10.0)

CHANNELS = (
    "normal_m", "normal_m_s", "normal_force_n", "tangential_m", "tangential_m_s", "tangential_force_n",
    "vertical_m",
)  # fmt: skip
# Deviation assumed before the residuals tell: the order in which the channels then count does not matter.
_FIRST_SD = {
    "normal_m_s": 0.05, "normal_force_n": 2.0, "tangential_m_s": 0.05, "tangential_force_n": 2.0,
}  # fmt: skip


class Estimate(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


class TrialFit(NamedTuple):
    """What a fit says of one trial.

    Attributes:
        name, mode: of the trial.
        onset_s: time of the onset in the recording.
        normal_m_s, tangential_m_s: velocity at the onset.
        samples_in_contact: position samples in contact.
        push_m_s2: the controller's acceleration along the normal, before and after the contact; 0 where the
            flight was straight.
    """

    name: str
    mode: str
    onset_s: float
    normal_m_s: float
    tangential_m_s: float | None
    samples_in_contact: int
    push_m_s2: tuple[float, float]


class Identification(NamedTuple):
    """Result of `identify`.

    Attributes:
        coefficients: mode -> k, f, mu, nu -> estimate, None where the data cannot tell.
        plane_m: position of the plane of first touch in the recordings.
        residuals: root mean square per quantity, in its own unit.
        trials: one per trial.
        vertical_side: whether the vertical force acts with (1) or against (-1) `vertical_m`; None if unknown.
        notes: what a reader should know, in sentences.
    """

    coefficients: dict[str, dict[str, Estimate | None]]
    plane_m: Estimate
    residuals: dict[str, float]
    trials: list[TrialFit]
    vertical_side: int | None
    notes: list[str]

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


# --- the model of one trial -----------------------------------------------------------------------------


class _Window(NamedTuple):
    """The samples of a trial that are fitted, by channel, and which of them count."""

    series: dict[str, Series]
    counts: dict[str, Array]


class _Parameters:
    """Names the entries of the parameter vector."""

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
                names += [f"{axis}_{when}" for axis in axes for when in _PUSHES] + ["n_in"]
            self.own.append({name: self.size + i for i, name in enumerate(names)})
            self.size += len(names)

    def of_mode(self, mode: str) -> dict[str, int]:
        first = 1 + 4 * self.modes.index(mode)
        return {name: first + i for i, name in enumerate(("k", "f", "mu", "nu"))}

    def of_trial(self, i: int, mode: str) -> list[int]:
        """Everything that trial i depends on."""
        return [0, *self.of_mode(mode).values(), *self.own[i].values()]


def _contact(theta: Array, shared: dict[str, int], own: dict[str, int], trial: Trial, fit: _Fit) -> Contact:
    c = Coefficients(
        k=math.exp(min(max(theta[shared["k"]], -5.0), 20.0)),
        f=math.exp(min(max(theta[shared["f"]], -12.0), 12.0)),
        mu=float(theta[shared["mu"]]),
        nu=1.0,
    )
    speed = -max(float(theta[own["speed"]]), 1e-4)
    push = float(theta[own["n_in"]]) if "n_in" in own else 0.0
    return Contact(c, fit.mass_kg, speed, fit.onset, acceleration_m_s2=trial.acceleration_m_s2 + push)


class _Fit:
    """The joint fit: trials, windows, weights, and the residuals of a parameter vector."""

    def __init__(
        self, trials: Sequence[Trial], mass_kg: float, onset: Onset, plane_sd_m: float, pushed: bool
    ) -> None:
        self.trials, self.mass_kg, self.onset, self.plane_sd_m = list(trials), mass_kg, onset, plane_sd_m
        self.parameters = _Parameters(trials, pushed)
        self.impacts = [find_impact(trial) for trial in trials]
        self.sd = dict(_FIRST_SD)
        self._memory: dict[int, dict[tuple[float, ...], dict[str, Array]]] = {}
        position = float(np.median([impact.noise_m for impact in self.impacts]))
        for name in ("normal_m", "tangential_m", "vertical_m"):
            self.sd[name] = max(position, 1e-5)
        self.windows = [
            _cut(trial, *_first_span(trial, impact))
            for trial, impact in zip(self.trials, self.impacts, strict=True)
        ]

    def predict(self, theta: Array, i: int) -> dict[str, Array]:
        """The model at the samples of trial i, by channel."""
        trial = self.trials[i]
        shared, own = self.parameters.of_mode(trial.mode), self.parameters.own[i]
        shapes = self._shapes(theta, i)
        out: dict[str, Array] = {}
        for name, series in self.windows[i].series.items():
            if name == "normal_m":
                out[name] = theta[0] + shapes[name]
            elif name == "vertical_m":
                free = theta[own["z0"]] + theta[own["vz"]] * (series.time_s - theta[own["onset"]])
                out[name] = free + theta[shared["nu"]] * shapes[name]
            elif name == "tangential_m":
                out[name] = theta[own["y0"]] + theta[own["vy"]] * shapes[name]
            elif name.startswith("tangential"):
                out[name] = theta[own["vy"]] * shapes[name]
            else:
                out[name] = shapes[name]
            self._add_push(out, theta, i, name)
        return out

    def _add_push(self, out: dict[str, Array], theta: Array, i: int, name: str) -> None:
        """The controller's accelerations outside the contact."""
        own, axis = self.parameters.own[i], name[0]
        if f"{axis}_after" not in own or name.endswith("_n"):
            return
        shapes = self._shapes(theta, i)
        late, early = shapes[name + " late"], shapes[name + " early"]
        after, before = theta[own[f"{axis}_after"]], theta[own[f"{axis}_before"]]
        if axis == "n":  # the contact's own push is in its shape, before and after it as well
            after, before = after - theta[own["n_in"]], before - theta[own["n_in"]]
        if name.endswith("_s"):
            out[name] = out[name] + after * late + before * early
        else:
            out[name] = out[name] + 0.5 * (after * late * late + before * early * early)

    def _shapes(self, theta: Array, i: int) -> dict[str, Array]:
        """What the channels need of the contact: the part that is not linear in the parameters.

        Remembered for the last few contacts, because derivatives by the linear parameters ask for the same.
        """
        trial, window = self.trials[i], self.windows[i]
        shared, own = self.parameters.of_mode(trial.mode), self.parameters.own[i]
        onset = float(theta[own["onset"]])
        push = float(theta[own["n_in"]]) if "n_in" in own else 0.0
        key = (onset, push, float(theta[own["speed"]]), *(float(theta[shared[n]]) for n in ("k", "f", "mu")))
        memory = self._memory.setdefault(i, {})
        if key in memory:
            return memory[key]
        contact = _contact(theta, shared, own, trial, self)
        shapes: dict[str, Array] = {}
        for name, series in window.series.items():
            t = series.time_s - onset
            shapes[name + " late"] = np.maximum(t - contact.end_s, 0.0)
            shapes[name + " early"] = np.minimum(t, 0.0)
            if name.startswith("normal"):
                shapes[name] = contact.normal(t)[("normal_m", "normal_m_s", "normal_force_n").index(name)]
            elif name == "vertical_m":
                shapes[name] = contact.lifted(t)[0]
            elif name == "tangential_force_n":
                shapes[name] = -contact.coefficients.mu * contact.normal(t)[2] * contact.along(t)[1]
            else:
                shapes[name] = contact.along(t)[0 if name == "tangential_m" else 1]
        if len(memory) >= _REMEMBERED:
            memory.clear()
        memory[key] = shapes
        return shapes

    def block(self, theta: Array, i: int) -> Array:
        """Weighted residuals of trial i."""
        window = self.windows[i]
        predicted = self.predict(theta, i)
        parts = [
            window.counts[name] * (predicted[name] - series.value) / self.sd[name]
            for name, series in window.series.items()
        ]
        return np.concatenate(parts)

    def _prior(self, theta: Array) -> Array:
        """The plane's position; and next to nothing on the coefficients, so that none is ever singular."""
        weak = []
        for mode in self.parameters.modes:
            at = self.parameters.of_mode(mode)
            weak += [
                (theta[at["k"]] - 7.5) / 20.0, (theta[at["f"]] - 2.5) / 20.0,
                theta[at["mu"]] / 1e3, theta[at["nu"]] / 1e4,
            ]  # fmt: skip
        for own in self.parameters.own:
            weak += [theta[j] / _PUSH_SD_M_S2 for name, j in own.items() if name.endswith(_PUSHES)]
            if "n_in" in own:
                weak.append((theta[own["n_in"]] - theta[own["n_before"]]) / _PUSH_CHANGE_SD_M_S2)
        return np.array([theta[0] / self.plane_sd_m, *weak])

    def residuals(self, theta: Array) -> Array:
        return np.concatenate([self.block(theta, i) for i in range(len(self.trials))] + [self._prior(theta)])

    def jacobian(self, theta: Array) -> Array:
        """Central differences; a trial is evaluated only for what it depends on."""
        blocks = []
        for i, trial in enumerate(self.trials):
            rows = self.block(theta, i).size
            block = np.zeros((rows, theta.size))
            for j in self.parameters.of_trial(i, trial.mode):
                block[:, j] = self._difference(theta, j, lambda x, i=i: self.block(x, i))
            blocks.append(block)
        prior = np.stack([self._difference(theta, j, self._prior) for j in range(theta.size)], axis=1)
        return np.concatenate([*blocks, prior])

    @staticmethod
    def _difference(theta: Array, j: int, function: Any) -> Array:
        h = 1e-6 * max(1.0, abs(float(theta[j])))
        up, down = theta.copy(), theta.copy()
        up[j] += h
        down[j] -= h
        difference: Array = (function(up) - function(down)) / (2.0 * h)
        return difference

    def cut(self, i: int, begin: float, end: float) -> None:
        """Fit trial i between two of its times."""
        self.windows[i] = _cut(self.trials[i], begin, end)
        self._memory.pop(i, None)

    def bounds(self) -> tuple[Array, Array]:
        """Limits that no impact in question goes beyond: they keep the search where the data are."""
        low, high = np.full(self.parameters.size, -np.inf), np.full(self.parameters.size, np.inf)
        for mode in self.parameters.modes:
            at = self.parameters.of_mode(mode)
            low[at["k"]], high[at["k"]] = math.log(10.0), math.log(1e6)
            low[at["f"]], high[at["f"]] = math.log(1e-3), math.log(1e4)
            low[at["mu"]], high[at["mu"]] = 0.0, 1e3
        low[0], high[0] = -0.2, 0.2
        for own, impact in zip(self.parameters.own, self.impacts, strict=True):
            low[own["onset"]], high[own["onset"]] = impact.turn_s - 0.2, impact.turn_s + 0.02
            low[own["speed"]], high[own["speed"]] = 0.4 * -impact.approach_m_s, 2.0 * -impact.approach_m_s
        return low, high

    # -- starting point --

    def start(self) -> Array:
        """Approach lines from the samples before, coefficients from a coarse search."""
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
            at = self.parameters.of_mode(mode)
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
        """The onset time at which this contact turns when the recording does."""
        trial, own = self.trials[i], self.parameters.own[i]
        contact = _contact(theta, self.parameters.of_mode(trial.mode), own, trial, self)
        end = contact.end_s if math.isfinite(contact.end_s) else 0.3
        t = np.linspace(0.0, end, 60)
        theta[own["onset"]] = self.impacts[i].turn_s - float(t[np.argmin(contact.normal(t)[0])])

    def _rough_cost(self, theta: Array, i: int) -> float:
        series = self.windows[i].series["normal_m"]
        shared, own = self.parameters.of_mode(self.trials[i].mode), self.parameters.own[i]
        contact = _contact(theta, shared, own, self.trials[i], self)
        error = series.value - contact.normal(series.time_s - theta[own["onset"]])[0]
        # The plane may be off by centimetres: its part of the error is a constant.
        return float(np.mean(np.abs(error - np.median(error))))


def _first_span(trial: Trial, impact: TrialImpact) -> tuple[float, float]:
    if trial.acceleration_m_s2 < 0.0:
        # A drop is free fall only from its release on, and after the rebound only until the next contact.
        fall = 0.85 * -impact.approach_m_s / -trial.acceleration_m_s2
        rise = 1.5 * impact.rebound_m_s / -trial.acceleration_m_s2
        return impact.turn_s - 0.03 - min(fall, _BEFORE_S), impact.turn_s + 0.04 + min(rise, _BEFORE_S)
    return impact.turn_s - 0.05 - _BEFORE_S, impact.turn_s + 0.06 + _AFTER_S


def _cut(trial: Trial, begin: float, end: float) -> _Window:
    series, counts = {}, {}
    for name in CHANNELS:
        if name in trial.series:
            time, value = trial.series[name]
            inside = (time >= begin) & (time <= end)
            if name == "normal_m" and inside.sum() < 8:
                raise InputError("too few samples about the impact", source=trial.name)
            if inside.any():
                series[name] = Series(time[inside], value[inside])
                counts[name] = np.ones(int(inside.sum()))
    return _Window(series, counts)


# --- the fit --------------------------------------------------------------------------------------------


def identify(
    trials: Sequence[Trial], mass_kg: float, onset: Onset, *, plane_sd_m: float = PLANE_SD_M
) -> Identification:
    """Coefficients per mode from trials at one plane (paper, Sec. IV-B and V-A).

    Args:
        trials: recordings; all share the plane, those of one mode its coefficients.
        mass_kg: vehicle mass.
        onset: onset rule of the model that is fitted; k and f depend on it a little.
        plane_sd_m: how well the plane's position is known beforehand, standard deviation.

    Raises:
        InputError: SciPy is missing, or a trial cannot be used (its name and why).
    """
    return _solve(trials, mass_kg, onset, plane_sd_m)[0]


def _solve(
    trials: Sequence[Trial], mass_kg: float, onset: Onset, plane_sd_m: float, *, may_curve: bool = True
) -> tuple[Identification, _Fit, Array]:
    try:
        from scipy.optimize import least_squares  # noqa: PLC0415
    except ImportError:
        raise InputError("needs SciPy: pip install dart-flight[identify]") from None
    if not trials:
        raise InputError("no trials")
    usable, notes = _without_derived(trials)

    def descend(fit: _Fit, theta: Array, losses: Sequence[str]) -> Array:
        low, high = fit.bounds()
        for turn, loss in enumerate(losses, 1):
            result = least_squares(
                fit.residuals, np.clip(theta, low, high), fit.jacobian, bounds=(low, high), x_scale="jac",
                loss=loss, f_scale=2.0, max_nfev=80,
            )  # fmt: skip
            theta = result.x
            _judge(fit, theta)
            if turn < len(losses):
                _refine(fit, theta)
        return theta

    fit = _Fit(usable, mass_kg, onset, plane_sd_m, pushed=False)
    theta = descend(fit, fit.start(), ("soft_l1", "linear", "linear"))
    if may_curve and _is_curved(fit, theta):
        notes.append("free flight is not straight: accelerations before and after the contact are estimated")
        pushed = _Fit(usable, mass_kg, onset, plane_sd_m, pushed=True)
        pushed.sd = dict(fit.sd)
        start = np.zeros(pushed.parameters.size)
        start[: 1 + 4 * len(fit.parameters.modes)] = theta[: 1 + 4 * len(fit.parameters.modes)]
        for old, new in zip(fit.parameters.own, pushed.parameters.own, strict=True):
            for name, j in old.items():
                start[new[name]] = theta[j]
        fit, theta = pushed, descend(pushed, start, ("soft_l1", "linear", "linear"))
    return _conclude(fit, theta, notes), fit, theta


def _is_curved(fit: _Fit, theta: Array) -> bool:
    """Whether the residuals of any wall hit bend, before or after the contact, more than noise does."""
    for i, trial in enumerate(fit.trials):
        if trial.acceleration_m_s2 != 0.0:
            continue
        begin, end, _ = _span(fit, theta, i)
        predicted = fit.predict(theta, i)
        for name in ("normal_m", "tangential_m", "vertical_m"):
            if name not in predicted:
                continue
            time, value = fit.windows[i].series[name]
            # From third differences: what bends does not add to it, as it would to the residuals.
            sd = noise_of(fit.trials[i].series[name])
            for part in (time < begin, time > end):
                part &= fit.windows[i].counts[name] > 0.0
                if part.sum() < 8:
                    continue
                t = time[part] - time[part].mean()
                bend = np.stack((np.ones_like(t), t, 0.5 * t * t), axis=1)
                error = (value - predicted[name])[part]
                inverse = np.linalg.pinv(bend.T @ bend)
                curvature = float((inverse @ bend.T @ error)[2])
                if abs(curvature) > _CURVED * sd * math.sqrt(float(inverse[2, 2])):
                    return True
    return False


def _without_derived(trials: Sequence[Trial]) -> tuple[list[Trial], list[str]]:
    """Leave out velocities that were only differenced from the positions: they would count twice."""
    kept, notes = [], []
    for trial in trials:
        series = dict(trial.series)
        for axis in ("normal", "tangential"):
            position, velocity = series.get(f"{axis}_m"), series.get(f"{axis}_m_s")
            if position is None or velocity is None or position.time_s.size < 20:
                continue
            slope = np.gradient(position.value, position.time_s)
            own = velocity.value - np.interp(velocity.time_s, position.time_s, slope)
            noise = np.std(np.diff(slope, 2)) / math.sqrt(6.0)
            if np.median(np.abs(own)) < 0.2 * noise:
                del series[f"{axis}_m_s"]
                notes.append(f"{trial.name}: {axis}_m_s is the derivative of {axis}_m and was not used")
        kept.append(replace(trial, series=series))
    return kept, notes


def _judge(fit: _Fit, theta: Array) -> None:
    """Refuse a trial that has hardly a sample in contact."""
    for i, trial in enumerate(fit.trials):
        n = _in_contact(fit, theta, i)
        if n < _LEAST_IN_CONTACT:
            raise InputError(
                f"{n} sample{'' if n == 1 else 's'} in contact, at least {_LEAST_IN_CONTACT} are needed",
                source=trial.name,
            )


def _span(fit: _Fit, theta: Array, i: int) -> tuple[float, float, Contact]:
    trial, own = fit.trials[i], fit.parameters.own[i]
    contact = _contact(theta, fit.parameters.of_mode(trial.mode), own, trial, fit)
    begin = float(theta[own["onset"]])
    return begin, begin + (contact.end_s if math.isfinite(contact.end_s) else 0.3), contact


def _in_contact(fit: _Fit, theta: Array, i: int) -> int:
    begin, end, _ = _span(fit, theta, i)
    time = fit.trials[i].normal.time_s
    return int(np.sum((time >= begin) & (time <= end)))


def _refine(fit: _Fit, theta: Array) -> None:
    """Windows about the contact that was found, deviations from the residuals, outliers out."""
    errors: dict[str, list[Array]] = {}
    for i, trial in enumerate(fit.trials):
        begin, end, contact = _span(fit, theta, i)
        if trial.acceleration_m_s2 < 0.0:
            g = -trial.acceleration_m_s2
            before = min(0.85 * -contact.normal_m_s / g, _BEFORE_S)
            after = min(1.5 * max(float(contact.normal(end - begin)[1]), 0.0) / g, _BEFORE_S)
        else:
            before, after = _BEFORE_S, _AFTER_S
        fit.cut(i, begin - before, end + after)
        for name, predicted in fit.predict(theta, i).items():
            errors.setdefault(name, []).append(predicted - fit.windows[i].series[name].value)
    for name, parts in errors.items():
        all_errors = np.concatenate(parts)
        robust = 1.4826 * float(np.median(np.abs(all_errors)))
        for i, window in enumerate(fit.windows):
            if name in window.series:
                own = fit.predict(theta, i)[name] - window.series[name].value
                window.counts[name][:] = np.abs(own) <= _OUTLIER * max(robust, 1e-9)
        kept = all_errors[np.abs(all_errors) <= _OUTLIER * max(robust, 1e-9)]
        fit.sd[name] = max(float(np.sqrt(np.mean(kept**2))), 1e-7)


def _correlation(fit: _Fit, theta: Array) -> float:
    """Factor on the variances for residuals that are not independent, from their lag-1 correlation."""
    products, squares, n = 0.0, 0.0, 0
    for i, window in enumerate(fit.windows):
        for name, predicted in fit.predict(theta, i).items():
            e = window.counts[name] * (predicted - window.series[name].value) / fit.sd[name]
            products += float(np.sum(e[1:] * e[:-1]))
            squares += float(np.sum(e * e))
            n += e.size
    rho = min(products / squares if squares > 0.0 else 0.0, 0.95)
    sure = rho - 2.0 / math.sqrt(n)  # what chance alone gives is no correlation
    return (1.0 + rho) / (1.0 - rho) if sure > 0.0 else 1.0


def covariance(fit: _Fit, theta: Array) -> Array:
    """Covariance of all parameters at the fit's weights: inverse information of data and priors."""
    jacobian = fit.jacobian(theta)
    scale = np.sqrt(np.sum(jacobian**2, axis=0))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), rcond=1e-14, hermitian=True)
    result: Array = inverse / np.outer(scale, scale)
    return result


def _conclude(fit: _Fit, theta: Array, notes: list[str]) -> Identification:
    data = sum(int(sum(counts.sum() for counts in window.counts.values())) for window in fit.windows)
    squares = sum(float(np.sum(fit.block(theta, i) ** 2)) for i in range(len(fit.trials)))
    freedom = max(data - fit.parameters.size, 1)
    spread = max(squares / freedom, 1e-12) * _correlation(fit, theta)
    deviation = np.sqrt(np.diag(covariance(fit, theta)) * spread)

    coefficients: dict[str, dict[str, Estimate | None]] = {}
    side: int | None = None
    for mode in fit.parameters.modes:
        at = fit.parameters.of_mode(mode)
        members = [i for i, trial in enumerate(fit.trials) if trial.mode == mode]
        found: dict[str, Estimate | None] = {}
        for name in ("k", "f"):
            half = _T95 * float(deviation[at[name]])
            value = float(theta[at[name]])
            known = half < _WIDEST_LOG
            found[name] = (
                Estimate(*(math.exp(v) for v in (value, value - half, value + half))) if known else None
            )
            if not known:
                notes.append(f"{mode}: {name} cannot be told from these trials")
        found["mu"] = _friction(fit, theta, deviation, members)
        found["nu"], up = _vertical(fit, theta, deviation, members)
        side = up if up is not None else side
        if found["mu"] is None:
            notes.append(
                f"{mode}: no mu, because the trials show no motion along the wall that friction changes"
            )
        if found["nu"] is None:
            notes.append(
                f"{mode}: no nu, because the trials show no vertical motion that the contact changes"
            )
        allowed = {n: max(fit.trials[i].allowance.get(n, 0.0) for i in members) for n in found}
        coefficients[mode] = {n: _widened(e, allowed[n]) for n, e in found.items()}
    half = _T95 * float(deviation[0])
    plane = Estimate(float(theta[0]), float(theta[0]) - half, float(theta[0]) + half)
    return Identification(coefficients, plane, _residuals(fit, theta), _trial_fits(fit, theta), side, notes)


def _widened(estimate: Estimate | None, share: float) -> Estimate | None:
    """The interval with a share of the value added at both ends."""
    if estimate is None:
        return None
    more = share * abs(estimate.value)
    return Estimate(estimate.value, max(estimate.low - more, 0.0), estimate.high + more)


def _friction(fit: _Fit, theta: Array, deviation: Array, members: list[int]) -> Estimate | None:
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["mu"]
    moving = False
    change = 0.0  # exponent of the slowing per s/m of mu: how strongly mu acts at all
    for i in members:
        own = fit.parameters.own[i]
        if "vy" in own:
            moving |= abs(theta[own["vy"]]) > max(5.0 * float(deviation[own["vy"]]), 0.02)
            _, end, contact = _span(fit, theta, i)
            change = max(change, float(contact.impulse(end)) / fit.mass_kg)
    value, half = float(theta[at]), _T95 * float(deviation[at])
    if not moving or (half > value and half * change > 0.3):
        return None
    return Estimate(value, max(value - half, 0.0), value + half)


def _vertical(
    fit: _Fit, theta: Array, deviation: Array, members: list[int]
) -> tuple[Estimate | None, int | None]:
    """Nu by its size, and the side on which the force acts."""
    at = fit.parameters.of_mode(fit.trials[members[0]].mode)["nu"]
    if not any("z0" in fit.parameters.own[i] for i in members):
        return None, None
    value, half = abs(float(theta[at])), _T95 * float(deviation[at])
    if half > max(value, 1.0):
        return None, None
    side = None if half > value else 1 if theta[at] > 0.0 else -1
    return Estimate(value, max(value - half, 0.0), value + half), side


def _residuals(fit: _Fit, theta: Array) -> dict[str, float]:
    errors: dict[str, list[Array]] = {}
    for i, window in enumerate(fit.windows):
        for name, predicted in fit.predict(theta, i).items():
            kept = window.counts[name] > 0.0
            errors.setdefault(name, []).append((predicted - window.series[name].value)[kept])
    return {name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) for name, parts in errors.items()}


def _trial_fits(fit: _Fit, theta: Array) -> list[TrialFit]:
    fits = []
    for i, trial in enumerate(fit.trials):
        own = fit.parameters.own[i]
        along = float(theta[own["vy"]]) if "vy" in own else None
        onset, speed = float(theta[own["onset"]]), -float(theta[own["speed"]])
        push = tuple(float(theta[own[f"n_{when}"]]) if "n_after" in own else 0.0 for when in _PUSHES)
        samples = _in_contact(fit, theta, i)
        fits.append(TrialFit(trial.name, trial.mode, onset, speed, along, samples, (push[0], push[1])))
    return fits


def deviation_bound(
    trials: Sequence[Trial],
    mass_kg: float,
    onset: Onset,
    noise: dict[str, float],
    *,
    plane_sd_m: float = PLANE_SD_M,
) -> dict[str, dict[str, float]]:
    """Cramér-Rao bound: the smallest standard deviation any unbiased estimate of k, f, mu, nu can have.

    Onset times, approach velocities and the plane (with its prior) are unknown, as they are in `identify`;
    free flight is taken to be straight.

    Args:
        trials: (nearly) noise-free recordings, at the sample times of those in question.
        mass_kg, onset, plane_sd_m: as `identify`.
        noise: standard deviation of the noise by channel.

    Returns:
        mode -> coefficient -> bound, in the coefficient's unit.
    """
    found, fit, theta = _solve(trials, mass_kg, onset, plane_sd_m, may_curve=False)
    fit.sd.update(noise)
    deviation = np.sqrt(np.diag(covariance(fit, theta)))
    bounds = {}
    for mode in found.coefficients:
        at = fit.parameters.of_mode(mode)
        bounds[mode] = {
            "k": float(deviation[at["k"]] * math.exp(theta[at["k"]])),
            "f": float(deviation[at["f"]] * math.exp(theta[at["f"]])),
            "mu": float(deviation[at["mu"]]),
            "nu": float(deviation[at["nu"]]),
        }
    return bounds
