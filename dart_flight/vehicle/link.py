"""Which program has a link: one vehicle, one program.

MAVSDK opens UDP ports so that others can open them, too, and a serial device without asking anybody: a second
program takes half of the datagrams or bytes away, and the flight with them. So every command of this software
that talks to a vehicle takes a `LinkLease` first. It is an advisory lock in the state folder, one file per
link, that the kernel gives back when its process ends; the file says who has it, and where the flight's log
is, for `monitor`. Other people's programs are found by what they have open.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import socket
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from dart_flight.base.text import printable
from dart_flight.config.document import InputError
from dart_flight.config.link_url import parse_link
from dart_flight.config.state_folder import HeldError, HeldFile, Lease, content_of_held, lock_file, state_dir

_PAUSE_S = 0.02
_STARTING_S = 2.0
_FREE_LINK_ATTEMPTS = 20


class LinkTakenError(InputError):
    """Another program has the link."""


class Holder(msgspec.Struct, frozen=True):
    """Who has a link.

    Attributes:
        pid: of the process.
        command: of this software, such as `fly`.
        url: as the operator wrote it.
        log: the flight's log, absolute; None: there is none, or not yet.
    """

    pid: int
    command: str
    url: str
    log: str | None = None

    def describe(self) -> str:
        """Such as "fly, process 1234"."""
        return f"{self.command}, process {self.pid}"


class LinkEndpoint(msgspec.Struct, frozen=True):
    """Where a URL leads, as far as sharing goes: two URLs with one `key` cannot be used at once.

    Attributes:
        key: part of a file name.
        udp_port: that this side binds; None: none.
        device: serial device; None: none.
    """

    key: str
    udp_port: int | None = None
    host: str = ""
    device: Path | None = None


def endpoint_of(url: str) -> LinkEndpoint:
    """Where a MAVSDK connection URL leads; what is no such URL gets a key all the same, MAVSDK refuses it."""
    link = parse_link(url)
    if link is None:
        return LinkEndpoint("url-" + re.sub(r"[^A-Za-z0-9.]+", "-", url)[:80])
    if link.kind == "serial":
        # /dev/serial0, /dev/ttyAMA0 and /dev/serial/by-id/... may be one device.
        device = Path(os.path.realpath(link.place))
        return LinkEndpoint("serial-" + str(device).strip("/").replace("/", "-"), device=device)
    kind, host, port = link
    if kind == "udpin" or (kind == "udp" and host in ("", "0.0.0.0", "127.0.0.1", "localhost")):
        return LinkEndpoint(f"udp-{port}", udp_port=port, host=host)
    return LinkEndpoint(f"{kind[:3]}-{'in' if kind.endswith('in') else 'out'}-{host}-{port}")


def feed_of(port: int) -> str:
    """What a simulated vehicle leases: the sending to a UDP port. A program that receives leases its URL."""
    return f"feed:{port}"


def link_folder() -> Path:
    """Where the leases are."""
    return state_dir() / "links"


class LinkLease(Lease):
    """The right to use one link, for as long as the process lives or until it is released.

    Args:
        url: MAVSDK connection URL.
        command: of this software that wants it.
        log: the flight's log.

    Raises:
        LinkTakenError: on entering, when another program has it; names it.
        InputError: on entering, when the state folder cannot be used.
    """

    def __init__(self, url: str, command: str, log: Path | None = None) -> None:
        self._url = url
        self._place = endpoint_of(url)
        self._file = HeldFile(_file_of(url))
        self._holder = Holder(os.getpid(), command, printable(url), None if log is None else _name_of(log))
        self._device: int | None = None

    def acquire(self) -> None:
        """Take the link."""
        try:
            self._file.acquire(self._says())
        except HeldError as error:
            holder = _decoded(error.content)
            words = holder.describe() if holder is not None else "another dart-flight"
            raise LinkTakenError(f"in use by {words}", source=self._url) from None
        try:
            self._look_for_others()
            if self._place.device is not None:
                self._lock_device(self._place.device)
        except InputError:
            self.release()
            raise

    def note_log(self, log: Path) -> None:
        """Say where the flight's log is, for `monitor`."""
        self._holder = msgspec.structs.replace(self._holder, log=_name_of(log))
        self._file.write(self._says())

    def close_device(self) -> None:
        """Once MAVSDK has opened a serial device: nobody else may open it, but root, and its reads wait.

        MAVSDK 4 sets VMIN 0, with which a read of nothing is no "not yet" but an end: its thread asks again
        at once and takes a whole core. The setting is the device's, not the opener's.
        """
        if self._device is not None:
            with contextlib.suppress(OSError, termios.error):
                fcntl.ioctl(self._device, termios.TIOCEXCL)
                settings = termios.tcgetattr(self._device)
                settings[6][termios.VMIN] = 1
                termios.tcsetattr(self._device, termios.TCSANOW, settings)

    def release(self) -> None:
        """Give the link back; harmless when it is not held."""
        if self._device is not None:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._device, termios.TIOCNXCL)
            os.close(self._device)
            self._device = None
        self._file.release()

    def _says(self) -> bytes:
        return msgspec.json.encode(self._holder)

    def _look_for_others(self) -> None:
        port = self._place.udp_port
        if port is None:
            return
        # A `simulate` that is just starting listens there for a moment, for other senders.
        end = time.monotonic() + (_STARTING_S if holder_of(feed_of(port)) is not None else 0.0)
        while not udp_port_is_free(port, self._place.host) and time.monotonic() < end:
            time.sleep(_PAUSE_S)
        if not udp_port_is_free(port, self._place.host):
            raise LinkTakenError(f"UDP port {port} is in use by {owner_of_udp_port(port)}", source=self._url)

    def _lock_device(self, device: Path) -> None:
        try:
            self._device = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            raise InputError("there is no such serial device", source=self._url) from None
        except OSError as error:
            if error.errno == errno.EBUSY:
                owners = _owners_of_device(device)
                raise LinkTakenError(f"{device} is in use by {owners}", source=self._url) from None
            raise InputError(f"cannot open {device}: {error.strerror}", source=self._url) from None
        others = _owners_of_device(device, besides=os.getpid())
        free = lock_file(self._device, device, "connect through another device")
        if not free or others != _SOMEBODY:
            raise LinkTakenError(f"{device} is in use by {others}", source=self._url)


