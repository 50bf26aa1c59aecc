"""The doubles of a serial cable (rate, losses, a cut) and of a ground station (its vehicle's system)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from tests.doubles import serial_cable
from tests.doubles.operator_station import OperatorStation
from tests.doubles.scripted_peer import Mavlink, ScriptedPeer, UdpLink
from tests.doubles.serial_cable import BUFFER_BYTES, SerialCable, SerialWay

RATE = 92_160.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [50.0]
    monkeypatch.setattr(serial_cable, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.fixture
def sink() -> Iterator[int]:
    """Yield the writing end of a pipe that is large enough for every test."""
    reading, writing = os.pipe()
    yield writing
    os.close(reading)
    os.close(writing)


def test_one_direction_carries_no_more_than_its_rate(clock: list[float], sink: int) -> None:
    way = SerialWay(RATE)
    for _ in range(200):
        way.take(bytes(200), BUFFER_BYTES)  # twice the rate
        clock[0] += 0.001
        way.pass_on(sink)
    assert way.carried == pytest.approx(RATE * 0.2, rel=0.01)
    assert way.dropped == 200 * 200 - way.carried - len(way.waiting)
    assert len(way.waiting) <= BUFFER_BYTES


def test_unused_capacity_is_not_saved_up(clock: list[float], sink: int) -> None:
    way = SerialWay(RATE)
    clock[0] += 10.0
    way.take(bytes(4000), BUFFER_BYTES)
    way.pass_on(sink)
    assert way.carried <= RATE * 0.005


def test_a_cable_without_a_rate_passes_everything_at_once(clock: list[float], sink: int) -> None:
    way = SerialWay(None)
    way.take(bytes(20_000), None)
    way.pass_on(sink)
    assert (way.carried, way.dropped) == (20_000, 0)


def test_a_cut_cable_drops_and_counts_sent_bytes() -> None:
    with SerialCable() as cable:
        ends = [os.open(end, os.O_RDWR | os.O_NOCTTY) for end in cable.ends]
        os.write(ends[0], b"whole")
        assert os.read(ends[1], 100) == b"whole"
        cable.cut = True
        os.write(ends[0], b"lost")
        while not cable.dropped[0]:
            pass
        cable.cut = False
        os.write(ends[0], b"again")
        assert os.read(ends[1], 100) == b"again"
        while cable.carried[0] < len(b"whole" + b"again"):
            pass  # bytes are counted after they are written, so the reader may be ahead
        assert (cable.carried, cable.dropped) == ((10, 0), (4, 0))
        for end in ends:
            os.close(end)


@pytest.mark.parametrize("system", [1, 21])
def test_a_ground_station_commands_the_system_that_it_was_given(system: int) -> None:
    def accept(command: mavlink.MAVLink_message) -> list[mavlink.MAVLink_message]:
        return [mavlink.MAVLink_command_ack_message(command.command, mavlink.MAV_RESULT_ACCEPTED)]

    link = UdpLink()
    with (
        ScriptedPeer(link, Mavlink(system), {"COMMAND_LONG": accept}) as px4,
        OperatorStation(vehicle_port=link.port, vehicle_system=system) as station,
    ):
        station.arm()
        assert station.set_mode(4, 3) == mavlink.MAV_RESULT_ACCEPTED
    commands = [(c.target_system, c.command, c.param2) for c in px4.received_of("COMMAND_LONG")]
    assert commands == [
        (system, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0),
        (system, mavlink.MAV_CMD_DO_SET_MODE, 4.0),
    ]
