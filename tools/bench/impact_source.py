"""A simulated hovering vehicle with impacts, for `tools.bench.latency`: a MAVLink source in a real-time
process.

    python -m tools.bench.impact_source PORT IMPACTS PERIOD_S

The source sends the telemetry of the embedded autopilot, armed and in offboard mode. Every PERIOD_S seconds
it adds the contact model's force pulse in rigid mode to the IMU samples. At the end it prints one JSON object
with the sending time of every IMU sample and the receiving time of every setpoint, in nanoseconds of the
host's monotonic clock.
"""

from __future__ import annotations

import math
import random
import select
import socket
import sys
import time
from pathlib import Path
from typing import Any

import msgspec

from dart_flight.base.geometry import GRAVITY_M_S2
from dart_flight.base.records import FlightMode, LandedState
from dart_flight.config.mission import load_mission
from dart_flight.sim.embedded_autopilot import TICK_S, TICK_US, ImuReading, make_autopilot
from dart_flight.sim.mavlink_endpoint import MavlinkEndpoint

MISSION = Path(__file__).parents[2] / "missions" / "paper_single_wall.yaml"
POSITION_NED = (1.6, 0.0, -1.0)  # just in front of the mission's acrylic wall
SPEED_M_S = 1.0
_SETTLE_S = 6.0  # time for connecting, setting message rates and starting the app


def free_udp_port() -> int:
    """Return a UDP port on the loopback interface that is currently free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Record(msgspec.Struct):
    """Times on the wire, nanoseconds of the monotonic clock."""

    imu: list[tuple[int, int]]  # (stamp in microseconds, sent)
    setpoints: list[tuple[int, float, float, float]]  # (received, north, east, down)


class _Endpoint(MavlinkEndpoint):
    """An endpoint that records when IMU samples leave and setpoints arrive."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.record = Record([], [])

    def _highres_imu(self) -> Any:
        self.record.imu.append((self.autopilot.imu.t_us, time.monotonic_ns()))
        return super()._highres_imu()

    def _position_target(self, message: Any) -> None:
        self.record.setpoints.append((time.monotonic_ns(), message.x, message.y, message.z))

    def read_until(self, due: float) -> None:
        """Receive messages as they arrive until a time of the monotonic clock."""
        sockets = [link.socket for link in self.links]
        while (left := due - time.monotonic()) > 0.0:
            if select.select(sockets, [], [], left)[0]:
                for link in self.links:
                    self._receive(link)


def pulse_n(t_s: float, k: float, f: float, mass_kg: float) -> float:
    """Return the force, N, at the time `t_s` after the onset of a contact at `SPEED_M_S`.

    The wall has the stiffness k (N/m) and the damping f (N s/m).
    """
    sigma = 0.5 * f / mass_kg
    w = math.sqrt(k / mass_kg - sigma * sigma)
    return (
        max(0.0, k * SPEED_M_S * math.exp(-sigma * t_s) * math.sin(w * t_s) / w) if w * t_s < math.pi else 0.0
    )


def main(port: int, impacts: int, period_s: float) -> int:
    """Run the source and print its record."""
    mission = load_mission(MISSION)
    rng = random.Random(1)
    autopilot = make_autopilot(mission, 1)
    autopilot.armed, autopilot.mode, autopilot.landed = True, FlightMode.OFFBOARD, LandedState.IN_AIR
    hover = mission.vehicle.thrust.command_for(mission.vehicle.airframe.mass_kg * GRAVITY_M_S2 / 4.0)
    autopilot.motors = (hover,) * 4
    e = autopilot.estimator
    e.ok, e.position = True, POSITION_NED
    rigid, mass = mission.vehicle.materials["acrylic"].rigid, mission.vehicle.airframe.mass_kg
    endpoint = _Endpoint(autopilot, (port,))
    due, first = time.monotonic(), time.monotonic() + _SETTLE_S
    next_s, done = _SETTLE_S + rng.uniform(0.0, TICK_S), 0
    start_us = autopilot.time_us
    while done < impacts or autopilot.time_us < start_us + (next_s + 0.5) * 1e6:
        autopilot.plant.time_s += TICK_S
        t_s = (autopilot.time_us - start_us) * 1e-6
        while done < impacts and t_s > next_s + period_s:
            next_s += period_s + rng.uniform(0.0, TICK_S)  # impacts are not synchronised with the ticks
            done += 1
        hit = done < impacts
        force = pulse_n(max(0.0, t_s - next_s), rigid.k, rigid.f, mass) if hit else 0.0
        noise = [rng.gauss(0.0, 0.2) for _ in range(3)]
        autopilot.imu = ImuReading(
            autopilot.time_us // TICK_US * TICK_US,
            (-force / mass + noise[0], noise[1], -GRAVITY_M_S2 + noise[2]),
            (0.0, 0.0, 0.0),
        )
        endpoint.exchange()
        due += TICK_S
        endpoint.read_until(due)
    assert time.monotonic() > first
    sys.stdout.buffer.write(msgspec.json.encode(endpoint.record) + b"\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
