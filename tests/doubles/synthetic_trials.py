"""Trials simulated from known coefficients, with the sampling and the noise of a laboratory's sensors."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.config.vehicle.airframe import Coefficients
from dart_flight.contact.coefficients import Array
from dart_flight.contact.contact_map import drop
from dart_flight.contact.law import Onset
from dart_flight.lab.csv_text import csv_text
from dart_flight.lab.identify.trials import Series, Trial
from dart_flight.lab.predict.path import ContactMotion, trajectory

MASS_KG = 1.3


def _sampled(begin: float, end: float, rate_hz: float, random: np.random.Generator) -> Array:
    """Return the sample times of a camera with a random phase."""
    return np.arange(begin + random.uniform(0.0, 1.0 / rate_hz), end, 1.0 / rate_hz)


def wall_trial(
    c: Coefficients,
    normal_m_s: float,
    random: np.random.Generator,
    *,
    onset: Onset = Onset.LCP,
    tangential_m_s: float | None = None,
    rate_hz: float = 240.0,
    noise_m: float = 0.001,
    plane_m: float = 0.0,
    with_vertical: bool = False,
    force_noise_n: float | None = None,
    mode: str = "unlabelled",
    name: str = "wall",
    before_s: float = 0.5,
    after_s: float = 0.25,
) -> Trial:
    """Return one wall hit as motion capture records it.

    Args:
        c: true coefficients.
        normal_m_s: normal velocity at the onset (negative).
        tangential_m_s: velocity along the wall. If None, no position along the wall is recorded.
        plane_m: position of the plane in the recording.
        with_vertical: whether the height is also recorded.
        force_noise_n: noise of the recorded normal force. If None, no force is recorded.
        before_s, after_s: recorded time before and after the contact.
    """
    contact = ContactMotion(c, MASS_KG, normal_m_s, onset)
    t = _sampled(-before_s, contact.end_s + after_s, rate_hz, random)
    path = trajectory(contact, t, tangential_m_s or 0.0)
    start = random.uniform(5.0, 20.0)  # the recording began earlier

    def noisy(value: Array, sd: float) -> Series:
        return Series(t + start, value + random.normal(0.0, sd, t.size))

    series = {"normal_m": noisy(path.normal_m + plane_m, noise_m)}
    if tangential_m_s is not None:
        series["tangential_m"] = noisy(path.tangential_m + random.uniform(-1.0, 1.0), noise_m)
    if with_vertical:
        # Heights: Z of the collision frame points down at a wall.
        series["vertical_m"] = noisy(1.0 - path.vertical_m, noise_m)
    if force_noise_n is not None:
        series["normal_force_n"] = noisy(path.normal_force_n, force_noise_n)
    return Trial(name, series, mode)


def drop_trial(
    c: Coefficients,
    height_m: float,
    random: np.random.Generator,
    *,
    onset: Onset = Onset.LCP,
    rate_hz: float = 1000.0,
    noise_m: float = 0.0005,
    plane_m: float = 0.0,
    mode: str = "unlabelled",
    name: str = "drop",
    held_s: float = 0.3,
) -> Trial:
    """Return one drop as a high-speed camera records it: held, released, in contact, rebounding to its apex.

    The arguments are those of `wall_trial`; `held_s` is the recorded time before the release.
    """
    numbers = drop(c, MASS_KG, height_m, onset)
    contact = ContactMotion(c, MASS_KG, -numbers.onset_speed_m_s, onset, acceleration_m_s2=-GRAVITY_M_S2)
    if not math.isfinite(contact.end_s):
        raise ValueError("this drop does not rebound")
    apex = float(contact.normal(contact.end_s)[1]) / GRAVITY_M_S2
    t = _sampled(-numbers.onset_s - held_s, contact.end_s + apex, rate_hz, random)
    x = np.where(t < -numbers.onset_s, height_m, contact.normal(t)[0])
    start = random.uniform(0.0, 3.0)
    return Trial(
        name,
        {"normal_m": Series(t + start, x + plane_m + random.normal(0.0, noise_m, t.size))},
        mode,
        -GRAVITY_M_S2,
    )


def write_csv(trial: Trial, path: Path) -> None:
    """Write a trial as a CSV file for `dart-flight identify`; all series must have the same times."""
    columns = [series.value.tolist() for series in trial.series.values()]
    rows = (
        [f"{time:.6f}", *(f"{value:.7g}" for value in values)]
        for time, *values in zip(trial.normal.time_s.tolist(), *columns, strict=True)
    )
    path.write_text(csv_text([["time_s", *trial.series], *rows]), newline="")