def free_link(command: str, log: Path | None = None) -> tuple[int, LinkLease]:
    """A UDP port of the loopback that nothing uses, and its lease, held.

    Raises:
        LinkTakenError: all ports that were tried are in use by other programs.
        InputError: the state folder cannot be used.
    """
    attempts = _FREE_LINK_ATTEMPTS
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        lease = LinkLease(f"udpin://127.0.0.1:{port}", command, log)
        try:
            lease.acquire()
            return port, lease
        except LinkTakenError:  # another program has opened or leased the port meanwhile
            attempts -= 1
            if not attempts:
                raise


def holder_of(url: str) -> Holder | None:
    """Which program of this software has a link now; None: none."""
    return _holder_in(_file_of(url))


def held_links() -> Iterator[Holder]:
    """The programs of this software that have a link now."""
    for path in sorted(link_folder().glob(f"*{_network()}.json")):
        holder = _holder_in(path)
        if holder is not None:
            yield holder


def _file_of(url: str) -> Path:
    return link_folder() / f"{endpoint_of(url).key}{_network()}.json"


def _holder_in(path: Path) -> Holder | None:
    content = content_of_held(path)
    return None if content is None else _decoded(content)


def _name_of(log: Path) -> str:
    return printable(str(log.resolve()))


def _decoded(content: bytes) -> Holder | None:
    with contextlib.suppress(msgspec.DecodeError):
        return msgspec.json.decode(content, type=Holder)
    return None


def _network() -> str:
    """Ports are those of one network namespace: containers that share a home do not share them."""
    with contextlib.suppress(OSError):
        return f"@{os.stat('/proc/self/ns/net').st_ino}"
    return "@"


# --- ports and devices -------------------------------------------------------------------------------

_SOMEBODY = "another program"


def udp_port_is_free(port: int, host: str = "") -> bool:
    """Return whether nothing is bound to a UDP port; a bind that shares it, as MAVSDK's, counts as bound.

    Raises:
        InputError: the port cannot be bound for another reason, such as an address of another computer.
    """
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host.strip("[]") if host and host != "localhost" else "0.0.0.0", port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return False
        place = f"{host}:{port}" if host else str(port)
        raise InputError(f"UDP port {place} cannot be opened: {error.strerror}") from None
    return True


def owner_of_udp_port(port: int) -> str:
    """The program that has a UDP port, as far as this user may see it."""
    wanted = f":{port:04X}"
    inodes = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with contextlib.suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[1].endswith(wanted):
                    inodes.add(f"socket:[{fields[9]}]")
    return _owners(inodes)


def _owners_of_device(device: Path, besides: int | None = None) -> str:
    return _owners({str(device)}, besides)


def _owners(targets: set[str], besides: int | None = None) -> str:
    """Which processes have one of these open, in words."""
    found = []
    for process in Path("/proc").iterdir():
        if not process.name.isdigit() or int(process.name) == besides:
            continue
        with contextlib.suppress(OSError):
            if any(os.readlink(entry) in targets for entry in (process / "fd").iterdir()):
                found.append(f"{(process / 'comm').read_text().strip()}, process {process.name}")
    return " and ".join(sorted(found)) or _SOMEBODY
