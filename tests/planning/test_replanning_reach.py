"""The campaign's independent judge of what any planner could have reached."""

import math

import msgspec
import pytest

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from tools.campaigns.reachable import nearest_m_s
from tools.campaigns.replanning import AfterFirst

MISSION = load_mission(packaged("missions", "paper_dual_collision.yaml"))
WALL = MISSION.walls[1]  # acrylic, at x = 1.65, met along x
MOST_M_S2 = 9.8
AFTER = AfterFirst((0.0, 0.0), (0.0, 0.0), 0.5)


def test_from_rest_any_velocity_is_reached_that_the_way_has_room_for() -> None:
    assert nearest_m_s(AFTER, WALL, -1.2, MISSION.bounds, MOST_M_S2) == pytest.approx(0.0, abs=1e-6)
    # v² = 2 a s; the polygon around the limit's circle touches it along x
    most = math.sqrt(2 * 0.5 * 1.65)
    no_run_up = msgspec.structs.replace(MISSION.bounds, x=(0.0, 2.2))
    error = nearest_m_s(AFTER, WALL, -3.0, no_run_up, 0.5)
    assert error == pytest.approx(3.0 - most, abs=0.05)


@pytest.mark.parametrize(
    "change",
    [
        {"settled_s": None},
        {"settled_s": 9.0},
        {"velocity_mission": (8.0, 0.0)},  # the wall is met before the lock has settled
        {"position_mission": (3.0, 0.0)},
    ],
)
def test_what_no_vehicle_could_do_is_out_of_reach(change: dict[str, object]) -> None:
    after = msgspec.structs.replace(AFTER, **change)
    assert nearest_m_s(after, WALL, -1.2, MISSION.bounds, MOST_M_S2) == math.inf
