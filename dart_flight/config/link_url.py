"""Connection URLs: validation before anything is opened, with one-line errors that list the allowed forms."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from dart_flight.config.document import InputError

FORMS = (
    "serial:///dev/ttyAMA0:921600, udpin://0.0.0.0:14540 (listens), udpout://192.168.1.2:14540, "
    "tcpout://192.168.1.2:5760, tcpin://0.0.0.0:5760"
)
_SERIAL = re.compile(r"serial(?:_flowcontrol)?://(?P<device>/[^:\s]+):(?P<baud>\d+)")
# MAVSDK's older schemes udp:// and tcp:// may omit the host.
_NETWORK = re.compile(
    r"(?P<kind>udp|tcp|(?:udp|tcp)(?:in|out)(?!://:))://(?P<host>\[[\da-fA-F:.]+\]|[\w.-]*):(?P<port>\d+)"
)
_MAX_SHOWN = 4


class LinkAddress(NamedTuple):
    """The parts of a connection URL."""

    kind: str  # scheme
    place: str  # host, or the serial device
    number: int  # port, or baud rate


def parse_link(url: str) -> LinkAddress | None:
    """Return the parts of a connection URL, or None if it is invalid."""
    serial, network = _SERIAL.fullmatch(url), _NETWORK.fullmatch(url)
    if serial is not None:
        return LinkAddress("serial", serial["device"], int(serial["baud"]))
    return None if network is None else LinkAddress(network["kind"], network["host"], int(network["port"]))


def link_problem(url: str) -> str | None:
    """Return a text with the error in a URL's form and the allowed forms, or None if the form is valid."""
    link = parse_link(url)
    if link is None:
        return f"{url!r} is not a connection URL, expected: {FORMS}"
    if link.kind == "serial":
        return None if link.number > 0 else "the baud rate must be above 0, such as 921600"
    return None if 0 < link.number < 65536 else f"the port must be from 1 to 65535, not {link.number}"


def usable_link(url: str, key: str = "--connection") -> str:
    """Check a URL without opening it, and return it unchanged.

    Raises:
        InputError: the URL has the wrong form, or the serial port does not exist.
    """
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
