"""Setpoints that the session sends, and those that it leaves to MAVSDK's repetition."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from dart_flight.base.records import FlightMode, Setpoint, StatusSample, VehicleAction
from dart_flight.vehicle.vehicle_session import VehicleSession

_TICK_US = 20_000


class RecordedSetpoints:
    """A session without a link that records its setpoints."""

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


def test_an_unchanged_setpoint_is_sent_ten_times_a_second() -> None:
    recorded = RecordedSetpoints(FlightMode.OFFBOARD)
    for _ in range(50):
        recorded.send(1.0)
    assert len(recorded.norths) == 10


def test_a_changed_setpoint_is_sent_at_once() -> None:
    recorded = RecordedSetpoints(FlightMode.OFFBOARD)
    for north_m in (1.0, 1.0, 2.0, 1.0, 1.0):
        recorded.send(north_m)
    recorded.send(1.0, velocity_ned=(0.1, 0.0, 0.0))
    assert recorded.norths == [1.0, 2.0, 1.0, 1.0]
    # The log reports every recovery setpoint as sent.
    recorded.send(1.0, velocity_ned=(0.1, 0.0, 0.0), recovery=True)
    assert len(recorded.norths) == 5


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.UNKNOWN])
def test_every_setpoint_is_sent_before_offboard_mode(mode: FlightMode) -> None:
    """In other modes MAVSDK stops repeating, and it refuses to start offboard without a setpoint."""
    recorded = RecordedSetpoints(mode)
    for _ in range(5):
        recorded.send(1.0)
    assert len(recorded.norths) == 5


def test_a_silenced_session_sends_neither_setpoints_nor_actions() -> None:
    """The pilot has control: a setpoint or a mode change would fight him."""
    recorded = RecordedSetpoints(FlightMode.OFFBOARD)
    recorded.send(1.0)
    recorded.session.silence()
    recorded.send(2.0)
    recorded.send(3.0, recovery=True, velocity_ned=(0.1, 0.0, 0.0))
    assert recorded.norths == [1.0]
    for action in VehicleAction:  # without an action plugin, a call would raise an AttributeError
        assert asyncio.run(recorded.session.perform(action)) == "silent"
