"""A real PX4 reports its mode ten times a second on request."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.records import FlightMode, Input, StatusSample
from dart_flight.config.parameter_file import PositionSource
from dart_flight.run.prepare import load_flyable
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.ground_station import PORT
from tests.px4.test_px4_check import MISSION, waiting_px4

pytestmark = [pytest.mark.px4, pytest.mark.realtime]

_ALTITUDE = 2  # PX4's main mode


def test_a_mode_held_for_a_fifth_of_a_second_is_noticed_on_px4(px4_dir: Path, tmp_path: Path) -> None:
    seen: list[FlightMode] = []

    def keep(record: Input) -> None:
        if isinstance(record, StatusSample) and record.flight_mode not in seen[-1:]:
            seen.append(record.flight_mode)

    async def switch(url: str) -> None:
        link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{PORT}", source_system=255, dialect="common")

        def select(main: int, sub: int = 0) -> None:
            link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            link.mav.command_long_send(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1, main, sub, 0, 0, 0, 0)

        async with connect(url, 30.0, keep) as session:
            mission = load_flyable(MISSION)
            session.subscribe(mission.vehicle.estimation, len(mission.vehicle.airframe.motors))
            assert "mode" not in await session.set_rates()
            for _ in range(5):
                select(4, 3)  # hold
                await asyncio.sleep(0.4)
                select(_ALTITUDE)
                await asyncio.sleep(0.2)
            select(4, 3)
            await asyncio.sleep(0.4)

    mission = load_flyable(MISSION)
    with waiting_px4(mission, px4_dir, tmp_path, PositionSource.MOCAP, {"COM_RC_IN_MODE": 4}) as url:
        asyncio.run(switch(url))
    short = [FlightMode.HOLD, FlightMode.MANUAL]
    assert seen[seen.index(FlightMode.HOLD) :] == short * 5 + [FlightMode.HOLD]
