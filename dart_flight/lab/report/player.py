"""The data of a flight's animation, which `player.js` draws on request; the page contains all of the data."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import Mode, PhaseChange
from dart_flight.lab.flight_arrays import Array, ForceArrays, MotionArrays
from dart_flight.lab.map_model import DrawnWall, RoomMap, arms_m, named_material, room_map
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight
from dart_flight.lab.report.tracks import (
    Angles,
    angles,
    in_force,
    lock_stretches,
    setpoint_series,
    stretches,
)

_STEP_S, _FINE_S = 0.04, 0.01  # intervals between frames: in general, and near a hit
_FINE_BEFORE_S, _FINE_AFTER_S = 0.2, 0.5
_FORCE_BEFORE_S, _FORCE_AFTER_S = 0.1, 0.35  # interval around a hit in which every sample is kept
_FORCE_STEP_S = 0.05
_PLANNED_STEP_M = 0.03
_NAME_IN_FRONT_M = 0.1


def player_data(flight: RecordedFlight) -> dict[str, Any] | None:
    """Return the data of the animation; None if the log contains no motion in the air.

    Units are ms, mm, mrad, cm/s and 0.1 N. Vectors are in the mission frame.
    """
    course, mission = flight.course, flight.mission
    span = flight.shown_span
    motion = course.true if course.true.time_s.size else course.estimated
    if flight.airborne is None or motion.time_s.size < 2 or span[1] - span[0] < _STEP_S:
        return None
    span = (max(span[0], float(motion.time_s[0])), min(span[1], float(motion.time_s[-1])))
    moments = [impact.at_s for impact in flight.impacts]
    times = _grid(span, moments)
    return {
        "truth": bool(course.true.time_s.size),
        "vehicle": {
            "guards": [_mm(guard) for guard in mission.vehicle.airframe.guards_m],
            "arms": [_mm(arm) for arm in arms_m(mission.vehicle.airframe)],
        },
        "room": _room(room_map(mission)),
        "planned": [_mm(_thinned(line)) for line in flight.planned_lines()],
        "hits": [_hit(impact) for impact in flight.impacts],
        "guard": [
            {"t": _ms(act.at_s), "rule": act.rule, "action": act.action}
            for act in flight.guard_acts()
            if span[0] <= act.at_s <= span[1]
        ],
        "lock": _lock(flight, span),
        "hasLock": mission.vehicle.has_lock,
        "phases": [
            [_ms(since), name]
            for since, _, name in stretches(
                [(course.time_of(c.t_us), c.after.value) for c in course.all(PhaseChange)], span[1]
            )
        ],
        **_motion(motion, times, angles(course, true=motion is course.true)),
        "setpoints": _setpoints(flight, times[::2]),
        "force": _forces(flight, span, moments),
        "threshold": round(10.0 * mission.vehicle.detection.force_threshold_n),
    }


def _lock(flight: RecordedFlight, span: tuple[float, float]) -> list[list[Any]]:
    """Return [begin, state] for each state of the arms; the arms of a vehicle without a lock are rigid."""
    if not flight.mission.vehicle.has_lock:
        return [[_ms(span[0]), Mode.RIGID.value]]
    return [[_ms(since), name] for since, _, name in lock_stretches(flight.course, span[1])]


def _grid(span: tuple[float, float], hits: list[float]) -> Array:
    """Return the times of the frames, which are denser near a hit."""
    parts = [np.arange(span[0], span[1], _STEP_S), np.array([span[1]])]
    for at in hits:
        fine = np.arange(at - _FINE_BEFORE_S, at + _FINE_AFTER_S, _FINE_S)
        parts.append(fine[(fine > span[0]) & (fine < span[1])])
    return np.unique(np.round(np.concatenate(parts), 3))


def _motion(motion: MotionArrays, times: Array, attitude: Angles) -> dict[str, list[int]]:
    found = {"t": _ints(times, 1e3)}
    for i, name in enumerate("xyz"):
        found[name] = _ints(np.interp(times, motion.time_s, motion.position[:, i]), 1e3)
    speed = np.linalg.norm(motion.velocity, axis=1)
    found["speed"] = _ints(np.interp(times, motion.time_s, speed), 1e2)
    for name in ("yaw", "pitch", "roll"):
        values = getattr(attitude, name)
        known = np.interp(times, attitude.time_s, values) if values.size else np.zeros(times.size)
        found[name] = _ints(known, 1e3)
    return found


def _setpoints(flight: RecordedFlight, times: Array) -> list[list[int]]:
    """Return [time, x, y, z] of the active setpoint at each frame at which the setpoint has changed."""
    sent = setpoint_series(flight.course)
    if not sent.time_s.size:
        return []
    index, known = in_force(sent.time_s, times)
    found: list[list[int]] = []
    for at_s, i in zip(times[known], index[known], strict=True):
        place = [int(v) for v in np.rint(1e3 * sent.position[i])]
        if not found or found[-1][1:] != place:
            found.append([_ms(float(at_s)), *place])
    return found


def _forces(flight: RecordedFlight, span: tuple[float, float], hits: list[float]) -> dict[str, list[int]]:
    """Return the horizontal force: the estimate as a vector, the truth as a magnitude."""
    estimated, true = flight.course.estimated_force, flight.course.true_force
    if not estimated.time_s.size:
        return {"t": [], "x": [], "y": [], "true": []}
    times = estimated.time_s
    keep = np.zeros(times.size, dtype=bool)
    index = np.searchsorted(times, np.arange(span[0], span[1], _FORCE_STEP_S))
    keep[index[index < times.size]] = True
    for at in hits:
        keep |= (times > at - _FORCE_BEFORE_S) & (times < at + _FORCE_AFTER_S)
    keep &= (times >= span[0]) & (times <= span[1])
    shown = times[keep]
    return {
        "t": _ints(shown, 1e3),
        "x": _ints(estimated.force[keep, 0], 10.0),
        "y": _ints(estimated.force[keep, 1], 10.0),
        "true": _ints(_size_at(true, shown), 10.0) if true.time_s.size else [],
    }


def _size_at(force: ForceArrays, times: Array) -> Array:
    size = np.hypot(force.force[:, 0], force.force[:, 1])
    return np.interp(times, force.time_s, size)


def _hit(impact: Impact) -> dict[str, Any]:
    (x, y, z), force = impact.verdict.onset.position_mission, impact.verdict.force
    return {
        "t": _ms(impact.at_s),
        "n": impact.verdict.index,
        "wall": impact.verdict.wall,
        "normal": [round(v, 5) for v in impact.collision.wall.normal],
        "mode": impact.verdict.mode,
        "at": _mm([(x, y)])[0],
        "z": round(1e3 * z),
        "force": None if force is None else round(10.0 * math.hypot(*force)),
    }


def _room(shown: RoomMap) -> dict[str, Any]:
    b = shown.bounds
    return {
        "bounds": [[round(1e3 * v) for v in axis] for axis in (b.x, b.y, b.z)],
        "start": _mm([shown.start])[0],
        "goal": _mm([shown.goal])[0],
        "capture": round(1e3 * shown.capture_radius_m),
        "walls": [
            {
                "name": wall.name,
                "outline": _mm(wall.outline),
                "plane": _mm(wall.plane.ends),
                "label": _mm([wall.surface.displaced(_name_at_m(wall)).point])[0],
                "normal": [round(v, 5) for v in wall.plane.normal],
            }
            for wall in shown.walls
        ],
        "posts": [
            {"name": named_material(post), "at": _mm([post.centre])[0], "radius": round(1e3 * post.radius_m)}
            for post in shown.posts
        ],
    }


def _name_at_m(wall: DrawnWall) -> float:
    return _NAME_IN_FRONT_M if wall.name_in_front else -0.5 * wall.thickness_m


def _thinned(line: Array) -> list[Vec2]:
    """Return a line with fewer points: its ends, and points more than `_PLANNED_STEP_M` apart."""
    kept = [line[0]]
    for point in line[1:-1]:
        if math.dist(point[:2], kept[-1][:2]) > _PLANNED_STEP_M:
            kept.append(point)
    return [(float(p[0]), float(p[1])) for p in [*kept, line[-1]]]


def _mm(points: Iterable[Vec2 | Vec3 | Array]) -> list[list[int]]:
    return [[round(1e3 * p[0]), round(1e3 * p[1])] for p in points]


def _ms(time_s: float) -> int:
    return round(1e3 * time_s)


def _ints(values: Array, scale: float) -> list[int]:
    return [int(v) for v in np.rint(scale * values)]
