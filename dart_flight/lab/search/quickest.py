"""Search for the fastest flight past all visits to the goal; the vehicle hits walls if this saves time.

The planner searches sequences of events (visits and hits). Each sequence has a lower bound on its time: the
contact times, plus the shortest time along each straight leg of the shortest path through the events. The
sequence with the lowest bound is computed first. A sequence whose bound exceeds the time of the best flight
found is not computed. For a computed sequence, optimal control (`optimal_trajectory`) finds places,
velocities and times. Flexible arms are tried first. A hit is changed to rigid arms if this is faster and the
servo has enough time.
"""

from __future__ import annotations

import heapq
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from enum import Enum

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import Vec2, distance2
from dart_flight.base.walls import Wall
from dart_flight.config.document import InputError
from dart_flight.core.mission.commitment import SETTLED_BEFORE_S
from dart_flight.lab.search.limited_sight import plan_limited_sight
from dart_flight.lab.search.optimal_trajectory import (
    INTERVALS,
    POLISHED,
    ContactResponse,
    Event,
    Hit,
    HitLimits,
    Part,
    Problem,
    RouteCorner,
    Visit,
    most_sliding_m_s,
    solve,
)
from dart_flight.lab.search.plan import MotionLimits, Plan, SearchResult
from dart_flight.lab.search.routes import Obstacles, regions, room_of, shortest_path
from dart_flight.lab.search.scenario import Scenario

Progress = Callable[[int, int], None]
Array = NDArray[np.float64]

MOST_HITS = 16  # longest sequence searched, in hits; `gap_s` covers the longer ones
_TOLERANCE_USED = 0.8  # fraction of a visit's tolerance used; the rest is a margin for tracking errors
_COMPARED_TO, _POLISHED_TO = 1e-4, 1e-6  # solver tolerance for comparing and for refining plans
_SWEEPS = 12  # number of iterations for the shortest path through discs and walls
_SLACK = 0.98  # factor on a leg's length, because the iterations end slightly above the shortest path
_REVERSAL_COSINE = -0.9  # cosine between two legs below which the path reverses between them
_SPEEDS = 61
_TRIED_IN_OTHER_MODE = 3  # number of the fastest sequences that are also tried in other modes
_SEARCHED = 0.94  # fraction of the time for the search; the rest is for refining the plan


def plan_quickest(
    scenario: Scenario, within_s: float = math.inf, progress: Progress = lambda done, of: None
) -> SearchResult:
    """Search a scenario with the objective `quickest`.

    The plan must hit the walls of the scenario's sequence, if there is a sequence.

    Args:
        within_s: time limit of the search; the best plan found in this time is refined and returned. A search
            with `sight` has no limit.
        progress: called with the number of computed sequences and the number of known sequences.

    Raises:
        InputError: no flight within the limits satisfies the scenario.
    """
    began = time.perf_counter()
    if scenario.sight is not None:
        free, colliding, computed = plan_limited_sight(scenario, scenario.sight, progress)
        plans = _ranked(scenario, free, colliding)
        return SearchResult(scenario, plans, computed, len(plans), computed, time.perf_counter() - began)
    search = _Search(scenario)
    search.run(lambda: time.perf_counter() - began > _SEARCHED * within_s, progress)
    plans = _ranked(scenario, search.polished(search.free), search.polished(search.colliding))
    return SearchResult(
        scenario,
        plans,
        candidates=search.computed + search.pruned,
        feasible=search.feasible,
        trajectories=search.computed,
        elapsed_s=time.perf_counter() - began,
        gap_s=max(0.0, plans[0].time_to_goal_s - search.least_open_s),
        most_hits=MOST_HITS if search.left_out_s < plans[0].time_to_goal_s else None,
    )


def _ranked(scenario: Scenario, free: Plan | None, colliding: Plan | None) -> tuple[Plan, ...]:
    """Return the plans ranked by time to the goal, each with the time it saves; reject an empty result."""
    demanded = _demanded(scenario)
    plans = [plan for plan in (free, colliding) if plan is not None]
    if demanded and colliding is None:
        problem = f"no feasible trajectory hits {', '.join(demanded)} and rests at the goal within the limits"
        raise InputError(problem, source=scenario.source, key=("limits",))
    if not plans:
        problem = "no feasible trajectory visits every place and rests at the goal within limits and bounds"
        raise InputError(problem, source=scenario.source, key=("limits",))
    plans.sort(key=lambda plan: (bool(demanded) and plan is free, plan.time_to_goal_s))
    return tuple(
        msgspec.structs.replace(plan, rank=rank, saving_s=free and free.time_to_goal_s - plan.time_to_goal_s)
        for rank, plan in enumerate(plans, start=1)
    )


