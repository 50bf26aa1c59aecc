"""Datagrams to a peer that does not listen are lost; a network that fails is reported with its own text."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from dart_flight.base.errors import FlightError
from dart_flight.sim.datagrams import receive_datagram, send_datagram
from tests.doubles.ports import free_udp_port

REFUSED_BY_THE_NETWORK = ("127.0.0.1", 0)


@pytest.fixture
def link() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        own.setblocking(False)
        yield own


def test_a_datagram_to_a_closed_port_is_lost_without_an_error(link: socket.socket) -> None:
    link.connect(("127.0.0.1", free_udp_port()))  # only a connected socket receives a refusal
    for _ in range(3):
        send_datagram(link, b"lost", link.getpeername())
        assert receive_datagram(link) is None


def test_a_datagram_is_received_with_its_sender(link: socket.socket) -> None:
    send_datagram(link, b"one", link.getsockname())
    assert receive_datagram(link) == (b"one", link.getsockname())


def test_a_network_that_fails_is_reported_with_its_own_text(link: socket.socket) -> None:
    with pytest.raises(FlightError, match=r"cannot send to 127\.0\.0\.1:0: Invalid argument"):
        send_datagram(link, b"", REFUSED_BY_THE_NETWORK)
    link.close()
    with pytest.raises(FlightError, match="cannot receive: Bad file descriptor"):
        receive_datagram(link)
