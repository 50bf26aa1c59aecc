"""The page of `dart-flight inspect`: impacts detected in PX4 logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dart_flight.lab.inspect.impacts import InspectedFlight
from dart_flight.lab.inspect.specific_thrust import SpecificThrust
from dart_flight.lab.report.figures.forces import force_over_flight
from dart_flight.lab.report.render import PageTable, picture, render


def inspection_page(flights: Sequence[InspectedFlight]) -> str:
    """Return the page of some logs, with force over the flight, impacts and unknown quantities."""
    impacts = sum(i.kind == "impact" for flight in flights for i in flight.impacts)
    title = f"{_counted(len(flights), 'flight')} inspected, {_counted(impacts, 'impact')}"
    return render("inspection.html", title, flights=[_flight(flight) for flight in flights])


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" + ("" if count == 1 else "s")


def _flight(flight: InspectedFlight) -> dict[str, Any]:
    series, thrust, force = flight.series, flight.thrust, None
    if series is not None and len(series.time_s):
        size = np.hypot(series.force_m_s2[:, 0], series.force_m_s2[:, 1])
        impacts_s = [i.t_s for i in flight.impacts]
        force = picture(force_over_flight(series.time_s, size, series.threshold_m_s2, impacts_s))
    rows = [
        (i.t_s, i.acceleration_m_s2, i.acceleration_sd_m_s2, i.force_n, i.direction_deg, i.speed_m_s, i.kind)
        for i in flight.impacts
    ]
    facts: list[tuple[str, str]] = [
        ("PX4", flight.px4_version or "unknown"),
        ("in the air", f"{flight.flight_s:.0f} s of {flight.duration_s:.0f} s"),
        ("thrust", "unknown" if thrust is None else _curve(thrust)),
        ("noise of a sample", f"{flight.noise_m_s2:.2f} m/s²"),
        ("noise of the means", f"{flight.noise_short_m_s2:.2f} and {flight.noise_long_m_s2:.2f} m/s²"),
        ("reliably detected, rigid", f"{flight.floor_rigid_m_s2:.1f} m/s²"),
        ("reliably detected, flexible", f"{flight.floor_flexible_m_s2:.1f} m/s²"),
        *(("unknown", what) for what in flight.unknown),
    ]
    heads = ("at s", "peak m/s²", "± m/s²", "peak N", "direction °", "speed before m/s", "")
    return {
        "log": flight.log,
        "force": force,
        "impacts": PageTable(heads, rows),
        "nothing_found": flight.nothing_found,
        "facts": PageTable(("", ""), facts),
    }


def _curve(thrust: SpecificThrust) -> str:
    held_out = f"held-out residual {thrust.held_out_percent:.1f} %"
    return f"{thrust.full_m_s2:.1f} m/s² at full command, {held_out}, from {thrust.said}"
