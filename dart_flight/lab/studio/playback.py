"""A recorded flight as data for the player, and the end of many flights; no viser in it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from dart_flight.base.geometry import Vec3
from dart_flight.base.records import Mode, TruthSample
from dart_flight.contact.law import Onset
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.predict.path import ContactHistory, ContactMotion, trajectory
from dart_flight.lab.report.player import player_data
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight
from dart_flight.lab.report.tracks import lock_stretches

_BEFORE_S, _AFTER_S, _STEP_S = 0.06, 0.175, 0.001  # time of the force charts around a detection
LOCK_LEVELS = {"flexible": 0.0, "travelling": 0.5, "rigid": 1.0}  # heights in the chart of the lock


class Moment(NamedTuple):
    """A value that holds from a time on, s."""

    at_s: float
    value: str


class ForceChart(NamedTuple):
    """Forces of one hit over the time after its detection, arrays (n,); NaN where unknown.

    Attributes:
        planned: by the contact law at the planned velocity.
    """

    time_ms: Array
    planned: Array
    measured: Array
    true: Array


class PlayedHit(NamedTuple):
    """A hit of a flight.

    Attributes:
        summary: velocities, peak force and lock mode in one line.
    """

    at_s: float
    number: int
    wall: str
    place: Vec3
    summary: str
    normal: ForceChart
    friction: ForceChart


class LockChart(NamedTuple):
    """Mode of the arms over the flight (`LOCK_LEVELS`), arrays (n,); NaN where unknown."""

    time_s: Array
    planned: Array
    measured: Array
    true: Array


class Playback(NamedTuple):
    """A flight to play.

    Attributes:
        summary: the outcome in one line.
        time_s: times of the frames, (n,).
        position, quaternion: (n, 3), and (n, 4) from the vehicle's axes (forward, left, up) to the mission
            frame, scalar first.
        setpoints: (time, place) of the active setpoint.
        force_s, force_n: times (k,) and estimated horizontal force (k, 2), N.
        planned: planned path as lines (m, 2), m.
    """

    name: str
    summary: str
    completed: bool
    time_s: Array
    position: Array
    quaternion: Array
    speed_m_s: Array
    phases: list[Moment]
    lock: list[Moment]
    guard: list[Moment]
    setpoints: list[tuple[float, Vec3]]
    force_s: Array
    force_n: Array
    hits: list[PlayedHit]
    planned: list[Array]
    lock_chart: LockChart | None
    altitude_m: float

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1] - self.time_s[0])

    def frame(self, at_s: float) -> tuple[Array, Array]:
        """Return position and quaternion at a time of the flight."""
        index = int(np.clip(np.searchsorted(self.time_s, at_s), 1, len(self.time_s) - 1))
        begin, end = self.time_s[index - 1 : index + 1]
        share = float(np.clip((at_s - begin) / (end - begin), 0.0, 1.0))
        turned = (1.0 - share) * self.quaternion[index - 1] + share * self.quaternion[index]
        position = (1.0 - share) * self.position[index - 1] + share * self.position[index]
        return position, turned / np.linalg.norm(turned)

    def force_at(self, at_s: float) -> tuple[float, float]:
        """Return the estimated horizontal force at a time, N."""
        if not self.force_s.size:
            return 0.0, 0.0
        x, y = (float(np.interp(at_s, self.force_s, self.force_n[:, i])) for i in (0, 1))
        return x, y

    def setpoint_at(self, at_s: float) -> Vec3 | None:
        """Return the active setpoint at a time, or None before the first."""
        return next((place for since_s, place in reversed(self.setpoints) if since_s <= at_s), None)

    def next_hit(self, at_s: float) -> PlayedHit | None:
        """Return the first hit after a time, or the first of all."""
        after = [hit for hit in self.hits if hit.at_s > at_s + 1e-3]
        return after[0] if after else next(iter(self.hits), None)

    def hit_near(self, at_s: float) -> PlayedHit | None:
        return min(self.hits, key=lambda hit: abs(hit.at_s - at_s), default=None)


def value_at(moments: list[Moment], at_s: float) -> str:
    """Return the value that holds at a time, or "" before the first."""
    return next((m.value for m in reversed(moments) if m.at_s <= at_s), "")


def playback_of(flight: RecordedFlight) -> Playback | None:
    """Return the data of a flight, or None if the log contains no motion in the air."""
    data = player_data(flight)
    if data is None:
        return None
    time_s = _scaled(data["t"], 1e-3)
    yaw, pitch, roll = (_scaled(data[name], 1e-3) for name in ("yaw", "pitch", "roll"))
    verdict = flight.verdict
    return Playback(
        flight.name,
        outcome_line(verdict.outcome.value, verdict.reason),
        verdict.outcome.value == "completed",
        time_s,
        np.stack([_scaled(data[axis], 1e-3) for axis in "xyz"], axis=1),
        quaternions(yaw, pitch, roll),
        _scaled(data["speed"], 1e-2),
        [Moment(1e-3 * at, name) for at, name in data["phases"]],
        [Moment(1e-3 * at, name) for at, name in data["lock"]],
        [Moment(1e-3 * act["t"], f"{act['rule']}: {act['action']}") for act in data["guard"]],
        [(1e-3 * at, (1e-3 * x, 1e-3 * y, 1e-3 * z)) for at, x, y, z in data["setpoints"]],
        _scaled(data["force"]["t"], 1e-3),
        np.stack([_scaled(data["force"][axis], 0.1) for axis in "xy"], axis=1),
        [_played(flight, impact) for impact in flight.impacts],
        [_scaled(line, 1e-3).reshape(-1, 2) for line in data["planned"]],
        _lock_chart(flight, time_s) if data["hasLock"] else None,
        flight.mission.altitude_m,
    )


def outcome_line(outcome: str, reason: str | None) -> str:
    return outcome if reason is None else f"{outcome}: {reason}"


def _scaled(values: list[Any], scale: float) -> Array:
    return np.asarray(values, dtype=float) * scale


def quaternions(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Return quaternions (n, 4); pitch is positive with the nose up, roll with the left side up."""
    cy, sy, cp, sp, cr, sr = (f(0.5 * a) for a in (yaw, -pitch, roll) for f in (np.cos, np.sin))
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


