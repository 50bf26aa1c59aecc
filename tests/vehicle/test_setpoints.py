"""Setpoints that the session sends, and those that it leaves to MAVSDK's repetition."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from dart_flight.base.records import Setpoint, VehicleAction
from dart_flight.vehicle.clock import SimulatedTime
from tests.vehicle.session_rig import MakeSession

_TICK_US = 20_000


HEARTBEAT = {"autopilot": 12, "base_mode": 129, "system_status": 4}
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24  # PX4's custom modes


class RecordedSetpoints:
    """A session in simulated time that sends a setpoint every 20 ms."""

    def __init__(self, make_session: MakeSession, custom_mode: int | None) -> None:
        self._clock = SimulatedTime()
        self.rig = make_session({}, clock=self._clock).subscribe()
        if custom_mode is not None:
            self.rig.receive("HEARTBEAT", **HEARTBEAT, custom_mode=custom_mode)

    @property
    def norths(self) -> list[float]:
        return [position.north_m for _, (position, *_) in self.rig.plugins["Offboard"].calls]

    def send(self, north_m: float, **more: Any) -> None:
        now_us = self._clock.receive(self._clock.host_us() + _TICK_US, 0)
        self.rig.session.send(Setpoint(now_us, now_us, (north_m, 0.0, -1.0), 0.0, **more))


def test_an_unchanged_setpoint_is_sent_ten_times_a_second(make_session: MakeSession) -> None:
    recorded = RecordedSetpoints(make_session, OFFBOARD)
    for _ in range(50):
        recorded.send(1.0)
    assert len(recorded.norths) == 10


def test_a_changed_setpoint_is_sent_at_once(make_session: MakeSession) -> None:
    recorded = RecordedSetpoints(make_session, OFFBOARD)
    for north_m in (1.0, 1.0, 2.0, 1.0, 1.0):
        recorded.send(north_m)
    recorded.send(1.0, velocity_ned=(0.1, 0.0, 0.0))
    assert recorded.norths == [1.0, 2.0, 1.0, 1.0]
    # The log reports every recovery setpoint as sent.
    recorded.send(1.0, velocity_ned=(0.1, 0.0, 0.0), recovery=True)
    assert len(recorded.norths) == 5


@pytest.mark.parametrize("mode", [HOLD, None])
def test_every_setpoint_is_sent_before_offboard_mode(make_session: MakeSession, mode: int | None) -> None:
    """In other modes MAVSDK stops repeating, and it refuses to start offboard without a setpoint."""
    recorded = RecordedSetpoints(make_session, mode)
    for _ in range(5):
        recorded.send(1.0)
    assert len(recorded.norths) == 5


def test_a_silenced_session_sends_neither_setpoints_nor_actions(make_session: MakeSession) -> None:
    """The pilot has control: a setpoint or a mode change would fight him."""
    recorded = RecordedSetpoints(make_session, OFFBOARD)
    recorded.send(1.0)
    recorded.rig.session.silence()
    recorded.send(2.0)
    recorded.send(3.0, recovery=True, velocity_ned=(0.1, 0.0, 0.0))
    assert recorded.norths == [1.0]
    for action in VehicleAction:
        assert asyncio.run(recorded.rig.session.perform(action)) == "silent"
    assert recorded.rig.plugins["Action"].calls == []
