"""The relay between PX4 and the application: it forwards everything and tracks messages for lockstep."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.errors import FlightError
from dart_flight.sim.px4 import relay
from dart_flight.sim.px4.relay import Relay, frames
from tests.doubles.ports import free_udp_port
from tests.real_time import wait_until

ORIGIN = (0.0, 0.0, 0.0)


class Ends:
    """PX4's end and the application's, with a relay between them."""

    def __init__(self, app_port: int | None = None) -> None:
        self.app = self._socket()
        px4_port = free_udp_port()
        self.relay = Relay(px4_port, self.app.getsockname()[1] if app_port is None else app_port)
        self.px4 = self._socket()
        self.px4.connect(("127.0.0.1", px4_port))

    @staticmethod
    def _socket() -> socket.socket:
        end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        end.bind(("127.0.0.1", 0))
        end.settimeout(5.0)
        return end

    def close(self) -> None:
        self.relay.close()
        self.px4.close()
        self.app.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    opened = Ends()
    yield opened
    opened.close()


def packed(message: mavlink.MAVLink_message, component: int = 1) -> bytes:
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component)))


def attitude(ms: int) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_attitude_quaternion_message(ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def imu(t_us: int) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_highres_imu_message(t_us, *ORIGIN, *ORIGIN, *ORIGIN, 0.0, 0.0, 0.0, 0.0, 63)


def current_mode(mode: int) -> bytes:
    """Return a CURRENT_MODE frame, which pymavlink's dialect `common` lacks; the relay reads no checksum."""
    return (
        b"\xfd\x08"
        + bytes(4)
        + b"\x01"
        + (436).to_bytes(3, "little")
        + struct.pack("<II", mode, mode)
        + bytes(2)
    )


def test_data_is_forwarded_unchanged_in_both_directions(ends: Ends) -> None:
    ends.px4.send(b"noise that is no MAVLink")
    data, sender = ends.app.recvfrom(4096)
    assert data == b"noise that is no MAVLink"
    ends.app.sendto(b"back", sender)
    assert ends.px4.recv(4096) == b"back"


def test_the_newest_timestamp_of_every_autopilot_stream_is_tracked(ends: Ends) -> None:
    ends.px4.send(packed(imu(8_000)) + packed(attitude(12)))
    ends.px4.send(packed(imu(4_000)))
    ends.px4.send(packed(imu(99_000), component=197))
    for _ in range(3):
        ends.app.recv(4096)
    wait_until(lambda: ends.relay.sent_us, 10.0, "the stamps")
    assert ends.relay.sent_us == {"imu": 8_000, "attitude": 12_000}


def test_a_truncated_timestamp_is_read(ends: Ends) -> None:
    """MAVLink 2 truncates trailing zeros of a payload, here all but two bytes of the timestamp."""
    message = mavlink.MAVLink_attitude_quaternion_message(0x0102, *(0.0,) * 7)
    data = packed(message)
    assert data[1] == 2
    ends.px4.send(data)
    ends.app.recv(4096)
    assert ends.relay.sent_us == {"attitude": 0x0102 * 1000}


def test_a_forwarded_setpoint_is_tracked(ends: Ends) -> None:
    ends.px4.send(packed(imu(4_000)))
    _, sender = ends.app.recvfrom(4096)
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0, 1.0, 2.0, -1.0, 0.5, math.nan, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0
    )
    ends.app.sendto(packed(message, component=191), sender)
    assert ends.px4.recv(4096) == packed(message, component=191)
    wait_until(lambda: ends.relay.arrived.get("setpoint", (0.0,))[0] == 1.0, 10.0, "the setpoint")
    assert ends.relay.arrived["setpoint"] == pytest.approx(
        (1.0, 2.0, -1.0, 0.5, math.nan, 0.0, 0.0, 0.0, 0.25), nan_ok=True
    )


def test_a_forwarded_pose_is_tracked_by_its_position(ends: Ends) -> None:
    ends.px4.send(packed(imu(4_000)))
    _, sender = ends.app.recvfrom(4096)
    unknown = [math.nan] * 21
    message = mavlink.MAVLink_odometry_message(
        1_000_000, 1, 12, 1.5, -2.0, -1.0, [1.0, 0.0, 0.0, 0.0], *(math.nan,) * 6, unknown, unknown, 0, 2
    )
    ends.app.sendto(packed(message, component=195), sender)
    wait_until(lambda: "pose" in ends.relay.arrived, 10.0, "the pose")
    assert ends.relay.arrived["pose"] == (1.5, -2.0, -1.0)
    assert "odometry" not in ends.relay.sent_us


def test_px4s_heartbeat_is_repeated_while_simulated_time_stops(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = time.monotonic()
    monkeypatch.setattr(relay, "time", SimpleNamespace(monotonic=lambda: now_s))
    beat = packed(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
    ends.px4.send(packed(imu(4_000)) + beat)
    ends.app.recv(4096)
    now_s += 1.5
    ends.relay.answer_requests()
    assert ends.app.recv(4096) == beat
    ends.relay.answer_requests()
    ends.px4.send(b"next")
    assert ends.app.recv(4096) == b"next", "the heartbeat may repeat only once per second"


def test_a_repeated_heartbeat_contains_the_newest_mode(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mode of the last heartbeat would look like a pilot's change, and end the flight as `released`."""
    hold, offboard = 4 << 16 | 3 << 24, 6 << 16
    now_s = time.monotonic()
    monkeypatch.setattr(relay, "time", SimpleNamespace(monotonic=lambda: now_s))
    ends.px4.send(packed(mavlink.MAVLink_heartbeat_message(2, 12, 1, hold, 3, 3)))
    ends.px4.send(current_mode(offboard))
    ends.px4.send(current_mode(0))  # not supplied
    for _ in range(3):
        ends.app.recv(4096)
    wait_until(lambda: ends.relay._heartbeat, 10.0, "the heartbeat")
    now_s += 1.5
    ends.relay.answer_requests()
    (beat,) = mavlink.MAVLink(None).parse_buffer(ends.app.recv(4096))  # checks the checksum
    assert (beat.get_type(), beat.custom_mode, beat.base_mode) == ("HEARTBEAT", offboard, 1)


@pytest.mark.parametrize("data", [b"", b"\xfd", b"\xfd\xff" + bytes(7), bytes(300), b"\xfe" + bytes(30)])
def test_noise_is_split_into_frames_without_an_error(data: bytes) -> None:
    assert all(number >= 0 for number, _, _, _ in frames(data))


def test_a_network_error_ends_the_wait_with_its_message() -> None:
    """Nothing is forwarded any more, and without the error the simulation would wait forever."""
    ends = Ends(app_port=0)
    ends.px4.send(packed(attitude(1)))
    with pytest.raises(FlightError, match=r"cannot send to 127\.0\.0\.1:0"):
        wait_until(ends.relay.answer_requests, 10.0, "the error")
    ends.close()
