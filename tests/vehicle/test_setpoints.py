"""Which setpoints leave, and which are left to MAVSDK's repeating."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from dart_flight.base.records import FlightMode, Setpoint, StatusSample, VehicleAction
from dart_flight.vehicle.vehicle_session import VehicleSession

_TICK_US = 20_000


class Sent:
    """A session without a link, whose setpoints are counted."""

    def __init__(self, mode: FlightMode) -> None:
        self.now_us = 1_000_000
        self.norths: list[float] = []
        session = self.session = VehicleSession.__new__(VehicleSession)
        session._silent, session._sent, session._sent_us = False, None, 0
        session._host_us = lambda: self.now_us
        session._status = StatusSample(0, 0, flight_mode=mode)
        session._offboard = self

    def set_position_ned(self, position: Any) -> None:
        self.norths.append(position.north_m)

    def set_position_velocity_ned(self, position: Any, _: Any) -> None:
        self.norths.append(position.north_m)

    def send(self, north_m: float, **more: Any) -> None:
        self.now_us += _TICK_US
        self.session.send(Setpoint(self.now_us, self.now_us, (north_m, 0.0, -1.0), 0.0, **more))


def test_one_that_is_being_repeated_leaves_ten_times_a_second() -> None:
    sent = Sent(FlightMode.OFFBOARD)
    for _ in range(50):
        sent.send(1.0)
    assert len(sent.norths) == 10


def test_another_one_leaves_at_once() -> None:
    sent = Sent(FlightMode.OFFBOARD)
    for north_m in (1.0, 1.0, 2.0, 1.0, 1.0):
        sent.send(north_m)
    sent.send(1.0, velocity_ned=(0.1, 0.0, 0.0))
    assert sent.norths == [1.0, 2.0, 1.0, 1.0]
    sent.send(1.0, velocity_ned=(0.1, 0.0, 0.0), recovery=True)  # the log says of it that it left
    assert len(sent.norths) == 5


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.UNKNOWN])
def test_before_offboard_every_one_leaves(mode: FlightMode) -> None:
    """MAVSDK stops repeating when it sees another mode, and refuses to start offboard without a setpoint."""
    sent = Sent(mode)
    for _ in range(5):
        sent.send(1.0)
    assert len(sent.norths) == 5


def test_after_silence_nothing_leaves_not_even_an_action() -> None:
    """The pilot has the vehicle: a setpoint or a mode would fight him."""
    sent = Sent(FlightMode.OFFBOARD)
    sent.send(1.0)
    sent.session.silence()
    sent.send(2.0)
    sent.send(3.0, recovery=True, velocity_ned=(0.1, 0.0, 0.0))
    assert sent.norths == [1.0]
    for action in VehicleAction:  # there is no action plugin to call: it would be an AttributeError
        assert asyncio.run(sent.session.perform(action)) == "silent"
