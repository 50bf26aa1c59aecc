"""Relay of every datagram between PX4 and the application; the relay records stamps for `sim.lockstep`.

It listens on PX4's onboard port; the application listens on another port.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Final

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.errors import FlightError
from dart_flight.base.streams import BY_NAME, SAMPLED
from dart_flight.sim.datagrams import receive_datagram, send_datagram

_HEARTBEAT, _CURRENT_MODE = 0, 436
_STREAMS: Final = {stream.number: stream.name for stream in SAMPLED}
# message id -> format of the stamp at the payload's start, and the stamp's unit in microseconds
_STAMPS: Final = {BY_NAME["attitude"].number: (struct.Struct("<I"), 1000)}
_USUAL_STAMP: Final = (struct.Struct("<Q"), 1)
# message id -> name in lockstep, format of the payload's start (stamp and values; only values are compared)
_SENT: Final = {84: ("setpoint", struct.Struct("<I9f")), 331: ("pose", struct.Struct("<Q3f"))}
_HEARTBEAT_S: Final = 1.0
_HEADER: Final = 10  # bytes before the payload in a MAVLink 2 frame; two bytes of checksum follow it
_FROM_AUTOPILOT: Final = 1  # component id


class Relay:
    """Relay between PX4 and the application, with its own thread.

    Args:
        px4_port: port that PX4 sends to.
        app_port: port on which the application listens.

    Attributes:
        sent_us: newest forwarded stamp of each telemetry stream.
        arrived: values of the last forwarded setpoint (position, velocity, acceleration) and pose (position).
        wake: descriptor that becomes readable when a datagram has been forwarded.
    """

    def __init__(self, px4_port: int, app_port: int) -> None:
        self.sent_us: dict[str, int] = {}
        self.arrived: dict[str, tuple[float, ...]] = {}
        self.wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._px4 = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._px4.bind(("127.0.0.1", px4_port))
        self._app = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._app.bind(("127.0.0.1", 0))
        self._app_address = ("127.0.0.1", app_port)
        self._px4_address: tuple[str, int] | None = None
        self._heartbeat, self._heartbeat_s = b"", 0.0
        self._closed = False
        self._failure: FlightError | None = None
        for one in (self._px4, self._app):
            one.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def answer_requests(self) -> None:
        """Repeat PX4's last heartbeat once per second of host time, and raise an error of the relay's thread.

        PX4 sends a heartbeat every simulated second, and MAVSDK reports a lost vehicle after 3 s of host
        time. The repeated heartbeat contains the newest mode, because an older one would look like a pilot's
        change of the mode.
        """
        if self._failure is not None:
            raise self._failure
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.wake)
        if self._heartbeat and time.monotonic() - self._heartbeat_s >= _HEARTBEAT_S:
            self._forward_to_app(self._heartbeat)
            self._heartbeat_s = time.monotonic()

    def close(self) -> None:
        self._closed = True
        self._thread.join(timeout=1.0)
        self._px4.close()
        self._app.close()

    def _run(self) -> None:
        try:
            self._relay()
        except FlightError as error:
            self._failure = error

    def _relay(self) -> None:
        while not self._closed:
            ready, _, _ = select.select([self._px4, self._app], [], [], 0.1)
            for source in ready:
                arrived = receive_datagram(source)
                if arrived is None:
                    continue
                data, sender = arrived
                if source is self._px4:
                    self._px4_address = sender
                    self._count(data)
                    self._forward_to_app(data)
                elif self._px4_address is not None:
                    send_datagram(self._px4, data, self._px4_address)
                    self._note_sent(data)
            if ready:
                os.eventfd_write(self.wake, 1)

    def _forward_to_app(self, data: bytes) -> None:
        send_datagram(self._app, data, self._app_address)

    def _count(self, data: bytes) -> None:
        for number, component, payload, frame in frames(data):
            if component != _FROM_AUTOPILOT:
                continue
            if number == _HEARTBEAT:
                self._heartbeat, self._heartbeat_s = frame, time.monotonic()
            elif number == _CURRENT_MODE and self._heartbeat and any(payload[:4]):
                self._heartbeat = _with_mode(self._heartbeat, payload[:4].ljust(4, b"\0"))
            name = _STREAMS.get(number)
            if name is not None:
                stamp, unit_us = _STAMPS.get(number, _USUAL_STAMP)
                # MAVLink 2 removes trailing zeros from a payload.
                (value,) = stamp.unpack(payload[: stamp.size].ljust(stamp.size, b"\0"))
                self.sent_us[name] = max(value * unit_us, self.sent_us.get(name, 0))

    def _note_sent(self, data: bytes) -> None:
        for number, _, payload, _ in frames(data):
            if number in _SENT:
                name, fields = _SENT[number]
                self.arrived[name] = fields.unpack(payload[: fields.size].ljust(fields.size, b"\0"))[1:]


def _with_mode(heartbeat: bytes, mode: bytes) -> bytes:
    """Return the frame of a HEARTBEAT with another custom mode, the payload's first field."""
    body = heartbeat[1:_HEADER] + mode + heartbeat[_HEADER + 4 : -2]
    checksum = mavlink.x25crc(body + bytes([mavlink.MAVLink_heartbeat_message.crc_extra]))
    return heartbeat[:1] + body + int(checksum.crc).to_bytes(2, "little")


def frames(data: bytes) -> Iterator[tuple[int, int, bytes, bytes]]:
    """Yield (message id, component id, payload, whole frame) for every MAVLink 2 frame in a datagram."""
    at = 0
    while at + _HEADER <= len(data):
        if data[at] != 0xFD:
            return  # MAVLink 1 or noise
        length, signed = data[at + 1], data[at + 2] & 1
        end = at + _HEADER + length + 2 + (13 if signed else 0)
        number = int.from_bytes(data[at + 7 : at + 10], "little")
        yield number, data[at + 6], data[at + _HEADER : at + _HEADER + length], data[at:end]
        at = end
