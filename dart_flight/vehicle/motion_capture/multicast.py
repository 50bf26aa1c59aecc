"""Reception of multicast on this computer's network interfaces."""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import socket
import struct
from typing import Final

from dart_flight.config.document import InputError
from dart_flight.vehicle.motion_capture.source import PoseAddress, in_quotes

_ANY: Final = "0.0.0.0"
_SIOCGIFADDR: Final = 0x8915  # ioctl: address of an interface
_REQUEST: Final = struct.Struct("16sHH4s16x")  # struct ifreq: name, family, port, IPv4 address
_MEMBER: Final = struct.Struct("4s4si")  # struct ip_mreqn: group, address of the interface, its index


def is_group(host: str) -> bool:
    """Return whether a host is an IPv4 multicast address."""
    try:
        return ipaddress.IPv4Address(host).is_multicast
    except ValueError:
        return False


def _cards() -> dict[str, str]:
    """Return name -> IPv4 address of this computer's network interfaces; an address may be missing ("")."""
    found = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            found[name] = ""
            with contextlib.suppress(OSError):
                request = _REQUEST.pack(name.encode(), socket.AF_INET, 0, bytes(4))
                answer = fcntl.ioctl(probe, _SIOCGIFADDR, request)
                found[name] = socket.inet_ntoa(_REQUEST.unpack(answer)[3])
    return found


def card_address(address: PoseAddress) -> str | None:
    """Return the IPv4 address of the interface that the URL names, or None if it names none.

    Raise InputError if this computer has no such interface, or the interface has no IPv4 address.
    """
    wanted = address.interface
    if wanted is None:
        return None
    cards = _cards()
    if cards.get(wanted):
        return cards[wanted]
    with (
        contextlib.suppress(OSError, ValueError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.bind((str(ipaddress.IPv4Address(wanted)), 0))  # also accepts an interface's second address
        return wanted
    known = in_quotes(f"{name} {own}".strip() for name, own in cards.items())
    raise InputError(
        f'mocap URL {address.url}: no network interface "{wanted}" with an IPv4 address, only {known}'
    )


def join_group(link: socket.socket, group: str, card: str | None) -> str:
    """Join a multicast group on the interface with address `card`; return the address.

    If `card` is None, join on every interface and return all names; the kernel would join on one. Raise
    OSError if no interface accepts the group.
    """
    if card is not None:
        _join(link, group, card, 0)
        return card
    joined, refused = [], OSError("this computer has no network interface")
    for index, name in socket.if_nameindex():
        try:
            _join(link, group, _ANY, index)
            joined.append(name)
        except OSError as error:
            refused = error
    if not joined:
        raise refused
    return ", ".join(joined)


def _join(link: socket.socket, group: str, card: str, index: int) -> None:
    member = _MEMBER.pack(socket.inet_aton(group), socket.inet_aton(card), index)
    link.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
