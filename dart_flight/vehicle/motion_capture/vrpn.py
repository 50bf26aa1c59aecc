"""A pose source for any VRPN server, over one TCP connection.

The layout is from the public description of VRPN's protocol; all numbers are big-endian. Both ends first send
a cookie with their version. A message is a header and a payload, which is padded to a multiple of 8 bytes.
The header gives sender and type as numbers, and the server also sends the name of each number. The server
sends no poses of an untracked body.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import BinaryIO, Final

from dart_flight.vehicle.motion_capture.source import AbsentSourceError, PoseAddress, RawPose, in_quotes

_VERSION: Final = b"vrpn: ver. 07."  # the minor version that follows may differ
_COOKIE: Final = (_VERSION + b"35  0").ljust(24, b"\0")  # 0: the server writes no log
# Length without padding, stamp (s, µs), sender, type, and the sequence number that VRPN's library adds.
_HEADER: Final = struct.Struct(">3I2iI")
_POSE: Final = struct.Struct(">i4x7d")  # sensor, position in metres, attitude as x, y, z, w
_SENDER_NAME, _TYPE_NAME = -1, -2  # types of the descriptions
_MAX_MESSAGE: Final = 65536
_TIMEOUT_S, _SILENT_S, _RETRY_S = 3.0, 1.0, 1.0


def read_poses(stream: BinaryIO, body: str, server: str, senders: dict[int, str]) -> Iterator[RawPose]:
    """Yield each pose of a body until the stream ends; add the senders' names to `senders`.

    Raise ValueError if the server does not speak VRPN.
    """
    if not stream.read(len(_COOKIE)).startswith(_VERSION):
        raise ValueError("the answer does not come from a VRPN 7 server")
    types: dict[int, str] = {}
    while len(header := stream.read(_HEADER.size)) == _HEADER.size:
        length, seconds, micros, sender, kind, number = _HEADER.unpack(header)
        size = length - _HEADER.size
        if not 0 <= size <= _MAX_MESSAGE:
            raise ValueError(f"message of {length} bytes")
        payload = stream.read(size + -size % 8)[:size]
        if len(payload) < size:
            return
        if kind in (_SENDER_NAME, _TYPE_NAME):
            names = senders if kind == _SENDER_NAME else types
            names[sender] = payload[4:].partition(b"\0")[0].decode("utf-8", "replace")
        elif types.get(kind) == "vrpn_Tracker Pos_Quat" and senders.get(sender) == body:
            if size != _POSE.size:
                raise ValueError(f"pose of {size} bytes")
            sensor, px, py, pz, x, y, z, w = _POSE.unpack(payload)
            if sensor == 0:
                stamp_us = 1_000_000 * seconds + micros
                yield RawPose(body, True, (px, py, pz), (w, x, y, z), number, stamp_us, server)


class VrpnSource:
    """A source that reads sensor 0 of one sender, on its own thread; the body in the URL names the sender.

    The constructor raises AbsentSourceError if no VRPN server answers, or the server does not list the
    sender.
    """

    def __init__(self, address: PoseAddress) -> None:
        self._address, self._server = address, f"{address.host}:{address.port}"
        self.place = f"VRPN server at {self._server}"
        self.remedy = "start VRPN streaming; check address and port"
        self._deliver: Callable[[RawPose], None] = lambda _: None
        self._senders: dict[int, str] = {}
        self._link: socket.socket | None = None
        self._error: str | None = None
        self._pose_s = opened_s = time.monotonic()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mocap", daemon=True)
        self._thread.start()
        while address.body not in self._names():
            if self._error is not None or time.monotonic() > opened_s + _TIMEOUT_S:
                problem = self.problem
                self.stop()
                raise AbsentSourceError(f"mocap URL {address.url}: {problem}")
            time.sleep(0.01)

    def _names(self) -> list[str]:
        return sorted({*self._senders.copy().values()} - {"VRPN Control"})  # every server has this sender

    @property
    def problem(self) -> str | None:
        body, names, error = self._address.body, self._names(), self._error
        silent_s = time.monotonic() - self._pose_s
        if error is None and silent_s > _SILENT_S:
            error = f'no sender "{body}", only {in_quotes(names)}' if names else "no answer"
            if body in names:
                error = f'no pose of "{body}" (sensor 0) for {silent_s:.0f} s'
        return None if error is None else f"VRPN server at {self._server}: {error}"

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        self._deliver = deliver

    def stop(self) -> None:
        self._stopped.set()
        if (link := self._link) is not None:
            with contextlib.suppress(OSError):  # the connection is already lost
                link.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _run(self) -> None:
        """Read poses until stopped; connect again if the connection is lost."""
        while not self._stopped.is_set():
            try:
                with socket.create_connection(self._address[1:3], _TIMEOUT_S) as self._link:
                    if not self._stopped.is_set():
                        self._read(self._link)
            except (OSError, ValueError) as error:
                self._error = getattr(error, "strerror", None) or str(error)
            self._stopped.wait(_RETRY_S)

    def _read(self, link: socket.socket) -> None:
        link.sendall(_COOKIE)
        link.settimeout(None)
        # The source sends nothing more, so only keep-alive probes show that the server's network is down.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT):
            link.setsockopt(socket.IPPROTO_TCP, option, 2)
        # Reset the connection on closing: a normal close would block a restarted server's port for 60 s.
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._error, self._senders = None, {}
        with link.makefile("rb") as stream:
            for pose in read_poses(stream, self._address.body, self._server, self._senders):
                self._error, self._pose_s = None, time.monotonic()
                self._deliver(pose)
        self._error = "connection lost"


open_source = VrpnSource
