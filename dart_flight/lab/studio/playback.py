"""A recorded flight as data for the player; no viser in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3, quaternion_from_euler
from dart_flight.base.records import Mode, TruthSample
from dart_flight.contact.law import Onset
from dart_flight.lab.flight_arrays import Array
from dart_flight.lab.predict.path import ContactHistory, ContactMotion, trajectory
from dart_flight.lab.report.player import player_data
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight
from dart_flight.lab.report.tracks import in_force, lock_stretches
from dart_flight.lab.studio.engine import FlownOne

_BEFORE_S, _AFTER_S, _STEP_S = 0.06, 0.175, 0.001  # time of the force charts around a detection
_MOST_POINTS = 300  # of the line of one of many flights
LOCK_LEVELS = {Mode.FLEXIBLE.value: 0.0, "travelling": 0.5, Mode.RIGID.value: 1.0}  # heights in the chart

V = TypeVar("V")
Moments = Sequence[tuple[float, V]]  # values, each with the time in s from which on it holds


class Chart(NamedTuple):
    """Curves over time, arrays (n,); NaN where unknown."""

    time: Array
    planned: Array
    measured: Array
    true: Array


class PlayedHit(NamedTuple):
    """A hit of a flight.

    Attributes:
        summary: velocities, peak force and lock mode in one line.
        normal, friction: forces in N over ms after the detection; planned by the contact law at the planned
            velocity.
    """

    at_s: float
    number: int
    wall: str
    summary: str
    normal: Chart
    friction: Chart


class Playback(NamedTuple):
    """A flight to play.

    Attributes:
        summary: the outcome in one line.
        time_s: times of the frames, (n,).
        position, quaternion: (n, 3), and (n, 4) from the vehicle's axes (forward, left, up) to the mission
            frame, scalar first.
        setpoints: places of the active setpoint.
        force_s, force_n: times (k,) and estimated horizontal force (k, 2), N.
        lock_chart: mode of the arms (`LOCK_LEVELS`) over s, or None without a lock.
    """

    name: str
    summary: str
    completed: bool
    time_s: Array
    position: Array
    quaternion: Array
    speed_m_s: Array
    phases: Moments[str]
    lock: Moments[str]
    guard: Moments[str]
    setpoints: Moments[Vec3]
    force_s: Array
    force_n: Array
    hits: list[PlayedHit]
    lock_chart: Chart | None

    def frame(self, at_s: float) -> tuple[Array, Array]:
        """Return position and quaternion at a time of the flight."""
        index = int(np.clip(np.searchsorted(self.time_s, at_s), 1, len(self.time_s) - 1))
        begin, end = self.time_s[index - 1 : index + 1]
        share = float(np.clip((at_s - begin) / (end - begin), 0.0, 1.0))
        position, turned = (
            (1.0 - share) * values[index - 1] + share * values[index]
            for values in (self.position, self.quaternion)
        )
        return position, turned / np.linalg.norm(turned)

    def force_at(self, at_s: float) -> Vec2:
        """Return the estimated horizontal force at a time, N."""
        if not self.force_s.size:
            return 0.0, 0.0
        x, y = (float(np.interp(at_s, self.force_s, self.force_n[:, i])) for i in (0, 1))
        return x, y

    def next_hit(self, at_s: float) -> PlayedHit | None:
        """Return the first hit after a time, or the first of all."""
        after = [hit for hit in self.hits if hit.at_s > at_s + 1e-3]
        return next(iter(after or self.hits), None)

    def hit_near(self, at_s: float) -> PlayedHit | None:
        return min(self.hits, key=lambda hit: abs(hit.at_s - at_s), default=None)


def value_at(moments: Moments[V], at_s: float, before: V) -> V:
    """Return the value that holds at a time, or `before` if the first comes later."""
    return next((value for since_s, value in reversed(moments) if since_s <= at_s), before)


def playback_of(flight: RecordedFlight) -> Playback | None:
    """Return the data of a flight, or None if the log contains no motion in the air."""
    data = player_data(flight)
    if data is None:
        return None
    time_s = _scaled(data["t"], 1e-3)
    angles = zip(*(_scaled(data[name], 1e-3) for name in ("roll", "pitch", "yaw")), strict=True)
    verdict = flight.verdict
    return Playback(
        flight.name,
        outcome_line(verdict.outcome.value, verdict.reason),
        verdict.outcome.value == "completed",
        time_s,
        np.stack([_scaled(data[axis], 1e-3) for axis in "xyz"], axis=1),
        # With z up, the nose goes up for a negative angle.
        np.array([quaternion_from_euler(roll, -pitch, yaw) for roll, pitch, yaw in angles]),
        _scaled(data["speed"], 1e-2),
        [(1e-3 * at, name) for at, name in data["phases"]],
        [(1e-3 * at, name) for at, name in data["lock"]],
        [(1e-3 * act["t"], f"{act['rule']}: {_action(act['action'])}") for act in data["guard"]],
        [(1e-3 * at, (1e-3 * x, 1e-3 * y, 1e-3 * z)) for at, x, y, z in data["setpoints"]],
        _scaled(data["force"]["t"], 1e-3),
        np.stack([_scaled(data["force"][axis], 0.1) for axis in "xy"], axis=1),
        [_played(flight, impact) for impact in flight.impacts],
        _lock_chart(flight, time_s) if data["hasLock"] else None,
    )


def _action(name: str) -> str:
    return "the action stays" if name == "none" else name.replace("_", " ")


def outcome_line(outcome: str, reason: str | None) -> str:
    return outcome if reason is None else f"{outcome}: {reason}"


def flown_from(log: Path) -> FlownOne:
    """Return a recorded flight as one of many."""
    flight = RecordedFlight.read(log)
    motion = flight.course.true if flight.course.true.time_s.size else flight.course.estimated
    path = motion.position[:: max(1, len(motion.position) // _MOST_POINTS)]
    verdict = flight.verdict
    return FlownOne(flight.log.seed or 0, verdict.outcome.value, verdict.reason, path, str(log))


def _scaled(values: list[Any], scale: float) -> Array:
    return np.asarray(values, dtype=float) * scale


def _played(flight: RecordedFlight, impact: Impact) -> PlayedHit:
    wall, course = impact.collision.wall, flight.course
    time_s = np.arange(-_BEFORE_S, _AFTER_S, _STEP_S)
    planned, unknown = _planned(flight, impact, time_s), np.full(time_s.size, math.nan)

    def chart(direction: Vec2, of_plan: Array | None) -> Chart:
        flown = [unknown, unknown]
        for i, force in enumerate((course.estimated_force, course.true_force)):
            if force.time_s.size > 1:
                along = force.force[:, :2] @ np.array(direction)
                after_s = force.time_s - impact.at_s
                flown[i] = np.interp(time_s, after_s, along, left=math.nan, right=math.nan)
        return Chart(1e3 * time_s, unknown if of_plan is None else of_plan, *flown)

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


def _lock_chart(flight: RecordedFlight, time_s: Array) -> Chart:
    """Return the mode that the next collision needs, the mode of the lock, and that of the simulated arms."""
    mission, course = flight.mission, flight.course
    modes = [*(collision.mode for collision in mission.collisions), mission.transit_mode]
    flown = np.searchsorted([impact.at_s for impact in flight.impacts], time_s)  # hits before each time
    wanted = [modes[min(int(n), len(modes) - 1)] for n in flown]

    def levels(moments: Moments[str]) -> Array:
        index, known = in_force(np.array([at for at, _ in moments]), time_s)
        values = np.array([LOCK_LEVELS.get(name, math.nan) for _, name in moments] or [math.nan])
        return np.where(known, values[index], math.nan)

    return Chart(
        time_s,
        np.array([math.nan if mode is None else LOCK_LEVELS[mode.value] for mode in wanted]),
        levels([(since, name) for since, _, name in lock_stretches(course, flight.shown_span[1])]),
        levels([(course.time_of(t.t_us), t.mode.value) for t in course.all(TruthSample)]),
    )
