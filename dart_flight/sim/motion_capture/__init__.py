"""Emulated motion-capture servers: they speak the vendors' protocols on loopback.

The servers have no clock: the caller publishes each pose when the pose is due in simulated time.
"""

from __future__ import annotations

import importlib
from typing import Final, Protocol

from dart_flight.base.geometry import Quaternion, Vec3

BODY: Final = "dart"  # name of the simulated vehicle's marker body
KINDS: Final = {
    "optitrack": ("natnet_server", "NatNetServer"),
    "qualisys": ("qtm_server", "QtmServer"),
    "vicon": ("vicon_sender", "ViconSender"),
    "vrpn": ("vrpn_server", "VrpnServer"),
    "udp": ("json_sender", "JsonSender"),
}


class PoseServer(Protocol):
    """An emulated motion-capture system that tracks one body."""

    @property
    def url(self) -> str:
        """The URL of the pose source that this server feeds."""

    @property
    def clients(self) -> int:
        """Number of programs that listen."""

    def publish(
        self, t_us: int, position_room: Vec3, q_body_to_room: Quaternion, tracked: bool = True
    ) -> None:
        """Send one frame with the body's pose; `t_us` is the server's time stamp."""

    def close(self) -> None:
        """Disconnect every client and free the ports."""


def make_server(kind: str, body: str) -> PoseServer:
    """Start an emulated server that tracks `body`; `kind` is a key of `KINDS`."""
    file, name = KINDS[kind]
    module = importlib.import_module(f"dart_flight.sim.motion_capture.{file}")
    server: PoseServer = getattr(module, name)(body)
    return server
