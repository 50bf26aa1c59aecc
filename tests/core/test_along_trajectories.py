"""The mission's own trajectories: when a wall counts as missed and when the goal counts as reached."""

from __future__ import annotations

from typing import Any

import pytest

from dart_flight.base.records import GuardEvent, Phase, PhaseChange
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.core.mission.approach import NoApproachError, check_segments_clear
from dart_flight.core.mission.executive import _NEAR_S
from tests.core.conftest import ROOT, core_in, known, of_kind

RETURNING = "missions/touch_and_return.yaml"
WITHOUT_WALLS = "missions/hover.yaml"
# Half a metre away and back, from rest to rest: pairs of seconds and constant jerk in x.
AWAY_AND_BACK = [(0.3, 10.0), (0.6, -10.0), (0.3, 10.0), (0.3, -10.0), (0.6, 10.0), (0.3, -10.0)]
AWAY: dict[str, Any] = {"position_m": [0.0, 0.0], "pieces": [[s, j, 0.0] for s, j in AWAY_AND_BACK]}


@pytest.mark.parametrize(("before_s", "missed"), [(_NEAR_S + 0.1, False), (_NEAR_S - 0.1, True)])
def test_a_position_behind_the_wall_is_a_miss_only_shortly_before_the_impact(
    before_s: float, missed: bool
) -> None:
    """A trajectory may start beside its wall, on the far side of the plane."""
    hits = load_mission(packaged("missions", "touch_and_return.yaml")).to_dict()["collisions"]
    untouched = {"collisions": [hit for hit in hits if hit.get("trajectory")], "waypoints": []}
    c = core_in(Phase.APPROACH, RETURNING, settings=untouched)
    assert c.core.phase is Phase.APPROACH
    trajectory = known(c.core.mission.collisions[0].trajectory)
    c.run(trajectory.duration_s - before_s - 0.02)
    c.position_ned = (3.0, 0.0, -1.0)  # a metre behind the plane
    c.run(0.04)
    assert c.fired_rules == (["wall_not_met"] if missed else [])


def test_a_goal_passed_on_the_trajectory_is_held_only_at_its_end() -> None:
    goal = {"position_m": [0.0, 0.0], "capture_radius_m": 0.15, "hold_s": 0.2}
    c = core_in(Phase.TRANSIT, WITHOUT_WALLS, settings={"goal": goal, "goal_trajectory": AWAY})
    phases = []
    for seconds in (0.5, 1.8, 1.0):
        c.run(seconds)
        phases.append(c.core.phase)
    assert phases == [Phase.GOAL, Phase.GOAL, Phase.LANDING]


def test_the_goal_is_given_up_after_flight_hold_and_timeout() -> None:
    goal = {"position_m": [0.0, 0.0], "capture_radius_m": 0.15, "hold_s": 0.8}
    changes = {"goal": goal, "goal_trajectory": AWAY, "limits.collision_timeout_s": 1.0}
    c = core_in(Phase.TRANSIT, WITHOUT_WALLS, settings=changes)
    c.position_ned = (0.3, 0.0, -1.0)
    c.run(5.0)
    (began_us,) = (o.t_us for o in c.outputs if isinstance(o, PhaseChange) and o.after is Phase.GOAL)
    (given_up,) = of_kind(GuardEvent, c.outputs)
    assert given_up.rule == "goal_not_reached"
    flight_s = sum(seconds for seconds, _ in AWAY_AND_BACK)
    assert (given_up.t_us - began_us) * 1e-6 == pytest.approx(flight_s + 0.8 + 1.0, abs=0.03)


@pytest.mark.parametrize(
    ("wall_m", "least_x_m", "refused"),
    [
        ([-0.25, 0.0], -2.0, "wall board blocks the trajectory to the goal"),
        ([-0.25, 1.0], -2.0, None),  # beside the path
        ([-0.6, 0.0], -2.0, None),  # behind the turning point
        ([1.5, 0.0], -0.3, "the trajectory to the goal leads .* m outside bounds_m"),
    ],
)
def test_a_goal_trajectory_must_be_clear(wall_m: list[float], least_x_m: float, refused: str | None) -> None:
    """The trajectory leads half a metre along -x and back."""
    board = {"point_m": wall_m, "normal": [1.0, 0.0], "length_m": 1.0, "material": "wood"}
    pieces = [[seconds, -jerk, 0.0] for seconds, jerk in AWAY_AND_BACK]
    mission = load_mission(ROOT / WITHOUT_WALLS).replace(
        {
            "walls": {"board": board},
            "bounds_m.x": [least_x_m, 2.2],
            "goal_trajectory": {"position_m": [0.0, 0.0], "pieces": pieces},
        }
    )
    if refused is None:
        check_segments_clear(mission)
        return
    with pytest.raises(NoApproachError, match=refused):
        check_segments_clear(mission)
