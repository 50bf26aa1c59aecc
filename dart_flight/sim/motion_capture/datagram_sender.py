"""An emulated system that sends one datagram per frame to a port of this computer, without a request."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Final
from urllib.parse import quote

_LOOPBACK: Final = "127.0.0.1"


class DatagramSender:
    """A sender of datagrams to a receiver that may not listen yet; `scheme` is the URL's scheme."""

    def __init__(self, scheme: str, body: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:  # a port that the receiver can bind
            probe.bind((_LOOPBACK, 0))
            self._port = int(probe.getsockname()[1])
        self._socket.connect((_LOOPBACK, self._port))
        self._socket.setblocking(False)
        self.url = f"{scheme}://{_LOOPBACK}:{self._port}/{quote(body)}"

    @property
    def clients(self) -> int:
        """1 if a program on this computer listens on the port, otherwise 0."""
        wanted = f":{self._port:04X} "
        lines = Path("/proc/net/udp").read_text().splitlines()[1:]
        return int(any(wanted in line.split(": ", 1)[1][:14] for line in lines))

    def send(self, data: bytes) -> None:
        """Send a datagram; it is lost if no program listens."""
        try:
            self._socket.send(data)
        except (BlockingIOError, ConnectionRefusedError):
            return

    def close(self) -> None:
        self._socket.close()
