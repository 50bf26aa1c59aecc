"""An emulated OptiTrack server: NatNet 4.1 in unicast, as used by Motive 3.

The layout is from the NatNet SDK's public documentation and headers. All values are little-endian.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from typing import Final
from urllib.parse import quote

from dart_flight.base.geometry import Quaternion, Vec3

_CONNECT, _SERVER_INFO, _REQUEST_MODEL, _MODEL, _FRAME, _DISCONNECT, _KEEP_ALIVE = 0, 1, 4, 5, 7, 9, 10
_LOOPBACK: Final = "127.0.0.1"
_TICKS_PER_S: Final = 10_000_000  # frequency of Windows' performance counter
_OTHER_ID, _BODY_ID = 1, 7
_RIGID_BODY: Final = 1  # type of a data description
_POLL_S: Final = 0.2


def _sized(kind: int, payload: bytes) -> bytes:
    return struct.pack("<HH", kind, len(payload)) + payload


def _counted(items: list[bytes]) -> bytes:
    """Encode a list within a frame: number of items, total size of the items in bytes, and the items."""
    data = b"".join(items)
    return struct.pack("<II", len(items), len(data)) + data


class NatNetServer:
    """An emulated NatNet server on a free port of this computer, with a calibration wand and the body."""

    def __init__(self, body: str) -> None:
        self._body, self._frame = body, 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((_LOOPBACK, 0))
        self._socket.settimeout(_POLL_S)
        self.url = f"optitrack://{_LOOPBACK}:{self._socket.getsockname()[1]}/{quote(body)}"
        self._clients: dict[tuple[str, int], socket.socket] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._answer, name="natnet", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """Number of programs that keep their connection alive."""
        return len(self._clients)

    def _answer(self) -> None:
        while not self._closed.is_set():
            try:
                data, client = self._socket.recvfrom(65535)
            except OSError:  # timeout, or the client has disappeared
                continue
            if len(data) < 4:
                continue
            (kind,) = struct.unpack_from("<H", data)
            answer = {_CONNECT: self._server_info, _REQUEST_MODEL: self._model}.get(kind)
            if answer is not None:
                with contextlib.suppress(OSError):
                    self._socket.sendto(answer(), client)
            elif kind == _KEEP_ALIVE and client not in self._clients:
                link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                link.connect(client)  # connect, so that a lost client raises an error
                with self._lock:
                    self._clients[client] = link
            elif kind == _DISCONNECT:
                self._forget(client)

    def _forget(self, client: tuple[str, int]) -> None:
        with self._lock:
            link = self._clients.pop(client, None)
        if link is not None:
            link.close()

    def _server_info(self) -> bytes:
        sender = b"Motive".ljust(256, b"\0") + bytes((3, 1, 0, 0)) + bytes((4, 1, 0, 0))
        return _sized(_SERVER_INFO, sender + struct.pack("<QHB4B", _TICKS_PER_S, 1511, 0, 239, 255, 42, 99))

    def _model(self) -> bytes:
        payload = struct.pack("<I", 2)
        for name, number in (("wand", _OTHER_ID), (self._body, _BODY_ID)):
            described = name.encode() + b"\0" + struct.pack("<ii3fI", number, -1, 0.0, 0.0, 0.0, 0)
            payload += struct.pack("<II", _RIGID_BODY, len(described)) + described
        return _sized(_MODEL, payload)

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        w, x, y, z = q_body_to_room
        flags = 1 if tracked else 0
        bodies = [
            struct.pack("<I7ffH", _OTHER_ID, 1.0, -0.5, 0.02, 0.0, 0.0, 0.0, 1.0, 1e-4, 1),
            struct.pack("<I7ffH", _BODY_ID, *position_room, x, y, z, w, 1e-4, flags),
        ]
        nothing = _counted([])
        ticks = t_us * (_TICKS_PER_S // 1_000_000)
        payload = struct.pack("<I", self._frame % 2**32)
        payload += nothing + nothing + _counted(bodies)  # marker sets, unlabelled markers, bodies
        payload += nothing * 5  # skeletons, assets, labelled markers, force plates, devices
        payload += struct.pack("<IIdQQQ", 0, 0, 1e-6 * t_us, ticks, ticks, ticks)
        payload += struct.pack("<IIH", 0, 0, 0) + struct.pack("<I", 0)  # precise time, flags, end
        self._frame += 1
        data = _sized(_FRAME, payload)
        for client, link in list(self._clients.items()):
            try:
                link.send(data)
            except OSError:
                self._forget(client)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        for client in list(self._clients):
            self._forget(client)
        self._socket.close()