def _played(flight: RecordedFlight, impact: Impact) -> PlayedHit:
    wall, course = impact.collision.wall, flight.course
    time_s = np.arange(-_BEFORE_S, _AFTER_S, _STEP_S)
    planned = _planned(flight, impact, time_s)

    def chart(direction: tuple[float, float], of_plan: Array | None) -> ForceChart:
        flown = []
        for force in (course.estimated_force, course.true_force):
            shown = (force.time_s > impact.at_s - _BEFORE_S - 0.01) & (
                force.time_s < impact.at_s + _AFTER_S + 0.01
            )
            if shown.sum() < 2:
                flown.append(np.full(time_s.size, math.nan))
                continue
            values = force.force[shown, :2] @ np.array(direction)
            flown.append(np.interp(time_s, force.time_s[shown] - impact.at_s, values))
        unknown = np.full(time_s.size, math.nan)
        return ForceChart(1e3 * time_s, unknown if of_plan is None else of_plan, *flown)

    measured, peak = impact.verdict.measured, impact.verdict.force
    parts = [f"{impact.verdict.mode}"]
    if measured.normal_m_s is not None:
        parts.append(f"{math.hypot(measured.normal_m_s, measured.tangential_m_s or 0.0):.2f} m/s")
    if peak is not None:
        parts.append(f"{math.hypot(*peak):.0f} N")
    return PlayedHit(
        impact.at_s,
        impact.verdict.index,
        impact.verdict.wall,
        impact.verdict.onset.position_mission,
        ", ".join(parts),
        chart(wall.normal, None if planned is None else planned.normal_force_n),
        chart(wall.tangent, None if planned is None else planned.tangential_force_n),
    )


def _planned(flight: RecordedFlight, impact: Impact, time_s: Array) -> ContactHistory | None:
    """Return the planned hit, with its onset where the prediction for the measured velocity has it."""
    planned, vehicle = impact.verdict.planned, flight.mission.vehicle
    if planned.normal_m_s is None or planned.normal_m_s >= 0.0:
        return None
    coefficients = vehicle.materials[impact.material].coefficients(impact.collision.mode)
    contact = ContactMotion(coefficients, vehicle.airframe.mass_kg, planned.normal_m_s, Onset(vehicle.onset))
    since_s = time_s + impact.at_s - impact.onset_s
    return trajectory(contact, since_s, planned.tangential_m_s or 0.0, vehicle.vertical_force_sign)


def _lock_chart(flight: RecordedFlight, time_s: Array) -> LockChart:
    """Return the mode that the next collision needs, the mode of the lock, and that of the simulated arms."""
    mission, course = flight.mission, flight.course
    hits = [impact.at_s for impact in flight.impacts]
    modes: list[Mode] = [collision.mode for collision in mission.collisions]
    nominal = mission.transit_mode
    wanted = [
        modes[len(flown)] if len(flown := [at for at in hits if at < t]) < len(modes) else nominal
        for t in time_s
    ]
    lock = [
        (since, LOCK_LEVELS.get(name, math.nan))
        for since, _, name in lock_stretches(course, flight.shown_span[1])
    ]
    times, levels = np.array(lock, dtype=float).reshape(-1, 2).T
    index = np.searchsorted(times, time_s, side="right") - 1
    measured = np.where(index >= 0, levels[np.maximum(index, 0)], math.nan) if times.size else None
    truth = course.all(TruthSample)
    true = None
    if truth:
        true_s = np.array([course.time_of(t.t_us) for t in truth])
        level = np.array([LOCK_LEVELS[t.mode.value] for t in truth])
        true = level[np.clip(np.searchsorted(true_s, time_s), 0, len(level) - 1)]
    unknown = np.full(time_s.size, math.nan)
    return LockChart(
        time_s,
        np.array([math.nan if mode is None else LOCK_LEVELS[mode.value] for mode in wanted]),
        unknown if measured is None else measured,
        unknown if true is None else true,
    )
