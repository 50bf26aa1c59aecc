"""The fastest flight through events (visits, hits, corners) within limits, as an optimal control problem.

The time between two events is divided into equal intervals of constant jerk. Position, velocity and
acceleration are therefore polynomials of the time, and the states at the ends of an interval are exact
(direct multiple shooting). The solver chooses the duration between two events. A hit changes the velocity by
the contact law in closed form (`ContactResponse`) and lasts as long as the contact. After the hit, the thrust
stays constant for `dead_s`, because the attitude cannot jump and the next leg is planned in this time. The
drag is proportional to the velocity. CasADi states the problem and its derivatives, and IPOPT solves the
problem (extra `plan`). To keep clear of walls and posts, each part of a path stays inside half-planes and
outside discs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.records import Mode
from dart_flight.base.walls import Wall
from dart_flight.config.mission_file import TrajectoryPieces
from dart_flight.config.packages import missing_package
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.contact.coefficients import CoefficientArrays
from dart_flight.contact.contact_map import collide, contact_map
from dart_flight.contact.law import Onset
from dart_flight.core.mission.trajectories import transit_time_s
from dart_flight.lab.search.plan import MotionLimits, Plan, PlannedCollision
from dart_flight.lab.search.scenario import Scenario
from dart_flight.planning.polynomials import quintic
from dart_flight.planning.task import drag_along

Array = NDArray[np.float64]

INTERVALS = 10  # number of intervals in a part between two events
POLISHED = 3 * INTERVALS
_ANY_JERK_M_S3 = 200.0  # jerk limit if none is given
_LONGEST_S = 30.0  # maximum duration of a part
_LEAST_S = 0.05  # smallest initial guess of a part's duration
_FORCE_USED = 0.8  # usable fraction of limits.peak_force_n; the stiffness is known to about 15 %
_FRICTION_RATIO = 0.5  # default limit; low, because friction was measured only at 0.5 m/s
_SMOOTH = 1e-5  # cost of jerk, s per (m/s3)^2 s: selects the smoother of two equally fast flights
_GUESSED_M_S, _GUESSED_LEFT = 1.5, 0.7  # initial guess of a hit's speed and of its restitution
_THRUST_M_S2 = {Mode.FLEXIBLE: (-0.05, 0.2), Mode.RIGID: (-0.05, 1.0)}  # see `HitLimits`
_SOLVER: dict[str, Any] = {
    "print_time": False,
    "no_nlp_grad": True,  # this gradient is expensive, and IPOPT does not use it
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 250},
}


class HitLimits(NamedTuple):
    """The limits of a hit; None means that the quantity is not limited.

    Attributes:
        peak_force_n: largest force, normal force and friction together.
        closing_m_s: largest velocity along the normal.
        sliding_m_s: largest velocity along the wall.
        friction_ratio: largest ratio of friction to normal force.
        detectable_n: smallest normal force that is detected.
        thrust_m_s2: mode -> (smallest, largest) thrust per mass at the hit, positive away from the wall. A
            contact rotates a tilted vehicle, and a longer contact causes a larger rotation. With flexible
            arms the vehicle must therefore be nearly level at the hit. Otherwise the vehicle turns over and
            loses its velocity (docs/results/faster_hits.md).
        thrust_along_m_s2: largest thrust per mass along the wall at the hit.
    """

    peak_force_n: float
    closing_m_s: float | None
    sliding_m_s: float | None
    friction_ratio: float | None
    detectable_n: float
    thrust_m_s2: Mapping[Mode, Vec2] = _THRUST_M_S2
    thrust_along_m_s2: float = 1.0

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> HitLimits:
        limits = scenario.limits
        return cls(
            _FORCE_USED * limits.peak_force_n,
            limits.closing_m_s,
            limits.sliding_m_s,
            _FRICTION_RATIO if limits.friction_ratio is None else limits.friction_ratio,
            scenario.vehicle.detection.force_threshold_n,
        )


class ContactResponse(NamedTuple):
    """A contact in closed form; restitution and times do not depend on the speed.

    Attributes:
        restitution: outgoing over incoming normal velocity.
        lead_s: distance between the plane of first touch and the place where the force begins or ends,
            divided by the normal speed at that place. With `onset: lcp`, the force begins before the vehicle
            reaches the plane, and ends before it is back at the plane. With `onset: touch`, `lead_s` is 0.
        peak_n_per_m_s: peak of the normal force, divided by the incoming velocity.
        friction_s_per_m: decay of the velocity along the wall; a hit multiplies this velocity by
            exp(-friction_s_per_m * incoming velocity).
        mu_s_per_m: ratio of friction to normal force, divided by the velocity along the wall.
    """

    restitution: float
    contact_s: float
    lead_s: float
    peak_n_per_m_s: float
    friction_s_per_m: float
    mu_s_per_m: float

    @classmethod
    def at_wall(cls, vehicle: VehicleConfig, wall: Wall, mode: Mode) -> ContactResponse:
        c = vehicle.materials[wall.material].coefficients(mode)
        mass_kg, onset = vehicle.airframe.mass_kg, Onset(vehicle.onset)
        hit = contact_map(CoefficientArrays.from_table(c), mass_kg, np.array(-1.0), np.array(0.0), onset)
        lead_s = c.lead_s if onset is Onset.LCP else 0.0
        return cls(
            float(hit.normal_out_m_s),
            float(hit.contact_time_s),
            lead_s,
            float(hit.peak_normal_force_n),
            c.mu * float(hit.impulse_n_s) / mass_kg,
            c.mu,
        )


def most_sliding_m_s(limits: HitLimits, response: ContactResponse) -> float:
    """Return the largest velocity along the wall at a hit; infinite without a limit."""
    return min(
        math.inf if limits.sliding_m_s is None else limits.sliding_m_s,
        math.inf
        if limits.friction_ratio is None or not response.mu_s_per_m
        else limits.friction_ratio / response.mu_s_per_m,
    )


class Visit(NamedTuple):
    """A place to pass in flight, at a distance of at most `within_m`."""

    place: Vec2
    within_m: float


class Hit(NamedTuple):
    """A wall to hit.

    Attributes:
        visit: the visit that the vehicle passes at the moment of the hit.
        guess: initial guess of the position.
        velocity_m_s: (normal, tangential) velocity of the hit; None if the solver chooses the velocity.
    """

    wall: Wall
    mode: Mode
    visit: Visit | None = None
    guess: Vec2 | None = None
    velocity_m_s: Vec2 | None = None


class RouteCorner(NamedTuple):
    """A corner of a path around a wall's end, at which the path passes into another half-plane.

    `place` is an initial guess.
    """

    place: Vec2


class Cruise(NamedTuple):
    """A place to pass at a velocity, without acceleration."""

    place: Vec2
    velocity: Vec2


class HalfPlane(NamedTuple):
    """The places p with `normal . p >= offset_m`."""

    normal: Vec2
    offset_m: float


class Disc(NamedTuple):
    """The places at least `radius_m` from a centre, around a post or the end of a wall."""

    centre: Vec2
    radius_m: float


Region = HalfPlane | Disc
Event = Visit | Hit | RouteCorner | Cruise


class Part(NamedTuple):
    """The path to an event, within the regions `keep`; the last part ends at the goal, without an event."""

    to: Event | None
    keep: tuple[Region, ...]


class Problem(NamedTuple):
    """An optimal control problem: from rest at `start` through all parts to rest at `goal`."""

    vehicle: VehicleConfig
    start: Vec2
    goal: Vec2
    parts: tuple[Part, ...]
    limits: MotionLimits
    hits: HitLimits
    dead_s: float


class _Transcription:
    """The problem as variables, constraints and initial guess for the solver."""

    def __init__(self, casadi: Any, problem: Problem, intervals: int) -> None:
        self.ca, self.problem, self.intervals = casadi, problem, intervals
        self.variables: list[Any] = []
        self.guess: list[float] = []
        self.low: list[float] = []
        self.high: list[float] = []
        self.constraints: list[Any] = []
        self.g_low: list[float] = []
        self.g_high: list[float] = []
        self.cost: Any = 0.0
        self.times: list[Any] = []
        self.states: list[Any] = []  # (6, n + 1) of each part
        self.jerks: list[Any] = []  # (2, n)

    def variable(self, name: str, guess: Array, low: float, high: float) -> Any:
        """Add an array of unknowns with the shape of `guess`, and return the unknowns."""
        symbol = self.ca.SX.sym(name, *guess.shape)
        self.variables.append(self.ca.vec(symbol))
        self.guess += guess.ravel(order="F").tolist()
        self.low += [low] * guess.size
        self.high += [high] * guess.size
        return symbol

    def require(self, value: Any, low: float, high: float) -> None:
        entries = self.ca.vec(value)
        self.constraints.append(entries)
        self.g_low += [low] * entries.shape[0]
        self.g_high += [high] * entries.shape[0]

    def propagate(self, states: Any, dt: Any, jerks: Any) -> Any:
        """Return states (x, y, vx, vy, ax, ay), one per column, after some time at a constant jerk."""
        p, v, a = states[:2, :], states[2:4, :], states[4:6, :]
        return self.ca.vertcat(
            p + v * dt + a * (dt**2 / 2) + jerks * (dt**3 / 6),
            v + a * dt + jerks * (dt**2 / 2),
            a + jerks * dt,
        )

    def add_part(self, i: int, part: Part, begin: _GuessedEnd, end: _GuessedEnd) -> None:
        ca, n, limits = self.ca, self.intervals, self.problem.limits
        jerk_most = limits.jerk_m_s3 or _ANY_JERK_M_S3
        length = distance2(begin.place, end.place)
        usual_s = transit_time_s(length, limits.speed_m_s, limits.acceleration_m_s2, limits.jerk_m_s3) + 0.3
        speeds = math.hypot(*begin.velocity), math.hypot(*end.velocity)
        if min(speeds) > 0.0:  # the vehicle does not stop: assume the mean of the two speeds
            usual_s = max(_LEAST_S, 2.0 * length / sum(speeds))  # `length` may be 0
        duration = self.variable(f"T{i}", np.array([[float(usual_s)]]), 1e-3, _LONGEST_S)
        guessed = _quintic_states(begin, end, float(usual_s), n)
        states = self.variable(f"x{i}", guessed, -math.inf, math.inf)
        self.require(ca.sum1(states[2:4, :] ** 2), -math.inf, limits.speed_m_s**2)
        self.require(ca.sum1(states[4:6, :] ** 2), -math.inf, limits.acceleration_m_s2**2)
        for region in part.keep:
            if isinstance(region, Disc):
                away = states[:2, :] - ca.repmat(ca.DM(region.centre), 1, n + 1)
                self.require(ca.sum1(away**2) / region.radius_m**2, 1.0, math.inf)
                continue
            along = region.normal[0] * states[0, :] + region.normal[1] * states[1, :]
            self.require(along, region.offset_m, math.inf)
        changes = np.diff(guessed[4:], axis=1) * n / float(usual_s)
        jerks, dt = self.variable(f"j{i}", changes, -jerk_most, jerk_most), duration / n
        squares = ca.sum1(jerks**2)
        self.require(squares / jerk_most**2, -math.inf, 1.0)
        self.require(states[:, 1:] - self.propagate(states[:, :-1], dt, jerks), 0.0, 0.0)
        self.cost += duration + _SMOOTH * ca.sum2(squares) * dt
        self.times.append(duration)
        self.states.append(states)
        self.jerks.append(jerks)

    def join(self, i: int, event: Event) -> None:
        """Connect the end of part `i` to the start of the next part, as the event between them requires."""
        before, after = self.states[i][:, -1], self.states[i + 1][:, 0]
        if isinstance(event, Hit):
            self.add_hit(event, before, after)
            return
        self.require(after - before, 0.0, 0.0)
        if isinstance(event, Visit):
            self.require_near(before, event)
        elif isinstance(event, Cruise):
            pinned = self.ca.vertcat(*event.place, *event.velocity, 0.0, 0.0)
            self.require(before - pinned, 0.0, 0.0)

    def require_near(self, state: Any, visit: Visit) -> None:
        away = self.ca.sumsqr(state[:2] - self.ca.DM(visit.place))
        self.require(away / visit.within_m**2, -math.inf, 1.0)

    def add_hit(self, event: Hit, before: Any, after: Any) -> None:
        """Connect the onset of a hit to the start of the next leg; release and dead time lie between them."""
        ca, wall, limits = self.ca, event.wall, self.problem.hits
        response = ContactResponse.at_wall(self.problem.vehicle, wall, event.mode)
        n, t = ca.DM(wall.normal), ca.DM(wall.tangent)
        place, velocity = before[:2] - ca.DM(wall.point), before[2:4]
        vn, vt = ca.dot(n, velocity), ca.dot(t, velocity)
        self.require(ca.dot(n, place) + response.lead_s * vn, 0.0, 0.0)
        reach = 0.5 * wall.length_m - wall.half_vehicle_m
        self.require(ca.dot(t, place), -reach, reach)
        slowest = 1.2 * limits.detectable_n / response.peak_n_per_m_s
        self.require(-vn, slowest, math.inf if limits.closing_m_s is None else limits.closing_m_s)
        force2 = response.peak_n_per_m_s**2 * vn**2 * (1.0 + (response.mu_s_per_m * vt) ** 2)
        self.require(force2 / limits.peak_force_n**2, -math.inf, 1.0)
        sliding = most_sliding_m_s(limits, response)
        if sliding < math.inf:
            self.require(vt, -sliding, sliding)
        drag_n, drag_t = drag_along(wall, self.problem.vehicle.airframe.drag_per_s)
        self.require(ca.dot(n, before[4:6]) + drag_n * vn, *limits.thrust_m_s2[event.mode])
        most = limits.thrust_along_m_s2
        self.require(ca.dot(t, before[4:6]) + drag_t * vt, -most, most)
        if event.visit is not None:
            self.require_near(before, event.visit)
        if event.velocity_m_s is not None:
            self.require(ca.vertcat(vn, vt) - ca.DM(event.velocity_m_s), 0.0, 0.0)
        out_n, out_t = -response.restitution * vn, vt * ca.exp(response.friction_s_per_m * vn)
        slide = 0.5 * (vt + out_t) * response.contact_s
        release = before[:2] + n * (-response.lead_s * out_n + response.lead_s * vn) + t * slide
        # The thrust is continuous, but the drag jumps with the velocity.
        pushed = before[4:6] + n * drag_n * (vn - out_n) + t * drag_t * (vt - out_t)
        released = ca.vertcat(release, n * out_n + t * out_t, pushed)
        self.require(after - self.propagate(released, self.problem.dead_s, ca.DM([0.0, 0.0])), 0.0, 0.0)


class _GuessedEnd(NamedTuple):
    place: Vec2
    velocity: Vec2


def _guessed_ends(problem: Problem) -> list[tuple[_GuessedEnd, _GuessedEnd]]:
    """Return the guessed start and end of every part, with a velocity only at hits and cruises."""
    found = []
    here = _GuessedEnd(problem.start, (0.0, 0.0))
    for part in problem.parts:
        if isinstance(part.to, Hit):
            wall, place = part.to.wall, part.to.guess or part.to.wall.foot(here.place)
            guessed_m_s = _GUESSED_M_S if part.to.velocity_m_s is None else -part.to.velocity_m_s[0]
            (nx, ny), out = wall.normal, guessed_m_s * _GUESSED_LEFT
            end = _GuessedEnd(place, (-guessed_m_s * nx, -guessed_m_s * ny))
            found.append((here, end))
            here = _GuessedEnd(place, (out * nx, out * ny))
            continue
        velocity = part.to.velocity if isinstance(part.to, Cruise) else (0.0, 0.0)
        end = _GuessedEnd(problem.goal if part.to is None else part.to.place, velocity)
        found.append((here, end))
        here = end
    return found


def _quintic_states(begin: _GuessedEnd, end: _GuessedEnd, duration_s: float, n: int) -> Array:
    """Return the states (6, n + 1) along a smooth path from one end to the other."""
    axes, s = [], np.linspace(0.0, duration_s, n + 1)
    for axis in range(2):
        first, last = ((state.place[axis], state.velocity[axis], 0.0) for state in (begin, end))
        poly = np.polynomial.Polynomial(quintic(first, last, np.array([duration_s]))[:, 0])
        axes.append([poly(s), poly.deriv(1)(s), poly.deriv(2)(s)])
    return np.stack([axes[axis][order] for order in range(3) for axis in range(2)])


def solve(problem: Problem, intervals: int = INTERVALS, tolerance: float = 1e-6) -> Plan | None:
    """Return the fastest flight through the events of a problem; None if the solver fails.

    Args:
        intervals: number of intervals of constant jerk in each part.
        tolerance: tolerance of the solver. A tolerance of 1e-4 saves 80 % of the iterations and makes the
            duration of a 6 s flight wrong by 2 ms.
    """
    try:
        import casadi  # noqa: PLC0415  (an extra)
    except ImportError:
        raise missing_package("the quickest flight needs casadi", "plan") from None
    if not all(_is_possible(problem.vehicle, part.to) for part in problem.parts):
        return None
    t = _Transcription(casadi, problem, intervals)
    for i, (part, ends) in enumerate(zip(problem.parts, _guessed_ends(problem), strict=True)):
        t.add_part(i, part, *ends)
    for i, part in enumerate(problem.parts):
        if part.to is not None:
            t.join(i, part.to)
    rest = casadi.DM.zeros(4)
    for state, place in ((t.states[0][:, 0], problem.start), (t.states[-1][:, -1], problem.goal)):
        t.require(state - casadi.vertcat(casadi.DM(place), rest), 0.0, 0.0)
    x, g = casadi.vertcat(*t.variables), casadi.vertcat(*t.constraints)
    options = _SOLVER | {"ipopt": _SOLVER["ipopt"] | {"tol": tolerance}}
    solver = casadi.nlpsol("quickest", "ipopt", {"x": x, "f": t.cost, "g": g}, options)
    found = solver(x0=t.guess, lbx=t.low, ubx=t.high, lbg=t.g_low, ubg=t.g_high)
    if not solver.stats()["success"]:
        return None
    values = casadi.Function("values", [x], [*t.times, *t.states, *t.jerks])(found["x"])
    return _as_plan(problem, intervals, [np.array(v) for v in values])


def _is_possible(vehicle: VehicleConfig, event: Event | None) -> bool:
    if not isinstance(event, Hit):
        return True
    response = ContactResponse.at_wall(vehicle, event.wall, event.mode)
    return math.isfinite(response.contact_s) and response.restitution > 0.0


def _as_plan(problem: Problem, n: int, values: list[Array]) -> Plan:
    count = len(problem.parts)
    durations = [float(v[0, 0]) for v in values[:count]]
    states, jerks = values[count : 2 * count], values[2 * count :]
    legs: list[TrajectoryPieces] = []
    hits: list[PlannedCollision] = []
    visits: list[float] = []
    now, pieces, begin = 0.0, [], states[0][:, 0]
    for i, part in enumerate(problem.parts):
        pieces += [(durations[i] / n, float(j[0]), float(j[1])) for j in jerks[i].T]
        now += durations[i]
        if isinstance(part.to, Visit) or (isinstance(part.to, Hit) and part.to.visit is not None):
            visits.append(now)
        if isinstance(part.to, Hit) or part.to is None:
            legs.append(_leg(begin, pieces))
            pieces = []
        if isinstance(part.to, Hit):
            response = ContactResponse.at_wall(problem.vehicle, part.to.wall, part.to.mode)
            hits.append(_hit(part.to, problem.vehicle, now, states[i][:, -1]))
            now += response.contact_s + problem.dead_s
            begin = states[i + 1][:, 0]
    return Plan(
        rank=1,
        score=now,
        goal_miss_m=0.0,
        time_to_goal_s=now,
        peak_force_n=max((math.hypot(hit.peak_force_n, hit.peak_friction_n) for hit in hits), default=0.0),
        closest_m=problem.goal,
        collisions=tuple(hits),
        time_to_rest_s=now,
        visits_s=tuple(visits),
        legs=tuple(legs),
    )


def _leg(begin: Array, pieces: list[tuple[float, float, float]]) -> TrajectoryPieces:
    """Return a leg; successive pieces with the same jerk become one piece."""
    joined: list[tuple[float, float, float]] = []
    for dt, jx, jy in pieces:
        if joined and math.hypot(joined[-1][1] - jx, joined[-1][2] - jy) < 1e-3:
            joined[-1] = (joined[-1][0] + dt, *joined[-1][1:])
        else:
            joined.append((dt, jx, jy))
    x, y, vx, vy, ax, ay = (float(v) for v in begin)
    return TrajectoryPieces((x, y), joined, (vx, vy), (ax, ay))


def _hit(event: Hit, vehicle: VehicleConfig, t_s: float, state: Array) -> PlannedCollision:
    x, y, vx, vy, ax, ay = (float(v) for v in state)
    normal, tangential, _ = event.wall.to_collision((vx, vy, 0.0))
    pushed = event.wall.to_collision((ax, ay, 0.0))
    coefficients = vehicle.materials[event.wall.material].coefficients(event.mode)
    hit = collide(coefficients, vehicle.airframe.mass_kg, normal, tangential, Onset(vehicle.onset))
    return PlannedCollision(
        wall=event.wall.name,
        mode=event.mode,
        t_s=t_s,
        position_m=(x, y),
        normal_m_s=normal,
        tangential_m_s=tangential,
        peak_force_n=hit.peak_normal_force_n,
        peak_friction_n=hit.peak_friction_force_n,
        contact_time_s=hit.contact_time_s,
        acceleration_m_s2=(pushed[0], pushed[1]),
    )
