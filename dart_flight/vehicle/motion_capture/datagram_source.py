"""A pose source that receives datagrams; the JSON and Vicon sources add their decoders."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter
from collections.abc import Callable
from typing import Final

from dart_flight.config.document import InputError
from dart_flight.vehicle.motion_capture.multicast import card_address, is_group, join_group
from dart_flight.vehicle.motion_capture.source import PoseAddress, RawPose

_MAX_DATAGRAM: Final = 65535
_POLL_S: Final = 0.2  # maximum time until the thread detects `stop`
_MAX_REASONS: Final = 32  # maximum number of distinct reasons, so that a hostile sender cannot exhaust memory

Decoder = Callable[[bytes, str, str], RawPose | str]


class DatagramSource:
    """A source that decodes each datagram received at an address.

    If the address is a multicast address, the source joins the group on the network interface that the URL
    names. If the URL names no interface, the source joins on every interface. The constructor raises
    InputError if the address cannot be bound, or the URL names a wrong interface.

    Args:
        decode: receives datagram, body and sender; returns the pose, or the reason why the datagram contains
            no pose of the body.

    Attributes:
        ignored: number of ignored datagrams by reason.
        problem: the reason why the newest datagram contains no pose of the body.
    """

    remedy = "check the sender's address and port, the cable, the network interface and the firewall"

    def __init__(self, address: PoseAddress, decode: Decoder) -> None:
        self._address, self._decode = address, decode
        self.ignored: Counter[str] = Counter()
        self.problem: str | None = None
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        host, port = address.host, address.port
        card, group = card_address(address), is_group(host)
        if card is not None and not group:
            raise InputError(
                f"mocap URL {address.url}: {host} is not a multicast group: remove ?interface=, and give an "
                "address of this computer, or 0.0.0.0 for all"
            )
        self.place = f"listening on {host}:{port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if group:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                self.place += f" on {join_group(self._socket, host, card)}"
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            reason = error.strerror or str(error)
            how = (
                "connect a network interface that accepts multicast"
                if group
                else "give an address of this computer, 0.0.0.0 for all, or a multicast group"
            )
            raise InputError(
                f"mocap URL {address.url}: cannot listen on {host}:{port}: {reason}; {how}"
            ) from None

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        """Deliver every subsequent pose from the source's own thread; discard earlier datagrams."""
        self._socket.settimeout(0.0)
        with contextlib.suppress(OSError):
            while True:
                self._socket.recv(_MAX_DATAGRAM)
        self._socket.settimeout(_POLL_S)
        self._thread = threading.Thread(target=self._run, args=(deliver,), name="mocap", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
        self._socket.close()

    def _run(self, deliver: Callable[[RawPose], None]) -> None:
        while not self._stopped.is_set():
            try:
                data, sender = self._socket.recvfrom(_MAX_DATAGRAM)
            except TimeoutError:
                continue
            except OSError as error:
                self.problem = f"cannot receive: {error.strerror or error}"
                self._stopped.wait(_POLL_S)
                continue
            pose = self._decode(data, self._address.body, f"{sender[0]}:{sender[1]}")
            if isinstance(pose, str):
                self._ignore(pose)
            else:
                self.problem = None
                deliver(pose)

    def _ignore(self, reason: str) -> None:
        if reason not in self.ignored and len(self.ignored) >= _MAX_REASONS:
            reason = "for other reasons"
        self.ignored[reason] += 1
        self.problem = f"{self.ignored[reason]} datagrams ignored: {reason}"
