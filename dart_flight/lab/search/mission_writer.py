"""A plan as a mission file: the scenario's own keys, the chosen collisions, and the predictions."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import yaml

from dart_flight.base.geometry import Vec2
from dart_flight.base.records import AfterImpact
from dart_flight.base.walls import Wall
from dart_flight.config.document import Document, InputError, dotted, replace_file, report_write_errors
from dart_flight.config.mission import Mission, parse_mission
from dart_flight.config.mission_file import FlownRecord, Limits, TrajectoryPieces, WallSpec
from dart_flight.config.vehicle import VehicleConfig
from dart_flight.lab.search.optimal_trajectory import ContactResponse
from dart_flight.lab.search.plan import Plan, PlannedCollision
from dart_flight.lab.search.scenario import Scenario
from dart_flight.planning.task import drag_along
from dart_flight.run.prepare import refuse_unflyable

_DIGITS = 4
_LEAST_GAIN, _USUAL_GAIN = 1e-3, 0.025  # m/N
_REST_S = 1.0  # duration of the rest at the start after a touch
_LEAST_FRICTION_N = 2.0  # minimum friction force that can move the setpoint along the wall


def mission_text(scenario: Scenario, plan: Plan, target: Path, flown: FlownRecord | None = None) -> str:
    """Return the text of the mission file; paths in it are relative to the folder of `target`."""
    spec = scenario.spec
    tree: dict[str, Any] = {"version": 1, "name": scenario.name}
    if scenario.vehicle_path is not None:
        relative = os.path.relpath(scenario.vehicle_path.resolve(), target.resolve().parent)
        tree["vehicle"] = Path(relative).as_posix()
    tree |= {
        "frame": spec.frame,
        "start": spec.start,
        "goal": spec.goal,
        "bounds_m": spec.bounds_m,
        "walls": {name: _given(wall) for name, wall in spec.walls.items()},
        "transit_mode": spec.transit_mode,
        "limits": _given(spec.limits),
    }
    if spec.posts:
        tree["posts"] = spec.posts
    if plan.legs:
        tree |= trajectory_keys(scenario.vehicle, scenario.walls, plan)
        if spec.touch_m_s is not None:
            tree |= _with_touches(tree["collisions"], spec.touch_m_s, spec.start.position_m)
    else:
        tree["collisions"] = [_collision(scenario, plan, c) for c in plan.collisions]
        tree["predicted"] = {"goal_miss_m": _short(plan.goal_miss_m)}
    if flown is not None:
        tree["flown"] = _without_none(msgspec.to_builtins(flown))
    head = (
        f"# Planned by `dart-flight plan` from {Path(scenario.source).name}, objective "
        f"{scenario.objective.value}. `predicted` is what the flight model expects.\n"
    )
    # default_flow_style=None puts collections of scalars on one line and all else in block style.
    return head + yaml.safe_dump(msgspec.to_builtins(tree), sort_keys=False, default_flow_style=None)


def trajectory_keys(vehicle: VehicleConfig, walls: Mapping[str, Wall], plan: Plan) -> dict[str, Any]:
    """Return the keys of a mission that flies to its collisions and its goal along a plan's trajectories."""
    collisions: list[dict[str, Any]] = []
    for hit, leg in zip(plan.collisions, plan.legs, strict=False):
        body: dict[str, Any] = {"wall": hit.wall, "mode": hit.mode}
        if not collisions:
            velocity = (_short(hit.normal_m_s), _short(hit.tangential_m_s))
            body["approach"] = {"normal_m_s": velocity[0], "tangential_m_s": velocity[1]}
        gains = recovery_gains(vehicle, walls[hit.wall], hit)
        body["alpha_wall_m_per_n"] = [_short(alpha) for alpha in gains]
        body["trajectory"] = _rounded(leg)
        body["predicted"] = _predicted(hit)
        collisions.append(body)
    return {
        "collisions": collisions,
        "goal_trajectory": _rounded(plan.legs[-1]),
        "after_impact": AfterImpact.REPLAN,
        "predicted": {"goal_miss_m": 0.0},
    }


def _with_touches(collisions: list[dict[str, Any]], speed_m_s: float, start: Vec2) -> dict[str, Any]:
    """Return the keys of a mission that touches its walls before it hits them.

    Each wall to be hit is touched once, and the vehicle rests at the start after each touch. The touches
    measure each wall's direction and vertical force. If the assumed direction is wrong, a hit turns the
    vehicle. Without touches, a first hit succeeds only at up to 2 m/s (docs/results/faster_hits.md).
    """
    modes = {hit["wall"]: hit["mode"] for hit in reversed(collisions)}  # the mode of each wall's first hit
    touches = [
        {
            "wall": wall,
            "mode": mode,
            "approach": {"normal_m_s": -speed_m_s, "tangential_m_s": 0.0},
            "alpha_wall_m_per_n": [_USUAL_GAIN, _USUAL_GAIN],
        }
        for wall, mode in modes.items()
    ]
    rests = [{"after": k, "position_m": [*start], "hold_s": _REST_S} for k in range(1, len(touches) + 1)]
    return {"collisions": touches + collisions, "waypoints": rests}


