"""A pose source for OptiTrack's Motive (NatNet protocol).

The server announces whether it uses unicast or multicast. In unicast, frames arrive at the socket that sends
the requests.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Final

from dart_flight.vehicle.motion_capture import natnet_packets as natnet
from dart_flight.vehicle.motion_capture.multicast import card_address, join_group
from dart_flight.vehicle.motion_capture.source import (
    AbsentSourceError,
    PoseAddress,
    RawPose,
    in_quotes,
    lost_pose,
)

_MAX_DATAGRAM: Final = 65535
_PING: Final = natnet.HEADER.pack(natnet.CONNECT, 5) + b"Ping\0"
_REQUEST_MODEL: Final = natnet.HEADER.pack(natnet.REQUEST_MODEL, 1) + b"\0"
_KEEP_ALIVE: Final = natnet.HEADER.pack(natnet.KEEP_ALIVE, 1) + b"\0"
_PINGS: Final = 3
_PING_S: Final = 1.0
_MODEL_S: Final = 3.0
_POLL_S: Final = 0.1  # poll timeout and keep-alive period; without keep-alives the server drops this client
_SILENT_S: Final = 1.0  # time without a frame until the server is queried


class OptiTrackSource:
    """A source that reads one rigid body from a NatNet server, on its own thread.

    The URL identifies the body by its name or streaming id. The constructor raises AbsentSourceError if no
    server answers, or if the server does not stream the body.
    """

    remedy = "start the live mode in Motive; check the network interface and the firewall"

    def __init__(self, address: PoseAddress) -> None:
        self._address, self._sender = address, f"{address.host}:{address.port}"
        self.problem: str | None = None
        self._ids: dict[str, int] = {}
        self._unread = "the server does not list its bodies"
        self._has_model = False
        self._deliver: Callable[[RawPose], None] | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mocap", daemon=True)
        self._asked_s = self._kept_s = self._framed_s = 0.0
        with contextlib.ExitStack() as opened:
            self._command = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._links = [self._command]
            try:
                self._open(opened)
            except OSError as error:
                reason = error.strerror or str(error)
                raise AbsentSourceError(f"mocap URL {address.url}: {self._sender}: {reason}") from None
            self._read_model()
            self._sockets = opened.pop_all()

    def _open(self, opened: contextlib.ExitStack) -> None:
        """Connect to the server; if the server uses multicast, also open the socket of the frames.

        Raises:
            OSError: the host name cannot be resolved, or no network interface has a route to the host.
            AbsentSourceError: no server answers.
            InputError: this computer has no such interface.
        """
        server = (socket.gethostbyname(self._address.host), self._address.port)
        card = card_address(self._address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
            if card is not None:
                route.bind((card, 0))
            route.connect(server)
            local = route.getsockname()[0]
        self._server = server
        self._command.bind((local, 0))
        self._info = self._query_server()
        self.place = f"OptiTrack server {self._sender}, listening on {local}"
        if self._info.multicast:
            frames = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            frames.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            frames.bind((self._info.group, self._info.data_port))
            card = join_group(frames, self._info.group, local)
            self._links.append(frames)
            group = f"{self._info.group}:{self._info.data_port}"
            self.place = f"OptiTrack server {self._sender}, listening on {group} on {card}"

    def _query_server(self) -> natnet.ServerInfo:
        """Request a connection and return the announcement; a server may answer from another address."""
        self._command.settimeout(_PING_S)
        for _ in range(_PINGS):
            self._command.sendto(_PING, self._server)
            with contextlib.suppress(TimeoutError):
                info = natnet.decode_server_info(self._command.recv(_MAX_DATAGRAM))
                if info is not None:
                    return info
        raise AbsentSourceError(
            f"mocap URL {self._address.url}: no OptiTrack server answers at {self._sender}; "
            "enable streaming in Motive and check the address, the network interface and the firewall"
        )

    def _read_model(self) -> None:
        end_s = time.monotonic() + _MODEL_S
        while not self._has_model and time.monotonic() < end_s:
            self._exchange()
        if not self._has_model:
            raise AbsentSourceError(f"mocap URL {self._address.url}: {self._sender} does not list its bodies")
        if self._body_id() is None:
            raise AbsentSourceError(f"mocap URL {self._address.url}: {self._describe_missing_body()}")

    def _body_id(self) -> int | None:
        body = self._address.body
        if body in self._ids:
            return self._ids[body]
        if body.isdecimal() and (self._unread or int(body) in self._ids.values()):
            return int(body)
        return None

    def _describe_missing_body(self) -> str:
        known = in_quotes(self._ids)
        ids = ", ".join(str(number) for number in sorted(self._ids.values()))
        unread = f"; {self._unread}, or give the body's streaming id" if self._unread else ""
        return f'Motive streams no rigid body "{self._address.body}", only {known} (ids {ids}){unread}'

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        for link in self._links:  # discard frames that arrived before the start
            link.settimeout(0.0)
            with contextlib.suppress(OSError):
                while True:
                    link.recv(_MAX_DATAGRAM)
        self._deliver, self._framed_s = deliver, time.monotonic()
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()
        self._sockets.close()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                self._exchange()
            except OSError as error:
                self.problem = f"{self._sender}: {error.strerror or error}"
                self._stopped.wait(_POLL_S)

    def _exchange(self) -> None:
        """Send the messages that are due, and process the packets that arrive within `_POLL_S`.

        A server forgets its clients when it restarts, so a silent server is queried again.
        """
        now_s = time.monotonic()
        if not self._info.multicast and now_s - self._kept_s >= _POLL_S:
            self._kept_s = now_s
            self._command.sendto(_KEEP_ALIVE, self._server)
        silent = now_s - self._framed_s >= _SILENT_S or self._body_id() is None
        if silent and now_s - self._asked_s >= _SILENT_S:
            self._asked_s = now_s
            self._command.sendto(_PING, self._server)
            self._command.sendto(_REQUEST_MODEL, self._server)
        for link in select.select(self._links, [], [], _POLL_S)[0]:
            try:
                self._process(link.recv(_MAX_DATAGRAM))
            except (ValueError, ArithmeticError) as error:
                self.problem = f"damaged packet from {self._sender}: {error}"

    def _process(self, data: bytes) -> None:
        kind, payload = natnet.split_packet(data)
        if kind == natnet.SERVER_INFO:
            info = natnet.decode_server_info(data)
            if info is not None:
                self._info = self._info._replace(version=info.version, ticks_per_s=info.ticks_per_s)
        elif kind == natnet.MODEL:
            self._ids, self._unread = natnet.decode_bodies(payload, self._info.version)
            self._has_model = True
        elif kind == natnet.FRAME and self._deliver is not None:
            frame = natnet.decode_frame(payload, self._info, self._body_id())
            self._framed_s = time.monotonic()
            self._deliver(self._pose(frame))

    def _pose(self, frame: natnet.Frame) -> RawPose:
        body = self._address.body
        self.problem = None if frame.body is not None else self._describe_missing_body()
        if frame.body is None or not frame.body.tracked:
            return lost_pose(body, frame.number, frame.stamp_us, self._sender)
        position, attitude, _ = frame.body
        return RawPose(body, True, position, attitude, frame.number, frame.stamp_us, self._sender)


def open_source(address: PoseAddress) -> OptiTrackSource:
    return OptiTrackSource(address)
