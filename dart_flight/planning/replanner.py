"""Replanning in flight, from the measured state after a contact and with the estimates of the walls.

The replanner uses the contact stages and constraints of `plan` (`contact_stage`, `constraints`). It chooses a
trajectory: one fifth-order polynomial per axis. The trajectory begins in the state that the vehicle will have
when the core receives the answer. The trajectory ends at the next wall with the planned velocity, or at rest
at the goal. The replanner tries durations and impact points along the wall and discards the trajectories that
violate a constraint. Among the remaining trajectories, the replanner prefers quick and gentle ones that end
near the planned point. If the mission has a trajectory of its own (`trajectory`, `goal_trajectory`), the
replanner first tries to return to this trajectory. For this return, the replanner adds a polynomial to the
mission's trajectory (`planning.rejoining`).

A `WallEstimate` replaces the wall's configured coefficients and its planned plane. The replanner keeps no
other state between requests, so an answer can be computed again from the log. An approach from rest stays as
planned. Its speed is reduced if the estimated impact would exceed a limit.

The replanner does not run within the core's step. In flights over MAVSDK the replanner runs in its own
process (`run.planner_process`). In the fast world the replanner runs in the flight's process (`run.fast`).
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dart_flight.base.geometry import GRAVITY_M_S2, Vec2
from dart_flight.base.records import FrameAnchor, Mode, PlanAnswer, PlanRequest, WallEstimate
from dart_flight.base.walls import Wall
from dart_flight.config.mission import Collision, Mission
from dart_flight.config.vehicle import Coefficients
from dart_flight.core.mission.anchors import FrameAnchors
from dart_flight.core.mission.commitment import SETTLED_BEFORE_S
from dart_flight.core.mission.contact_feedforward import balancing_acceleration_m_s2
from dart_flight.core.mission.planned_impact import impact_velocity
from dart_flight.core.mission.position_loop import ATTITUDE_LAG_S, PositionLoop
from dart_flight.core.mission.trajectories import Trajectory
from dart_flight.core.mission.wall_uncertainty import EstimatedWalls, end_margin_m, position_margin_m
from dart_flight.planning.constraints import REFUSALS, Constraints
from dart_flight.planning.contact_stage import build_stages, expm
from dart_flight.planning.flight_model import Array, GridWindow, Rows, loop_matrix
from dart_flight.planning.polynomials import derivative, quintic
from dart_flight.planning.predicted_flight import impact_place, predict_mission
from dart_flight.planning.rejoining import SETTLED_S, RejoiningTrajectories, candidate_trajectories
from dart_flight.planning.task import MissionTask, drag_along

_DURATIONS_S = np.arange(0.3, 4.01, 0.05)
_ALONG_M = np.arange(-0.8, 0.81, 0.05)  # candidate points of impact, relative to the planned point
_SPEED_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5)  # factors on the planned velocity, tried in this order
# Options for the straight flight in which the attitude settles, s; the shorter one fits small rooms.
_STRAIGHT_S = (0.3, 0.1)
_SAMPLES = 24  # samples of a trajectory at which the constraints are checked
_LAST = 3  # the last samples, at which the jerk towards the wall is evaluated
_PUSH_SAMPLES = 12  # samples at which acceleration and jerk are checked, before the other constraints
# Usable fraction of PX4's tilt limit; the rest is for wind, errors and the position loop's corrections.
_TILT_SHARE = 0.6
_JERK_M_S3 = 25.0  # jerk limit: about 150 degrees of tilt per second, which the attitude loop can follow
_GENTLE_S = 0.5  # a trajectory at the tilt limit must save this time over a gentle one
_GENTLE_REJOINING_S = 0.05  # value for `_GENTLE_S` when rejoining a plan, which keeps the limits
_REJOINING_ALLOWANCE = 1.25  # factor on the acceleration limit, because the plan may already reach the limit
_SPEED_TOLERANCE = 1.01  # a trajectory with a larger slow-down factor counts as slower than planned
# A contact rotates the vehicle (docs/results/faster_hits.md) if the planned tilt away from the wall is too
# large for rigid arms, or if a tilt into the wall begins too late for the lagging attitude.
_THRUST_OFF_SHARE = 0.5  # fraction of the final outward thrust removed with rigid arms; lag removes the rest
_LEANS_IN_M_S3 = 8.0  # with a larger final jerk into the wall, another trajectory is preferred
_LEANS_IN_STEP_M_S3 = 5.0
_COMPRESSED_M = 0.15  # largest depth behind a wall, due to compressed arms and the wall's position error
_OFF_PLACE_S = 1.0  # cost, s, of an impact that misses the planned point by the mission's tolerance


class _EndStates(NamedTuple):
    """End states and durations of n candidates; the best one has the smallest duration plus `cost_s`."""

    x: Array
    y: Array
    vx: Array
    vy: Array
    duration_s: Array
    cost_s: Array


class Replanner:
    """Planner that answers the `PlanRequest`s of one flight."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._planned = predict_mission(mission).hits
        walls = {wall.name: wall for wall in mission.walls}
        self._walls = {c.wall.name: c.wall for c in mission.collisions}
        self._task = MissionTask(
            mission.vehicle,
            mission.start,
            mission.goal,
            mission.bounds,
            walls,
            mission.limits,
            mission.vehicle.modes,
            {c.wall.name: (c.alpha_normal_m_per_n, c.alpha_tangential_m_per_n) for c in mission.collisions},
        )
        self._constraints = Constraints(self._task, posts=mission.posts)
        loop = PositionLoop.from_px4(mission.vehicle.px4)
        self._coefficients: dict[tuple[str, Mode], Coefficients] = {}
        drift_m_s = mission.vehicle.estimation.position_drift_m_s
        self._anchors = FrameAnchors(drift_m_s) if mission.is_anchored else None
        self._survey = EstimatedWalls(self._anchors)
        # The mission's trajectories, by the index of the collision at their end; None is the goal.
        self._trajectories: dict[int | None, Trajectory] = {
            led_to: Trajectory.from_mission(pieces, mission.altitude_at(len(mission.collisions)))
            for led_to, pieces in (
                *((c.index, c.trajectory) for c in mission.collisions),
                (None, mission.goal_trajectory),
            )
            if pieces is not None
        }
        self._matrices = [loop_matrix(loop, b) for b in mission.vehicle.airframe.drag_per_s[:2]]
        tilt = math.radians(mission.vehicle.px4.mpc_tiltmax_air)
        self._most_m_s2 = _TILT_SHARE * GRAVITY_M_S2 * math.tan(tilt)
        # A new trajectory stays within the mission's limits. A trajectory that rejoins may exceed them.
        limits = mission.limits
        self._planned_m_s2 = min(self._most_m_s2, limits.acceleration_m_s2 or math.inf)
        self._planned_m_s3 = min(_JERK_M_S3, limits.jerk_m_s3 or math.inf)

    def update_wall(self, estimate: WallEstimate) -> None:
        """Store a wall estimate; use its coefficients only if the mode is known and the fit succeeded."""
        self._survey.add_estimate(estimate, self._walls[estimate.wall])
        mode = estimate.mode_felt or estimate.mode_reported
        if mode is not None and not estimate.problem:
            self._coefficients[estimate.wall, mode] = Coefficients(
                estimate.k_n_per_m, estimate.f_ns_per_m, estimate.mu_s_per_m, estimate.nu_n
            )

    def move_frame(self, anchor: FrameAnchor) -> None:
        """Move the estimated walls into the mission frame that a contact has corrected."""
        self._survey.move_frame(anchor.moved_mission)
        if self._anchors is not None:
            self._anchors.add_recorded(anchor)

    def answer(self, request: PlanRequest) -> PlanAnswer:
        """Plan a trajectory that starts in the requested state. If none is found, the answer has a `problem`.

        An exception in the planner also becomes a `problem`, so that the flight continues. The receiver
        of the answer sets `received_us`.
        """
        found = PlanAnswer(0, request.number, request.begin_us, collision=request.collision)
        try:
            return self._plan(found, request)
        except Exception as error:
            return _no_plan(found, f"the planner failed: {type(error).__name__}: {error}")

    def _plan(self, found: PlanAnswer, request: PlanRequest) -> PlanAnswer:
        if request.collision is None:
            to_goal = self._rejoined(found, request, None)
            if to_goal is None and request.under_way:
                return _no_plan(found, "no feasible trajectory leads back to the mission's trajectory")
            to_goal = to_goal or self._choose(found, request, self._to_goal(), None)
            return to_goal or _no_plan(found, "no trajectory to the goal is within the limits")
        collision = self._mission.collisions[request.collision - 1]
        if request.lock_ready_us is None:
            return _no_plan(found, "lock fault")
        velocity = self._planned_velocity(collision)
        if velocity is None:
            return _no_plan(found, f"no velocity is planned for wall {collision.wall.name}")
        if collision.approach_m_s is not None:
            return self._from_rest(found, collision, velocity)
        rejoined = self._rejoined(found, request, collision)
        if rejoined is not None:
            return rejoined
        if request.under_way:
            return _no_plan(found, "no feasible trajectory leads back to the mission's trajectory")
        wall = self._survey.known_wall(collision.wall, request.t_us)
        slack = float(position_margin_m(wall, impact_place(collision, self._planned)))
        for share, (straight_s, slacks) in itertools.product(_SPEED_SHARES, _straights(slack)):
            wanted = (share * velocity[0], share * velocity[1])
            straight_s -= slacks * slack / wanted[0]
            ends = self._to_wall(request, collision, wanted, straight_s)
            best = self._choose(found, request, ends, collision)
            if best is not None:
                return self._with_hit(best, collision, wanted, straight_s)
        return _no_plan(found, f"no trajectory to wall {collision.wall.name} is within the limits")

    def _rejoined(
        self, answer: PlanAnswer, request: PlanRequest, collision: Collision | None
    ) -> PlanAnswer | None:
        """Return the answer that rejoins the mission's own trajectory, or None if there is no such answer."""
        written = self._trajectories.get(request.collision)
        if written is None:
            return None
        wall, moved, pushed, settled_s = None, (0.0, 0.0), (0.0, 0.0), 0.0
        if collision is not None:
            # The attitude follows the plan to its end if an attitude delay is configured. Otherwise it lags.
            follows = bool(self._mission.vehicle.flying.attitude_delay_s)
            settled_s = SETTLED_S if follows else 0.0
            wall = self._survey.known_wall(collision.wall, request.t_us)
            place = written.at(written.duration_s).position
            away = collision.wall.signed_distance(place) - wall.signed_distance(place)
            moved = (away * wall.normal[0], away * wall.normal[1])
            out_m = self._mission.vehicle.airframe.contact_distance_m
            push_m_s2 = balancing_acceleration_m_s2(request.contact_height_m, out_m)
            if collision.mode is Mode.RIGID:
                removed_share = 1.0 if follows else _THRUST_OFF_SHARE
                push_m_s2 -= removed_share * max(0.0, self._thrust_off(wall, written))
            pushed = (push_m_s2 * wall.normal[0], push_m_s2 * wall.normal[1])
        rejoining = candidate_trajectories(written, self._start(request), moved, pushed, settled_s)
        if collision is not None:
            assert request.lock_ready_us is not None
            ready_s = (request.lock_ready_us - request.begin_us) * 1e-6
            rejoining = rejoining.select(np.flatnonzero(rejoining.duration_s >= ready_s + SETTLED_BEFORE_S))
        push = np.hypot(rejoining.acceleration[0], rejoining.acceleration[1]).max(axis=1, initial=0.0)
        jerk = np.hypot(rejoining.jerk[0], rejoining.jerk[1]).max(axis=1, initial=0.0)
        fine = (push <= self._most_m_s2) & (jerk <= _JERK_M_S3)
        # Prefer the mission's acceleration limit plus an allowance. Only the attitude loop limits the jerk,
        # because the mission's jerk limit would make a leg up to a tenth slower than planned.
        over = push > _REJOINING_ALLOWANCE * self._planned_m_s2
        rejoining, over = rejoining.select(np.flatnonzero(fine)), over[fine]
        push = push[fine] / self._most_m_s2
        if rejoining.duration_s.size:
            states = (v.astype(np.float32) for v in (*rejoining.position, *rejoining.velocity))
            window = GridWindow(rejoining.shares, *states)
            until = np.full(rejoining.duration_s.size, rejoining.shares.size)
            walls = self._obstacles(self._start(request), request.t_us)
            clear = self._constraints.path(window, until, wall, begins=True, walls=walls) == 0
            rejoining, push, over = rejoining.select(np.flatnonzero(clear)), push[clear], over[clear]
        # Prefer the planned impact speed, because a slower impact differs from the plan.
        slow = (rejoining.slower > _SPEED_TOLERANCE) & (collision is not None)
        if request.under_way:  # a slower trajectory does not improve on the trajectory in progress
            rejoining, push = rejoining.select(np.flatnonzero(~slow)), push[~slow]
            over, slow = over[~slow], slow[~slow]
        if wall is not None:
            over = over + _leans_in_late(rejoining, wall)
        for k in np.lexsort((rejoining.duration_s + _GENTLE_REJOINING_S * push**2, over, slow)):
            trajectory = rejoining.trajectory(int(k))
            found = msgspec.structs.replace(
                answer,
                duration_s=trajectory.duration_s,
                x_mission=trajectory.x,
                y_mission=trajectory.y,
                pieces_s=trajectory.pieces_s,
            )
            if collision is not None and wall is not None:
                (vx, vy, _) = trajectory.at(trajectory.duration_s).velocity
                normal, tangential, _ = wall.to_collision((vx, vy, 0.0))
                found = self._with_hit(found, collision, (normal, tangential), 0.0)
            if not found.problem:
                return found
        return None

    def _thrust_off(self, wall: Wall, written: Trajectory) -> float:
        """Return the thrust per mass, m/s2, at the mission trajectory's end, positive off the wall."""
        end = written.at(written.duration_s)
        drag_n, _ = drag_along(wall, self._mission.vehicle.airframe.drag_per_s)
        return wall.to_collision(end.acceleration)[0] + drag_n * wall.to_collision(end.velocity)[0]

    def _from_rest(self, answer: PlanAnswer, collision: Collision, velocity: Vec2) -> PlanAnswer:
        """Return an answer for an approach from rest, at the highest speed that the limits allow."""
        hit = answer
        for share in _SPEED_SHARES:
            hit = self._with_hit(answer, collision, (share * velocity[0], share * velocity[1]), 0.0)
            if not hit.problem:
                return msgspec.structs.replace(hit, impact_s=None)
        return hit

    # -- end states --

    def _planned_velocity(self, collision: Collision) -> Vec2 | None:
        """Return the planned (normal, tangential) velocity of an impact, m/s, or None."""
        hit = self._planned.get(collision.index)
        if collision.predicted is None and hit is not None:
            return (hit.normal_m_s, hit.tangential_m_s)
        return impact_velocity(collision)

    def _to_wall(
        self, request: PlanRequest, collision: Collision, velocity: Vec2, straight_s: float
    ) -> _EndStates:
        """Return end states from which the vehicle flies straight for `straight_s` to the wall.

        `velocity` is (normal, tangential) in the wall's collision frame.
        """
        wall = self._survey.known_wall(collision.wall, request.t_us)
        vx, vy, _ = wall.from_collision((*velocity, 0.0))
        place = wall.foot(impact_place(collision, self._planned))
        along, duration = (v.ravel() for v in np.meshgrid(_ALONG_M, _DURATIONS_S))
        x = place[0] + wall.tangent[0] * along - vx * straight_s
        y = place[1] + wall.tangent[1] * along - vy * straight_s
        impact_s = duration + straight_s
        assert request.lock_ready_us is not None
        ready_s = (request.lock_ready_us - request.begin_us) * 1e-6
        hit = (x + vx * straight_s, y + vy * straight_s)
        on_wall = wall.end_distance_m(hit) >= end_margin_m(wall, hit)
        fine = on_wall & (impact_s >= ready_s + SETTLED_BEFORE_S)
        goal = self._mission.goal.position_m
        rest_s = np.hypot(x - goal[0], y - goal[1]) / self._mission.vehicle.flying.transit_speed_m_s
        rest_s += _OFF_PLACE_S * (along / self._mission.tolerance.place_m) ** 2
        one = np.ones(int(fine.sum()))
        return _EndStates(x[fine], y[fine], vx * one, vy * one, duration[fine], rest_s[fine])

    def _to_goal(self) -> _EndStates:
        goal, one = self._mission.goal.position_m, np.ones_like(_DURATIONS_S)
        return _EndStates(goal[0] * one, goal[1] * one, 0.0 * one, 0.0 * one, _DURATIONS_S, 0.0 * one)

    # -- trajectories --

    def _start(self, request: PlanRequest) -> tuple[Array, Array]:
        """Return position, velocity and acceleration per axis when the trajectory begins."""
        ahead_s = (request.begin_us - request.t_us) * 1e-6
        vectors = (request.position_mission, request.velocity_mission, request.acceleration_mission)
        place, speed, push = (np.array(vector[:2]) for vector in vectors)
        if request.under_way:  # predict with the trajectory's current acceleration
            states = np.stack(
                [place + ahead_s * (speed + 0.5 * ahead_s * push), speed + ahead_s * push, push]
            )
            return states[:, 0], states[:, 1]
        if request.coasts:  # the vehicle levels immediately after a contact
            lag, left = ATTITUDE_LAG_S, math.exp(-ahead_s / ATTITUDE_LAG_S)
            gained = lag * (1.0 - left) * push
            flown = ahead_s * speed + lag * (ahead_s * push - gained)
            states = np.stack([place + flown, speed + gained, left * push])
            return states[:, 0], states[:, 1]
        axes = []
        for axis, matrix in enumerate(self._matrices):
            drag = self._mission.vehicle.airframe.drag_per_s[axis]
            p, v, a, to = (
                vector[axis]
                for vector in (
                    request.position_mission,
                    request.velocity_mission,
                    request.acceleration_mission,
                    request.setpoint_mission,
                )
            )
            state = expm(matrix * ahead_s) @ np.array([p - to, v, a + drag * v, 0.0])
            axes.append(np.array([state[0] + to, state[1], state[2] - drag * state[1]]))
        return axes[0], axes[1]

    def _choose(
        self, answer: PlanAnswer, request: PlanRequest, ends: _EndStates, collision: Collision | None
    ) -> PlanAnswer | None:
        """Return the answer with the best permitted trajectory to any of the end states, or None."""
        start = self._start(request)
        x = quintic(start[0], (ends.x, ends.vx, 0.0), ends.duration_s)
        y = quintic(start[1], (ends.y, ends.vy, 0.0), ends.duration_s)
        rows, push = self._within_limits(x, y, ends.duration_s)
        wall = None if collision is None else collision.wall
        obstacles = self._obstacles(start, request.t_us)
        rows = rows[self._stays_clear(x[:, rows], y[:, rows], ends.duration_s[rows], wall, obstacles)]
        if rows.size == 0:
            return None
        total = ends.duration_s[rows] + ends.cost_s[rows] + _GENTLE_S * push[rows] ** 2
        best = int(rows[np.argmin(total)])
        return msgspec.structs.replace(
            answer,
            duration_s=float(ends.duration_s[best]),
            x_mission=tuple(map(float, x[:, best])),
            y_mission=tuple(map(float, y[:, best])),
        )

    def _within_limits(self, x: Array, y: Array, duration_s: Array) -> tuple[Rows, Array]:
        """Return the indices of the trajectories within the limits of acceleration and jerk.

        The second result is each trajectory's largest horizontal acceleration, divided by the acceleration
        that PX4's tilt limit permits.
        """
        times = duration_s[:, None] * np.linspace(0.0, 1.0, _PUSH_SAMPLES)
        push = np.hypot(*(derivative(c[:, :, None], times, 2) for c in (x, y))).max(axis=1)
        rows = np.flatnonzero(push <= self._planned_m_s2)
        jerk = np.hypot(*(derivative(c[:, rows, None], times[rows], 3) for c in (x, y))).max(axis=1)
        return rows[jerk <= self._planned_m_s3], push / self._most_m_s2

    def _obstacles(self, start: tuple[Array, Array], now_us: int) -> list[Wall]:
        """Return the known walls; `start` is (position, velocity, acceleration) of the vehicle in x and y.

        The vehicle may start slightly behind the plane of the wall that it has just left: flexible arms
        release while still compressed, and a wall's position is uncertain. The plane of such a wall is
        shifted back to the vehicle.
        """
        place = (float(start[0][0]), float(start[1][0]))
        walls = []
        for wall in (self._survey.known_wall(one, now_us) for one in self._constraints.walls):
            depth_m = wall.signed_distance(place)
            walls.append(wall.displaced(depth_m) if -_COMPRESSED_M < depth_m < 0.0 else wall)
        return walls

    def _stays_clear(
        self, x: Array, y: Array, duration_s: Array, wall: Wall | None, obstacles: list[Wall]
    ) -> NDArray[np.bool_]:
        """Return which trajectories respect the bounds and speed limit and touch no wall except `wall`."""
        times = duration_s[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
        states = (
            derivative(c[:, :, None], times, order).astype(np.float32) for order in (0, 1) for c in (x, y)
        )
        window = GridWindow(np.linspace(0.0, 1.0, _SAMPLES), *states)
        until = np.full(duration_s.size, _SAMPLES)
        codes = self._constraints.path(window, until, wall, begins=True, walls=obstacles)
        clear: NDArray[np.bool_] = codes == 0
        return clear

    def _with_hit(
        self, answer: PlanAnswer, collision: Collision, velocity: Vec2, straight_s: float
    ) -> PlanAnswer:
        """Return the answer with its impact, or with a `problem` if the impact violates a limit."""
        wall, vehicle = collision.wall, self._mission.vehicle
        vn, vt, zero = np.array([velocity[0]]), np.array([velocity[1]]), np.zeros(1)
        drag_n, drag_t = drag_along(wall, vehicle.airframe.drag_per_s)
        coefficients = self._coefficients.get((wall.name, collision.mode))
        if coefficients is None:
            coefficients = vehicle.materials[wall.material].coefficients(collision.mode)
        (stage,) = build_stages(vehicle, [coefficients], [self._task.alphas[wall.name]], [drag_n], [0.0])
        out = stage.normal(vn, drag_n * vn, zero)
        slide = stage.tangential(stage.tangential_shape(vn), vt, drag_t * vt, zero)
        peak_n = float(out.peak_force_n[0])
        code = int(self._constraints.hit((vn, vt), out.peak_force_n, slide.friction_n, out.velocity)[0])
        if code:
            return _no_plan(answer, f"impact not allowed: {REFUSALS[code - 1].value}, {peak_n:.0f} N")
        return msgspec.structs.replace(
            answer,
            impact_s=answer.duration_s + straight_s,
            normal_m_s=velocity[0],
            tangential_m_s=velocity[1],
            peak_force_n=peak_n,
        )


def _leans_in_late(rejoining: RejoiningTrajectories, wall: Wall) -> Array:
    """Return the excess of each trajectory's final jerk towards the wall over `_LEANS_IN_M_S3`.

    The excess is a number of steps of `_LEANS_IN_STEP_M_S3`, rounded up, or 0 without an excess.
    """
    (nx, ny), (jx, jy) = wall.normal, rejoining.jerk[:, :, -_LAST:]
    too_fast = np.max(-(nx * jx + ny * jy), axis=1, initial=0.0) - _LEANS_IN_M_S3
    steps: Array = np.maximum(np.ceil(too_fast / _LEANS_IN_STEP_M_S3), 0.0)
    return steps


def _straights(slack: float) -> list[tuple[float, float]]:
    """Return options for the time of straight flight before a wall, best first, as pairs (duration, count).

    `slack` is the tolerance of the wall's position, metres. The straight flight lasts `duration` seconds plus
    the time to fly the distance `count` times `slack`.
    """
    if slack <= 0.0:
        return [(s, 0.0) for s in _STRAIGHT_S]
    return [(s, 1.0) for s in _STRAIGHT_S] + [(_STRAIGHT_S[-1], 0.0)]


def _no_plan(answer: PlanAnswer, problem: str) -> PlanAnswer:
    return msgspec.structs.replace(answer, problem=problem)
