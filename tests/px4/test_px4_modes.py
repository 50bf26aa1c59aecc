"""A real PX4 reports its mode ten times a second on request."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from dart_flight.base.records import FlightMode, Input, StatusSample
from dart_flight.vehicle.vehicle_session import connect
from tests.px4.real_px4 import SINGLE, station_of, waiting_px4
from tests.real_time import TooSlow

pytestmark = [pytest.mark.px4, pytest.mark.realtime]

_HOLD, _ALTITUDE = (4, 3), (2, 0)  # main mode and sub mode of PX4


def test_a_mode_held_for_a_fifth_of_a_second_is_noticed_on_px4(px4_dir: Path, tmp_path: Path) -> None:
    seen: list[FlightMode] = []

    def keep(record: Input) -> None:
        if isinstance(record, StatusSample) and record.flight_mode not in seen[-1:]:
            seen.append(record.flight_mode)

    async def switch(url: str) -> None:
        with station_of(url) as station:
            async with connect(url, 30.0, keep) as session:
                session.subscribe(SINGLE.vehicle.estimation, len(SINGLE.vehicle.airframe.motors))
                assert "mode" not in await session.set_rates()
                for _ in range(5):
                    for mode, seconds in (_HOLD, 0.4), (_ALTITUDE, 0.2):
                        station.set_mode(*mode, wait_s=0.0)
                        await asyncio.sleep(seconds)
                station.set_mode(*_HOLD, wait_s=0.0)
                await asyncio.sleep(0.4)

    with waiting_px4(px4_dir, tmp_path, {"COM_RC_IN_MODE": 4}) as url:
        asyncio.run(switch(url))
    seen = seen[seen.index(FlightMode.HOLD) :]
    assert set(seen) == {FlightMode.HOLD, FlightMode.MANUAL}
    if seen != [FlightMode.HOLD, FlightMode.MANUAL] * 5 + [FlightMode.HOLD]:
        raise TooSlow(f"a mode held for 0.2 s was missed: {seen}")
