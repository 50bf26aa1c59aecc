"""Scenarios with the PX4 parameters of the connected vehicle."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from dart_flight.config.mission import load_mission
from dart_flight.lab.search.scenario import load_scenario, with_vehicle_parameters
from dart_flight.run.simulator_process import SimulatorError, SimulatorProcess
from dart_flight.sim.pipe import SimulatorSpec
from tests.doubles.ports import free_udp_port
from tests.real_time import TooSlow

SCENARIOS = Path(__file__).parents[2] / "missions" / "scenarios"


@pytest.mark.realtime
@pytest.mark.mavlink
def test_position_gains_are_read_from_the_vehicle(tmp_path: Path) -> None:
    scenario = load_scenario(SCENARIOS / "dual_collision.yaml")
    tuned = msgspec.structs.replace(scenario.vehicle.px4, mpc_xy_p=1.25, mpc_xy_vel_p_acc=2.5)
    vehicle = msgspec.structs.replace(scenario.vehicle, px4=tuned)
    port = free_udp_port()
    flown = load_mission(SCENARIOS.parent / "paper_dual_collision.yaml")
    flown = msgspec.structs.replace(flown, vehicle=vehicle, source="no file")
    spec = SimulatorSpec(flown, 1, [port], str(tmp_path / "world.txt"))
    world = SimulatorProcess(spec, lambda record: None)
    try:
        try:
            world.wait_ready()
        except SimulatorError as error:
            raise TooSlow(str(error)) from error
        read = with_vehicle_parameters(scenario, f"udpin://127.0.0.1:{port}")
    finally:
        world.close()
    assert read.vehicle.px4.mpc_xy_p == pytest.approx(1.25)
    assert read.vehicle.px4.mpc_xy_vel_p_acc == pytest.approx(2.5)
    assert scenario.vehicle.px4.mpc_xy_p == pytest.approx(0.95)
