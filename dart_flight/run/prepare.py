"""Preparation of missions: check space and force, change the lock driver or pose source, rehearse.

Every function raises InputError if the mission, or a requested option, cannot be flown.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.parameter_file import PositionSource
from dart_flight.config.vehicle import LockDriver
from dart_flight.core.flight_core import FlightCore
from dart_flight.core.mission.approach import NoApproachError
from dart_flight.planning.envelope import impact_problem
from dart_flight.planning.positioning import simulated_source
from dart_flight.sim.motion_capture import BODY, KINDS
from dart_flight.vehicle.motion_capture.source import parse_url

# Measured on v1.18 SITL (docs/results/faster_hits.md): the delay from an odometry sample's stamp to the
# attitude setpoint computed from the sample, and the delay that the rate loop adds to the attitude.
_PX4_DELAYS_S = {"setpoint_delay_s": 0.024, "attitude_delay_s": 0.05}


def load_flyable(path: str | Path, config: str | Path | None = None, settings: Sequence[str] = ()) -> Mission:
    """Load a mission whose approaches have enough space and whose impacts are within the force limit."""
    mission = load_mission(path, config, settings)
    refuse_unflyable(mission)
    return mission


def refuse_unflyable(mission: Mission) -> None:
    """Raise InputError if an approach cannot be flown, or an impact exceeds the force limit."""
    flight_core_of(mission)
    problem = impact_problem(mission)
    if problem is not None:
        raise InputError(problem, source=mission.source)


def flight_core_of(mission: Mission) -> FlightCore:
    """Return the flight core; raise InputError if an approach cannot be flown, or a wall blocks a transit."""
    try:
        return FlightCore(mission)
    except NoApproachError as error:
        raise InputError(str(error), source=mission.source) from None


def with_driver(mission: Mission, driver: LockDriver | None) -> Mission:
    """Return the mission with another lock driver; None changes nothing."""
    if driver is None:
        return mission
    if mission.vehicle.lock is None:
        raise InputError("this vehicle has no lock: leave the option out", key=("--driver",))
    lock = msgspec.structs.replace(mission.vehicle.lock, driver=driver)
    vehicle = msgspec.structs.replace(mission.vehicle, lock=lock)
    return msgspec.structs.replace(mission, vehicle=vehicle)


NO_MOCAP = "none"  # with this value of `--mocap`, a command ignores `mocap.url`


def with_mocap(mission: Mission, url: str | None) -> Mission:
    """Return the mission with another source of poses, or with none if `url` is `NO_MOCAP`.

    If `url` is None, the mission's own URL is checked and kept.
    """
    url = url if url is not None else mission.vehicle.mocap.url
    if url is None:
        return mission
    if url == NO_MOCAP:
        url = None
    else:
        parse_url(url)
    mocap = msgspec.structs.replace(mission.vehicle.mocap, url=url)
    vehicle = msgspec.structs.replace(mission.vehicle, mocap=mocap)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def with_simulated_mocap(
    mission: Mission, kind: str | None, source: PositionSource = PositionSource.MOCAP
) -> Mission:
    """Return the mission for a simulated vehicle with an emulated motion capture, or without one.

    Args:
        kind: one of `sim.motion_capture.KINDS`; None or `NO_MOCAP` if the simulated autopilot needs no poses.
        source: position source of the simulated autopilot.
    """
    kind = None if kind == NO_MOCAP else kind
    if kind is not None and kind not in KINDS:
        known = ", ".join(KINDS)
        message = f"{kind!r}: a simulated vehicle needs an emulated motion capture, one of {known}"
        raise InputError(message, key=("--mocap",))
    if kind is not None and not simulated_source(mission) is source is PositionSource.MOCAP:
        raise InputError("this vehicle's position comes from GPS", key=("--mocap",))
    url = None if kind is None else f"{kind}://127.0.0.1/{BODY}"  # the emulated server chooses its port
    mocap = msgspec.structs.replace(mission.vehicle.mocap, url=url)
    vehicle = msgspec.structs.replace(mission.vehicle, mocap=mocap)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def emulated_kind(mission: Mission) -> str | None:
    """Return the kind of motion capture that a simulated world emulates for a mission."""
    url = mission.vehicle.mocap.url
    return None if url is None else url.partition(":")[0]


def with_px4_delays(mission: Mission) -> Mission:
    """Set `setpoint_delay_s` and `attitude_delay_s` to PX4's values if the configuration lacks them."""
    flying = mission.vehicle.flying
    own = {name: default_s for name, default_s in _PX4_DELAYS_S.items() if getattr(flying, name) is None}
    flying = msgspec.structs.replace(flying, **own)
    vehicle = msgspec.structs.replace(mission.vehicle, flying=flying)
    return msgspec.structs.replace(mission, vehicle=vehicle)


def as_rehearsal(mission: Mission, standoff_m: float | None) -> Mission:
    """Return the rehearsal of a mission, in which the vehicle stops `standoff_m` in front of each wall.

    If `standoff_m` is None, return the mission unchanged.
    """
    if standoff_m is None:
        return mission
    if not 0.1 <= standoff_m <= 2.0:
        raise InputError(f"{standoff_m:g} m, expected 0.1 to 2 m", key=("--standoff",))
    return msgspec.structs.replace(mission, standoff_m=standoff_m)
