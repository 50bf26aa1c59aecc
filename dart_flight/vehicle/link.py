"""Leases of links. A lease ensures that only one program uses a vehicle.

MAVSDK opens UDP ports and serial devices without excluding other programs. A second program would receive
half of the datagrams or bytes, and the flight would fail. Every command that talks to a vehicle therefore
acquires a `LinkLease` first. Each link has one file in the state folder, and a lease is an advisory lock on
this file. The kernel releases the lock when the process ends. The file names the holder and the flight's log,
for `monitor`. Programs that do not use leases are detected by their open ports and devices.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from dart_flight.base.text import printable
from dart_flight.config.document import InputError
from dart_flight.config.held_files import HeldError, HeldFile, Lease, lock_file, read_held
from dart_flight.config.link_url import endpoint_of
from dart_flight.config.state_folder import ensure_folder, state_dir

_PAUSE_S = 0.02
_STARTING_S = 2.0
_FREE_LINK_ATTEMPTS = 20


class LinkInUseError(InputError):
    """Another program has the link."""


class Holder(msgspec.Struct, frozen=True):
    """The process that holds a link.

    Attributes:
        command: command of this software, such as `fly`.
        url: URL as the operator wrote it.
        log: absolute path of the flight's log, or None if there is none yet.
    """

    pid: int
    command: str
    url: str
    log: str | None = None

    def describe(self) -> str:
        """Return text such as "fly, process 1234"."""
        return f"{self.command}, process {self.pid}"


def feed_name(port: int) -> str:
    """Return the name of the lease that a simulated vehicle acquires before it sends to a UDP port.

    A program that receives on the port acquires the lease of the port's URL instead, so both can use the
    port.
    """
    return f"feed:{port}"


def link_folder() -> Path:
    return state_dir() / "links"


class LinkLease(Lease):
    """The exclusive right to use one link, until `release` or the end of the process.

    Entering the context raises the same errors as `acquire`.
    """

    def __init__(self, url: str, command: str, log: Path | None = None) -> None:
        self._url = url
        self._endpoint = endpoint_of(url)
        self._file = HeldFile(_file_of(url))
        self._holder = Holder(os.getpid(), command, printable(url), None if log is None else _path_text(log))
        self._device: int | None = None

    def acquire(self) -> None:
        """Acquire the link.

        Raises:
            LinkInUseError: another program has the link; the message names that program.
            InputError: the state folder or the serial device cannot be used.
        """
        ensure_folder(link_folder())
        try:
            self._file.acquire(self._content())
        except HeldError as error:
            holder = _decoded(error.content)
            words = holder.describe() if holder is not None else "another dart-flight"
            raise LinkInUseError(f"in use by {words}", source=self._url) from None
        try:
            self._check_port()
            if self._endpoint.device is not None:
                self._lock_device(self._endpoint.device)
        except InputError:
            self.release()
            raise

    def store_log_path(self, log: Path) -> None:
        """Store the path of the flight's log in the lease, for `monitor`."""
        self._holder = msgspec.structs.replace(self._holder, log=_path_text(log))
        self._file.write(self._content())

    def lock_device(self) -> None:
        """Lock the serial device exclusively and make reads from the device blocking.

        Call this method after MAVSDK has opened the device. MAVSDK 4 sets VMIN to 0, so its reads return
        immediately even without data and occupy a whole core. VMIN is a setting of the device, so this method
        can change it. Root can still open a locked device.
        """
        if self._device is not None:
            with contextlib.suppress(OSError, termios.error):
                fcntl.ioctl(self._device, termios.TIOCEXCL)
                settings = termios.tcgetattr(self._device)
                settings[6][termios.VMIN] = 1
                termios.tcsetattr(self._device, termios.TCSANOW, settings)

    def release(self) -> None:
        """Release the link; do nothing if it is not held."""
        if self._device is not None:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._device, termios.TIOCNXCL)
            os.close(self._device)
            self._device = None
        self._file.release()

    def _content(self) -> bytes:
        return msgspec.json.encode(self._holder)

    def _check_port(self) -> None:
        port = self._endpoint.udp_port
        if port is None:
            return
        # When `simulate` starts, it listens on the port briefly to detect other senders.
        end = time.monotonic() + (_STARTING_S if find_holder(feed_name(port)) is not None else 0.0)
        while not udp_port_is_free(port, self._endpoint.host) and time.monotonic() < end:
            time.sleep(_PAUSE_S)
        if not udp_port_is_free(port, self._endpoint.host):
            raise LinkInUseError(f"UDP port {port} is in use by {owner_of_udp_port(port)}", source=self._url)

    def _lock_device(self, device: Path) -> None:
        try:
            self._device = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            raise InputError("this serial device does not exist", source=self._url) from None
        except OSError as error:
            if error.errno == errno.EBUSY:
                owners = _owners_of_device(device)
                raise LinkInUseError(f"{device} is in use by {owners}", source=self._url) from None
            raise InputError(f"cannot open {device}: {error.strerror}", source=self._url) from None
        others = _owners_of_device(device, besides=os.getpid())
        free = lock_file(self._device, device, "connect through another device")
        if not free or others != _UNKNOWN_OWNER:
            raise LinkInUseError(f"{device} is in use by {others}", source=self._url)


def acquire_free_link(command: str, log: Path | None = None) -> tuple[int, LinkLease]:
    """Return an unused UDP port on the loopback interface and its acquired lease.

    Raise LinkInUseError if other programs use all tried ports.
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
        except LinkInUseError:  # another program has since opened or leased the port
            attempts -= 1
            if not attempts:
                raise


def find_holder(url: str) -> Holder | None:
    return _holder_in(_file_of(url))


def held_links() -> Iterator[Holder]:
    """Yield the processes of this software that hold a device, or a link in this network namespace."""
    for path in sorted(link_folder().glob("*.json")):
        holder = _holder_in(path)
        if holder is not None and _file_of(holder.url) == path:
            yield holder


def _file_of(url: str) -> Path:
    return link_folder() / f"{endpoint_of(url).key}.json"


def _holder_in(path: Path) -> Holder | None:
    content = read_held(path)
    return None if content is None else _decoded(content)


def _path_text(log: Path) -> str:
    return printable(str(log.resolve()))


def _decoded(content: bytes) -> Holder | None:
    with contextlib.suppress(ValueError):
        return msgspec.json.decode(content, type=Holder)
    return None


# --- ports and devices -------------------------------------------------------------------------------

_UNKNOWN_OWNER = "another program"


def udp_port_is_free(port: int, host: str = "") -> bool:
    """Return whether a UDP port is free. A port with a shared socket, such as MAVSDK's, is not free.

    Raise InputError if the port cannot be bound for another reason, for example because `host` is not local.
    """
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host.strip("[]") if host and host != "localhost" else "0.0.0.0", port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return False
        place = f"{host}:{port}" if host else str(port)
        raise InputError(f"cannot open UDP port {place}: {error.strerror}") from None
    return True


def owner_of_udp_port(port: int) -> str:
    """Name the programs that have a UDP port open, if this user may list their open files."""
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
    """Name all processes that have a file or socket in `targets` open; omit the process id `besides`."""
    found = []
    for process in Path("/proc").iterdir():
        if not process.name.isdigit() or int(process.name) == besides:
            continue
        with contextlib.suppress(OSError):
            if any(os.readlink(entry) in targets for entry in (process / "fd").iterdir()):
                found.append(f"{(process / 'comm').read_text().strip()}, process {process.name}")
    return " and ".join(sorted(found)) or _UNKNOWN_OWNER
