"""Fast flights against walls with other coefficients than configured, so plant and flight core disagree."""

from __future__ import annotations

from pathlib import Path

import msgspec

from dart_flight.base.records import World
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import Coefficients
from dart_flight.recording.about import describe_flight
from dart_flight.recording.writer import FlightLog
from dart_flight.run.fast import FastFlight
from dart_flight.sim.draws import DrawnWorld


def with_walls(mission: Mission, **factors: float) -> Mission:
    """Return the mission with every material's coefficients multiplied: `k=1.2`, `f=`, `mu=`, `nu=`."""

    def scaled(c: Coefficients) -> Coefficients:
        return msgspec.structs.replace(c, **{n: getattr(c, n) * x for n, x in factors.items()})

    materials = {
        name: msgspec.structs.replace(
            m, **{mode.value: scaled(m.coefficients(mode)) for mode in mission.vehicle.modes}
        )
        for name, m in mission.vehicle.materials.items()
    }
    vehicle = msgspec.structs.replace(mission.vehicle, materials=materials)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def fly_against(mission: Mission, real: Mission, seed: int, path: Path, world: World = World.FAST) -> Path:
    """Fly a mission against the walls of `real`; the returned log contains only the mission.

    `world` is the world that the log names.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    log = FlightLog(path, describe_flight(mission, world, seed))
    FastFlight(mission, seed, observe=log.put, world=DrawnWorld(real, None, {})).run()
    log.close()
    return path
