"""The interface of a pose source, the check of its poses, and the parser of a pose source's URL.

A source reads one body from one motion-capture system and delivers each pose as a `RawPose`, on its own
thread. The source does not check the numbers; the bridge calls `checked_pose` for every pose. Each system has
one module in this package, and only that module imports the vendor's client.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple, Protocol
from urllib.parse import parse_qs, unquote, urlsplit

from dart_flight.base.geometry import IDENTITY, Quaternion, Vec3, quaternion_normalise
from dart_flight.base.text import alternatives
from dart_flight.config.document import InputError
from dart_flight.config.packages import missing_package

_MAX_M: Final = 1000.0  # maximum coordinate; a larger value means that the sender's unit is not the metre
_MAX_US: Final = 2**62  # maximum stamp; a larger stamp minus a clock's time may exceed 64 bits
_MAX_NAMES: Final = 5  # maximum number of names listed in a message


class AbsentSourceError(InputError):
    """A motion-capture server does not answer or does not stream the body; a later attempt may succeed."""


class RawPose(NamedTuple):
    """A pose of a marker body from a motion-capture system, in metres and the room's axes."""

    body: str
    tracked: bool
    position_room: Vec3
    q_body_to_room: Quaternion
    frame_number: int | None
    source_us: int | None  # the source's stamp, on its own clock
    sender: str  # address of the sender


def lost_pose(body: str, frame_number: int | None, source_us: int | None, sender: str) -> RawPose:
    """Return the pose of a body that the source does not currently track."""
    return RawPose(body, False, (0.0, 0.0, 0.0), IDENTITY, frame_number, source_us, sender)


def checked_pose(pose: RawPose) -> tuple[RawPose, str | None]:
    """Return the pose with a normalised attitude, and None as the reason.

    If the numbers are not a pose in metres, return a lost pose and the reason instead. A stamp that is not a
    time is removed.
    """
    if pose.source_us is not None and abs(pose.source_us) > _MAX_US:
        pose = pose._replace(source_us=None)
    if not pose.tracked:
        return pose, None
    lost = lost_pose(pose.body, pose.frame_number, pose.source_us, pose.sender)
    if not all(abs(coordinate) <= _MAX_M for coordinate in pose.position_room):
        return lost, f"the body's coordinates exceed {_MAX_M:g} m or are NaN: check the sender's unit"
    if not 0.9 < math.hypot(*pose.q_body_to_room) < 1.1:
        return lost, "the body's quaternion is not of length 1"
    return pose._replace(q_body_to_room=quaternion_normalise(pose.q_body_to_room)), None


def in_quotes(names: Iterable[str]) -> str:
    """Return names as text; the quotes make a space at the end of a name visible."""
    return ", ".join(f'"{name}"' for name in sorted(names)[:_MAX_NAMES]) or "none"


class PoseSource(Protocol):
    """A source of poses, as returned by `open_source`.

    Attributes:
        place: address on which the source listens, or the server that it reads.
        remedy: advice for the operator if nothing arrives.
    """

    place: str
    remedy: str

    @property
    def problem(self) -> str | None:
        """One line with the reason why no poses of the body arrive, or None while poses arrive."""

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        """Deliver every subsequent pose from the source's own thread."""

    def stop(self) -> None:
        """Stop delivering and close the connection; may be called again."""


class PoseAddress(NamedTuple):
    """The parts of a pose source's URL.

    Attributes:
        interface: name or address of the network interface that receives multicast; None if the source
            decides.
    """

    url: str
    host: str
    port: int
    body: str
    interface: str | None = None


class System(NamedTuple):
    """A motion-capture system.

    Attributes:
        url: form of the system's URL, for messages and documentation.
        module: module of this package that reads the system's poses.
        port: default port; None: the URL must give a port.
        multicast: whether the system may send multicast; if so, the URL may name a network interface.
    """

    url: str
    module: str
    port: int | None = None
    multicast: bool = False


# Keys are URL schemes. `sim.motion_capture` emulates each system, and docs/motion_capture.md lists them.
SYSTEMS: Final = {
    "optitrack": System("optitrack://SERVER/BODY", "optitrack", 1510, multicast=True),
    "qualisys": System("qualisys://HOST/BODY", "qualisys", 22223),
    "vicon": System("vicon://ADDRESS:51001/BODY", "vicon", 51001, multicast=True),
    "vrpn": System("vrpn://HOST/BODY", "vrpn", 3883),
    "udp": System("udp://ADDRESS:PORT/BODY", "json_udp", multicast=True),
}
URLS: Final = alternatives(system.url for system in SYSTEMS.values())


def parse_url(url: str) -> tuple[str, PoseAddress]:
    """Return the scheme and the address; raise InputError if the URL does not name a pose source."""
    try:
        parts = urlsplit(url)
        host, port, body = parts.hostname, parts.port, unquote(parts.path).removeprefix("/")
        options = parse_qs(parts.query, strict_parsing=True) if parts.query else {}
    except ValueError as error:
        raise InputError(f"mocap URL {url}: {error}; use {URLS}") from None
    if url in SYSTEMS:
        raise InputError(
            f"mocap URL {url}: only dry-run and simulate accept a bare system name; a real system needs "
            f"{URLS}"
        )
    system = SYSTEMS.get(parts.scheme)
    if system is None or not host or not body or parts.fragment:
        raise InputError(f"mocap URL {url}: use {URLS}")
    (interface,) = options.pop("interface", [None])[-1:]
    if options or (interface is not None and not system.multicast):
        multicast = ", ".join(scheme for scheme, system in SYSTEMS.items() if system.multicast)
        raise InputError(
            f"mocap URL {url}: the only option is ?interface=NAME_OR_ADDRESS, and only for multicast "
            f"({multicast}); escape a ? in the body's name as %3F"
        )
    port = port if port is not None else system.port
    if port is None:
        raise InputError(f"mocap URL {url}: add a port, such as udp://0.0.0.0:9763/{body}")
    return parts.scheme, PoseAddress(url, host, port, body, interface)


def open_source(url: str) -> PoseSource:
    """Open the pose source that a URL names.

    Raises:
        InputError: the URL is wrong, or the vendor's client is not installed.
        AbsentSourceError: the system does not answer or does not stream the body.
    """
    scheme, address = parse_url(url)
    try:
        module = importlib.import_module(f"dart_flight.vehicle.motion_capture.{SYSTEMS[scheme].module}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("dart_flight"):
            raise
        raise missing_package(f"mocap URL {url} needs {error.name}", "mocap") from None
    source: PoseSource = module.open_source(address)
    return source