def _rounded(leg: TrajectoryPieces) -> dict[str, Any]:
    """Return a trajectory with rounded numbers; rounding moves its end by a few micrometres."""
    pieces = [[round(t, 5), round(jx, 4) + 0.0, round(jy, 4) + 0.0] for t, jx, jy in leg.pieces]
    vectors = ("position_m", "velocity_m_s", "acceleration_m_s2")
    return {name: [round(v, 5) + 0.0 for v in getattr(leg, name)] for name in vectors} | {"pieces": pieces}


def recovery_gains(vehicle: VehicleConfig, wall: Wall, hit: PlannedCollision) -> Vec2:
    """Return the gains (A_n, A_t) of a hit's recovery setpoint, m/N.

    The recovery setpoint is active from the peak of the hit until the replanned trajectory begins. The gains
    keep the thrust per mass at its value u at the onset: u = a + drag v_in, where a is the acceleration and
    v_in the velocity at the onset. PX4's position loop commands kv (kp A F - v_out), where A is the gain, F
    the peak force and v_out the outgoing velocity; kp = MPC_XY_P and kv = MPC_XY_VEL_P_ACC. The gains make
    this command equal to u.
    """
    response, px4 = ContactResponse.at_wall(vehicle, wall, hit.mode), vehicle.px4
    drag_n, drag_t = drag_along(wall, vehicle.airframe.drag_per_s)
    assert hit.acceleration_m_s2 is not None
    thrust_n = hit.acceleration_m_s2[0] + drag_n * hit.normal_m_s
    thrust_t = hit.acceleration_m_s2[1] + drag_t * hit.tangential_m_s
    kept = math.exp(response.friction_s_per_m * hit.normal_m_s)
    wanted_n = -response.restitution * hit.normal_m_s + thrust_n / px4.mpc_xy_vel_p_acc
    wanted_t = hit.tangential_m_s * kept + thrust_t / px4.mpc_xy_vel_p_acc
    friction_n = response.mu_s_per_m * hit.tangential_m_s * hit.peak_force_n
    along = wanted_t / (px4.mpc_xy_p * friction_n) if abs(friction_n) > _LEAST_FRICTION_N else _USUAL_GAIN
    away = wanted_n / (px4.mpc_xy_p * hit.peak_force_n)
    return max(_LEAST_GAIN, min(1.0, away)), max(0.0, min(1.0, along))


def _collision(scenario: Scenario, plan: Plan, c: PlannedCollision) -> dict[str, Any]:
    body: dict[str, Any] = {"wall": c.wall, "mode": c.mode}
    if c is plan.collisions[0]:
        body["approach"] = {"normal_m_s": c.normal_m_s, "tangential_m_s": c.tangential_m_s}
    spec = scenario.spec
    if c.wall in spec.alpha_m_per_n:
        body["alpha_m_per_n"] = spec.alpha_m_per_n[c.wall]
    else:
        body["alpha_wall_m_per_n"] = spec.alpha_wall_m_per_n[c.wall]
    body["predicted"] = _predicted(c)
    return body


def _predicted(hit: PlannedCollision) -> dict[str, Any]:
    return {
        "t_s": _short(hit.t_s),
        "position_m": [_short(v) for v in hit.position_m],
        "normal_m_s": _short(hit.normal_m_s),
        "tangential_m_s": _short(hit.tangential_m_s),
        "peak_force_n": _short(hit.peak_force_n),
        "contact_time_s": _short(hit.contact_time_s),
    }


class RefusedPlanError(InputError):
    """A plan's mission does not load or cannot be flown, for a reason that the search does not check."""

    @property
    def reason(self) -> str:
        """The reason for the refusal, with the mission's key."""
        return ": ".join(part for part in (dotted(self.key), self.message) if part)


def planned_mission(scenario: Scenario, plan: Plan, text: str | None = None) -> Mission:
    """Return a plan's mission, parsed from its text (by default `mission_text`), if it can be flown.

    Raise RefusedPlanError if `dry-run` would reject the mission.
    """
    source = Path(scenario.source)
    document = Document(text or mission_text(scenario, plan, source), str(source))
    try:
        mission = parse_mission(document, scenario.vehicle)
        refuse_unflyable(mission)
    except InputError as error:
        # Omit the error's line number: it refers to the plan's mission, which is not a file yet.
        raise RefusedPlanError(error.message, source=f"plan of {source}", key=error.key) from None
    return mission


def write_mission(scenario: Scenario, plan: Plan, target: Path, flown: FlownRecord | None = None) -> str:
    """Write the mission file, validated as by `dry-run`, and return its text.

    After a `RefusedPlanError` or a failed write, an existing file is kept.
    """
    text = mission_text(scenario, plan, target, flown)
    planned_mission(scenario, plan, text)
    with report_write_errors(target):
        replace_file(target, text.encode("utf-8"))
    return text


def _given(section: WallSpec | Limits) -> dict[str, Any]:
    return _without_none(msgspec.to_builtins(section))


def _without_none(tree: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in tree.items()
        if value is not None
    }


def _short(value: float) -> float:
    return round(value, _DIGITS) + 0.0
