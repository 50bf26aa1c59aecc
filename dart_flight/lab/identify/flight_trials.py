"""Collisions of recorded flights as trials for `identify`."""

from __future__ import annotations

import numpy as np

from dart_flight.base.records import ContactEnd, ImpactOnset, ImuSample, Phase, PhaseChange
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.config.provenance import FoundVehicle
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.identify.trials import UNLABELLED, Series, Trial
from dart_flight.recording.about import flown_mission
from dart_flight.recording.measured_walls import WallMeasurements
from dart_flight.recording.reader import Log, NothingInItError

_BEFORE_S, _AFTER_S = 0.5, 0.4
_POSES = 40  # within 0.4 s of an onset: at 50 Hz a contact is between two of them
_LONGEST_S = 0.15  # of a contact whose end was not noticed
# What flight logs of the simulated vehicle, whose coefficients are known, are off by themselves
# (docs/results/flight_identification.md): PX4's velocity loop brakes too while the wall does.
ALLOWANCE = {"k": 0.03, "f": 0.15, "mu": 0.08, "nu": 0.6}


def trials_of(log: Log, material: str | None = None, mode: str = UNLABELLED) -> dict[str, list[Trial]]:
    """Every planned collision of a flight with this material in this mode, by the material of its wall.

    Series: position from the motion capture's poses where their age is known, else from PX4's estimate, which
    smears a contact; force from the flight core's estimate. Both are in the wall's collision frame and on the
    autopilot's clock. The plane is the mission's, or of a wall that a probe has found that which the
    contact told, and the vehicle that which flew it.

    Raises:
        InputError: the log does not hold its mission.
    """
    mission = flown_mission(log.about, log.source)
    flown = FoundVehicle(mission.vehicle, mission.flown_vehicle())
    course = FlightArrays(log, mission)
    found: dict[str, list[Trial]] = {}
    onset: ImpactOnset | None = None
    measured = WallMeasurements(mission)
    for record in course.records:
        measured.take(record)
    for record in course.records:
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
                    _series(course, wall, onset.t_us),
                    collision.mode.value,
                    allowance=ALLOWANCE,
                    flown=flown,
                    turn_rad_s=_turn(course, onset.t_us),
                )
                found.setdefault(wall.material, []).append(trial)
    return found


def _series(course: FlightArrays, wall: Wall, onset_us: int) -> dict[str, Series]:
    at = course.time_of(onset_us)
    force = course.estimated_force
    motion_s, position = course.estimated.time_s, course.estimated.position
    if course.posed.is_timed and np.sum(np.abs(course.posed.time_s - at) < _AFTER_S) >= _POSES:
        motion_s, position = course.posed.time_s, course.posed.position
    near = (motion_s > at - _BEFORE_S) & (motion_s < at + _AFTER_S)
    felt = (force.time_s > at - _BEFORE_S) & (force.time_s < at + _AFTER_S)
    n = np.array([*wall.normal, 0.0])
    t = np.array([*wall.tangent, 0.0])
    place = position[near] - np.array([*wall.point, 0.0])
    time, force_time = motion_s[near] - at, force.time_s[felt] - at
    return {
        "normal_m": Series(time, place @ n),
        "tangential_m": Series(time, place @ t),
        "vertical_m": Series(time, place[:, 2]),
        "normal_force_n": Series(force_time, force.force[felt] @ n),
        "tangential_force_n": Series(force_time, force.force[felt] @ t),
    }


def _turn(course: FlightArrays, onset_us: int) -> float | None:
    """The largest rate about the vehicle's vertical between an onset and the end of its contact."""
    longest_us = onset_us + round(_LONGEST_S * 1e6)
    ends = [end.t_us for end in course.all(ContactEnd) if onset_us < end.t_us < longest_us]
    end_us = min(ends, default=longest_us)
    rates = [abs(s.rate_frd[2]) for s in course.all(ImuSample) if onset_us <= s.t_us <= end_us]
    return max(rates, default=None)


def trials_at_one(log: Log, material: str | None, mode: str = UNLABELLED) -> list[Trial]:
    """As `trials_of`, of the collisions with one material; None: there must be only one.

    Raises:
        InputError: there are several; `NothingInItError` where there is no such collision.
    """
    by_material = trials_of(log, material, mode)
    if not by_material:
        what = f"no collision with {material}" if material else "no collision"
        how_armed = "" if mode == UNLABELLED else f" in {mode} mode"
        raise NothingInItError(f"{what}{how_armed} in this flight", source=log.source)
    if len(by_material) > 1:
        names = ", ".join(by_material)
        raise InputError(f"collisions with {names}: choose one with --surface", source=log.source)
    (trials,) = by_material.values()
    return trials
