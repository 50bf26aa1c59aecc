"""The map of a mission before its flight, as data: its path, probes, planned hits and randomly moved walls.

`report/figures/mission_figure.py` draws the map for `--plot`, and the studio's room view shows it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Mission
from dart_flight.core.mission.planned_impact import describe_force
from dart_flight.lab.figure_style import FORCE
from dart_flight.lab.map_model import (
    Arrow,
    DrawnVehicle,
    Label,
    Line,
    MapKind,
    Place,
    RoomMap,
    at_altitude,
    planned_lines,
    room_map,
)
from dart_flight.planning.envelope import impact_yaw, incidence_deg
from dart_flight.planning.predicted_flight import PredictedFlight


def mission_map(
    mission: Mission, planned: PredictedFlight | None, drawn: Sequence[PredictedFlight] = ()
) -> RoomMap:
    """Return a map of a mission with its predicted path and the predictions for varied walls."""
    shown = room_map(mission)
    climb = [(*mission.start, z) for z in (0.0, mission.altitude_m)]
    shown.paths.append(Line(MapKind.PREDICTED, np.array(climb)))
    _add_draws(shown, mission, drawn)
    _add_probes(shown, mission, labelled=planned is None)
    if planned is not None:
        _add_trajectory(shown, mission, planned)
        _add_hits(shown, mission, planned)
    shown.labels += [Label(text, place, (1.0, 1.0)) for text, place in _stops(mission)]
    return shown


def _add_probes(shown: RoomMap, mission: Mission, *, labelled: bool) -> None:
    for collision in mission.collisions:
        if collision.probe is None:
            continue
        path = np.array([collision.probe.begin, collision.probe.end])
        z = mission.altitude_at(collision.index - 1)
        shown.paths.append(Line(MapKind.PROBE, at_altitude(path, z)))
        (dx, dy), middle = path[1] - path[0], path[0] + 0.6 * (path[1] - path[0])
        (x, y) = collision.probe.end
        shown.arrows.append(Arrow(MapKind.PROBE, (x - 0.06 * dx, y - 0.06 * dy), (x, y)))
        if labelled:
            across = (-dy / math.hypot(dx, dy), dx / math.hypot(dx, dy))
            text = f"{collision.index} probe for {collision.wall.name}\n{collision.probe.speed_m_s:g} m/s"
            shown.labels.append(Label(text, (float(middle[0]), float(middle[1])), across, FORCE))


def _add_draws(shown: RoomMap, mission: Mission, drawn: Sequence[PredictedFlight]) -> None:
    """Add the wall surfaces and the paths after the hits for every set of randomly varied walls."""
    legend = f"{len(drawn)} draws of the walls"
    for flight in drawn:
        surfaces = [np.array(mission.vehicle.airframe.wall_surface(wall).ends) for wall in flight.walls]
        legs = [at_altitude(leg, mission.altitude_at(index - 1)) for index, leg in flight.legs.items()]
        shown.paths += [Line(MapKind.DRAW, points, legend) for points in (*legs, *surfaces)]


def _add_trajectory(shown: RoomMap, mission: Mission, planned: PredictedFlight) -> None:
    shown.paths += [Line(MapKind.PREDICTED, line) for line in planned_lines(mission, planned)]
    for index, line in planned.approaches.items():
        begins = 0 if mission.collisions[index - 1].trajectory is not None else -2
        shown.places.append(Place(MapKind.RUN_UP, line[begins]))
        (ax, ay), (bx, by) = line[-2:]
        middle, tip = ((ax + share * (bx - ax), ay + share * (by - ay)) for share in (0.55, 0.61))
        shown.arrows.append(Arrow(MapKind.PREDICTED, middle, tip))


class PlannedHit(NamedTuple):
    """A hit, predicted by the flight model, or planned by the mission if there is no prediction.

    Attributes:
        at: position of the vehicle's centre, mission frame, m.
        velocity: velocity before the hit, mission frame, m/s; None if unknown.
        force: peak force on the vehicle, mission frame, N; None without a prediction or a contact.
        setpoint: recovery setpoint, mission frame, m; None without a recovery.
        text: lines with mode, speed, force and incidence; "" without a prediction.
    """

    number: int
    wall: Wall
    mode: Mode
    at: Vec3
    yaw_rad: float
    velocity: Vec2 | None
    force: Vec2 | None
    setpoint: Vec2 | None
    text: str


def planned_hits(mission: Mission, planned: PredictedFlight | None) -> Iterator[PlannedHit]:
    """Yield the hits whose place is known."""
    for collision in mission.collisions:
        hit = None if planned is None else planned.hits.get(collision.index)
        at = hit.position if hit is not None else collision.impact_point
        if at is None:
            continue
        wall, place = collision.wall, (*at, mission.altitude_at(collision.index - 1))
        found = PlannedHit(
            collision.index, wall, collision.mode, place, impact_yaw(mission, collision), None, None, None, ""
        )
        if hit is None:
            x, y, _ = collision.approach_velocity()
            yield found._replace(velocity=None if collision.approach_m_s is None else (x, y))
            continue
        x, y, _ = wall.from_collision((hit.normal_m_s, hit.tangential_m_s, 0.0))
        speed = math.hypot(hit.normal_m_s, hit.tangential_m_s)
        text = f"{collision.index} {collision.mode.value}\n{speed:.2f} m/s, "
        text += describe_force(hit.normal_n, hit.tangential_n)
        incidence = incidence_deg(mission, collision)
        if incidence >= 1.0:
            text += f"\nincidence {incidence:.0f}°"
        found = found._replace(velocity=(x, y), text=text)
        if mission.standoff_m is None:
            x, y, _ = wall.from_collision((hit.normal_n, hit.tangential_n, 0.0))
            found = found._replace(force=(x, y), setpoint=hit.setpoint)
        yield found


def _add_hits(shown: RoomMap, mission: Mission, planned: PredictedFlight) -> None:
    forces: list[tuple[Vec2, Vec2]] = []
    for hit in planned_hits(mission, planned):
        shown.add_hit(DrawnVehicle(hit.at, hit.yaw_rad, hit.mode, hit.number), hit.setpoint)
        if hit.force is not None:
            forces.append((hit.at[:2], hit.force))
        if hit.text:
            behind = (-hit.wall.normal[0], -hit.wall.normal[1])
            shown.labels.append(Label(hit.text, hit.at[:2], behind, FORCE))
    shown.add_forces(forces)


def _stops(mission: Mission) -> list[tuple[str, Vec2]]:
    """Return the labels and places of start, goal, waypoints (numbered) and changes of altitude."""
    found: dict[Vec2, str] = {mission.start: "start"}
    goal = mission.goal.position_m
    found[goal] = f"{found[goal]}, goal" if goal in found else "goal"
    z_before = mission.altitude_m
    for waypoint in mission.waypoints:
        if waypoint.position is None:
            continue
        x, y, z = waypoint.position
        text = f"{waypoint.index}" if z == z_before else f"{waypoint.index}: {z:g} m high"
        found[x, y] = f"{found[x, y]}, {text}" if (x, y) in found else text
        z_before = z
    return [(text, place) for place, text in found.items()]
