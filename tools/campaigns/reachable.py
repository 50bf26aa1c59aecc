"""Which flights could still have met the second wall as planned, from where the first contact left them?

    python -m tools.campaigns.replanning --ways replan --vary all --keep build/replanned.jsonl
    python -m tools.campaigns.reachable build/replanned.jsonl --vary all

Knows nothing of the planner. From the true state at the end of the first contact any acceleration is allowed
that PX4's tilt limit lets the vehicle have, changed as fast as one likes: what is out of reach for that is
out of reach for every planner. A linear programme for each duration: acceleration constant over each of its
steps, inside a 16-gon around the limit's circle; within the bounds, before the true wall until its end, there
with the lock settled, and the end's normal velocity as near to the planned one as it can be.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.optimize import linprog

from dart_flight.base.geometry import GRAVITY_M_S2, Wall
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.mission_file import BoundsSpec
from dart_flight.planning.planned import planned_flight
from dart_flight.sim.draws import draw_world, parse_vary
from tools.campaigns.body import ROOT
from tools.campaigns.replanning import AfterFirst, Flown

Array = NDArray[np.float64]
WITHIN_M_S = 0.1
_DURATIONS_S = np.arange(0.2, 4.01, 0.2)
_STEPS = 20
_SIDES = 16


def nearest_m_s(
    after: AfterFirst, wall: Wall, normal_m_s: float, bounds: BoundsSpec, most_m_s2: float
) -> float:
    """How near the normal velocity at a wall can come to the planned one, m/s; inf: the wall is out of reach.

    Args:
        after: state to begin with.
        wall: where it truly stands.
        normal_m_s: planned, < 0.
        bounds: of the mission.
        most_m_s2: of the horizontal acceleration.
    """
    if after.settled_s is None:
        return math.inf
    durations = [float(t) for t in _DURATIONS_S if t >= after.settled_s]
    return min((_error(after, wall, normal_m_s, bounds, most_m_s2, t) for t in durations), default=math.inf)


def _error(
    after: AfterFirst, wall: Wall, normal_m_s: float, bounds: BoundsSpec, most_m_s2: float, duration_s: float
) -> float:
    h, n = duration_s / _STEPS, _STEPS
    speed = np.tril(np.full((n, n), h))
    ahead = np.subtract.outer(np.arange(n), np.arange(n)) + 0.5
    place = np.where(ahead > 0.0, ahead, 0.0) * h * h
    time_s = h * np.arange(1, n + 1)
    # Unknown: acceleration along x (n), along y (n), the error of the end's normal velocity.
    rows: list[Array] = []
    limits: list[Array] = []

    def at_most(x: Array, y: Array, limit: Array) -> None:
        rows.append(np.hstack([x, y, np.zeros((len(limit), 1))]))
        limits.append(limit)

    none, one = np.zeros((n, n)), np.eye(n)
    for k in range(_SIDES):
        c, s = math.cos(2 * math.pi * k / _SIDES), math.sin(2 * math.pi * k / _SIDES)
        # A polygon around the circle: more than the vehicle can, never less.
        at_most(c * one, s * one, np.full(n, most_m_s2 / math.cos(math.pi / _SIDES)))
    for axis, (low, high) in enumerate((bounds.x, bounds.y)):
        free = after.position_mission[axis] + after.velocity_mission[axis] * time_s
        to = (place, none) if axis == 0 else (none, place)
        at_most(to[0], to[1], np.asarray(high - free))
        at_most(-to[0], -to[1], np.asarray(free - low))
    (nx, ny), (wx, wy) = wall.normal, wall.point
    free_n = (after.position_mission[0] - wx) * nx + (after.position_mission[1] - wy) * ny
    along = free_n + (after.velocity_mission[0] * nx + after.velocity_mission[1] * ny) * time_s
    at_most(-nx * place[:-1], -ny * place[:-1], np.asarray(along[:-1]))
    closing = after.velocity_mission[0] * nx + after.velocity_mission[1] * ny
    end = np.hstack([nx * speed[-1], ny * speed[-1]])
    off = normal_m_s - closing
    rows += [np.append(end, -1.0)[None], np.append(-end, -1.0)[None]]
    limits += [np.array([off]), np.array([-off])]
    meets = np.concatenate([nx * place[-1], ny * place[-1], [0.0]])[None]
    found = linprog(
        np.append(np.zeros(2 * n), 1.0),
        np.vstack(rows),
        np.concatenate(limits),
        meets,
        np.array([-along[-1]]),
        [*[(None, None)] * (2 * n), (0.0, None)],
        method="highs",
    )
    return float(found.x[-1]) if found.status == 0 else math.inf


def judged(flights: Sequence[Flown], mission: Mission, vary: Sequence[str]) -> list[str]:
    """What became of the flights, in words."""
    hit = planned_flight(mission).hits[mission.collisions[-1].index]
    most = GRAVITY_M_S2 * math.tan(math.radians(mission.vehicle.px4.mpc_tiltmax_air))
    spreads = parse_vary(vary, mission.vehicle)
    reached = 0
    missed: list[str] = []
    out: list[str] = []
    for flown in track(flights, "reachable", console=Console(stderr=True)):
        if flown.second_m_s is not None and abs(flown.second_m_s[0] - hit.normal_m_s) <= WITHIN_M_S:
            reached += 1
            continue
        name = f"{flown.way} {flown.seed} ({flown.rule or flown.outcome})"
        if flown.after_first is None:
            out.append(f"{name}: the first wall was not met")
            continue
        walls = draw_world(mission, flown.seed, spreads).mission.walls
        wall = next(w for w in walls if w.name == mission.collisions[-1].wall.name)
        error = nearest_m_s(flown.after_first, wall, hit.normal_m_s, mission.bounds, most)
        (missed if error <= WITHIN_M_S else out).append(f"{name}: {error:.2f} m/s at the nearest")
    reachable = reached + len(missed)
    share = f" ({reached / reachable:.1%})" if reachable else ""
    return [
        f"{len(flights)} flights; within {WITHIN_M_S} m/s: {reached}",
        f"could have been: {reachable}; of these {reached}{share}",
        "could have been and was not:",
        *(f"  {line}" for line in missed),
        "could not have been:",
        *(f"  {line}" for line in out),
    ]


def main() -> int:
    """Read what `replanning --keep` wrote and print what could have been."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("flights", type=Path)
    parser.add_argument("--vary", nargs="*", default=["contact=0.3"], help="as the flights were flown")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--mission", default=str(ROOT / "missions" / "paper_dual_collision.yaml"))
    options = parser.parse_args()
    flights = [msgspec.json.decode(line, type=Flown) for line in options.flights.read_bytes().splitlines()]
    mission = load_mission(options.mission, settings=options.set)
    print("\n".join(judged(flights, mission, options.vary)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
