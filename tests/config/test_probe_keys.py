"""Probes, conditions and waypoints at walls in a mission file: read, written and refused."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_flight.base.records import Mode
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import packaged
from tests.lab.api.test_api import every_key

EAST: dict[str, Any] = {
    "wall": "east",
    "mode": "rigid",
    "probe": {"from_m": [0.0, 0.0], "direction": [2.0, 0.0], "length_m": 1.8},
}
BOARD = {"point_m": [1.5, 0.0], "normal": [-1.0, 0.0], "length_m": 2.0, "material": "wood"}
AT_BOARD = {"wall": "board", "mode": "rigid", "probe": {"from_m": [0.0, 0.0], "length_m": 1.8}}
AGAIN = {
    "wall": "east",
    "mode": "flexible",
    "approach": {"normal_m_s": -0.8},
    "alpha_wall_m_per_n": [0.02, 0.02],
}


def with_keys(collision: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return collision | {"probe": collision["probe"] | keys}


def mission(*collisions: dict[str, Any], **changes: Any) -> Mission:
    tree = {
        "version": 1,
        "name": "probes",
        "start": {"position_m": [0.0, 0.0], "altitude_m": 1.0},
        "goal": {"position_m": [0.0, 0.5], "capture_radius_m": 0.3},
        "bounds_m": {"x": [-2.0, 2.0], "y": [-2.0, 2.0], "z": [0.3, 2.5]},
        "collisions": list(collisions),
    }
    return load_mission(tree | changes)


def test_an_unknown_wall_is_assumed_across_the_end_of_its_probe() -> None:
    loaded = mission(EAST, AGAIN)
    assert loaded.walls == ()
    probing, hit = loaded.collisions
    wall = probing.wall
    assert (wall.name, wall.point, wall.normal) == ("east", (1.8, 0.0), (-1.0, 0.0))
    assert (wall.sought, wall.material_known) == (True, False)
    vehicle = loaded.vehicle
    stiffest = max(m.coefficients(Mode.RIGID).k for m in vehicle.materials.values())
    assert vehicle.materials[wall.material].coefficients(Mode.RIGID).k == stiffest, (
        "an unknown wall is assumed to be the stiffest one"
    )
    assert probing.probe is not None
    assert (probing.probe.begin, probing.probe.end) == ((0.0, 0.0), (1.8, 0.0))
    assert probing.approach_m_s == pytest.approx((-0.5, 0.0))
    assert probing.impact_point == pytest.approx((1.8, 0.0))
    assert hit.wall == wall
    assert hit.impact_point == pytest.approx((1.8, 0.0))
    assert [c.is_conditional for c in loaded.collisions] == [True, True]


def test_a_probe_for_a_known_wall_leads_along_its_normal_and_reaches_it() -> None:
    loaded = mission(AT_BOARD, walls={"board": BOARD})
    (collision,) = loaded.collisions
    assert collision.wall == loaded.walls[0]
    assert collision.probe is not None
    assert collision.probe.end == pytest.approx((1.8, 0.0))
    assert collision.impact_point == pytest.approx((1.5, 0.0))
    askew = mission(
        with_keys(AT_BOARD, direction=[1.0, 1.0], length_m=2.4), walls={"board": BOARD | {"length_m": 4.0}}
    )
    assert askew.collisions[0].impact_point == pytest.approx((1.5, 1.5))
    assert askew.collisions[0].approach_m_s == pytest.approx((-0.5 / math.sqrt(2), 0.5 / math.sqrt(2)))
    assert not loaded.recovers_to_goal, "the vehicle is at rest after a probe"


@pytest.mark.parametrize("known", ["wood", None])
def test_a_probe_may_give_the_material_of_its_wall(known: str | None) -> None:
    wall = mission(with_keys(EAST, material=known)).collisions[0].wall
    assert wall.material_known is (known is not None)
    assert known in (None, wall.material)


def test_a_waypoint_at_a_wall_assumes_the_wall_at_the_end_of_its_probe() -> None:
    at = {"wall": "east", "away_m": 1.0, "along_m": 0.25}
    loaded = mission(EAST, waypoints=[{"after": 1, "at_wall": at, "if_met": "east"}])
    (waypoint,) = loaded.waypoints
    # Along the normal, which points to -x, the right is +y.
    assert waypoint.position == pytest.approx((0.8, 0.25, 1.0))
    assert waypoint.wall_at == loaded.collisions[0].wall
    assert load_mission(loaded.to_dict()).waypoints == loaded.waypoints


@given(
    angle=st.floats(-3.1, 3.1),
    length_m=st.floats(0.2, 1.9),
    speed_m_s=st.floats(0.1, 1.5),
    back_m=st.floats(0.1, 1.0),
    material=st.sampled_from([None, "wood", "acrylic"]),
    condition=st.sampled_from(["if_met", "if_not_met"]),
)
@settings(max_examples=50, deadline=None)
def test_a_mission_with_probes_can_be_written_and_read_back(
    angle: float, length_m: float, speed_m_s: float, back_m: float, material: str | None, condition: str
) -> None:
    first = with_keys(
        EAST,
        direction=[math.cos(angle), math.sin(angle)],
        length_m=length_m,
        speed_m_s=speed_m_s,
        back_m=back_m,
        material=material,
        from_here=material is None,
    )
    second = with_keys(EAST, direction=[-1.0, 0.5], length_m=0.9) | {"wall": "west", condition: "east"}
    loaded = mission(first, second, simulated_walls={"board": BOARD})
    again = load_mission(loaded.to_dict())
    assert again.simulated_walls == loaded.simulated_walls
    for a, b in zip(loaded.collisions, again.collisions, strict=True):
        assert a.probe is not None
        assert b.probe is not None
        assert b.probe.end == pytest.approx(a.probe.end, abs=1e-12)
        assert b.probe.from_here is a.probe.from_here
        assert b.wall.point == pytest.approx(a.wall.point, abs=1e-12)
        assert b.wall.normal == pytest.approx(a.wall.normal, abs=1e-12)
        for name in ("material", "material_known", "sought", "name", "length_m"):
            assert getattr(a.wall, name) == getattr(b.wall, name)
        for name in ("mode", "if_met", "if_not_met", "index"):
            assert getattr(a, name) == getattr(b, name)
        assert (b.probe.speed_m_s, b.probe.back_m) == (a.probe.speed_m_s, a.probe.back_m)


WALLS = {"walls": {"board": BOARD}}
STAY = {"after": 1, "at_wall": {"wall": "east", "away_m": 1.0}}


@pytest.mark.parametrize(
    ("collisions", "changes", "message"),
    [
        (
            [EAST | {"approach": {"normal_m_s": -1.0}}],
            {},
            r"collisions\[0\].approach: a probe cannot have this key",
        ),
        ([EAST | {"impact_along_m": 0.1}], {}, "impact_along_m: a probe cannot have this key"),
        ([EAST | {"alpha_wall_m_per_n": [0.1, 0.1]}], {}, "alpha_wall_m_per_n: a probe cannot have this key"),
        (
            [with_keys(AT_BOARD, material="wood")],
            WALLS,
            "probe.material: wall board of the mission already has a material",
        ),
        ([with_keys(EAST, material="cheese")], {}, r"probe.material: .*cheese"),
        (
            [with_keys(EAST, from_m=[3.0, 0.0])],
            {},
            r"probe.from_m: \(3.00, 0.00\) is 1.00 m outside bounds_m",
        ),
        ([with_keys(EAST, length_m=2.5)], {}, r"probe.length_m: \(2.50, 0.00\) is 0.50 m outside bounds_m"),
        (
            [with_keys(EAST, speed_m_s=3.0)],
            {"limits": {"speed_m_s": 2.0}},
            "3 m/s exceeds limits.speed_m_s 2",
        ),
        ([with_keys(EAST, speed_m_s=0.05)], {}, "probe.speed_m_s"),
        ([with_keys(EAST, direction=[0.0, 0.0])], {}, "probe.direction: the direction has length 0"),
        (
            [with_keys(EAST, direction=None)],
            {},
            r"probe: east is not a wall of the mission \(none\): .* "
            r"direction",
        ),
        (
            [with_keys(AT_BOARD, direction=[0.0, 1.0])],
            WALLS,
            "the angle between probe and normal exceeds 60 degrees",
        ),
        ([with_keys(AT_BOARD, direction=[-1.0, 0.0])], WALLS, "between probe and normal exceeds"),
        ([with_keys(AT_BOARD, from_m=[1.8, 0.0], length_m=0.1)], WALLS, "begins behind wall board"),
        (
            [with_keys(AT_BOARD, length_m=1.2)],
            WALLS,
            "probe.length_m: wall board is 1.50 m away; length_m must be this distance",
        ),
        ([EAST, EAST], {}, r"collisions\[1\].wall: two probes search for east"),
        ([EAST], {"simulated_walls": {"east": BOARD}}, "a simulated wall already has the name east"),
        (
            [EAST],
            {"posts": {"east": {"centre_m": [-1.5, 1.5], "radius_m": 0.1, "material": "wood"}}},
            r"collisions\[0\].probe: east is a post",
        ),
        ([EAST | {"if_met": "east"}], {}, r"collisions\[0\].if_met: there is no earlier probe"),
        ([EAST, AGAIN | {"if_not_met": "west"}], {}, r"collisions\[1\].if_not_met: .*west"),
        ([AGAIN, EAST], {}, r"collisions\[0\].wall: no earlier probe searches for wall east"),
        ([EAST, AGAIN | {"impact_point_m": [1.8, 0.0]}], {}, "the position of wall east is unknown"),
        (
            [EAST, {k: v for k, v in AGAIN.items() if k != "approach"}],
            {},
            r"collisions\[1\]: needs an approach, because the vehicle is at rest after a probe",
        ),
        ([EAST], {"waypoints": [STAY | {"after": 0}]}, r"waypoints\[0\].at_wall.wall: .*east"),
        ([EAST], {"waypoints": [STAY | {"position_m": [0, 0]}]}, "exactly one key: position_m or at_wall"),
        ([EAST], {"waypoints": [{"after": 1, "position_m": [0, 0], "if_met": "west"}]}, r"if_met: .*west"),
        (
            [EAST],
            {"waypoints": [{"position_m": [0, 0], "if_met": "east"}]},
            "if_met: there is no earlier probe",
        ),
        (
            [],
            {"simulated_walls": {"b": BOARD | {"normal": [0, 0]}}},
            r"simulated_walls.b.normal: .* length 0",
        ),
        ([], {"simulated_walls": {"b": BOARD | {"material": "cheese"}}}, "simulated_walls.b.material"),
        (
            [EAST],
            {"goal_trajectory": every_key()["goal_trajectory"], "after_impact": "replan"},
            "goal_trajectory: the path from a probe to the goal is straight",
        ),
        ([], {"frame": {"anchored_by": "gps"}}, "frame.anchored_by"),
    ],
)
def test_contradictory_probe_keys_are_refused(
    collisions: list[dict[str, Any]], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        mission(*collisions, **changes)


def test_the_shipped_missions_with_probes_can_be_written_and_read_back() -> None:
    for name in ("find_a_wall.yaml", "dual_collision_gps.yaml"):
        loaded = load_mission(packaged("missions", name))
        assert load_mission(loaded.to_dict()).collisions == loaded.collisions
    gps = load_mission(packaged("missions", "dual_collision_gps.yaml"))
    assert gps.is_anchored
    assert [c.probe is not None and c.probe.from_here for c in gps.collisions] == [False, True, False, False]
    assert not load_mission(packaged("missions", "find_a_wall.yaml")).is_anchored
