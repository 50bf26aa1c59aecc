"""The predicted path is judged by the guard's limits before the flight."""

from __future__ import annotations

import math

import pytest

from dart_flight.check.mission_check import check_path
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.planning.predicted_flight import predict_mission


@pytest.mark.parametrize("name", ["dual_collision", "dual_collision_stiff", "shuttle"])
def test_a_recovery_that_is_predicted_to_be_too_fast_is_a_no_go(name: str) -> None:
    mission = load_mission(packaged("missions", f"{name}.yaml"))
    planned = predict_mission(mission)
    assert planned is not None
    fastest_m_s = max(math.hypot(*state[2:]) for path in planned.legs.values() for state in path.tolist())
    for limit, go in ((0.99 * fastest_m_s, False), (1.01 * fastest_m_s, True)):
        limited = mission.replace({"limits.speed_m_s": limit})
        (found,) = check_path(limited, predict_mission(limited))
        assert found.go is go
        assert ("limits.speed_m_s" in found.says) is not go
