"""The simulated vehicle for other programs, without a pipe to an app. A signal stops it."""

from __future__ import annotations

import contextlib
import gc
import signal
import socket
import struct
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from dart_flight.base.records import Record
from dart_flight.base.signals import StopSignals
from dart_flight.config.document import InputError
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.pose_feed import EmulatedMotionCapture
from dart_flight.sim.served_world import ticks_in_real_time
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from dart_flight.vehicle.link import LinkInUseError, LinkLease, feed_name, owner_of_udp_port, udp_port_is_free

_OWN_PORT = 40  # PX4's own port (14580) minus the port that PX4 sends to (14540)
_LISTEN_S = 0.4  # time to listen; a vehicle sends dozens of messages in this time


class VehiclePortLease:
    """The right to be the only vehicle that sends to a UDP port.

    This class detects most other senders to `port`:

    - Another `simulate` or `dry-run --px4` has a lease of `port`.
    - A PX4 with another simulator has bound `own_port`, the local port from which PX4 sends. The simulated
      vehicle also binds `own_port`. If both start at the same time, only the first that binds `own_port`
      continues.
    - Any other sender is detected by listening on `port`, if no program already receives on `port`.

    Raises:
        LinkInUseError: another program already sends to the port; if known, the message names this program.
    """

    def __init__(self, port: int) -> None:
        self.port, self.own_port = port, port + _OWN_PORT if port + _OWN_PORT < 1 << 16 else port - _OWN_PORT
        self._lease = LinkLease(feed_name(port), "simulate")
        try:
            self._lease.acquire()
        except LinkInUseError as error:
            raise self._taken_error(f": {error.message}") from None
        try:
            if not udp_port_is_free(self.own_port):
                owner = owner_of_udp_port(self.own_port)
                raise self._taken_error(f" from UDP port {self.own_port} ({owner}); choose another --port")
            traffic = _listen(port)
            if traffic is not None:
                raise self._taken_error(f", {traffic}; choose another --port")
        except InputError:
            self._lease.release()
            raise

    def _taken_error(self, by: str) -> LinkInUseError:
        where = f"UDP port {self.port}"
        return LinkInUseError(f"another vehicle already sends to this port{by}", source=where)

    def release(self) -> None:
        self._lease.release()


def _listen(port: int) -> str | None:
    """Describe the MAVLink traffic that arrives at a port. Return None if the port is silent or in use."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        # Share the port, as MAVSDK does, so that a program that starts now can open it.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if not udp_port_is_free(port, "127.0.0.1"):
            return None
        try:
            listener.bind(("127.0.0.1", port))
        except OSError:
            return None
        end = time.monotonic() + _LISTEN_S
        while (left := end - time.monotonic()) > 0.0:
            listener.settimeout(left)
            try:
                data, sender = listener.recvfrom(65536)
            except TimeoutError:
                break
            with contextlib.suppress(mavlink.MAVError, struct.error):
                for message in parser.parse_buffer(data) or []:
                    if message.get_type() != "BAD_DATA":
                        return f"MAVLink system {message.get_srcSystem()} from UDP port {sender[1]}"
    return None


def run_vehicle(
    vehicle: SimulatedVehicle,
    ports: tuple[int, ...],
    print_line: Callable[[str], None],
    own_port: int = 0,
    viewer: Callable[[Record], None] = lambda record: None,
    mocap: EmulatedMotionCapture | None = None,
) -> None:
    """Simulate in real time until SIGINT, SIGTERM or SIGHUP.

    Args:
        ports: remote UDP ports, all of which receive the vehicle's messages.
        own_port: local UDP port from which the vehicle sends to the first remote port; 0 selects any port.
        viewer: receives the true motion and contacts.
        mocap: sends the vehicle's poses.
    """
    endpoint = MavlinkEndpoint(vehicle.autopilot, ports, own_port)
    to_link = vehicle.autopilot.send_text
    stopped: list[signal.Signals] = []

    def report(severity: str, text: str) -> None:
        to_link(severity, text)
        print_line(f"{vehicle.autopilot.now_s:8.2f} s  {text}")

    def step() -> None:
        if mocap is not None:
            mocap.publish(vehicle.autopilot.now_s, vehicle.autopilot.pose)
        vehicle.advance()
        endpoint.exchange()
        plant = vehicle.autopilot.plant
        viewer(plant.truth())
        while plant.finished:
            hit = plant.finished.pop(0)
            viewer(hit)
            print_line(
                f"{vehicle.autopilot.now_s:8.2f} s  hit {hit.wall} {hit.mode.value} at "
                f"{hit.normal_in_m_s:.2f} m/s normal, {hit.tangential_in_m_s:.2f} m/s tangential: "
                f"{hit.peak_normal_force_n:.1f} N"
            )

    vehicle.autopilot.send_text = report
    gc.freeze()
    with StopSignals(stopped.append):
        for _ in ticks_in_real_time():
            step()
            if stopped:
                break
    endpoint.close()
