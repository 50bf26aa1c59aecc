"""The tables of `dart-flight tables`, which compare the paper's figures on collisions with the model.

This module contains the published figures, and computes the model's figures from the configuration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import VehicleConfig, packaged
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import collide, drop, drop_map
from dart_flight.contact.law import Onset
from dart_flight.planning.predicted_flight import predict_mission


class PublishedDrop(NamedTuple):
    """The average of three drops on concrete (paper, Sec. III)."""

    height_m: float
    mode: Mode
    contact_time_s: float
    max_rebound_speed_m_s: float


DROPS = (
    PublishedDrop(0.05, Mode.RIGID, 0.046, 0.74),
    PublishedDrop(0.05, Mode.FLEXIBLE, 0.177, 0.70),
    PublishedDrop(0.2, Mode.RIGID, 0.052, 1.59),
    PublishedDrop(0.2, Mode.FLEXIBLE, 0.145, 1.34),
)
DROP_SURFACE, FLIGHT_SURFACE = "concrete", "acrylic"
SURFACES = (DROP_SURFACE, FLIGHT_SURFACE, "wood")  # materials that the tables need
# Collision in flight with acrylic (Sec. V-A): approach, and agreement of the paper's predicted and measured
# peak acceleration ("accuracy", over three trials). The measured values are not published.
FLIGHT_APPROACH_M_S = (-1.0, 0.5)
FLIGHT_ACCURACY = {Mode.FLEXIBLE: 0.88, Mode.RIGID: 0.82}
STIFFNESS_RATIO = 7.0  # the paper's abstract and conclusion: "seven times higher stiffness"


def published_drop(height_m: float, mode: Mode) -> PublishedDrop | None:
    return next((row for row in DROPS if row.mode is mode and abs(row.height_m - height_m) < 1e-9), None)


class DropRow(NamedTuple):
    """A published drop and the model's prediction; errors are model / published - 1."""

    published: PublishedDrop
    onset: Onset
    contact_time_s: float
    max_rebound_speed_m_s: float
    peak_force_n: float
    contact_time_error: float
    rebound_error: float


def drop_rows(vehicle: VehicleConfig) -> Iterator[DropRow]:
    """Yield the drop tests for both heights, modes and onset rules; the vehicle must have `concrete`."""
    for onset in Onset:
        for row in DROPS:
            c = vehicle.materials[DROP_SURFACE].coefficients(row.mode)
            got = drop(c, vehicle.airframe.mass_kg, row.height_m, onset)
            yield DropRow(
                row,
                onset,
                got.contact_time_s,
                got.max_rebound_speed_m_s,
                got.peak_force_n,
                got.contact_time_s / row.contact_time_s - 1.0,
                got.max_rebound_speed_m_s / row.max_rebound_speed_m_s - 1.0,
            )


class Refit(NamedTuple):
    """Stiffness and damping fitted to published drops; the remaining errors are model / published - 1.

    Attributes:
        fitted: heights of the drops used in the fit, m.
        errors: (contact time, rebound speed) of each published height, in the order of `DROPS`.
    """

    mode: Mode
    onset: Onset
    fitted: tuple[float, ...]
    k_n_per_m: float
    f_ns_per_m: float
    errors: tuple[tuple[float, float], ...]


_REFIT_STEPS, _REFIT_ROUNDS = 41, 9
_REFIT_RANGE = ((100.0, 30_000.0), (0.3, 100.0))  # k in N/m, f in N s/m


def refits(mass_kg: float, onset: Onset) -> Iterator[Refit]:
    """Yield fits to the drops of each mode: one fit per height, then one fit to all heights.

    Each fit minimises the sum of the squared relative errors.
    """
    for mode in Mode:
        rows = [row for row in DROPS if row.mode is mode]
        for fitted in (*([row] for row in rows), rows):
            yield _refit(mass_kg, onset, rows, fitted)