def _demanded(scenario: Scenario) -> tuple[str, ...]:
    """Return the walls that the plan must hit, whether the hits save time or not."""
    return () if scenario.chosen_by_planner else scenario.sequences[0]


class LegEnd(Enum):
    """The constraint on the motion at an end of a straight leg."""

    REST = "rest"  # velocity and acceleration are zero
    REVERSAL = "reversal"  # the velocity along the leg is zero
    HIT = "hit"  # any velocity into the wall before the hit, the remaining velocity after it
    ANY = "any"


class LeastTimes:
    """Lower bounds on the flight times of straight legs.

    `left_m_s` is the largest speed at which the vehicle leaves a wall after a hit.
    """

    def __init__(self, limits: MotionLimits, left_m_s: float) -> None:
        self._limits, self._left_m_s = limits, left_m_s
        self._speeds = np.linspace(0.0, limits.speed_m_s, _SPEEDS)

    def leg_s(self, length_m: float, begin: LegEnd, end: LegEnd) -> float:
        """Return a lower bound on the time of a leg: accelerate as far as possible, cruise, brake."""
        # If the vehicle stops at both ends, its speed peaks between them, where its acceleration is zero.
        levels = {begin, end} <= {LegEnd.REST, LegEnd.REVERSAL}
        before_s, before_m = self._to_speed(begin, True, levels)
        after_s, after_m = self._to_speed(end, False, levels)
        fits = np.flatnonzero(before_m + after_m <= length_m + 1e-12)
        # The next speed of the grid is slightly too high, which keeps the result a lower bound.
        top = min(int(fits[-1]) + 1, _SPEEDS - 1) if fits.size else 1
        cruise_m = max(0.0, length_m - before_m[top] - after_m[top])
        below = max(0, top - 1)
        ramped_s = before_s[below] + after_s[below] + cruise_m / self._speeds[top]
        return max(float(ramped_s), length_m / self._limits.speed_m_s)

    def _to_speed(self, end: LegEnd, leaving: bool, levels: bool) -> tuple[Array, Array]:
        """Return the time and distance to gain or lose each of `_speeds` at a leg's end.

        If `levels` is True, the acceleration must be zero when the vehicle has one of these speeds.
        """
        v, a, j = self._speeds, self._limits.acceleration_m_s2, self._limits.jerk_m_s3
        zero = np.zeros_like(v)
        if end is LegEnd.ANY or (end is LegEnd.HIT and not leaving):
            return zero, zero
        if end is LegEnd.HIT:
            left = self._left_m_s
            more = np.maximum(v - left, 0.0)
            return more / a, more * (left + 0.5 * more) / a
        if j is None or (end is LegEnd.REVERSAL and not levels):
            return v / a, 0.5 * v**2 / a
        if end is LegEnd.REVERSAL:  # accelerate fully, then reduce the acceleration at the jerk limit
            gained = np.minimum(v, 0.5 * a * a / j)
            level_s = np.sqrt(2.0 * gained / j)
            hard_s = (v - gained) / a
            return hard_s + level_s, 0.5 * a * hard_s**2 + v * level_s - j * level_s**3 / 6.0
        if levels:  # the acceleration rises from 0 and falls to 0, symmetric about half the speed
            whole_s = np.where(v > a * a / j, v / a + a / j, 2.0 * np.sqrt(v / j))
            return whole_s, 0.5 * v * whole_s
        # From rest the acceleration grows at the jerk limit up to its own limit.
        ramp_v = np.minimum(v, 0.5 * a * a / j)
        ramp_s = np.sqrt(2.0 * ramp_v / j)
        rest_s = (v - ramp_v) / a
        return ramp_s + rest_s, j * ramp_s**3 / 6.0 + (ramp_v + 0.5 * a * rest_s) * rest_s


