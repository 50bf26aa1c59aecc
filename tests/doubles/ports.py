"""Free UDP ports for tests and measurements."""

from __future__ import annotations

import contextlib
import secrets
import socket

_PORTS = range(20_000, 30_000)  # used neither by Linux for ephemeral ports nor by PX4


def free_udp_port() -> int:
    """Return a UDP port on the loopback interface that is currently free.

    The port is outside of the ephemeral range, because the system could give such a port to another socket
    before its use. It is random, so that simultaneous flights do not collide.
    """
    while True:
        port = _PORTS.start + secrets.randbelow(len(_PORTS))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
