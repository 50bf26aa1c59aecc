"""An emulated Qualisys Track Manager (QTM), which sends 6DOF data.

The layout is from the public documentation of QTM's real-time protocol, version 1.25, little-endian.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
from typing import Final
from urllib.parse import quote
from xml.sax.saxutils import escape

from dart_flight.base.geometry import Quaternion, Vec3, rotate

_LOOPBACK: Final = "127.0.0.1"
_ERROR, _COMMAND, _XML, _DATA = 0, 1, 2, 3  # packet types
_SIX_DOF: Final = 5  # component type
_HEADER: Final = struct.Struct("<II")
_BODY: Final = struct.Struct("<3f9f")
_MAX_COMMAND: Final = 65536
_POLL_S: Final = 0.2
_SEND_S: Final = 2.0  # a client that reads nothing for this time is dropped


def _packet(kind: int, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def _text(kind: int, text: str) -> bytes:
    return _packet(kind, text.encode() + b"\0")


class QtmServer:
    """An emulated QTM that tracks a calibration wand and the body, on a free port of this computer."""

    def __init__(self, body: str) -> None:
        self._body, self._frame = body, 0
        self._socket = socket.create_server((_LOOPBACK, 0))
        self._socket.settimeout(_POLL_S)
        self.url = f"qualisys://{_LOOPBACK}:{self._socket.getsockname()[1]}/{quote(body)}"
        self._links: dict[socket.socket, bool] = {}  # whether the client has asked for frames
        self._closed = threading.Event()
        self._threads = [threading.Thread(target=self._accept, name="qtm", daemon=True)]
        self._threads[0].start()

    @property
    def clients(self) -> int:
        """Number of programs that have asked for frames."""
        return sum(self._links.values())

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                link, _ = self._socket.accept()
            except OSError:
                continue
            link.settimeout(_SEND_S)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._links[link] = False
            link.sendall(_text(_COMMAND, "QTM RT Interface connected"))
            thread = threading.Thread(target=self._serve, args=(link,), name="qtm client", daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, link: socket.socket) -> None:
        received = b""
        with contextlib.suppress(OSError):
            while not self._closed.is_set():
                try:
                    data = link.recv(4096)
                except TimeoutError:
                    continue
                received += data
                if not data or len(received) > _MAX_COMMAND:
                    break
                while len(received) >= _HEADER.size:
                    size, kind = _HEADER.unpack_from(received)
                    if not _HEADER.size <= size <= _MAX_COMMAND:
                        return
                    if len(received) < size:
                        break
                    text, received = received[_HEADER.size : size], received[size:]
                    if kind == _COMMAND:
                        self._obey(link, text.rstrip(b"\0").decode("ascii", "replace").lower().split())
        self._drop(link)

    def _drop(self, link: socket.socket) -> None:
        self._links.pop(link, None)
        link.close()

    def _obey(self, link: socket.socket, words: list[str]) -> None:
        match words:
            case ["version", version]:
                link.sendall(_text(_COMMAND, f"Version set to {version}"))
            case ["getparameters", *_]:
                bodies = "".join(f"<Body><Name>{escape(name)}</Name></Body>" for name in ("wand", self._body))
                tag = "QTM_Parameters_Ver_1.25"
                link.sendall(_text(_XML, f"<{tag}><The_6D>{bodies}</The_6D></{tag}>"))
            case ["streamframes", "stop"]:
                self._links[link] = False
            case ["streamframes", "allframes", *components] if "6d" in components:
                self._links[link] = True
            case _:
                link.sendall(_text(_ERROR, "Parse error"))

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        columns = [
            x
            for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
            for x in rotate(q_body_to_room, axis)
        ]
        values = [1e3 * x for x in position_room] + columns if tracked else [math.nan] * 12
        wand = (1000.0, -500.0, 20.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        component = struct.pack("<Ihh", 2, 0, 0) + _BODY.pack(*wand) + _BODY.pack(*values)
        data = struct.pack("<qII", t_us, self._frame % 2**32, 1)
        data += _HEADER.pack(_HEADER.size + len(component), _SIX_DOF) + component
        self._frame += 1
        for link, asked in list(self._links.items()):
            if asked:
                try:
                    link.sendall(_packet(_DATA, data))
                except OSError:
                    self._drop(link)

    def close(self) -> None:
        self._closed.set()
        for link in list(self._links):
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._socket.close()
