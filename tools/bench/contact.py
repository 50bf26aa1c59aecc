"""Benchmark of the contact model: the closed form against time stepping in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dart_flight.base.records import Mode
from dart_flight.config.vehicle import packaged
from dart_flight.config.vehicle.configuration import load_vehicle
from dart_flight.contact.coefficients import Array, CoefficientArrays
from dart_flight.contact.contact_map import contact_map
from dart_flight.contact.law import Onset

BATCH = 100_000


def _best_s(run: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs, which is the least disturbed one."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


def step_through(
    c: CoefficientArrays, mass_kg: float, normal_m_s: Array, tangential_m_s: Array, step_s: float
) -> tuple[Array, Array]:
    """Return the exit velocities of a batch of contacts by implicit Euler, as in the paper."""
    out_n, out_t = normal_m_s.copy(), tangential_m_s.copy()
    index = np.arange(out_n.size)
    x, v, slip = -c.f * out_n / c.k, out_n.copy(), out_t.copy()
    begun = np.zeros(index.size, dtype=bool)
    while index.size:
        stiff = c.k * step_s + c.f
        force = np.maximum(-(c.k * x + stiff * v), 0.0) / (1.0 + stiff * (step_s / mass_kg))
        v = v + (step_s / mass_kg) * force
        x = x + step_s * v
        slip = slip / (1.0 + step_s * c.mu * force / mass_kg)
        begun |= force > 0.0
        out_n[index], out_t[index] = v, slip
        stays = ~(begun & (force == 0.0))
        index, x, v, slip, begun = index[stays], x[stays], v[stays], slip[stays], begun[stays]
        c = CoefficientArrays(*(values[stays] for values in c))
    return out_n, out_t


def rows(batch: int = BATCH) -> list[dict[str, Any]]:
    """Return rows for the benchmark table: collisions per second on one core.

    The batch mixes all materials and modes of the configuration. `baseline` is the implicit Euler model with
    the step that the row's name gives. `ratio` is the speed of the closed form over that of the baseline.
    """
    vehicle = load_vehicle(packaged("configs", "dart.yaml"))
    table = CoefficientArrays.from_table(
        [m.coefficients(mode) for m in vehicle.materials.values() for mode in Mode]
    )
    mass = vehicle.airframe.mass_kg
    random = np.random.default_rng(1)
    which = random.integers(0, table.k.size, batch)
    normal, tangential = -random.uniform(0.1, 3.0, batch), random.uniform(-1.5, 1.5, batch)

    def closed() -> None:
        contact_map(table, mass, normal, tangential, Onset.LCP, rows=which)

    c = table.select(which)

    def stepped(step_s: float) -> Callable[[], object]:
        return lambda: step_through(c, mass, normal, tangential, step_s)

    closed()
    fast = batch / _best_s(closed, 15)
    result = []
    for name, step_s, repeats in (("contact map", 1e-3, 3), ("contact map, step 1e-4", 1e-4, 1)):
        slow = batch / _best_s(stepped(step_s), repeats)
        result.append(
            {"name": name, "value": fast, "unit": "collisions/s", "baseline": slow, "ratio": fast / slow}
        )
    return result


if __name__ == "__main__":
    for row in rows():
        print(
            f"{row['name']:24s} {row['value'] / 1e6:8.2f} M {row['unit']}, "
            f"stepping {row['baseline'] / 1e3:8.1f} k, {row['ratio']:.0f} times"
        )
