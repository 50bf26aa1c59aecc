"""A pose source for OptiTrack's Motive (NatNet protocol).

The server announces whether it uses unicast or multicast.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from natnet import NatNetClient

from dart_flight.config.document import InputError
from dart_flight.vehicle.motion_capture.source import PoseAddress, RawPose, lost_pose

_HEADER: Final = struct.Struct("<HH")
_PING: Final = _HEADER.pack(NatNetClient.NAT_CONNECT, 5) + b"Ping\0"
# After the header: name and version of the application, version of NatNet. NatNet 3 adds the clock's ticks
# per second, the data port, whether the server uses multicast, and the multicast group.
_SERVER: Final = struct.Struct("<256s4B4B")
_TRANSMISSION: Final = struct.Struct("<QHB4B")
_PINGS: Final = 3
_PING_S: Final = 1.0
_MODEL_S: Final = 3.0
_POLL_S: Final = 0.02
_SILENT_S: Final = 1.0  # time without a frame until the server is queried
_DEAD_S: Final = 3.0  # time without an answer until the connection is opened again


class ServerInfo(NamedTuple):
    """The transmission settings of a NatNet server; the defaults apply to servers before NatNet 3."""

    ticks_per_s: int = 0
    data_port: int = 1511
    multicast: bool = True
    group: str = "239.255.42.99"


def decode_server_info(data: bytes) -> ServerInfo | None:
    """Decode a server's answer to a connection request; return None for other data."""
    start = _HEADER.size + _SERVER.size
    if len(data) < start or _HEADER.unpack_from(data)[0] != NatNetClient.NAT_SERVERINFO:
        return None
    if len(data) < start + _TRANSMISSION.size:
        return ServerInfo()
    ticks, port, multicast, *group = _TRANSMISSION.unpack_from(data, start)
    return ServerInfo(ticks, port, bool(multicast), ".".join(map(str, group)))


def _query_server(address: PoseAddress) -> tuple[ServerInfo, str, str]:
    """Request a connection; return the server's announcement and the addresses of both sides.

    The result is (announcement, the server's address, this computer's address towards the server).

    Raises:
        InputError: the host has no address, or no server answers.
    """
    place = f"{address.host}:{address.port}"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.connect((address.host, address.port))
            link.settimeout(_PING_S)
            for _ in range(_PINGS):
                with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                    link.send(_PING)
                    info = decode_server_info(link.recv(65535))
                    if info is not None:
                        return info, link.getpeername()[0], link.getsockname()[0]
    except OSError as error:
        raise InputError(f"mocap URL {address.url}: {place}: {error.strerror or error}") from None
    raise InputError(
        f"mocap URL {address.url}: no OptiTrack server answers at {place}; "
        "enable streaming in Motive and check the address"
    )


class OptiTrackSource:
    """A source that reads one rigid body from a NatNet server.

    Args:
        address: the server's host and command port, and the body's name or streaming id.

    Raises:
        InputError: no server answers, or the server does not know the body.
    """

    def __init__(self, address: PoseAddress) -> None:
        self._address, self._sender = address, f"{address.host}:{address.port}"
        self._info, server, local = _query_server(address)
        self._client = NatNetClient(
            server, local, self._info.group, address.port, self._info.data_port, self._info.multicast
        )
        self._client.on_data_description_received_event.handlers.append(self._on_model)
        self._client.on_data_frame_received_event.handlers.append(self._on_frame)
        self.problem: str | None = None
        self._ids: dict[str, int] = {}
        self._has_model = False
        self._answered_s = self._framed_s = time.monotonic()
        self._deliver: Callable[[RawPose], None] | None = None
        self._stopped = threading.Event()
        self._watch: threading.Thread | None = None
        try:
            self._client.connect(timeout=_PINGS * _PING_S)
            self._read_model()
        except InputError:
            self._client.shutdown()
            raise
        except Exception as error:  # the client's own errors, and those of its parser
            self._client.shutdown()
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"mocap URL {address.url}: {self._sender}: {reason}") from None

    def _read_model(self) -> None:
        end_s = time.monotonic() + _MODEL_S
        while not self._has_model and time.monotonic() < end_s:
            self._client.request_modeldef()
            requested_s = time.monotonic()
            while not self._has_model and time.monotonic() < requested_s + _PING_S:
                self._client.update_sync()
                time.sleep(_POLL_S)
        if not self._has_model:
            raise InputError(f"mocap URL {self._address.url}: {self._sender} does not list its bodies")
        if self._body_id() is None:
            raise InputError(f"mocap URL {self._address.url}: {self._describe_missing_body()}")

    def _body_id(self) -> int | None:
        body = self._address.body
        if body in self._ids:
            return self._ids[body]
        return int(body) if body.isdecimal() and int(body) in self._ids.values() else None

    def _describe_missing_body(self) -> str:
        names = ", ".join(f"{name} ({number})" for name, number in sorted(self._ids.items()))
        return f"Motive streams no rigid body {self._address.body}, only {names or 'none'}"

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        """Deliver every further pose on a thread of the client."""
        self._client.update_sync()  # discards the frames that wait in the socket
        self._deliver = deliver
        self._answered_s = self._framed_s = time.monotonic()
        self._client.run_async()
        self._watch = threading.Thread(target=self._reconnect, name="mocap", daemon=True)
        self._watch.start()

    def stop(self) -> None:
        """Stop delivering and close the connection."""
        self._stopped.set()
        if self._watch is not None:
            self._watch.join()
        self._client.shutdown()

    def _on_model(self, model: Any) -> None:
        self._ids = {str(body.name): int(body.id_num) for body in model.rigid_bodies}
        self._has_model, self._answered_s = True, time.monotonic()

    def _on_frame(self, frame: Any) -> None:
        if self._deliver is None:
            return
        self._answered_s = self._framed_s = time.monotonic()
        number, wanted = int(frame.prefix.frame_number), self._body_id()
        ticks, frequency = frame.suffix.stamp_camera_mid_exposure, self._info.ticks_per_s
        if ticks and frequency:
            source_us = int(ticks) * 1_000_000 // frequency
        else:
            source_us = round(1e6 * frame.suffix.timestamp)
        body = next((body for body in frame.rigid_bodies if body.id_num == wanted), None)
        self.problem = None if body is not None else self._describe_missing_body()
        if body is None or body.tracking_valid is False or not any(body.rot):
            self._deliver(lost_pose(self._address.body, number, source_us, self._sender))
            return
        x, y, z, w = body.rot
        self._deliver(
            RawPose(self._address.body, True, tuple(body.pos), (w, x, y, z), number, source_us, self._sender)
        )

    def _reconnect(self) -> None:
        """Query a silent server, and connect again if the server does not answer.

        A damaged datagram ends the client's threads, and a restarted server does not know its clients. In
        both cases a new connection is needed.
        """
        while not self._stopped.wait(_SILENT_S):
            now_s = time.monotonic()
            if now_s - self._framed_s < _SILENT_S and self._body_id() is not None:
                continue
            if now_s - self._framed_s >= _SILENT_S:
                self.problem = f"no frame from {self._sender} for {now_s - self._framed_s:.0f} s"
            with contextlib.suppress(Exception):
                if now_s - self._answered_s >= _DEAD_S:
                    self._client.shutdown()
                    self._client.connect(timeout=_PING_S)
                    self._client.run_async()
                self._client.request_modeldef()


def open_source(address: PoseAddress) -> OptiTrackSource:
    """Connect to a NatNet server."""
    return OptiTrackSource(address)
