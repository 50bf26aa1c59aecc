"""Datagrams between a simulated vehicle and peers that may not be listening."""

from __future__ import annotations

import socket

from dart_flight.base.errors import FlightError

Address = tuple[str, int]


def send_datagram(link: socket.socket, data: bytes, address: Address) -> None:
    """Send a datagram, which is lost if no peer listens; any other failure raises FlightError."""
    try:
        link.sendto(data, address)
    except (BlockingIOError, ConnectionRefusedError):
        return
    except OSError as error:
        host, port = address
        raise FlightError(f"cannot send to {host}:{port}: {error.strerror or error}") from None


def receive_datagram(link: socket.socket) -> tuple[bytes, Address] | None:
    """Return a datagram and its sender, or None without a datagram. A network failure raises FlightError."""
    while True:
        try:
            return link.recvfrom(4096)
        except BlockingIOError:
            return None
        except ConnectionRefusedError:  # the kernel reports that an earlier datagram found no listener
            continue
        except OSError as error:
            raise FlightError(f"cannot receive: {error.strerror or error}") from None
