"""A scripted peer: the other end of a link in a test, on a thread of its own.

A peer has a link (UDP, TCP or a pseudo-terminal), a protocol, a table of answers by the kind of message,
messages that it sends periodically, and a record of what it received. The peers of this package are its
subclasses; a test of one message uses `ScriptedPeer` itself.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.thread_context import ThreadContext
from tests.real_time import TooSlow

Address = tuple[str, int]
Answer = Callable[[Any], Iterable[Any] | None]  # the replies to a message, if any
_HOST, _CHUNK, _TURN_S = "127.0.0.1", 65536, 0.02
_T = TypeVar("_T")


class PeerLink(Protocol):
    """The bytes of a peer."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when data arrives."""

    def receive(self) -> bytes | None:
        """Return the data that has arrived, or None if the other end has closed the link."""

    def send(self, data: bytes) -> None:
        """Send data."""

    def close(self) -> None:
        """Close the link."""


class UdpLink:
    """A UDP socket on loopback, which sends to `to`: a fixed address, or the latest sender's."""

    def __init__(self, port: int = 0, to: Address | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((_HOST, port))
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(_HOST))
        self.port, self.to = int(self.socket.getsockname()[1]), to

    def fileno(self) -> int:
        return self.socket.fileno()

    def receive(self) -> bytes:
        with contextlib.suppress(ConnectionError):  # the other end has closed its port
            data, self.to = self.socket.recvfrom(_CHUNK)
            return data
        return b""

    def send(self, data: bytes) -> None:
        if self.to is not None:
            with contextlib.suppress(OSError):
                self.socket.sendto(data, self.to)

    def close(self) -> None:
        self.socket.close()


class TcpLink:
    """A TCP connection, given or made to a port on loopback."""

    def __init__(self, connection: socket.socket | int) -> None:
        if isinstance(connection, int):
            connection = socket.create_connection((_HOST, connection))
        self.socket = connection

    def fileno(self) -> int:
        return self.socket.fileno()

    def receive(self) -> bytes | None:
        with contextlib.suppress(ConnectionError):
            return self.socket.recv(_CHUNK) or None
        return None

    def send(self, data: bytes) -> None:
        with contextlib.suppress(ConnectionError):
            self.socket.sendall(data)

    def close(self) -> None:
        self.socket.close()


class PtyLink:
    """The far end of a serial device, whose path is `device`; no program has the device open at first."""

    def __init__(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.device = os.ttyname(slave)
        self._slave = slave  # held open: without a program the far end would read errors

    def fileno(self) -> int:
        return self._master

    def receive(self) -> bytes:
        return os.read(self._master, _CHUNK)

    def send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    def close(self) -> None:
        os.close(self._slave)
        os.close(self._master)


class PeerProtocol(Protocol):
    """The messages in the bytes of a link."""

    def decode(self, data: bytes) -> Iterable[Any]:
        """Return the messages that `data` completes."""

    def encode(self, message: Any) -> bytes:
        """Return a message as bytes."""

    def kind(self, message: Any) -> Any:
        """Return the key of a message in the table of answers."""


class Mavlink:
    """MAVLink as one component of one system; noise is skipped."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True

    def decode(self, data: bytes) -> Iterable[Any]:
        return self._parser.parse_buffer(data) or []

    def encode(self, message: Any) -> bytes:
        return bytes(message.pack(self.sender))

    def kind(self, message: Any) -> str:
        return str(message.get_type())


class NatNet:
    """NatNet packets: a message is a pair of its number and its payload."""

    def decode(self, data: bytes) -> Iterable[tuple[int, bytes]]:
        return [(struct.unpack_from("<H", data)[0], data[4:])]

    def encode(self, message: tuple[int, bytes]) -> bytes:
        kind, payload = message
        return struct.pack("<HH", kind, len(payload)) + payload

    def kind(self, message: tuple[int, bytes]) -> int:
        return message[0]


class PlainBytes:
    """Bytes that are sent and received as they are."""

    def decode(self, data: bytes) -> Iterable[bytes]:
        return [data] if data else []

    def encode(self, message: bytes) -> bytes:
        return message

    def kind(self, message: bytes) -> None:
        return None


class ScriptedPeer(ThreadContext):
    """`with ScriptedPeer(UdpLink(), Mavlink(), {"HIL_SENSOR": answer}) as peer: ...`.

    Args:
        link: the peer's end of the link; the context closes it.
        protocol: the messages on the link.
        answers: functions that return the replies to a message, by its kind; a test may change the table.
        every: periods in seconds, and functions that return the messages to send then.

    Attributes:
        RECORDED: kinds of messages that are recorded; None: all.
        received: the recorded messages, in order of arrival.
        ended: set when the other end has closed the link.
    """

    RECORDED: frozenset[Any] | None = None

    def __init__(
        self,
        link: PeerLink,
        protocol: PeerProtocol,
        answers: Mapping[Any, Answer] | None = None,
        every: Sequence[tuple[float, Callable[[], Iterable[Any]]]] = (),
    ) -> None:
        super().__init__()
        self._link, self.protocol = link, protocol
        self.answers = dict(answers or {})
        self._every = [(period_s, make) for period_s, make in every]
        self.received: list[Any] = []
        self.ended = threading.Event()
        self.news = threading.Condition()
        self._sending = threading.Lock()

    def send(self, *messages: Any) -> None:
        """Send messages now."""
        with self._sending:
            for message in messages:
                self._link.send(self.protocol.encode(message))

    def send_bytes(self, data: bytes) -> None:
        """Send bytes that may be no message."""
        with self._sending:
            self._link.send(data)

    def received_of(self, kind: Any) -> list[Any]:
        """Return the received messages of a kind."""
        return [message for message in list(self.received) if self.protocol.kind(message) == kind]

    def wait_for(self, condition: Callable[[], _T], seconds: float, what: str) -> _T:
        """Return the first true value of a condition, which is asked after every received message.

        Raises:
            TooSlow: no value was true within `seconds`.
        """
        with self.news:
            value = self.news.wait_for(condition, seconds)
        if not value:
            raise TooSlow(f"{what}: not within {seconds:g} s")
        return value

    def update(self, message: Any) -> None:
        """Handle a received message, in a subclass."""

    def _run(self) -> None:
        due = {i: time.monotonic() for i in range(len(self._every))}
        while not self._stop.is_set():
            for i, (period_s, make) in enumerate(self._every):
                if time.monotonic() >= due[i]:
                    due[i] = time.monotonic() + period_s
                    self.send(*make())
            if not select.select([self._link], [], [], _TURN_S)[0]:
                continue
            data = self._link.receive()
            if data is None:
                self.ended.set()
                return
            for message in self.protocol.decode(data):
                kind = self.protocol.kind(message)
                if self.RECORDED is None or kind in self.RECORDED:
                    self.received.append(message)  # before the answer, after which a test may look
                self.send(*(self.answers.get(kind, _no_answer)(message) or ()))
                with self.news:
                    self.update(message)
                    self.news.notify_all()

    def _close(self) -> None:
        self._link.close()


def _no_answer(message: Any) -> None:
    """Return no reply."""
