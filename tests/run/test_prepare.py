"""Completion of a mission before its flight."""

from __future__ import annotations

from msgspec import structs

from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.run.prepare import with_mocap, with_px4_delays, with_simulated_mocap

MISSION = load_mission(packaged("missions", "paper_single_wall.yaml"))


def test_px4_delays_are_the_default_unless_the_configuration_specifies_others() -> None:
    flying = MISSION.vehicle.flying
    assert (flying.setpoint_delay_s, flying.attitude_delay_s) == (None, None)
    completed = with_px4_delays(MISSION).vehicle.flying
    assert (completed.setpoint_delay_s, completed.attitude_delay_s) == (0.024, 0.05)
    own = structs.replace(flying, setpoint_delay_s=0.0, attitude_delay_s=0.1)
    mission = structs.replace(MISSION, vehicle=structs.replace(MISSION.vehicle, flying=own))
    assert with_px4_delays(mission) == mission


def test_mocap_none_switches_the_motion_capture_of_the_configuration_off() -> None:
    configured = with_mocap(MISSION, "udp://0.0.0.0:9763/dart")
    assert configured.vehicle.mocap.url is not None
    for without in (with_mocap(configured, "none"), with_simulated_mocap(configured, "none")):
        assert without.vehicle.mocap.url is None
    assert with_mocap(MISSION, "none").vehicle == MISSION.vehicle
