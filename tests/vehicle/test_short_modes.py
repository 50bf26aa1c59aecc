"""A change of mode that is shorter than the heartbeat's period, through real MAVSDK."""

from __future__ import annotations

import asyncio

import pytest

from dart_flight.base.records import FlightMode, Input, StatusSample
from dart_flight.config.vehicle import load_vehicle, packaged
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.parameter_vehicle import ParameterVehicle
from tests.doubles.ports import free_udp_port
from tests.flights.test_embedded_flights import SINGLE

VEHICLE = load_vehicle(packaged("configs", "dart.yaml"))


@pytest.mark.mavlink
def test_a_mode_held_for_a_fifth_of_a_second_is_noticed() -> None:
    other, seen = FlightMode.HOLD, list[FlightMode]()
    port = free_udp_port()

    def keep(record: Input) -> None:
        if isinstance(record, StatusSample) and record.flight_mode not in seen[-1:]:
            seen.append(record.flight_mode)

    async def watch(vehicle: ParameterVehicle) -> None:
        async with connect(f"udpin://127.0.0.1:{port}", 20.0, keep) as session:
            session.subscribe(VEHICLE.estimation, len(VEHICLE.airframe.motors))
            await session.set_rates()
            short = [(other, 0.2), (FlightMode.OFFBOARD, 0.5)]
            vehicle.show_modes([(FlightMode.OFFBOARD, 1.5), *short, *short])
            await asyncio.to_thread(vehicle.has_shown.wait)
            await asyncio.sleep(0.3)

    with ParameterVehicle(SINGLE, port) as vehicle:
        asyncio.run(watch(vehicle))
    first = seen.index(FlightMode.OFFBOARD)
    assert seen[first:] == [FlightMode.OFFBOARD, other] * 2 + [FlightMode.OFFBOARD]
