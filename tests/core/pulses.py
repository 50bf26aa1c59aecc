"""The vehicle and the forces on which pulse fit and detector are tested."""

from __future__ import annotations

import math

import msgspec

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import VehicleConfig
from tests.core.conftest import ROOT

# The paper's point law, for which the detector's pulse is designed; test_torque has the hits of a body.
MISSION = load_mission(
    ROOT / "missions" / "paper_dual_collision.yaml", settings=["simulation.contact.body=point"]
)
VEHICLE = MISSION.vehicle
MASS = VEHICLE.airframe.mass_kg


def with_estimation(**changes: object) -> VehicleConfig:
    return msgspec.structs.replace(VEHICLE, estimation=msgspec.structs.replace(VEHICLE.estimation, **changes))


def true_pulse(
    k: float, f: float, v: float, push_n: float, vy: float, mu: float
) -> list[tuple[float, float]]:
    """Return normal and friction force every 10 us from the first force, by stepping the contact law."""
    h, x, vx = 1e-5, f * v / k, -v
    out: list[tuple[float, float]] = []
    while True:
        n = -(k * x + f * vx)
        if n < 0.0 and out:
            return out
        n = max(n, 0.0)
        t = -mu * n * vy
        out.append((n, t))
        vx += h * (n - push_n) / MASS
        vy += h * t / MASS
        x += h * vx


def half_sine(peak: float, ticks: int) -> list[float]:
    return [peak * math.sin(math.pi * (i + 0.5) / ticks) for i in range(ticks)]
