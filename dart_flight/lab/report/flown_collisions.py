"""Where the events of a flight happened: its hits and what the guard did, for the map and the animation."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from dart_flight.base.geometry import Vec2, Vec3
from dart_flight.base.records import (
    GuardEvent,
    ImpactOnset,
    LockPhase,
    LockState,
    Mode,
    Phase,
    PhaseChange,
    Setpoint,
)
from dart_flight.lab.flight_arrays import FlightArrays
from dart_flight.lab.report.recorded_flight import Impact, RecordedFlight
from dart_flight.lab.report.tracks import angles

V = TypeVar("V")


class FlownCollision(NamedTuple):
    """A planned collision as it was met.

    Attributes:
        impact: the figures of it.
        position: of the centre at the onset, mission frame.
        yaw_rad: mission yaw then.
        mode: that the lock reported as settled; None: it was not.
        force_n: peaks of normal force and friction as a vector, mission frame; None where not measured.
        set_point: that followed, mission frame.
    """

    impact: Impact
    position: Vec3
    yaw_rad: float
    mode: Mode | None
    force_n: Vec2 | None
    setpoint: Vec3 | None


class GuardAct(NamedTuple):
    """A rule that fired, and where the vehicle was; None where that is not known."""

    at_s: float
    rule: str
    action: str
    place: Vec2 | None


def flown_collisions(flight: RecordedFlight) -> list[FlownCollision]:
    """The hits of a flight, in order."""
    course = flight.course
    onsets = {o.t_us: o for o in course.all(ImpactOnset)}
    heading = angles(course)
    found = []
    for impact in flight.impacts:
        onset = onsets.get(impact.verdict.t_us)
        if onset is None:
            continue
        yaw = float(np.interp(impact.at_s, heading.time_s, heading.yaw)) if heading.time_s.size else 0.0
        found.append(
            FlownCollision(
                impact,
                onset.position_mission,
                yaw,
                lock_mode(course, onset.t_us) if flight.mission.vehicle.has_lock else Mode.RIGID,
                _force(impact),
                _recovery_setpoint(course, onset.t_us),
            )
        )
    return found


def _force(impact: Impact) -> Vec2 | None:
    peak = impact.peak
    if peak is None:
        return None
    x, y, _ = impact.collision.wall.from_collision((peak.normal_force_n, peak.tangential_force_n, 0.0))
    return x, y


def _recovery_setpoint(course: FlightArrays, onset_us: int) -> Vec3 | None:
    """The recovery setpoint of the impact that began then."""
    following = [o.t_us for o in course.all(ImpactOnset) if o.t_us > onset_us]
    until = min(following, default=1 << 62)
    sent = next((s for s in course.all(Setpoint) if s.recovery and onset_us <= s.t_us < until), None)
    frame = None if sent is None else course.frame_at(sent.t_us)
    return None if sent is None or frame is None else frame.point_from_ned(sent.position_ned)


def lock_mode(course: FlightArrays, t_us: int) -> Mode | None:
    """The mode in which the lock was settled at a moment."""
    before = [s for s in course.all(LockState) if s.t_us <= t_us]
    return before[-1].mode if before and before[-1].phase is LockPhase.SETTLED else None


def guard_acts(flight: RecordedFlight) -> list[GuardAct]:
    """What the guard did, in order."""
    course = flight.course
    return [
        GuardAct(course.time_of(g.t_us), g.rule, g.action.value, place_at(flight, course.time_of(g.t_us)))
        for g in course.all(GuardEvent)
    ]


def place_at(flight: RecordedFlight, at_s: float) -> Vec2 | None:
    """Where the vehicle was from above, by its own estimate."""
    motion = flight.course.estimated
    if not motion.time_s.size:
        return None
    x, y = (float(np.interp(at_s, motion.time_s, motion.position[:, i])) for i in (0, 1))
    return x, y


def airborne(flight: RecordedFlight) -> tuple[float, float] | None:
    """From the climb to the landing, s; None of a flight that did not leave the ground."""
    changes = flight.course.all(PhaseChange)
    begin = next((flight.course.time_of(c.t_us) for c in changes if c.after is Phase.CLIMB), None)
    if begin is None:
        return None
    end = next(
        (flight.course.time_of(c.t_us) for c in changes if c.after in (Phase.LANDING, Phase.DONE)),
        float("inf"),
    )
    return begin, end


def shown_span(flight: RecordedFlight) -> tuple[float, float]:
    """The time that figures over the whole flight show: from the climb until a second into the landing."""
    motion = flight.course.estimated
    if not motion.time_s.size:
        return (0.0, 1.0)
    air = airborne(flight)
    last = float(motion.time_s[-1])
    return (air[0], min(last, air[1] + 1.0)) if air is not None else (0.0, last)


def stretches(moments: list[tuple[float, V]], end: float) -> list[tuple[float, float, V]]:
    """Values that hold from one moment to the next, the last to the end."""
    stops = [t for t, _ in moments[1:]] + [end] if moments else []
    return [(t, stop, value) for (t, value), stop in zip(moments, stops, strict=True)]


def lock_stretches(course: FlightArrays, end_s: float) -> list[tuple[float, float, str]]:
    """(since, until, what) of the lock: rigid, flexible, travelling, fault or unknown."""

    def name(state: LockState) -> str:
        known = state.mode.value if state.mode else "unknown"
        return known if state.phase is LockPhase.SETTLED else state.phase.value

    return stretches([(course.time_of(s.t_us), name(s)) for s in course.all(LockState)], end_s)
