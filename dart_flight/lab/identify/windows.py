"""Selection and weights of the samples in a fit.

In *free flight*, a sample that deviates by more than five standard deviations is a recording error and is
rejected. In *contact*, this test would reject good samples, because most large deviations there are model
errors of the law. The contact therefore has its own scale, estimated from its own residuals, and its outlying
samples get smaller weights (Huber). A sample in contact is excluded only if the samples before and after it
fit well. At most a tenth of a contact's samples is excluded, and a note gives their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.config.document import InputError
from dart_flight.contact.coefficients import Array
from dart_flight.lab.identify.recorded_impact import deviation_of
from dart_flight.lab.identify.trials import Trial

Mask = NDArray[np.bool_]

_OUTLIER = 5.0  # number of standard deviations beyond which a sample in free flight is rejected
_HUBER = 3.0  # number of standard deviations in contact beyond which a sample is weighted down
_SPIKE = 8.0  # number of standard deviations in contact beyond which a single sample is excluded
MAX_SET_ASIDE = 0.1  # maximum fraction of a contact's samples that may be excluded
_LIKE_FREE = 1.5  # residuals in contact over those in free flight below which both count as noise

CHANNELS = (
    "normal_m", "normal_m_s", "normal_force_n", "tangential_m", "tangential_m_s", "tangential_force_n",
    "vertical_m",
)  # fmt: skip


class Channel(NamedTuple):
    """The fitted samples of one channel of a trial.

    Attributes:
        counts: weight of each residual. Weight 0 ignores the sample, weight 1 assumes the noise of free
            flight.
        contact: mask of the samples in contact, as predicted by the law or as measured without a law
            (`measured_impacts`).
    """

    time_s: Array
    value: Array
    counts: Array
    contact: Mask


def cut(trial: Trial, begin: float, end: float) -> dict[str, Channel]:
    """Return the samples of a trial from `begin` to `end`, all with weight 1; reject too few samples."""
    window = {}
    for name in CHANNELS:
        if name in trial.series:
            time, value = trial.series[name]
            inside = (time >= begin) & (time <= end)
            n = int(inside.sum())
            if name == "normal_m" and n < 8:
                raise InputError("too few samples around the impact", source=trial.name)
            if n:
                window[name] = Channel(time[inside], value[inside], np.ones(n), np.zeros(n, dtype=bool))
    return window


def weigh(errors: Sequence[Array], contacts: Sequence[Mask]) -> tuple[list[Array], float]:
    """Return the weights of one channel's residuals per trial, and the standard deviation in free flight.

    A sample with this standard deviation has weight 1. `contacts` are masks of the samples in contact.
    """
    free = np.concatenate([e[~c] for e, c in zip(errors, contacts, strict=True)])
    hit = np.concatenate([e[c] for e, c in zip(errors, contacts, strict=True)])
    robust = deviation_of(free if free.size >= 8 else np.concatenate((free, hit)))
    inside = free[np.abs(free) <= _OUTLIER * robust]
    if hit.size >= 4 and deviation_of(hit) < _LIKE_FREE * robust:  # as noisy as free flight
        inside = np.concatenate((inside, hit[np.abs(hit) <= _OUTLIER * robust]))
    sd = max(float(np.sqrt(np.mean(inside**2))) if inside.size else robust, 1e-7)
    scale = deviation_of(hit) if hit.size else sd
    if scale < _LIKE_FREE * sd:
        scale = sd
    counts = []
    for e, c in zip(errors, contacts, strict=True):
        size = np.abs(e)
        weight = np.where(
            c,
            sd / scale * np.sqrt(np.minimum(1.0, _HUBER * scale / np.maximum(size, 1e-12))),
            (size <= _OUTLIER * robust).astype(float),
        )
        weight[_spikes(size, c, scale)] = 0.0
        counts.append(weight)
    return counts, sd


def _spikes(size: Array, contact: Mask, scale: float) -> NDArray[np.intp]:
    """Return the samples in contact to exclude: outliers between good neighbours, the worst first."""
    far = contact & (size > _SPIKE * scale)
    near = size <= _HUBER * scale
    before = np.concatenate(([True], near[:-1]))
    after = np.concatenate((near[1:], [True]))
    alone = np.flatnonzero(far & before & after)
    most = math.floor(MAX_SET_ASIDE * int(contact.sum()))
    return alone[np.argsort(size[alone])[::-1][:most]]