def _refit(
    mass_kg: float, onset: Onset, rows: Sequence[PublishedDrop], fitted: Sequence[PublishedDrop]
) -> Refit:
    """Fit k and f by searching a grid of their logarithms, which contracts around the best point."""
    (low_k, high_k), (low_f, high_f) = np.log(_REFIT_RANGE)
    for _ in range(_REFIT_ROUNDS):
        k, f = np.meshgrid(np.linspace(low_k, high_k, _REFIT_STEPS), np.linspace(low_f, high_f, _REFIT_STEPS))
        misfit = sum(
            (
                time**2 + speed**2
                for time, speed in (_drop_errors(row, k, f, mass_kg, onset) for row in fitted)
            ),
            start=np.zeros_like(k),
        )
        best = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
        at_k, at_f = float(k[best]), float(f[best])
        reach_k, reach_f = 0.1 * (high_k - low_k), 0.1 * (high_f - low_f)
        low_k, high_k, low_f, high_f = at_k - reach_k, at_k + reach_k, at_f - reach_f, at_f + reach_f
    point = (np.array([at_k]), np.array([at_f]))
    errors = [_drop_errors(row, *point, mass_kg, onset) for row in rows]
    return Refit(
        rows[0].mode,
        onset,
        tuple(row.height_m for row in fitted),
        float(np.exp(at_k)),
        float(np.exp(at_f)),
        tuple((float(time[0]), float(speed[0])) for time, speed in errors),
    )


def _drop_errors(
    row: PublishedDrop, log_k: Array, log_f: Array, mass_kg: float, onset: Onset
) -> tuple[Array, Array]:
    """Return the relative errors of contact time (huge without a predicted rebound) and rebound speed."""
    k, f = np.exp(log_k), np.exp(log_f)
    got = drop_map(CoefficientArrays(k, f, np.zeros_like(k), np.zeros_like(k)), mass_kg, row.height_m, onset)
    time = np.where(np.isfinite(got.contact_time_s), got.contact_time_s, 1e3)
    return time / row.contact_time_s - 1.0, got.max_rebound_speed_m_s / row.max_rebound_speed_m_s - 1.0


class DualRow(NamedTuple):
    """One of the two impacts of the paper's dual collision (Sec. V-B); velocities are (normal, tangential).

    The model's entries are None if the flight model does not reach the wall.
    """

    wall: str
    mode: Mode
    published_m_s: tuple[float, float]
    model_m_s: tuple[float, float] | None
    model_peak_n: float | None


DUAL_MISSION = "paper_dual_collision.yaml"
DUAL_PUBLISHED = ((-0.6, 0.5), (-1.6, 0.25))


def dual_rows(vehicle: VehicleConfig) -> Iterator[DualRow]:
    """Yield the impacts of the dual collision, as published and as the flight model predicts them.

    The flight model has PX4's default parameters.
    """
    mission = load_mission(packaged("missions", DUAL_MISSION), packaged("configs", "dart.yaml"))
    mission = msgspec.structs.replace(mission, vehicle=vehicle)
    hits = predict_mission(mission).hits
    for collision, published in zip(mission.collisions, DUAL_PUBLISHED, strict=True):
        hit = hits.get(collision.index)
        reached = None if hit is None else (hit.normal_m_s, hit.tangential_m_s)
        peak = None if hit is None else hit.normal_n
        yield DualRow(collision.wall.name, collision.mode, published, reached, peak)


class FlightRow(NamedTuple):
    """The model's peak forces in the paper's collision in flight, also divided by the mass."""

    mode: Mode
    onset: Onset
    peak_normal_force_n: float
    peak_friction_force_n: float
    peak_vertical_force_n: float
    peak_normal_m_s2: float
    peak_friction_m_s2: float
    accuracy: float


def flight_rows(vehicle: VehicleConfig) -> Iterator[FlightRow]:
    """Yield the paper's collision in flight (Sec. V-A), once for each mode and onset rule.

    The vehicle needs the material `acrylic`.
    """
    mass = vehicle.airframe.mass_kg
    for onset in Onset:
        for mode in Mode:
            c = vehicle.materials[FLIGHT_SURFACE].coefficients(mode)
            r = collide(c, mass, *FLIGHT_APPROACH_M_S, onset)
            yield FlightRow(
                mode,
                onset,
                r.peak_normal_force_n,
                r.peak_friction_force_n,
                r.peak_vertical_force_n,
                r.peak_normal_force_n / mass,
                r.peak_friction_force_n / mass,
                FLIGHT_ACCURACY[mode],
            )


def stiffness_ratios(vehicle: VehicleConfig) -> dict[str, float]:
    """Return the ratio of rigid to flexible stiffness of each material that has both modes."""
    return {name: m.rigid.k / m.flexible.k for name, m in vehicle.materials.items() if m.flexible}


