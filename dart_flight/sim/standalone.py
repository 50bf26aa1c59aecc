"""The simulated vehicle for another program: no pipe, no truth, until it is stopped."""

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
from dart_flight.config.document import InputError
from dart_flight.config.mission import Mission
from dart_flight.config.vehicle import LockDriver
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint
from dart_flight.sim.served_world import ticks_in_real_time
from dart_flight.sim.simulated_vehicle import SimulatedVehicle
from dart_flight.vehicle.link import LinkLease, LinkTakenError, feed_of, owner_of_udp_port, udp_port_is_free

_OWN_PORT = 40  # of PX4's own, 14580, from the one that it sends to, 14540
_LISTEN_S = 0.4  # a vehicle sends dozens of messages a second


class VehiclePortLease:
    """The right to be the vehicle on a UDP port: nobody else sends there, as far as can be known.

    Another `simulate` or `dry-run --px4` is known by its lease; PX4's own simulator by the port that it has
    of its own, which is bound here, too, so that the later one of the two gives up; any other sender by
    listening, where no program receives on the port yet.

    Args:
        port: to send to.

    Raises:
        LinkTakenError: something sends there already; names it where that is known.
        InputError: the state folder cannot be used.
    """

    def __init__(self, port: int) -> None:
        self.port, self.own_port = port, port + _OWN_PORT if port + _OWN_PORT < 1 << 16 else port - _OWN_PORT
        self._lease = LinkLease(feed_of(port), "simulate")
        try:
            self._lease.acquire()
        except LinkTakenError as error:
            raise self._taken(f": {error.message}") from None
        try:
            if not udp_port_is_free(self.own_port):
                owner = owner_of_udp_port(self.own_port)
                raise self._taken(f", {owner}, from UDP port {self.own_port}; choose another --port")
            heard = _listen(port)
            if heard is not None:
                raise self._taken(f", {heard}; choose another --port")
        except InputError:
            self._lease.release()
            raise

    def _taken(self, by: str) -> LinkTakenError:
        where = f"UDP port {self.port}"
        return LinkTakenError(f"another vehicle already sends to this port{by}", source=where)

    def release(self) -> None:
        """Give it back."""
        self._lease.release()


def _listen(port: int) -> str | None:
    """Which MAVLink arrives at a port that no program has; None: none, or somebody has the port."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        # MAVSDK, too, lets others open its port: a program that starts in this moment is not kept out.
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if not udp_port_is_free(port, "127.0.0.1"):
            return None
        try:
            ear.bind(("127.0.0.1", port))
        except OSError:
            return None
        end = time.monotonic() + _LISTEN_S
        while (left := end - time.monotonic()) > 0.0:
            ear.settimeout(left)
            try:
                data, sender = ear.recvfrom(65536)
            except TimeoutError:
                break
            with contextlib.suppress(mavlink.MAVError, struct.error):
                for message in parser.parse_buffer(data) or []:
                    if message.get_type() != "BAD_DATA":
                        return f"MAVLink system {message.get_srcSystem()} from UDP port {sender[1]}"
    return None


def run_vehicle(
    mission: Mission,
    seed: int,
    ports: tuple[int, ...],
    say: Callable[[str], None],
    own_port: int = 0,
    viewer: Callable[[Record], None] = lambda record: None,
) -> None:
    """Simulate in real time until SIGINT or SIGTERM; `say` takes lines for the terminal.

    `own_port` is the UDP port that it sends to the first of the ports from; 0: any. `viewer` sees what the
    vehicle really does.
    """
    vehicle = SimulatedVehicle(mission, seed, LockDriver.PX4)
    endpoint = MavlinkEndpoint(vehicle.autopilot, ports, own_port)
    to_link = vehicle.autopilot.say
    stopped: list[int] = []

    def tell(severity: str, text: str) -> None:
        to_link(severity, text)
        say(f"{vehicle.autopilot.now_s:8.2f} s  {text}")

    def step() -> None:
        vehicle.advance()
        endpoint.exchange()
        plant = vehicle.autopilot.plant
        viewer(plant.truth())
        while plant.finished:
            hit = plant.finished.pop(0)
            viewer(hit)
            say(
                f"{vehicle.autopilot.now_s:8.2f} s  hit {hit.wall} {hit.mode.value} at "
                f"{hit.normal_in_m_s:.2f} m/s normal, {hit.tangential_in_m_s:.2f} m/s along: "
                f"{hit.peak_normal_force_n:.1f} N"
            )

    vehicle.autopilot.say = tell
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(number, lambda signum, _frame: stopped.append(signum))
    gc.freeze()
    for _ in ticks_in_real_time():
        step()
        if stopped:
            break
    endpoint.close()
