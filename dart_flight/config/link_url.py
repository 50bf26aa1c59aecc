"""Checks of connection URLs before a link is opened; their one-line errors list the allowed forms."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from typing import NamedTuple

import msgspec

from dart_flight.config.document import InputError

FORMS = (
    "serial:///dev/ttyAMA0:921600, udpin://0.0.0.0:14540 (listens), udpout://192.168.1.2:14540, "
    "tcpout://192.168.1.2:5760, tcpin://0.0.0.0:5760"
)
# Names in /dev/serial/by-path contain colons, so the baud rate follows the last colon.
_SERIAL = re.compile(r"serial(?:_flowcontrol)?://(?P<device>/\S+):(?P<baud>\d+)")
# MAVSDK's older schemes udp:// and tcp:// may omit the host.
_NETWORK = re.compile(
    r"(?P<kind>udp|tcp|(?:udp|tcp)(?:in|out)(?!://:))://(?P<host>\[[\da-fA-F:.]+\]|[\w.-]*):(?P<port>\d+)"
)
_MAX_SHOWN = 4


class LinkAddress(NamedTuple):
    """The parts of a connection URL."""

    kind: str  # scheme
    place: str  # host, or path of the serial device
    number: int  # port, or baud rate


def parse_link(url: str) -> LinkAddress | None:
    """Return the parts of a connection URL, or None if it is invalid."""
    serial, network = _SERIAL.fullmatch(url), _NETWORK.fullmatch(url)
    if serial is not None:
        return LinkAddress("serial", serial["device"], int(serial["baud"]))
    return None if network is None else LinkAddress(network["kind"], network["host"], int(network["port"]))


class LinkEndpoint(msgspec.Struct, frozen=True):
    """The resource that a URL uses. Only one program at a time may use a resource, identified by its `key`.

    Attributes:
        key: part of the names of the files that reserve the link, or a servo on the link.
        udp_port: UDP port that this program binds, or None.
        host: local address of `udp_port`.
        device: path of the serial device, or None.
    """

    key: str
    udp_port: int | None = None
    host: str = ""
    device: Path | None = None


def endpoint_of(url: str) -> LinkEndpoint:
    """Return the resource that a MAVSDK connection URL uses.

    An invalid URL gets a key too; MAVSDK refuses the URL later.
    """
    link = parse_link(url)
    if link is not None and link.kind == "serial":
        return LinkEndpoint(f"serial-{device_key(link.place)}", device=Path(os.path.realpath(link.place)))
    if link is None:
        key, udp_port = "url-" + re.sub(r"[^A-Za-z0-9.]+", "-", url)[:80], None
    else:
        kind, host, port = link
        bound = kind == "udpin" or (kind == "udp" and host in ("", "0.0.0.0", "127.0.0.1", "localhost"))
        udp_port = port if bound else None
        key = f"udp-{port}" if bound else f"{kind[:3]}-{'in' if kind.endswith('in') else 'out'}-{host}-{port}"
    host = "" if udp_port is None or link is None else link.place
    return LinkEndpoint(f"{key}@{_network()}", udp_port=udp_port, host=host)


def mavsdk_url(url: str) -> str:
    """Return an equivalent URL whose device name has no colon; MAVSDK ends the name at the first colon."""
    link = parse_link(url)
    if link is None or link.kind != "serial" or ":" not in link.place:
        return url
    return f"{url.partition(':')[0]}://{os.path.realpath(link.place)}:{link.number}"


def device_key(path: str | Path) -> str:
    """Return the key of a device; all symbolic links to it, such as /dev/serial0, give the same key."""
    return os.path.realpath(path).strip("/").replace("/", "-")


def _network() -> str:
    """Return the number of the network namespace; containers may share a folder but not their ports."""
    with contextlib.suppress(OSError):
        return str(os.stat("/proc/self/ns/net").st_ino)
    return ""


def link_problem(url: str) -> str | None:
    """Return the error in a URL's form and the allowed forms, or None if the form is valid."""
    link = parse_link(url)
    if link is None:
        return f"{url!r} is not a connection URL, expected: {FORMS}"
    if link.kind == "serial":
        return None if link.number > 0 else "the baud rate must be above 0, such as 921600"
    return None if 0 < link.number < 65536 else f"the port must be from 1 to 65535, not {link.number}"


def usable_link(url: str, key: str = "--connection") -> str:
    """Check the form of a URL and that its serial port exists, without opening it; return it unchanged."""
    problem = link_problem(url)
    if problem is not None:
        raise InputError(problem, key=(key,))
    link = parse_link(url)
    if link is not None and link.kind == "serial" and not Path(link.place).exists():
        there = [str(p) for pattern in ("ttyA*", "ttyU*") for p in sorted(Path("/dev").glob(pattern))]
        known = ", ".join(there[:_MAX_SHOWN]) or "none"
        raise InputError(
            f"the serial port {link.place} does not exist (found: {known}); expected: {FORMS}", key=(key,)
        )
    return url