def _rows(rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def page(vehicle: VehicleConfig) -> str:
    """Return the text of `docs/paper_tables.md`, which compares the paper's figures with the model's."""
    drops = [
        [
            f"{row.published.height_m:g} m {row.published.mode.value}",
            row.onset.value,
            f"{1e3 * row.published.contact_time_s:.0f}",
            f"{1e3 * row.contact_time_s:.1f}",
            f"{row.contact_time_error:+.1%}",
            f"{row.published.max_rebound_speed_m_s:.2f}",
            f"{row.max_rebound_speed_m_s:.3f}",
            f"{row.rebound_error:+.1%}",
            f"{row.peak_force_n:.1f}",
        ]
        for row in drop_rows(vehicle)
    ]
    means = []
    for onset in Onset:
        rows = [row for row in drop_rows(vehicle) if row.onset is onset]
        time = sum(abs(row.contact_time_error) for row in rows) / len(rows)
        speed = sum(abs(row.rebound_error) for row in rows) / len(rows)
        means.append(f"with `{onset.value}`, {time:.1%} in contact time and {speed:.1%} in rebound speed")
    flights = [
        [
            row.mode.value,
            row.onset.value,
            f"{row.peak_normal_force_n:.1f}",
            f"{row.peak_friction_force_n:.1f}",
            f"{row.peak_vertical_force_n:.1f}",
            f"{row.peak_normal_m_s2:.1f}",
            f"{row.peak_friction_m_s2:.1f}",
            f"{row.accuracy:.0%}",
        ]
        for row in flight_rows(vehicle)
    ]
    ratios = [
        [name, vehicle.materials[name].source, f"{ratio:.2f}"]
        for name, ratio in stiffness_ratios(vehicle).items()
    ]
    refitted = [
        [
            row.mode.value,
            row.onset.value,
            " and ".join(f"{height:g} m" for height in row.fitted),
            f"{row.k_n_per_m:.0f}",
            f"{row.f_ns_per_m:.1f}",
            *(f"{error:+.1%}" for pair in row.errors for error in pair),
        ]
        for onset in Onset
        for row in refits(vehicle.airframe.mass_kg, onset)
    ]
    duals = [
        [
            row.wall,
            row.mode.value,
            *(f"{value:g}" for value in row.published_m_s),
            *(("-", "-") if row.model_m_s is None else (f"{value:.2f}" for value in row.model_m_s)),
            "-" if row.model_peak_n is None else f"{row.model_peak_n:.1f}",
        ]
        for row in dual_rows(vehicle)
    ]
    normal, tangential = FLIGHT_APPROACH_M_S
    return f"""# The paper's tables

`dart-flight tables` computes these tables. They compare the paper's figures with the contact model in closed
form, for a mass of {vehicle.airframe.mass_kg:g} kg and with the coefficients of the configuration.
docs/contact.md explains the onset rules `lcp` and `touch`.

## Drop tests

The vehicle is released at rest above concrete, so gravity acts along the normal. The published values are
averages of three trials (Sec. III).

| drop | onset | contact ms, paper | model | error | rebound m/s, paper | model | error | peak force N |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
{_rows(drops)}

Mean magnitude of the error: {"; ".join(means)}.

## Drop tests refitted

The table has the stiffness k and the damping f with which the model fits the published contact time and
rebound speed best: for each height alone, and for both together. Errors are relative to the published
value. One height can be fitted exactly, but no pair of k and f fits both.
The rigid mode fits worst: with the height the published contact time increases, but the law predicts that
it decreases.

| mode | onset | fitted to | k N/m | f N s/m | 0.05 m contact | rebound | 0.2 m contact | rebound |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
{_rows(refitted)}

## Peaks in flight

The vehicle hits acrylic at {normal:g} m/s along the normal and {
        tangential:g} m/s along the wall (Sec. V-A). The paper does not give the peak forces.
The last column is the paper's agreement between predicted and measured peak acceleration, over three
trials.

| mode | onset | normal N | friction N | vertical N | normal m/s² | friction m/s² | agreement in the paper |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |
{_rows(flights)}

## Dual collision

The velocities are those at each impact, in the wall's frame. The model begins with the published first
impact and uses the published recovery gains (Sec. V-B). The paper does not give its controller gains, so the
flight model uses PX4's defaults. The paper gives no coefficients of wood; the model uses those of concrete.

| wall | mode | normal m/s, paper | along, paper | normal m/s, model | along, model | peak N, model |
| --- | --- | ---: | ---: | ---: | ---: | ---: |
{_rows(duals)}

## Stiffness ratio

The ratio is the rigid stiffness divided by the flexible stiffness. The paper's abstract states a ratio of
{STIFFNESS_RATIO:g}, from the drop tests.

| surface | source of the coefficients | k rigid / k flexible |
| --- | --- | ---: |
{_rows(ratios)}
"""
