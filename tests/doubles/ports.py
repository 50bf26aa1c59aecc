"""A UDP port for a test or a measurement."""

from __future__ import annotations

import contextlib
import secrets
import socket

_PORTS = range(20_000, 30_000)  # neither handed out by Linux nor PX4's


def free_udp_port() -> int:
    """A UDP port on the loopback that is free at the moment.

    Not one of those that the system hands out by itself: between this answer and its use another
    socket could get it. Flights that start at the same moment do not meet either.
    """
    while True:
        port = _PORTS.start + secrets.randbelow(len(_PORTS))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
