"""Real MAVSDK on a link shared with another component: its messages do not become samples."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from dart_flight.base.records import (
    ActuatorSample,
    AttitudeSample,
    EstimatorSample,
    ImuSample,
    LandedState,
    OdometrySample,
    StatusSample,
    StatusText,
)
from dart_flight.config.mission import load_mission
from dart_flight.config.vehicle import packaged
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.foreign_sender import COMPONENT, foreign_sender, messages
from tests.flights.test_embedded_flights import simulated_vehicle

MISSION = str(packaged("missions", "paper_single_wall.yaml"))
_WAIT_S, _ENOUGH = 30.0, 200


@pytest.mark.mavlink
def test_no_sample_of_another_component_reaches_the_core() -> None:
    delivered = list[Any]()
    vehicle = load_mission(MISSION).vehicle

    async def listen(url: str) -> dict[tuple[str, int, int, int], Any]:
        loop, enough = asyncio.get_running_loop(), asyncio.Event()
        counts: dict[type[Any], int] = dict.fromkeys(
            (ImuSample, OdometrySample, AttitudeSample, ActuatorSample), 0
        )

        def deliver(record: Any) -> None:
            delivered.append(record)
            if type(record) in counts:
                counts[type(record)] += 1
                if min(counts.values()) >= _ENOUGH and session_senders:
                    foreign = {key[0] for key in list(session_senders) if key[2] == COMPONENT}
                    if len(foreign) == len(messages()):
                        loop.call_soon_threadsafe(enough.set)

        session_senders: dict[tuple[str, int, int, int], Any] = {}
        async with connect(url, _WAIT_S, deliver) as session:
            session_senders = session.senders
            session.subscribe(vehicle.estimation, len(vehicle.airframe.motors))
            await session.set_rates()
            with foreign_sender(int(url.rpartition(":")[2])):
                await asyncio.wait_for(enough.wait(), _WAIT_S)
            return dict(session.senders)

    with simulated_vehicle(MISSION) as url:
        senders = asyncio.run(listen(url))

    def records_of(kind: type[Any]) -> list[Any]:
        return [record for record in delivered if isinstance(record, kind)]

    assert all(abs(c) < 20.0 for s in records_of(OdometrySample) for c in s.position_ned)
    assert all(s.specific_force_frd[2] > -50.0 for s in records_of(ImuSample))
    assert max(s.t_us for s in records_of(ImuSample)) < 10**12
    assert all(s.motors == (0.0,) * 4 for s in records_of(ActuatorSample))
    assert all(s.position_sd_m is None or s.position_sd_m < 1.0 for s in records_of(EstimatorSample))
    assert {s.reset_counter for s in records_of(EstimatorSample)} <= {None, *range(10)}
    for status in records_of(StatusSample):
        assert status.landed is not LandedState.LANDING
        assert status.battery_v is None or status.battery_v > 10.0
    assert not any("failsafe" in text.text for text in records_of(StatusText))
    assert all(count.usable == 0 for key, count in senders.items() if key[2] == COMPONENT)
