"""The source of the latency bench: it knows when every IMU sample left."""

from __future__ import annotations

import itertools

import pytest

from dart_flight.config.mission import load_mission
from dart_flight.sim.embedded_autopilot import make_autopilot
from tests.doubles.ports import free_udp_port
from tools.bench.impact_source import MISSION, _Endpoint


@pytest.mark.mavlink
def test_every_imu_sample_that_leaves_is_noted() -> None:
    autopilot = make_autopilot(load_mission(MISSION), 1)
    endpoint = _Endpoint(autopilot, (free_udp_port(),))
    for _ in range(100):  # at 50 Hz, unless another rate is asked for
        autopilot.step()
        endpoint.exchange()
    assert len(endpoint.record.imu) >= 10
    assert all(before[1] < after[1] for before, after in itertools.pairwise(endpoint.record.imu))