class _Search:
    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.vehicle, self.walls = scenario.vehicle, tuple(scenario.walls.values())
        self.limits = MotionLimits.from_scenario(scenario)
        self.hits = HitLimits.from_scenario(scenario)
        self.dead_s = self.vehicle.flying.replan_within_s
        self.free: tuple[Event, ...] = tuple(self._visits())
        self.colliding: tuple[Event, ...] | None = None
        self.computed = self.pruned = 0
        self._compared: dict[tuple[Event, ...], Plan | None] = {}
        self.least_open_s = self.left_out_s = math.inf  # lowest bounds: of skipped sequences, of longer ones
        # Every bound needs the responses, so compute them once.
        self._responses = {
            (wall.name, mode): ContactResponse.at_wall(self.vehicle, wall, mode)
            for wall, mode in itertools.product(self.walls, scenario.modes)
        }
        self._least = LeastTimes(self.limits, self._largest_speed_after_hit_m_s())
        self._obstacles = Obstacles.from_scenario(scenario)
        self._room, self._demanded = room_of(scenario), _demanded(scenario)

    def run(self, enough: Callable[[], bool], progress: Progress) -> None:
        """Compute the plans of sequences; begin with the sequence that has the lowest bound on its time.

        The search ends when no remaining sequence can be faster than the best plan, or `enough` returns True.
        """
        self._solved(self.free)
        tie, found = itertools.count(), list[tuple[Event, ...]]()
        open_ = list[tuple[float, int, tuple[Event, ...]]]()
        seen = set[tuple[Event, ...]]()

        def put(events: tuple[Event, ...]) -> None:
            if events in seen or (bound_s := self._bound_s(events)) >= self._to_beat_s():
                return
            if _count_hits(events) > MOST_HITS:
                self.left_out_s = min(self.left_out_s, bound_s)
                return
            heapq.heappush(open_, (bound_s, next(tie), events))
            seen.add(events)

        for events in self._serving_sequences():
            put(events)
            if enough():
                self.least_open_s = 0.0  # the remaining sequences have no bound yet
                break
        while open_:
            bound_s, _, events = heapq.heappop(open_)
            progress(self.computed, self.computed + len(open_))
            if bound_s >= self._to_beat_s():
                self.pruned += 1 + len(open_)
                break
            if enough():
                self.least_open_s = min(self.least_open_s, bound_s)
                break
            if self._is_wanted(events):
                found.append(events)
                self.colliding = min(events, self.colliding, key=self._time_s)
            for more in self._with_one_more(events):
                put(more)
        self.least_open_s = min(self.least_open_s, self.left_out_s)
        # Another mode may make the second or third sequence the fastest.
        feasible = [events for events in found if self._solved(events) is not None]
        for events in sorted(feasible, key=self._time_s)[:_TRIED_IN_OTHER_MODE]:
            for mode in self.scenario.modes:
                other = tuple(e._replace(mode=mode) if isinstance(e, Hit) else e for e in events)
                self.colliding = min(other, self.colliding, key=self._time_s)
        if self.colliding is not None:
            self.colliding = self._with_best_modes(self.colliding)

    def _to_beat_s(self) -> float:
        free_s = math.inf if self._demanded else self._time_s(self.free)
        return min(free_s, self._time_s(self.colliding))

    # -- sequences --

    def _visits(self) -> list[Visit]:
        return [Visit(v.position_m, _TOLERANCE_USED * v.within_m) for v in self.scenario.visits]

    def _serving_sequences(self) -> Iterator[tuple[Event, ...]]:
        """Yield each sequence of events that passes the visits in order.

        The vehicle passes a visit in flight, or by a hit if the visit lies at a wall.
        """
        mode = self.scenario.first_mode
        choices: list[list[Event]] = [
            [visit, *(Hit(wall, mode, visit) for wall in self.walls if _serves(wall, visit))]
            for visit in self._visits()
        ]
        for events in itertools.product(*choices):
            if self._may_be_wanted(events):
                yield events

    def _with_one_more(self, events: tuple[Event, ...]) -> Iterator[tuple[Event, ...]]:
        """Yield the events with one more hit before, between or after them."""
        for wall, k in itertools.product(self.walls, range(len(events) + 1)):
            more = (*events[:k], Hit(wall, self.scenario.first_mode), *events[k:])
            if not _repeats(more) and self._may_be_wanted(more):
                yield more

    def _is_wanted(self, events: Sequence[Event]) -> bool:
        """Return whether the events contain a hit and, if hits are demanded, exactly these hits."""
        walls = _walls_hit(events)
        return bool(walls) and (not self._demanded or walls == self._demanded)

    def _may_be_wanted(self, events: Sequence[Event]) -> bool:
        """Return whether additional hits can turn the hits of the events into the demanded sequence."""
        rest = iter(self._demanded)
        return not self._demanded or all(name in rest for name in _walls_hit(events))

    # -- bounds --

    def _bound_s(self, events: Sequence[Event]) -> float:
        """Return a lower bound on the time of a sequence: the sum of the shortest leg and contact times."""
        places = _shortest_path_through(self.scenario.start, events, self._goal)
        total = 0.0
        for k, (a, b) in enumerate(itertools.pairwise(places)):
            begin = self._end_of_leg(events, places, k - 1)
            end = self._end_of_leg(events, places, k)
            total += self._least.leg_s(_SLACK * distance2(a, b), begin, end)
        return total + sum(self._least_contact_s(e.wall) for e in events if isinstance(e, Hit))

    def _end_of_leg(self, events: Sequence[Event], places: Sequence[Vec2], k: int) -> LegEnd:
        """Return the constraints of event `k` on the two legs that meet there.

        -1 is the start, and len(events) is the goal.
        """
        if not 0 <= k < len(events):
            return LegEnd.REST
        event = events[k]
        if isinstance(event, Hit):
            return LegEnd.HIT
        before, here, after = places[k : k + 3]
        into, out = math.dist(before, here), math.dist(here, after)
        if into == 0.0 or out == 0.0:
            return LegEnd.ANY
        dot = sum((h - b) * (a - h) for b, h, a in zip(before, here, after, strict=True))
        return LegEnd.REVERSAL if dot < _REVERSAL_COSINE * into * out else LegEnd.ANY

    def _largest_speed_after_hit_m_s(self) -> float:
        """Return an upper bound on the speed after any hit.

        The bound assumes the largest velocity along the wall and no friction. The normal velocity after the
        hit is the restitution times the largest normal velocity that the speed and hit limits permit.
        """
        fastest, hits, left = self.limits.speed_m_s, self.hits, 0.0
        for wall, mode in itertools.product(self.walls, self.scenario.modes):
            response = self._responses[wall.name, mode]
            sliding = min(fastest, most_sliding_m_s(hits, response))
            closing = math.sqrt(fastest**2 - sliding**2)
            closing = min(closing, hits.closing_m_s or math.inf, hits.peak_force_n / response.peak_n_per_m_s)
            left = max(left, math.hypot(response.restitution * closing, sliding))
        return left

    def _least_contact_s(self, wall: Wall) -> float:
        return min(self._responses[wall.name, mode].contact_s for mode in self.scenario.modes)

    @property
    def _goal(self) -> Vec2:
        return self.scenario.goal.position_m

    # -- flights --

    def _solved(self, events: tuple[Event, ...]) -> Plan | None:
        """Return the plan of a sequence, for comparison with other sequences; it is computed once and kept.

        Its duration is inaccurate by a few milliseconds.
        """
        if events not in self._compared:
            self._compared[events] = self._computed_plan(events, INTERVALS, _COMPARED_TO)
        return self._compared[events]

    def _time_s(self, events: tuple[Event, ...] | None) -> float:
        """Return the duration of a sequence's plan; infinite without a plan."""
        plan = None if events is None else self._solved(events)
        return math.inf if plan is None else plan.time_to_goal_s

    def _computed_plan(self, events: tuple[Event, ...], intervals: int, tolerance: float) -> Plan | None:
        problem = self._problem(events)
        if problem is None:
            return None
        self.computed += 1
        found = solve(problem, intervals, tolerance)
        return found if found is not None and self._servo_has_time(found) else None

    def _problem(self, events: Sequence[Event]) -> Problem | None:
        """Return the optimal control problem whose parts end at the events and at the path's corners.

        The result is None if there is no path from one event to the next.
        """
        parts: list[Part] = []
        touched: tuple[Wall, ...] = ()
        places = _shortest_path_through(self.scenario.start, events, self._goal)
        for event, (here, there) in zip((*events, None), itertools.pairwise(places), strict=True):
            at_end = (event.wall,) if isinstance(event, Hit) else ()
            to = event._replace(guess=there) if isinstance(event, Hit) else event
            path = shortest_path(here, there, self._obstacles)
            if path is None:
                return None
            for k, (a, b) in enumerate(itertools.pairwise(path)):
                last = k == len(path) - 2
                near = (*(touched if k == 0 else ()), *(at_end if last else ()))
                keep = (*self._room, *regions(a, b, self._obstacles, near, bool(touched)))
                parts.append(Part(to if last else RouteCorner(b), keep))
            touched = at_end
        return Problem(
            self.vehicle, self.scenario.start, self._goal, tuple(parts), self.limits, self.hits, self.dead_s
        )

    def _servo_has_time(self, plan: Plan) -> bool:
        """Return whether the lock settles before each hit whose mode differs from the previous hit's mode."""
        lock = self.vehicle.lock
        if lock is None:
            return True
        needed_s = lock.relaxation_s + lock.servo.full_travel_s + SETTLED_BEFORE_S
        return all(
            a.mode is b.mode or b.t_s - (a.t_s + a.contact_time_s) >= needed_s
            for a, b in itertools.pairwise(plan.collisions)
        )

    def _with_best_modes(self, events: tuple[Event, ...]) -> tuple[Event, ...]:
        """Return the events with the faster mode for each hit; the hits are examined one after the other."""
        for k, mode in itertools.product(range(len(events)), self.scenario.modes):
            event = events[k]
            if isinstance(event, Hit) and event.mode is not mode:
                other = (*events[:k], event._replace(mode=mode), *events[k + 1 :])
                events = min(events, other, key=self._time_s)
        return events

    def polished(self, events: tuple[Event, ...] | None) -> Plan | None:
        """Return the plan of a sequence, computed with more intervals."""
        if events is None or (plan := self._solved(events)) is None:
            return None
        return self._computed_plan(events, POLISHED, _POLISHED_TO) or plan

    @property
    def feasible(self) -> int:
        """The number of sequences that have a plan."""
        return sum(plan is not None for plan in self._compared.values())


