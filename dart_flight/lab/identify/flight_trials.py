"""Collisions of recorded flights as trials for `identify`."""

from __future__ import annotations

import numpy as np

from dart_flight.base.records import ContactEnd, ContactRequest, ImpactOnset, ImuSample, Phase, PhaseChange
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.provenance import LoadedVehicle
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.identify.trials import UNLABELLED, Series, Trial
from dart_flight.recording.about import flown_mission
from dart_flight.recording.measured_walls import WallMeasurements
from dart_flight.recording.reader import Log, MissingDataError

_BEFORE_S, _AFTER_S = 0.5, 0.4
_POSES = 40  # minimum number of poses up to 0.4 s from an onset; poses at 50 Hz can miss a contact
_LONGEST_S = 0.15  # assumed duration of a contact whose end was not detected
# Systematic relative errors, which arise because PX4's velocity loop also brakes during the contact. They
# were measured on simulated flights (docs/results/flight_identification.md).
ALLOWANCE = {"k": 0.03, "f": 0.15, "mu": 0.08, "nu": 0.6}


def trials_of(log: Log, material: str | None = None, mode: str = UNLABELLED) -> dict[str, list[Trial]]:
    """Return the planned collisions in a flight as trials, by material.

    `material` and `mode` select the collisions; None and `UNLABELLED` select all. If the age of the motion
    capture's poses is known, the positions are those of the poses. Otherwise they are PX4's estimate, which
    smooths the velocity change of a contact. The force is the flight core's estimate. All series are in the
    wall's collision frame and on the autopilot's clock. The wall's plane comes from the mission, or from the
    contact if a probe searched for the wall. The vehicle comes from the log.
    """
    mission = flown_mission(log.about, log.source)
    flown = LoadedVehicle(mission.vehicle, mission.flown_vehicle())
    flight = FlightArrays(log, mission)
    found: dict[str, list[Trial]] = {}
    onset: ImpactOnset | None = None
    measured = WallMeasurements(mission)
    contacts: dict[int, ContactRequest] = {}
    for record in flight.records:
        measured.add(record)
        if isinstance(record, ContactRequest):
            contacts[record.onset.t_us] = record
    for record in flight.records:
        if isinstance(record, ImpactOnset):
            onset = record
        elif isinstance(record, PhaseChange) and record.after is Phase.CONTACT and onset is not None:
            collision = mission.collisions[(record.collision or 1) - 1]
            wall = collision.wall
            if wall.sought:
                wall = measured.wall(wall.name) or wall
            if material in (None, wall.material) and mode in (UNLABELLED, collision.mode.value):
                name = f"{log.source}: {wall.name}"
                trial = Trial(
                    name,
                    _series(flight, wall, onset.t_us),
                    collision.mode.value,
                    allowance=ALLOWANCE,
                    flown=flown,
                    turn_rad_s=_largest_turn_rate(flight, onset.t_us),
                    contact=contacts.get(onset.t_us),
                )
                found.setdefault(wall.material, []).append(trial)
    return found


def _series(flight: FlightArrays, wall: Wall, onset_us: int) -> dict[str, Series]:
    at = flight.time_of(onset_us)
    force = flight.estimated_force
    motion_s, position = flight.estimated.time_s, flight.estimated.position
    if flight.posed.is_timed and np.sum(np.abs(flight.posed.time_s - at) < _AFTER_S) >= _POSES:
        motion_s, position = flight.posed.time_s, flight.posed.position
    near = (motion_s > at - _BEFORE_S) & (motion_s < at + _AFTER_S)
    force_near = (force.time_s > at - _BEFORE_S) & (force.time_s < at + _AFTER_S)
    n = np.array([*wall.normal, 0.0])
    t = np.array([*wall.tangent, 0.0])
    place = position[near] - np.array([*wall.point, 0.0])
    time, force_time = motion_s[near] - at, force.time_s[force_near] - at
    return {
        "normal_m": Series(time, place @ n),
        "tangential_m": Series(time, place @ t),
        "vertical_m": Series(time, place[:, 2]),
        "normal_force_n": Series(force_time, force.force[force_near] @ n),
        "tangential_force_n": Series(force_time, force.force[force_near] @ t),
    }


def _largest_turn_rate(flight: FlightArrays, onset_us: int) -> float | None:
    """Return the largest yaw rate between an onset and the end of its contact, rad/s."""
    longest_us = onset_us + round(_LONGEST_S * 1e6)
    ends = [end.t_us for end in flight.all(ContactEnd) if onset_us < end.t_us < longest_us]
    end_us = min(ends, default=longest_us)
    rates = [abs(s.rate_frd[2]) for s in flight.all(ImuSample) if onset_us <= s.t_us <= end_us]
    return max(rates, default=None)


def trials_at_one(log: Log, material: str | None, mode: str = UNLABELLED) -> list[Trial]:
    """Return the collisions with one material in a flight.

    If `material` is None, all collisions in the flight must be with the same material.
    """
    by_material = trials_of(log, material, mode)
    if not by_material:
        what = f"no collision with {material}" if material else "no collision"
        how_armed = "" if mode == UNLABELLED else f" in {mode} mode"
        raise MissingDataError(f"{what}{how_armed} in this flight", source=log.source)
    if len(by_material) > 1:
        names = ", ".join(by_material)
        raise InputError(
            f"this flight has collisions with {names}: choose one material with --surface", source=log.source
        )
    (trials,) = by_material.values()
    return trials
