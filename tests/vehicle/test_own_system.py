"""The program's MAVLink system id: the buttons of a ground station reach it on a vehicle with any id."""

from __future__ import annotations

import asyncio

import pytest

from dart_flight.vehicle.command_server import Press, Result
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.vehicle_session import connect
from tests.doubles.operator_station import OperatorStation
from tests.doubles.parameter_vehicle import ParameterVehicle
from tests.doubles.ports import free_udp_port
from tests.flights.test_embedded_flights import SINGLE

STATION = 255


@pytest.mark.mavlink
@pytest.mark.parametrize(("system", "flies"), [(1, False), (2, True), (200, False)])
def test_a_button_is_answered_whatever_the_vehicles_system_id(system: int, flies: bool) -> None:
    port, ground_port = free_udp_port(), free_udp_port()
    url = f"udpin://127.0.0.1:{port}"
    presses: list[Press] = []

    def answer(press: Press) -> tuple[Result, str]:
        presses.append(press)
        return Result.ACCEPTED, "pressed"

    def press(station: OperatorStation) -> int | None:
        station.wait_for_program()
        return station.press(3, 7)

    async def in_flight(station: OperatorStation) -> int | None:
        async with connect(url, 20.0, lambda record: None) as session:
            session.serve_operator(STATION, answer)
            return await asyncio.to_thread(press, station)

    with (
        OperatorStation(ground_port) as station,
        ParameterVehicle(SINGLE, port, system=system, ground_port=ground_port),
    ):
        if flies:
            assert asyncio.run(in_flight(station)) == Result.ACCEPTED
        else:
            with GroundLink(url, 20.0) as link:
                link.serve_operator(STATION, answer)
                assert press(station) == Result.ACCEPTED
    assert set(presses) == {Press(3, 7)}
