"""The interface of a pose source, and the parser of a pose source's URL.

A source reads one body from one motion-capture system and delivers each pose as a `RawPose`, on its own
thread. Each system has one module in this package, and only that module imports the vendor's client.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Final, NamedTuple, Protocol
from urllib.parse import unquote, urlsplit

from dart_flight.base.geometry import IDENTITY, Quaternion, Vec3, quaternion_normalise
from dart_flight.config.document import InputError
from dart_flight.config.packages import missing_package

_EXAMPLES: Final = (
    "use optitrack://SERVER/BODY, qualisys://HOST/BODY, vicon://ADDRESS:51001/BODY, vrpn://HOST/BODY "
    "or udp://ADDRESS:PORT/BODY"
)
_MAX_M: Final = 1000.0  # no room is larger; beyond this the sender's unit is not the metre


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
    """Return the pose of a body that the source does not track at present."""
    return RawPose(body, False, (0.0, 0.0, 0.0), IDENTITY, frame_number, source_us, sender)


def checked_pose(pose: RawPose) -> RawPose | str:
    """Return a pose with its attitude normalised, or the reason why the numbers are not a pose in metres."""
    if not all(abs(coordinate) <= _MAX_M for coordinate in pose.position_room):
        return f"position is not within {_MAX_M:g} m"
    if not 0.9 < math.sqrt(sum(part * part for part in pose.q_body_to_room)) < 1.1:
        return "quaternion is not of length 1"
    return pose._replace(q_body_to_room=quaternion_normalise(pose.q_body_to_room))


class PoseSource(Protocol):
    """A source of poses, as returned by `open_source`."""

    @property
    def problem(self) -> str | None:
        """The reason why no poses of the body arrive, in one line, or None while they arrive."""

    def start(self, deliver: Callable[[RawPose], None]) -> None:
        """Deliver every further pose on a thread of the source."""

    def stop(self) -> None:
        """Stop delivering and close the connection."""


class PoseAddress(NamedTuple):
    """The parts of a pose source's URL."""

    url: str
    host: str
    port: int
    body: str


# scheme: module in this package, default port
_SYSTEMS: Final = {
    "optitrack": ("optitrack", 1510),
    "qualisys": ("qualisys", 22223),
    "vicon": ("vicon", 51001),
    "vrpn": ("vrpn", 3883),
    "udp": ("json_udp", None),
}


def parse_url(url: str) -> tuple[str, PoseAddress]:
    """Return the scheme and the address in a pose source's URL.

    Raises:
        InputError: the URL does not name a pose source.
    """
    try:
        parts = urlsplit(url)
        host, port, body = parts.hostname, parts.port, unquote(parts.path).removeprefix("/")
    except ValueError as error:
        raise InputError(f"mocap URL {url}: {error}; {_EXAMPLES}") from None
    if parts.scheme not in _SYSTEMS or not host or not body or parts.query or parts.fragment:
        raise InputError(f"mocap URL {url}: {_EXAMPLES}")
    port = port if port is not None else _SYSTEMS[parts.scheme][1]
    if port is None:
        raise InputError(f"mocap URL {url}: add a port, such as udp://0.0.0.0:9763/{body}")
    return parts.scheme, PoseAddress(url, host, port, body)


def open_source(url: str) -> PoseSource:
    """Open the pose source that a URL names.

    Raises:
        InputError: the URL is wrong, the vendor's client is not installed, or the system does not answer.
    """
    scheme, address = parse_url(url)
    try:
        module = importlib.import_module(f"dart_flight.vehicle.motion_capture.{_SYSTEMS[scheme][0]}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("dart_flight"):
            raise
        raise missing_package(f"mocap URL {url} needs {error.name}", "mocap") from None
    source: PoseSource = module.open_source(address)
    return source
