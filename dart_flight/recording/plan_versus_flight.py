"""Comparison of plan and flight: every planned value, its flown value, and the mission's tolerance.

The outcome `completed` only states that a mission passed its phases. The deviations state whether the flight
followed the plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.records import AfterImpact
from dart_flight.config.mission import Collision, Mission
from dart_flight.core.mission.planned_impact import expected_hit, impact_velocity
from dart_flight.planning.predicted_flight import predict_mission
from dart_flight.recording.flown_impact import FlownImpact, Velocities


class Deviation(msgspec.Struct, frozen=True):
    """A planned value and the flown value.

    Attributes:
        what: description with its unit.
        planned, flown: the two values; `flown` is None if the flight has no such value.
        tolerance: largest allowed difference, or None if the values must be equal.
    """

    what: str
    planned: float | str
    flown: float | str | None
    tolerance: float | None

    @property
    def within(self) -> bool:
        """Whether there is a flown value within the tolerance."""
        if isinstance(self.planned, float) and isinstance(self.flown, float):
            return abs(self.flown - self.planned) <= (self.tolerance or 0.0)
        return self.flown == self.planned


class Prediction(NamedTuple):
    """The velocities, impact points and miss distance that are predicted for a mission.

    Attributes:
        velocities: predicted velocities by index of the collision; fields are None if not predicted.
        places: predicted impact points, by index of the collision, mission frame.
        goal_miss_m: predicted smallest distance to the goal during the last recovery. None if this distance
            is unknown, or if the vehicle flies to the goal from rest.
    """

    velocities: dict[int, Velocities]
    places: dict[int, Vec2]
    goal_miss_m: float | None


def predict_flight(mission: Mission) -> Prediction:
    """Predict each collision from the first available source.

    The sources are, in this order: the planner's prediction in the mission file, the contact law at the
    planned approach velocity, and the flight model. If the mission replans after every impact, the predicted
    miss distance at the goal is 0.
    """
    velocities, places, miss_m = dict[int, Velocities](), dict[int, Vec2](), None
    for collision in mission.collisions:
        velocities[collision.index], place = _as_written(mission, collision)
        if place is not None:
            places[collision.index] = place
    if mission.recovers_to_goal:
        written_m = None if mission.predicted is None else mission.predicted.goal_miss_m
        miss_m = 0.0 if mission.after_impact is AfterImpact.REPLAN else written_m
    missing = [index for index, one in velocities.items() if one.normal_m_s is None]
    if not missing and (miss_m is not None or not mission.recovers_to_goal):
        return Prediction(velocities, places, miss_m)
    model = predict_mission(mission)
    for index in missing:
        if index in model.hits:
            hit = model.hits[index]
            velocities[index] = Velocities(hit.normal_m_s, hit.tangential_m_s, hit.normal_n)
            places[index] = hit.position
    return Prediction(velocities, places, model.goal_miss_m if miss_m is None else miss_m)


def _as_written(mission: Mission, collision: Collision) -> tuple[Velocities, Vec2 | None]:
    if collision.predicted is not None:
        p = collision.predicted
        return Velocities(p.normal_m_s, p.tangential_m_s, p.peak_force_n), p.position_m
    velocity, hit = impact_velocity(collision), expected_hit(mission, collision)
    if velocity is None or hit is None:
        return Velocities(), None
    return Velocities(*velocity, hit.peak_normal_force_n), collision.impact_point


def deviations(
    mission: Mission, planned: Prediction, flown: Sequence[FlownImpact], goal_miss_m: float | None
) -> list[Deviation]:
    """Return a deviation for every planned value, in the mission's order; a rehearsal has no deviations.

    `goal_miss_m` is None if the goal was not passed.
    """
    if mission.standoff_m is not None:
        return []
    by_index = {one.index: one for one in flown}
    found: list[Deviation] = []
    for collision in mission.collisions:
        if collision.index in by_index or not collision.is_conditional:
            found += _compare_collision(mission, collision, planned, by_index.get(collision.index))
    if planned.goal_miss_m is not None:
        allowed = mission.goal.capture_radius_m
        found.append(Deviation("goal miss, m", planned.goal_miss_m, goal_miss_m, allowed))
    return found


def _compare_collision(
    mission: Mission, collision: Collision, planned: Prediction, flown: FlownImpact | None
) -> Iterator[Deviation]:
    name, tolerance, wall = f"collision {collision.index}", mission.tolerance, collision.wall
    wanted, place = planned.velocities[collision.index], planned.places.get(collision.index)
    measured = Velocities() if flown is None else flown.measured
    for what, planned_m_s, flown_m_s in (
        ("normal velocity", wanted.normal_m_s, measured.normal_m_s),
        ("velocity along the wall", wanted.tangential_m_s, measured.tangential_m_s),
    ):
        if planned_m_s is not None:
            yield Deviation(f"{name} {what}, m/s", planned_m_s, flown_m_s, tolerance.impact_m_s)
    if wanted.peak_force_n is not None and collision.probe is None and wall.material_known:
        allowed = tolerance.peak_force_share * wanted.peak_force_n
        yield Deviation(f"{name} peak force, N", wanted.peak_force_n, measured.peak_force_n, allowed)
    if place is not None and collision.probe is None and not wall.sought:
        beside_m = None if flown is None else distance2(flown.onset.position_mission[:2], place)
        yield Deviation(f"{name} distance from the planned point, m", 0.0, beside_m, tolerance.place_m)
    mode = collision.mode.value
    if flown is None:
        yield Deviation(f"{name} mode", mode, None, None)
    elif flown.mode_felt is not None:  # if the contact did not show the mode, there is no deviation
        yield Deviation(f"{name} mode", mode, flown.mode_felt.value, None)


def out_of_tolerance(found: Sequence[Deviation]) -> list[Deviation]:
    """Return the deviations outside their tolerance: first those without numbers, then the others by size."""
    outside = [one for one in found if not one.within]
    return sorted(outside, key=lambda one: -_excess_ratio(one))


def format_departures(found: Sequence[Deviation], most: int = 3) -> str:
    """Describe the `most` largest deviations; return "" if all are within tolerance."""
    outside = out_of_tolerance(found)
    more = len(outside) - most
    return "; ".join(map(_format_deviation, outside[:most])) + (f"; {more} more" if more > 0 else "")


def _format_deviation(one: Deviation) -> str:
    name, _, unit = one.what.partition(", ")
    within = f" ± {one.tolerance:.2f}" if one.tolerance is not None else ""
    return f"{name} {_figure(one.flown)} instead of {_figure(one.planned)}{within} {unit}".rstrip()


def _figure(value: float | str | None) -> str:
    return "none" if value is None else value if isinstance(value, str) else f"{value:.2f}"


def _excess_ratio(one: Deviation) -> float:
    if isinstance(one.planned, float) and isinstance(one.flown, float) and one.tolerance:
        return abs(one.flown - one.planned) / one.tolerance
    return math.inf