def _walls_hit(events: Sequence[Event]) -> tuple[str, ...]:
    return tuple(event.wall.name for event in events if isinstance(event, Hit))


def _count_hits(events: Sequence[Event]) -> int:
    return sum(isinstance(event, Hit) for event in events)


def _serves(wall: Wall, visit: Visit) -> bool:
    """Return whether a hit at a wall can be close enough to a visit's place to count as the visit."""
    off_m = math.hypot(wall.signed_distance(visit.place), min(0.0, wall.end_distance_m(visit.place)))
    return off_m <= visit.within_m


def _repeats(events: Sequence[Event]) -> bool:
    """Return whether one hit could replace two consecutive events of a sequence."""
    return any(
        isinstance(hit, Hit)
        and (
            other.wall == hit.wall
            if isinstance(other, Hit)
            else isinstance(other, Visit) and _serves(hit.wall, other)
        )
        for pair in itertools.pairwise(events)
        for hit, other in (pair, pair[::-1])
    )


def _place_of(event: Event, before: Vec2) -> Vec2:
    if isinstance(event, Hit):
        return event.wall.foot(before if event.visit is None else event.visit.place)
    return event.place


def _shortest_path_through(start: Vec2, events: Sequence[Event], goal: Vec2) -> list[Vec2]:
    """Return a nearly shortest path through all events.

    Each of several sweeps moves every place to its best position between the two neighbouring places.
    """
    places = [start]
    for event in events:
        places.append(_place_of(event, places[-1]))
    places.append(goal)
    for _ in range(_SWEEPS):
        for k, event in enumerate(events, start=1):
            places[k] = _between(places[k - 1], event, places[k + 1])
    return places


def _between(a: Vec2, event: Event, b: Vec2) -> Vec2:
    """Return the place of an event at which the path from `a` through the event to `b` is shortest."""
    if isinstance(event, Hit):
        wall = event.wall
        here, there = abs(wall.signed_distance(a)), abs(wall.signed_distance(b))
        share = here / (here + there) if here + there > 0.0 else 0.5  # on the line from a to b's mirror image
        place = wall.foot((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])))
        return place if event.visit is None else _nearest_in(event.visit, place)
    (ax, ay), (bx, by), (cx, cy) = a, b, event.place
    square = (bx - ax) ** 2 + (by - ay) ** 2
    share = max(0.0, min(1.0, ((cx - ax) * (bx - ax) + (cy - ay) * (by - ay)) / square)) if square else 0.0
    nearest = (ax + share * (bx - ax), ay + share * (by - ay))
    return _nearest_in(event, nearest) if isinstance(event, Visit) else event.place


def _nearest_in(visit: Visit, place: Vec2) -> Vec2:
    away = distance2(visit.place, place)
    if away <= visit.within_m:
        return place
    share, (cx, cy) = visit.within_m / away, visit.place
    return (cx + share * (place[0] - cx), cy + share * (place[1] - cy))
