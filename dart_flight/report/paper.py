"""What the paper published about collisions, and our model beside it: the tables of `dart-flight tables`.

The published figures are data here; everything computed is computed from the vehicle's configuration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.contact_map import collide, drop
from dart_flight.contact.law import Onset
from dart_flight.samples import Mode


class PublishedDrop(NamedTuple):
    """Average of three drops on concrete (paper, Sec. III)."""

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
# In flight against acrylic (Sec. V-A): approach, and how well the paper's peak acceleration met its own
# measurement ("accuracy", over three trials). The measured values themselves are not published.
FLIGHT_APPROACH_M_S = (-1.0, 0.5)
FLIGHT_ACCURACY = {Mode.FLEXIBLE: 0.88, Mode.RIGID: 0.82}
STIFFNESS_RATIO = 7.0  # abstract and conclusion: "seven times higher stiffness"


def published_drop(height_m: float, mode: Mode) -> PublishedDrop | None:
    """The published drop of this height and mode, if there is one."""
    return next((row for row in DROPS if row.mode is mode and abs(row.height_m - height_m) < 1e-9), None)


class DropRow(NamedTuple):
    """A published drop and the model's; errors are model / published - 1."""

    published: PublishedDrop
    onset: Onset
    contact_time_s: float
    max_rebound_speed_m_s: float
    peak_force_n: float
    contact_time_error: float
    rebound_error: float


def drop_rows(vehicle: VehicleConfig) -> Iterator[DropRow]:
    """The drop tests, both heights, modes and onset rules.

    Raises:
        KeyError: the configuration has no concrete.
    """
    for onset in Onset:
        for row in DROPS:
            c = vehicle.materials[DROP_SURFACE].of(row.mode)
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


class FlightRow(NamedTuple):
    """Peaks of the in-flight collision; accelerations are force over mass."""

    mode: Mode
    onset: Onset
    peak_normal_force_n: float
    peak_friction_force_n: float
    peak_vertical_force_n: float
    peak_normal_m_s2: float
    peak_friction_m_s2: float
    accuracy: float


def flight_rows(vehicle: VehicleConfig) -> Iterator[FlightRow]:
    """The in-flight collision of Sec. V-A, both modes and onset rules.

    Raises:
        KeyError: the configuration has no acrylic.
    """
    mass = vehicle.airframe.mass_kg
    for onset in Onset:
        for mode in Mode:
            c = vehicle.materials[FLIGHT_SURFACE].of(mode)
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
    """Rigid over flexible stiffness per material."""
    return {name: m.rigid.k / m.flexible.k for name, m in vehicle.materials.items()}


def _table(header: list[str], rows: list[list[str]]) -> str:
    align = ["---"] * 2 + ["---:"] * (len(header) - 2)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, align, *rows))


def page(vehicle: VehicleConfig) -> str:
    """`docs/paper_tables.md`: the paper's figures and the model's side by side."""
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
        means.append(f"`{onset.value}` {time:.1%} in contact time and {speed:.1%} in rebound speed")
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
    normal, tangential = FLIGHT_APPROACH_M_S
    return f"""# The paper's tables

Generated by `dart-flight tables`; do not edit. Model: closed form, {
        vehicle.airframe.mass_kg:g} kg, coefficients
of the configuration. The onset rules `lcp` and `touch` are explained in [contact.md](contact.md).

## Drop tests

Concrete, gravity along the normal, released at rest; published values are averages of three trials
(Sec. III).

{
        _table(
            [
                "drop",
                "onset",
                "contact ms, paper",
                "model",
                "error",
                "rebound m/s, paper",
                "model",
                "error",
                "peak force N",
            ],
            drops,
        )
    }

Mean size of the error: {"; ".join(means)}.

## Peaks in flight

Acrylic, {normal:g} m/s along the normal, {
        tangential:g} m/s along the wall (Sec. V-A). The paper gives no values,
only how closely its peak acceleration met the measured one over three trials (last column).

{
        _table(
            [
                "mode",
                "onset",
                "normal N",
                "friction N",
                "vertical N",
                "normal m/s²",
                "friction m/s²",
                "agreement in the paper",
            ],
            flights,
        )
    }

## Stiffness ratio

Rigid over flexible; the paper states {STIFFNESS_RATIO:g} (abstract), from the drop tests.

{_table(["surface", "source of the coefficients", "k rigid / k flexible"], ratios)}
"""
