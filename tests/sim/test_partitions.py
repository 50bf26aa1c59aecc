"""Partitions: two faces back to back, hit by the simulated vehicle, and as one entry of a file."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from dart_flight.base.records import Mode, Outcome
from dart_flight.base.walls import Post, Wall
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission, load_mission
from dart_flight.config.vehicle import VehicleConfig, load_vehicle
from dart_flight.core.mission.position_loop import stop_share
from dart_flight.lab.api import plan
from dart_flight.run.fast import fly_fast
from dart_flight.sim.draws import draw_world
from tests.mission_findings import check_mission
from tests.sim.plants import drift, drifting_plant, energy_j, in_still_air

ROOT = Path(__file__).parents[2]
BODIES = [
    ("dart", "guards"),
    *(
        pytest.param(*body, marks=pytest.mark.rest)
        for body in (("dart", "point"), ("rigid_cage", "guards"), ("ring_guard_250g", "guards"))
    ),
]


def vehicle(name: str, body: str = "guards") -> VehicleConfig:
    return in_still_air(load_vehicle(ROOT / f"configs/{name}.yaml", [f"simulation.contact.body={body}"]))


def separate_faces(one: VehicleConfig, thickness_m: float, end_m: float = 1.0) -> tuple[Wall, Wall]:
    """Return two walls back to back, as somebody enters them without `thickness_m`."""
    middle, apart = end_m - 1.0, 2.0 * one.airframe.contact_distance_m + thickness_m
    kind = {"length_m": 2.0, "material": "acrylic", "half_vehicle_m": one.airframe.contact_distance_m}
    return (
        Wall("near", (1.0, middle), (-1.0, 0.0), **kind),  # type: ignore[arg-type]
        Wall("far", (1.0 + apart, middle), (1.0, 0.0), **kind),  # type: ignore[arg-type]
    )


def partition(one: VehicleConfig, thickness_m: float, end_m: float = 1.0) -> tuple[Wall, Wall]:
    near, _ = separate_faces(one, thickness_m, end_m)
    front = msgspec.structs.replace(near, name="near.front", thickness_m=thickness_m)
    return front, front.back()


@pytest.mark.parametrize(("name", "body"), BODIES)
@pytest.mark.parametrize(
    ("thickness_m", "faces_of"),
    [(0.0, partition), (0.012, partition), (0.05, partition), (0.012, separate_faces)],
)
def test_a_partition_throws_the_vehicle_back_like_one_wall(
    name: str, body: str, thickness_m: float, faces_of: Any
) -> None:
    one = vehicle(name, body)
    near, far = faces_of(one, thickness_m)
    after = []
    for walls in ((near,), (near, far), (far, near)):
        plant = drifting_plant(one, one.modes[-1], walls, (0.9, 0.0), (1.5, 0.2), math.radians(6.0))
        drift(plant, 0.25)
        assert [contact.wall for contact in plant.finished] == [near.name]
        after.append((*plant.position, *plant.velocity, *plant.rate))
    assert after[1:] == [pytest.approx(after[0], abs=1e-3)] * 2


def test_a_wedge_throws_the_vehicle_back_too() -> None:
    """Two faces of a wedge are not parallel, but the guards pass the other face in the same way."""
    one = vehicle("dart")
    near, far = separate_faces(one, 0.05)
    after = []
    for walls in ((near,), (near, far.rotated(math.radians(8.0)))):
        plant = drifting_plant(one, Mode.FLEXIBLE, walls, (0.9, 0.0), (2.0, 0.0), 0.0)
        drift(plant, 0.2)
        after.append(plant.velocity)
    assert after[0] == pytest.approx(after[1], abs=1e-3)


@pytest.mark.parametrize(
    ("thickness_m", "end_m"),
    [
        (0.012, -0.05),
        *(pytest.param(*end, marks=pytest.mark.rest) for end in ((0.0, 0.05), (0.012, -0.19))),
    ],
)
def test_the_end_of_a_partition_neither_traps_nor_drives_the_vehicle(
    thickness_m: float, end_m: float
) -> None:
    one = vehicle("dart")
    walls = partition(one, thickness_m, end_m)
    plant = drifting_plant(one, Mode.FLEXIBLE, walls, (0.9, 0.0), (1.2, 0.2), 0.05)
    before = energy_j(plant)
    for _ in range(200):
        plant.advance((0.0,) * 4)
        assert energy_j(plant) <= before * (1.0 + 1e-6)
    assert all(contact.end_us - contact.t_us < 0.15e6 for contact in plant.finished)
    assert math.hypot(*plant.velocity) > 0.3


def test_a_partition_hit_on_its_end_pushes_like_one_edge() -> None:
    """The edges of both faces are in one place, so that they must not push twice."""
    one = vehicle("rigid_cage")
    peaks = []
    for walls in (partition(one, 0.02, 0.0), partition(one, 0.02, 0.0)[:1]):
        # The end points west; the vehicle comes from there with the partition ahead of its middle.
        middle = 1.0 + one.airframe.contact_distance_m + 0.01
        plant = drifting_plant(one, Mode.RIGID, walls, (middle, 0.25), (0.0, -1.0), 0.0)
        drift(plant, 0.15)
        peaks.append([contact.peak_normal_force_n for contact in plant.finished])
    assert len(peaks[0]) == len(peaks[1]) == 1
    assert peaks[0][0] == pytest.approx(peaks[1][0], rel=0.01)


def test_a_post_in_front_of_a_partition_still_pushes() -> None:
    one = vehicle("dart")
    after = []
    for walls in ((), partition(one, 0.012)):
        post = Post("post", (1.1, 0.0), 0.05, "acrylic")
        plant = drifting_plant(one, Mode.FLEXIBLE, (*walls, post), (0.8, 0.0), (1.0, 0.0), 0.0)
        drift(plant, 0.3)
        assert [contact.wall for contact in plant.finished] == ["post"]
        after.append(plant.velocity[0])
    assert after[0] == pytest.approx(after[1], abs=1e-3)


# --- in files ---------------------------------------------------------------------------------------------


def written(**board: Any) -> dict[str, Any]:
    """Return a mission that hits a partition with a rigid cage, starting 0.5 m before it."""
    tree: dict[str, Any] = yaml.safe_load((ROOT / "missions/rigid_cage/single_wall.yaml").read_text("utf-8"))
    tree["vehicle"] = str(ROOT / "configs/rigid_cage.yaml")
    entry = tree["walls"].pop("acrylic")
    tree["walls"]["board"] = entry | {"thickness_m": 0.012} | board
    tree["collisions"][0]["wall"] = "board.front"
    return tree


def by_name(mission: Mission) -> dict[str, Wall]:
    return {wall.name: wall for wall in mission.walls}


@pytest.mark.parametrize("given_at", ["surface", "centre"])
def test_one_entry_gives_both_faces(given_at: str) -> None:
    mission = load_mission(written(given_at=given_at, position_sd_m=0.02))
    front, back = by_name(mission)["board.front"], by_name(mission)["board.back"]
    surface_of = mission.vehicle.airframe.wall_surface
    assert surface_of(front).signed_distance(surface_of(back).point) == pytest.approx(-0.012)
    assert (back.normal, back.length_m, back.material) == ((1.0, 0.0), front.length_m, front.material)
    assert back.position_sd_m == 0.02
    assert load_mission(mission.to_dict()).walls == mission.walls


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"walls.board.given_at": None},
            r"walls\.board.*: a partition needs given_at: .* 0\.18 m before",
        ),
        ({"collisions[0].wall": "board"}, r"unknown board, expected board\.front or board\.back"),
        ({"walls.board.thickness_m": 12}, r"thickness_m=12: .* 0 to 1 m"),  # millimetres
    ],
)
def test_a_partition_that_is_half_described_is_refused(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_mission(written()).replace(change)


def test_the_name_of_a_face_must_be_free() -> None:
    tree = written()
    tree["walls"]["board.back"] = tree["walls"]["board"] | {"thickness_m": None, "point_m": [5.0, 0.0]}
    with pytest.raises(InputError, match=r"another wall already has the name board\.back"):
        load_mission(tree)


@pytest.mark.parametrize("side", [pytest.param("front", marks=pytest.mark.rest), "back"])
def test_a_hit_on_either_face_is_a_legal_collision(side: str) -> None:
    """The vehicle starts half a metre from the face and rests there again, on either side."""
    tree = written()
    if side == "back":  # the same flight, with the entry turned round
        board = tree["walls"]["board"]
        board["point_m"], board["normal"] = [1.812, 0.5], [1.0, 0.0]
        tree["collisions"][0]["wall"] = "board.back"
    tree["start"]["position_m"] = [0.9, -0.3]
    mission = load_mission(tree)
    assert not no_goes(mission)
    verdict = fly_fast(mission, 1, None)
    assert (verdict.outcome, verdict.uncontrolled) == (Outcome.COMPLETED, [])
    assert [hit.wall for hit in verdict.collisions] == [f"board.{side}"]


def no_goes(mission: Mission) -> dict[str, str]:
    return {finding.item: finding.message for finding in check_mission(mission) if not finding.go}


def test_both_faces_move_together_in_a_drawn_world() -> None:
    mission = load_mission(written())
    spreads = {"wall_offset_m": 0.05, "wall_yaw_deg": 2.0, "contact": 0.2}
    for seed in range(5):
        world = by_name(draw_world(mission, seed, spreads).mission)
        front, back = world["board.front"], world["board.back"]
        assert front.point != by_name(mission)["board.front"].point
        assert front.back() == back


def test_a_partition_does_not_stop_a_vehicle_that_leaves_it() -> None:
    """A vehicle in front of one face is behind the other one, which must not count as a wall ahead."""
    mission = load_mission(written())
    front = by_name(mission)["board.front"]
    place = (front.point[0] - 0.02, front.point[1])
    assert stop_share(mission.walls, place, (-1.0, 0.0)) == 1.0
    assert stop_share(mission.walls, place, (1.0, 0.0)) < 0.1


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"point_m": [1.812, 0.5], "normal": [1.0, 0.0]}, "back to back at 0.012 m"),
        ({"point_m": [1.83, 1.5], "normal": [1.0, 0.05]}, "back to back at 0.005 m"),
        ({"point_m": [1.5, 0.5], "normal": [1.0, 0.0]}, "face each other at 0.300 m, minimum 0.36 m"),
        ({"point_m": [1.9, 0.5], "normal": [0.0, -1.0]}, None),  # a corner of the room
        ({"point_m": [1.812, 5.5], "normal": [1.0, 0.0]}, None),  # beside it
        ({"point_m": [2.2, 0.5], "normal": [1.0, 0.0]}, None),  # a pillar of 0.4 m
    ],
)
def test_check_names_opposite_walls_that_leave_no_room(change: dict[str, Any], says: str | None) -> None:
    tree = written(thickness_m=None)
    tree["collisions"][0]["wall"] = "board"
    tree["walls"]["other"] = tree["walls"]["board"] | change
    found = no_goes(load_mission(tree)).get("opposite_walls")
    assert found is None if says is None else found is not None and says in found


@pytest.mark.parametrize("side", ["front", "back"])
def test_a_partition_is_planned_like_one_wall(side: str) -> None:
    """The other face is within half a metre behind the vehicle, but it is no obstacle."""
    tree = {key: value for key, value in written().items() if key != "collisions"}
    grid = {"min": -1.2, "max": -0.8, "step": 0.2}, {"min": 0.0, "max": 0.5, "step": 0.25}
    tree |= {
        "sequence": ["board"],
        "objective": "gentlest",
        "search": {"normal_m_s": grid[0], "tangential_m_s": grid[1]},
        "alpha_wall_m_per_n": {"board": [0.02, 0.02]},
    }
    if side == "back":
        tree["walls"]["board"] |= {"point_m": [1.812, 0.5], "normal": [1.0, 0.0]}
    face = tree | {"sequence": [f"board.{side}"], "alpha_wall_m_per_n": {f"board.{side}": [0.02, 0.02]}}
    single = {"point_m": [1.8, 0.5], "normal": [-1.0, 0.0], "thickness_m": None}
    tree = tree | {"walls": {"board": tree["walls"]["board"] | single}}
    force = [plan(one).plans[0].peak_force_n for one in (tree, face)]
    assert force[0] == pytest.approx(force[1], rel=1e-6)
