"""An emulated VRPN server with two trackers, TCP only, based on the public description of VRPN's protocol."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from typing import Final
from urllib.parse import quote

from dart_flight.base.geometry import Quaternion, Vec3

_LOOPBACK: Final = "127.0.0.1"
_COOKIE: Final = b"vrpn: ver. 07.35  0".ljust(24, b"\0")
_SENDER, _TYPE = -1, -2  # types of the messages that announce a name
_SEND_S: Final = 2.0  # a client that reads nothing for this time is dropped
_POLL_S: Final = 0.2


def _message(kind: int, number: int, payload: bytes, t_us: int = 0, sequence: int = 0) -> bytes:
    seconds, micros = divmod(t_us, 1_000_000)
    header = struct.pack(">3I2iI", 24 + len(payload), seconds, micros, number, kind, sequence % 2**32)
    return header + payload + bytes(-len(payload) % 8)


def _name(kind: int, number: int, name: str) -> bytes:
    data = name.encode() + b"\0"
    return _message(kind, number, struct.pack(">I", len(data)) + data)


class VrpnServer:
    """An emulated VRPN server that tracks a wand and the body, on a free port of this computer."""

    def __init__(self, body: str) -> None:
        self._frame = 0
        names = _name(_TYPE, 0, "vrpn_Tracker Pos_Quat")
        for number, name in enumerate(("VRPN Control", "wand", body)):
            names += _name(_SENDER, number, name)
        self._names = names
        self._socket = socket.create_server((_LOOPBACK, 0))
        self._socket.settimeout(_POLL_S)
        self.url = f"vrpn://{_LOOPBACK}:{self._socket.getsockname()[1]}/{quote(body)}"
        self._links: list[socket.socket] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._accept, name="vrpn", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        return len(self._links)

    def _accept(self) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(OSError):
                link, _ = self._socket.accept()
                link.settimeout(_SEND_S)
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                link.sendall(_COOKIE)
                link.recv(len(_COOKIE))
                link.sendall(self._names)
                self._links.append(link)

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        """Send the wand's pose, and the body's pose if the body is tracked."""
        w, x, y, z = q_body_to_room
        poses = [(1, (1.0, -0.5, 0.02, 0.0, 0.0, 0.0, 1.0))]
        poses += [(2, (*position_room, x, y, z, w))] if tracked else []
        data = b"".join(
            _message(0, sender, struct.pack(">ii7d", 0, 0, *values), t_us, self._frame)
            for sender, values in poses
        )
        self._frame += 1
        for link in list(self._links):
            try:
                link.sendall(data)
            except OSError:
                self._links.remove(link)
                link.close()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        for link in self._links:
            link.close()
        self._socket.close()
